"""Other libraries on the problem that FISTA solves here: PyLops, SigPy, SPGL1, scikit-learn.

Each gets the project's operator as its own kind of linear operator.
"""

from __future__ import annotations

import contextlib
import io
from abc import ABC, abstractmethod
from importlib.util import find_spec
from typing import Any

import numpy as np

from sparseskin.nodes.reconstructor.fista import FistaSolver

from .scene_frames import Floats
from .speed_problem import Bpdn


class Peer(ABC):
    """A solver of the problem, from 0, made ready for it.

    Parameters
    ----------
    problem : Bpdn
    best : ndarray of float32, shape (n,)
        The solution, for what a peer has to be told of it.
    """

    #: Whether it stops by itself, whatever number of iterations it is given.
    stops_by_itself = False

    def __init__(self, problem: Bpdn, best: Floats) -> None:
        self.problem = problem

    @abstractmethod
    def solve(self, y: Floats, iterations: int) -> Any:
        """Solve, with so many iterations; what is timed."""

    def theta(self, solved: Any) -> Floats:
        """Coefficients of what `solve` returned, float32, shape (n,)."""
        theta: Floats = np.asarray(solved, dtype=np.float32)
        return theta


class Ours(Peer):
    """The project's own FISTA; it is given no warm start here either."""

    def __init__(self, problem: Bpdn, best: Floats) -> None:
        super().__init__(problem, best)
        self._solvers: dict[int, FistaSolver] = {}

    def solve(self, y: Floats, iterations: int) -> FistaSolver:
        if iterations not in self._solvers:
            self._solvers[iterations] = self.problem.fista(iterations)
        solver = self._solvers[iterations]
        solver.reset()
        solver.solve(y)
        return solver

    def theta(self, solved: FistaSolver) -> Floats:
        return solved.theta.reshape(-1)


class PyLopsFista(Peer):
    """FISTA of PyLops, whose l1 norm weighs half its eps."""

    def __init__(self, problem: Bpdn, best: Floats) -> None:
        super().__init__(problem, best)
        from pylops import LinearOperator
        from pylops.optimization.sparsity import fista

        class Operator(LinearOperator):  # type: ignore[misc, unused-ignore]
            def _matvec(self, x: Any) -> Any:
                return problem.forward(x)

            def _rmatvec(self, x: Any) -> Any:
                return problem.adjoint(x)

        self._fista = fista
        self._operator = Operator(dtype=np.dtype(np.float32), shape=(problem.m, problem.n))
        self._settings = {"eps": 2 * problem.lambda_n, "alpha": 1.0, "tol": 0, "preallocate": True}

    def solve(self, y: Floats, iterations: int) -> Any:
        return self._fista(self._operator, y, niter=iterations, **self._settings)[0]


class SigPyFista(Peer):
    """Accelerated proximal gradient of SigPy."""

    def __init__(self, problem: Bpdn, best: Floats) -> None:
        super().__init__(problem, best)
        import sigpy

        class Operator(sigpy.linop.Linop):  # type: ignore[misc, unused-ignore]
            def __init__(self, forward: Any, adjoint: Any, shape: tuple[int, int]) -> None:
                self._forward, self._backward = forward, adjoint
                super().__init__([shape[0]], [shape[1]])

            def _apply(self, x: Any) -> Any:
                return self._forward(x)

            def _adjoint_linop(self) -> Any:
                shape = (self.ishape[0], self.oshape[0])
                return Operator(self._backward, self._forward, shape)

        self._app = sigpy.app.LinearLeastSquares
        self._operator = Operator(problem.forward, problem.adjoint, (problem.m, problem.n))
        self._settings = {
            "proxg": sigpy.prox.L1Reg([problem.n], problem.lambda_n),
            **{"alpha": 1.0, "show_pbar": False},
        }

    def solve(self, y: Floats, iterations: int) -> Any:
        return self._app(self._operator, y, max_iter=iterations, **self._settings).run()


class Spgl1Lasso(Peer):
    """SPGL1 on the same problem with a bound on the l1 norm, told the bound that makes it so."""

    def __init__(self, problem: Bpdn, best: Floats) -> None:
        super().__init__(problem, best)
        from scipy.sparse.linalg import LinearOperator
        from spgl1 import spg_lasso

        self._lasso = spg_lasso
        self._operator = LinearOperator(
            (problem.m, problem.n),
            matvec=problem.forward,
            rmatvec=problem.adjoint,
            dtype=np.float32,
        )
        self._bound_n = float(np.abs(best, dtype=np.float64).sum())

    def solve(self, y: Floats, iterations: int) -> Any:
        # It prints that a search was cut short, as all are here, however quiet it is told to be.
        with contextlib.redirect_stdout(io.StringIO()):
            found = self._lasso(self._operator, y, self._bound_n, iter_lim=iterations, verbosity=0)
        return found[0]


class SklearnOmp(Peer):
    """Orthogonal matching pursuit of scikit-learn, which takes nothing but a dense matrix.

    It minimises another objective; it stops at the residual that the solution has.
    """

    stops_by_itself = True

    def __init__(self, problem: Bpdn, best: Floats) -> None:
        super().__init__(problem, best)
        from sklearn.linear_model import orthogonal_mp

        self._omp = orthogonal_mp
        self._matrix = problem.dense()
        self._best = best

    def solve(self, y: Floats, iterations: int) -> Any:
        misfit = self.problem.forward(self._best).astype(np.float64) - y
        return self._omp(self._matrix, y.astype(np.float64), tol=float(misfit @ misfit))


OURS = "sparseskin FISTA"
PEERS: dict[str, tuple[str, type[Peer]]] = {
    OURS: ("sparseskin", Ours),
    "PyLops FISTA": ("pylops", PyLopsFista),
    "SigPy FISTA": ("sigpy", SigPyFista),
    "SPGL1": ("spgl1", Spgl1Lasso),
    "scikit-learn OMP": ("sklearn", SklearnOmp),
}


def missing_peers() -> list[str]:
    """Names of peers whose library is not installed."""
    return [name for name, (module, _) in PEERS.items() if find_spec(module) is None]
