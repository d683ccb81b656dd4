"""Other libraries: SigPy, pyproximal, PyLops, SPGL1 on the problem that FISTA solves here; total
variation.

Each gets the project's operator as its own kind of linear operator.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.studies.evaluate import VALUE_BYTES, Solved


class Bpdn:
    """min over theta of 1/2 ||A theta - y||^2 + lambda ||theta||_1, A = Phi Psi, ||A|| = 1.

    A, m x n, is the project's own operators, on a grid of which every cell is a taxel. `lambda_n`:
    lambda in newtons, for orthonormal rows; `sigma_n`: standard deviation of the noise of a
    measurement, newtons, for a library that bounds the residual in place of weighing it.
    """

    def __init__(
        self, phi: Phi, basis: Basis, lambda_n: float, sigma_n: float = 0.0
    ) -> None:
        self.phi = phi
        self.basis = basis
        self.lambda_n = lambda_n
        self.sigma_n = sigma_n
        self.grid = (basis.n_rows, basis.n_cols)

    def forward(self, theta: Any) -> Floats:
        """A theta: shape (n,) to (m,)."""
        image = self.basis.synthesis(theta.reshape(self.grid))
        return self.phi.forward(image.reshape(-1))

    def adjoint(self, y: Any) -> Floats:
        """A^T y: shape (m,) to (n,)."""
        image = self.phi.adjoint(y).reshape(self.grid)
        return self.basis.analysis(image).reshape(-1)

    def objective(self, theta: Any, y: Floats) -> float:
        """The value that is minimised, in newtons squared (theta in newtons)."""
        residual = self.forward(theta).astype(np.float64) - y
        l1 = np.abs(theta, dtype=np.float64).sum()
        return float(0.5 * residual @ residual + self.lambda_n * l1)

    def image(self, theta: Any) -> Floats:
        """Forces that belong to theta, negative ones set to 0: shape (n_rows, n_cols)."""
        return np.maximum(self.basis.synthesis(theta.reshape(self.grid)), 0)


#: Coefficients for measurements (m,), from coefficients to begin at (n,), with so many iterations.
Solve: TypeAlias = Callable[[Floats, Floats, int], Any]


class Peer(NamedTuple):
    """A solver of the problem: module that has to be installed, and what makes it of a problem."""

    module: str
    make: Callable[[Bpdn], Solve]


def _pylops_operator(problem: Bpdn) -> Any:
    """A as a linear operator of PyLops."""
    from pylops import LinearOperator

    class Operator(LinearOperator):  # type: ignore[misc, unused-ignore]
        def _matvec(self, x: Any) -> Any:
            return problem.forward(x)

        def _rmatvec(self, x: Any) -> Any:
            return problem.adjoint(x)

    shape = (problem.phi.m, problem.phi.n)
    return Operator(dtype=np.dtype(np.float32), shape=shape)


def _pylops(problem: Bpdn) -> Solve:
    """FISTA of PyLops, whose l1 norm weighs half its eps."""
    from pylops.optimization.sparsity import fista

    operator = _pylops_operator(problem)
    settings: dict[str, Any] = {"eps": 2 * problem.lambda_n, "alpha": 1.0}
    # A tolerance of 0: all iterations are made, as by the others.
    settings |= {"tol": 0, "preallocate": True}

    def solve(y: Floats, start: Floats, iterations: int) -> Any:
        theta, *_ = fista(
            operator,
            y,
            x0=start,
            niter=iterations,
            **settings,
        )
        return theta

    return solve


def _pyproximal(problem: Bpdn) -> Solve:
    """Proximal gradient of pyproximal, accelerated as FISTA is."""
    from pyproximal import L1, L2
    from pyproximal.optimization.primal import ProximalGradient

    operator = _pylops_operator(problem)
    l1 = L1(sigma=problem.lambda_n)
    settings = {"tau": 1.0, "acceleration": "fista"}

    def solve(y: Floats, start: Floats, iterations: int) -> Any:
        distance = L2(Op=operator, b=y)
        return ProximalGradient(
            distance,
            l1,
            x0=start,
            niter=iterations,
            **settings,
        )

    return solve


def _sigpy(problem: Bpdn) -> Solve:
    """Accelerated proximal gradient of SigPy."""
    import sigpy

    n = problem.phi.n
    m = problem.phi.m
    operator = _sigpy_operator(problem.forward, problem.adjoint, (n,), (m,))
    proximal = sigpy.prox.L1Reg([n], problem.lambda_n)
    settings = {
        "proxg": proximal,
        "alpha": 1.0,
        "show_pbar": False,
    }

    def solve(y: Floats, start: Floats, iterations: int) -> Any:
        of_call = {"x": start.copy(), "max_iter": iterations}
        # Its soft threshold divides 0 by 0.
        with np.errstate(invalid="ignore"):
            solver = sigpy.app.LinearLeastSquares(operator, y, **of_call, **settings)
            return solver.run()

    return solve


def _spgl1(problem: Bpdn) -> Solve:
    """SPGL1 on the equal problem with a bound on the norm of the residual: that of the noise."""
    from scipy.sparse.linalg import LinearOperator
    from spgl1 import spgl1

    m = problem.phi.m
    products = {"matvec": problem.forward, "rmatvec": problem.adjoint}
    operator = LinearOperator((m, problem.phi.n), dtype=np.float32, **products)
    bound_n = problem.sigma_n * math.sqrt(m)
    # It warns of each frame that noise alone explains, whose solution is 0.
    logging.getLogger("spgl1").setLevel(logging.ERROR)

    def solve(y: Floats, start: Floats, iterations: int) -> Any:
        settings = {
            "x0": start,
            "iter_lim": iterations,
            "verbosity": 0,
        }
        # It prints that a search was cut short, as all are here, whatever its verbosity.
        with contextlib.redirect_stdout(io.StringIO()):
            theta, *_ = spgl1(operator, y, sigma=bound_n, **settings)
        return theta

    return solve


class Library:
    """Estimator: a library of `PEERS` on a stream, as its user would run it. A constant number of
    iterations per frame; each frame begins at the coefficients of the last one.
    """

    def __init__(self, name: str, problem: Bpdn, iterations: int) -> None:
        self._problem = problem
        self._iterations = iterations
        self._solve = PEERS[name].make(problem)
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._theta = np.zeros(self._problem.phi.n, dtype=np.float32)

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`; timed is the call of the library and the image of its coefficients."""
        y = self._problem.phi.forward(taxels.reshape(-1))

        begin_s = time.perf_counter()
        begin_cpu_s = time.thread_time()
        theta = self._solve(y, self._theta, self._iterations)
        self._theta = np.asarray(theta, dtype=np.float32)
        forces = self._problem.image(self._theta)
        cpu_s = time.thread_time() - begin_cpu_s
        wall_s = time.perf_counter() - begin_s
        return Solved(forces, wall_s, cpu_s, self._iterations, VALUE_BYTES * y.size)


