"""An executor of your own: the processes of an MPI job, with mpi4py.

mpiexec -n 5 python -m mpi4py.futures -m sparseskin.launch.commands.entry \\
    reprocess day*.mcap --out results --executor mpi_pool:pool
mpiexec -n 3 python -m mpi4py.futures examples/mpi_pool.py           # by itself

One process hands out the work, the others (4, and 2) do it. The same goes for `study`.
"""

import sys

import numpy as np

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.tasks import make_executor


def pool():
    """All processes of this job but the first."""
    from mpi4py.futures import MPIPoolExecutor

    return MPIPoolExecutor()


def worker(k: int) -> tuple[int, float]:
    """A stand-in for work: number of the process, and a figure."""
    from mpi4py import MPI

    matrix = np.random.default_rng(k).normal(size=(64, 64))
    return MPI.COMM_WORLD.Get_rank(), float(np.linalg.norm(matrix))


def main() -> None:
    with make_executor("mpi_pool:pool") as executor:
        results = list(executor.map(worker, range(8)))
    ranks = sorted({rank for rank, _ in results})
    norm = np.mean([x for _, x in results])
    print(f"{len(results)} tasks on processes {ranks}, mean norm {norm:.1f}")


if __name__ == "__main__":
    try:
        main()
    except SettingsError as error:
        # The line names the package that is not installed.
        sys.exit(str(error))
