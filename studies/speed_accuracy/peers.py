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

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.reconstructor.bases.base import Basis, make_basis
from sparseskin.nodes.reconstructor.solvers.base import MAX_ITERATIONS
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver


class Bpdn:
    """min over theta of 1/2 ||A theta - y||^2 + lambda ||theta||_1, A = Phi Psi.

    A is the project's own operators, for Haar and SBHE: ||A|| = 1.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the grid, every cell a taxel.
    ratio : int
        N / M.
    seed : int
        Of Phi.
    lambda_n : float
        In newtons, for orthonormal rows.

    Attributes
    ----------
    n, m : int
        A is m x n.
    """

    def __init__(self, shape: tuple[int, int], ratio: int, seed: int, lambda_n: float) -> None:
        self.grid = shape
        self.n = shape[0] * shape[1]
        self.m = self.n // ratio
        self.lambda_n = lambda_n
        self.phi: Phi = make_phi("sbhe", n=self.n, m=self.m, seed=seed)
        self.basis: Basis = make_basis("haar", *shape)

    def forward(self, theta: Any) -> Floats:
        """A theta: shape (n,) to (m,)."""
        return self.phi.forward(self.basis.synthesis(theta.reshape(self.grid)).reshape(-1))

    def adjoint(self, y: Any) -> Floats:
        """A^T y: shape (m,) to (n,)."""
        return self.basis.analysis(self.phi.adjoint(y).reshape(self.grid)).reshape(-1)

    def dense(self) -> Doubles:
        """A as a matrix, float64, shape (m, n)."""
        rows = np.eye(self.m, dtype=np.float32)
        return np.stack([self.adjoint(row) for row in rows]).astype(np.float64)

    def objective(self, theta: Any, y: Floats) -> float:
        """The value that is minimised, in newtons squared (theta in newtons)."""
        residual = self.forward(theta).astype(np.float64) - y
        l1 = np.abs(theta, dtype=np.float64).sum()
        return float(0.5 * residual @ residual + self.lambda_n * l1)

    def image(self, theta: Any) -> Floats:
        """Forces that belong to theta, negative ones set to 0: shape (n_rows, n_cols)."""
        return np.maximum(self.basis.synthesis(theta.reshape(self.grid)), 0)

    def fista(self, iterations: int) -> FistaSolver:
        """The project's FISTA for this problem."""
        return FistaSolver(self.phi, self.basis, iterations=iterations, lambda_n=self.lambda_n)

    def solution(self, y: Floats) -> Floats:
        """Theta after 1000 iterations, shape (n,): as good as the minimum."""
        solver = self.fista(MAX_ITERATIONS)
        solver.solve(y)
        return solver.theta.reshape(-1)


class Peer(ABC):
    """Solver of the problem, from 0.

    Parameters
    ----------
    problem : Bpdn
    best : ndarray of float32, shape (n,)
        The solution, for peers that need something of it.
    """

    #: True if it stops by itself, whatever number of iterations it is given.
    stops_by_itself = False

    def __init__(self, problem: Bpdn, best: Floats) -> None:
        self.problem = problem

    @abstractmethod
    def solve(self, y: Floats, iterations: int) -> Any:
        """Solve with so many iterations; this is timed."""

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
    """SPGL1 on the same problem with a bound on the l1 norm, with the bound of its solution."""

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
        # It prints that a search was cut short, as all are here, whatever its verbosity.
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
        residual = self.problem.forward(self._best).astype(np.float64) - y
        return self._omp(self._matrix, y.astype(np.float64), tol=float(residual @ residual))


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