class TotalVariation:
    """Estimator: min over x of 1/2 ||Phi x - y||^2 + w (|D_row x|_1 + |D_col x|_1), by the
    primal-dual method of SigPy, each frame by itself; negative forces are set to 0.

    `weight` is w in newtons, for orthonormal rows; `mask` as in `Solver`.
    """

    def __init__(self, phi: Phi, mask: Mask, weight: float, iterations: int) -> None:
        import sigpy

        self._phi = phi
        self._mask = mask
        self._flat = np.flatnonzero(mask)
        differences = sigpy.linop.FiniteDifference(list(mask.shape))
        proximal = sigpy.prox.L1Reg(differences.oshape, weight)
        self._settings = {
            "G": differences,
            "proxg": proximal,
            "max_iter": iterations,
        }
        self._operator = _sigpy_operator(
            self._measurements, self._image, mask.shape, (phi.m,)
        )

    def _measurements(self, x: Any) -> Floats:
        forces = x.reshape(-1)[self._flat]
        return self._phi.forward(forces)

    def _image(self, y: Any) -> Floats:
        image = np.zeros(self._mask.shape, dtype=np.float32)
        measurements = np.asarray(y, dtype=np.float32)
        image.reshape(-1)[self._flat] = self._phi.adjoint(measurements)
        return image

    def reconstruct(self, taxels: Floats) -> Solved:
        """See `Estimator`."""
        import sigpy

        y = self._phi.forward(taxels[self._mask])
        begin = time.perf_counter()
        # Its soft threshold divides 0 by 0.
        with np.errstate(invalid="ignore"):
            solver = sigpy.app.LinearLeastSquares(
                self._operator, y, show_pbar=False, **self._settings
            )
            x = solver.run()
        forces = np.where(self._mask, np.maximum(x, 0), 0)
        wall_s = time.perf_counter() - begin
        return Solved(forces.astype(np.float32), wall_s=wall_s)


def _sigpy_operator(
    forward: Any, adjoint: Any, shape: Sequence[int], out: Sequence[int]
) -> Any:
    """A linear operator of SigPy."""
    import sigpy

    class Operator(sigpy.linop.Linop):  # type: ignore[misc, unused-ignore]
        def __init__(
            self, forward: Any, adjoint: Any, shape: Sequence[int], out: Sequence[int]
        ) -> None:
            self._forward = forward
            self._backward = adjoint
            super().__init__(list(out), list(shape))

        def _apply(self, x: Any) -> Any:
            return self._forward(x)

        def _adjoint_linop(self) -> Any:
            return Operator(self._backward, self._forward, self.oshape, self.ishape)

    return Operator(forward, adjoint, shape, out)


PEERS = {
    "SigPy": Peer("sigpy", _sigpy),
    "pyproximal": Peer("pyproximal", _pyproximal),
    "PyLops": Peer("pylops", _pylops),
    "SPGL1": Peer("spgl1", _spgl1),
}
