"""An executor of your own: the workers of a Dask cluster, on which the same packages are installed.

dask scheduler --port 8786                                     # on one machine
dask worker tcp://10.0.0.1:8786 --nworkers -1 --nthreads 1     # on each
DASK_SCHEDULER_ADDRESS=tcp://10.0.0.1:8786 \\
    sparseskin reprocess day*.mcap --out results --executor dask_pool:pool

Who reaches the scheduler has code run by its workers, and who controls it runs code in this
process: results come as pickles. Keep it on a network of your own, or use tls://.
"""


def pool():
    """All workers of the cluster at DASK_SCHEDULER_ADDRESS."""
    from distributed import Client

    return Client().get_executor(pure=False)
