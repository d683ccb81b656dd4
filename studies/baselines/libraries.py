"""Other libraries: on the problem that FISTA solves here PyLops, SigPy, SPGL1; total variation.

Each gets the project's operator as its own kind of linear operator.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sparseskin.nodes.compressor.phi.base import RANDOM, Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import PAPER_BLOCK
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis, make_basis
from sparseskin.nodes.reconstructor.solvers.base import MAX_ITERATIONS
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.studies.evaluate import Solved


class Bpdn:
    """min over theta of 1/2 ||A theta - y||^2 + lambda ||theta||_1, A = Phi Psi, ||A|| = 1.

    A, m x n, is the project's own operators, for Haar and SBHE, on a grid of which every cell is a
    taxel, at N / M = `ratio`; `lambda_n` is in newtons, for orthonormal rows.
    """

    def __init__(self, shape: tuple[int, int], ratio: int, seed: int, lambda_n: float) -> None:
        self.grid = shape
        self.n = shape[0] * shape[1]
        self.m = self.n // ratio
        self.lambda_n = lambda_n
        self.phi: Phi = make_phi("sbhe", self.n, self.m, seed, PAPER_BLOCK, RANDOM)
        self.basis: Basis = make_basis("haar", *shape)

    def forward(self, theta: Any) -> Floats:
        """A theta: shape (n,) to (m,)."""
        return self.phi.forward(self.basis.synthesis(theta.reshape(self.grid)).reshape(-1))

    def adjoint(self, y: Any) -> Floats:
        """A^T y: shape (m,) to (n,)."""
        return self.basis.analysis(self.phi.adjoint(y).reshape(self.grid)).reshape(-1)

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


#: Solution from 0 for measurements with so many iterations, the call that is timed: an array of n
#: coefficients.
Solve: TypeAlias = Callable[[Floats, int], Any]


class Peer(NamedTuple):
    """A solver of the problem: module that has to be installed; what makes it of a problem and its
    solution.
    """

    module: str
    make: Callable[[Bpdn, Floats], Solve]


def _ours(problem: Bpdn, best: Floats) -> Solve:
    """The project's own FISTA; it is given no warm start here either."""
    solver_of = cache(problem.fista)

    def solve(y: Floats, iterations: int) -> Any:
        solver = solver_of(iterations)
        solver.reset()
        solver.solve(y)
        return solver.theta.reshape(-1)

    return solve


def _pylops(problem: Bpdn, best: Floats) -> Solve:
    """FISTA of PyLops, whose l1 norm weighs half its eps."""
    from pylops import LinearOperator
    from pylops.optimization.sparsity import fista

    class Operator(LinearOperator):  # type: ignore[misc, unused-ignore]
        def _matvec(self, x: Any) -> Any:
            return problem.forward(x)

        def _rmatvec(self, x: Any) -> Any:
            return problem.adjoint(x)

    operator = Operator(dtype=np.dtype(np.float32), shape=(problem.m, problem.n))
    settings = {"eps": 2 * problem.lambda_n, "alpha": 1.0, "tol": 0, "preallocate": True}
    return lambda y, iterations: fista(operator, y, niter=iterations, **settings)[0]


def _sigpy(problem: Bpdn, best: Floats) -> Solve:
    """Accelerated proximal gradient of SigPy."""
    import sigpy

    operator = _sigpy_operator(problem.forward, problem.adjoint, (problem.n,), (problem.m,))
    proximal = sigpy.prox.L1Reg([problem.n], problem.lambda_n)
    settings = {"proxg": proximal, "alpha": 1.0, "show_pbar": False}

    def solve(y: Floats, iterations: int) -> Any:
        return sigpy.app.LinearLeastSquares(operator, y, max_iter=iterations, **settings).run()

    return solve


def _spgl1(problem: Bpdn, best: Floats) -> Solve:
    """SPGL1 on the same problem with a bound on the l1 norm, with the bound of its solution."""
    from scipy.sparse.linalg import LinearOperator
    from spgl1 import spg_lasso

    shape, both = (problem.m, problem.n), {"matvec": problem.forward, "rmatvec": problem.adjoint}
    operator = LinearOperator(shape, dtype=np.float32, **both)
    bound_n = float(np.abs(best, dtype=np.float64).sum())

    def solve(y: Floats, iterations: int) -> Any:
        # It prints that a search was cut short, as all are here, whatever its verbosity.
        with contextlib.redirect_stdout(io.StringIO()):
            return spg_lasso(operator, y, bound_n, iter_lim=iterations, verbosity=0)[0]

    return solve


class TotalVariation:
    """Estimator: min over x of 1/2 ||Phi x - y||^2 + w (|D_row x|_1 + |D_col x|_1), by the
    primal-dual method of SigPy, each frame by itself; negative forces are set to 0.

    `weight` is w in newtons, for orthonormal rows; `mask` as in `Solver`.
    """

    def __init__(self, phi: Phi, mask: Mask, weight: float, iterations: int) -> None:
        import sigpy

        self._phi, self._mask = phi, mask
        self._flat = np.flatnonzero(mask)
        differences = sigpy.linop.FiniteDifference(list(mask.shape))
        proximal = sigpy.prox.L1Reg(differences.oshape, weight)
        self._settings = {"G": differences, "proxg": proximal, "max_iter": iterations}
        self._operator = _sigpy_operator(
            lambda x: phi.forward(x.reshape(-1)[self._flat]), self._image, mask.shape, (phi.m,)
        )

    def _image(self, y: Any) -> Floats:
        image = np.zeros(self._mask.shape, dtype=np.float32)
        image.reshape(-1)[self._flat] = self._phi.adjoint(np.asarray(y, dtype=np.float32))
        return image

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        import sigpy

        y = self._phi.forward(taxels[self._mask])
        begin = time.perf_counter()
        with np.errstate(invalid="ignore"):  # its soft threshold divides 0 by 0
            solver = sigpy.app.LinearLeastSquares
            x = solver(self._operator, y, show_pbar=False, **self._settings).run()
        forces = np.where(self._mask, np.maximum(x, 0), 0).astype(np.float32)
        return Solved(forces, wall_s=time.perf_counter() - begin)


def _sigpy_operator(forward: Any, adjoint: Any, shape: Sequence[int], out: Sequence[int]) -> Any:
    """A linear operator of SigPy."""
    import sigpy

    class Operator(sigpy.linop.Linop):  # type: ignore[misc, unused-ignore]
        def __init__(
            self, forward: Any, adjoint: Any, shape: Sequence[int], out: Sequence[int]
        ) -> None:
            self._forward, self._backward = forward, adjoint
            super().__init__(list(out), list(shape))

        def _apply(self, x: Any) -> Any:
            return self._forward(x)

        def _adjoint_linop(self) -> Any:
            return Operator(self._backward, self._forward, self.oshape, self.ishape)

    return Operator(forward, adjoint, shape, out)


OURS = "sparseskin FISTA"
PEERS = {
    OURS: Peer("sparseskin", _ours),
    "PyLops FISTA": Peer("pylops", _pylops),
    "SigPy FISTA": Peer("sigpy", _sigpy),
    "SPGL1": Peer("spgl1", _spgl1),
}
