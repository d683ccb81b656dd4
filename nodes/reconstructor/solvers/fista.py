"""FISTA for basis pursuit denoising, the paper's method."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi, block_layout
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.numerics.compiled import use_compiled
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis

from .base import MAX_ITERATIONS, Solver, newtons, whole_number

if TYPE_CHECKING:
    from .fast import CompiledFista


class Fista:
    """The iterations of FISTA on basis pursuit denoising, for any phi and any basis.

    With A = Phi R Psi and R the restriction to the existing taxels,

        min over theta of  1/2 ||A theta - y||_2^2 + lambda ||theta||_1

    From z_1 = theta_0 and t_1 = 1, for k = 1, 2, ...:

        u_k       = z_k + 1/L A^T (y - A z_k)                    (gradient step)
        theta_k   = sign(u_k) max(0, |u_k| - lambda / L)         (soft threshold)
        t_{k+1}   = (1 + sqrt(1 + 4 t_k^2)) / 2
        z_{k+1}   = theta_k + (t_k - 1) / t_{k+1} (theta_k - theta_{k-1})      (momentum)

    with the constant step 1/L, L >= the largest eigenvalue of A A^T. Compiled loops are tested
    against this class, and this class against the equations with a dense matrix.

    Parameters
    ----------
    phi, basis, lambda_n
        As in `FistaSolver`.
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    """

    def __init__(self, phi: Phi, basis: Basis, mask: Mask, lambda_n: float) -> None:
        self._phi = phi
        self._basis = basis
        self._taxels = np.flatnonzero(mask)
        self._shape = mask.shape
        self._step = np.float32(1 / phi.lipschitz)
        self._limit = np.float32(lambda_n / phi.lipschitz)
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._theta = np.zeros(self._shape, dtype=np.float32)
        self._before = self._theta

    def begin(self, y: Floats, warm: Floats | None) -> None:
        """Begin a frame of measurements, float32 (m,).

        It starts from an image, float32 (n_rows, n_cols); None: from the last frame's theta.
        """
        if warm is not None:
            self._theta = self._basis.analysis(warm)
        self._before = self._theta
        self._y = y.copy()

    def advance(self, betas: Floats) -> None:
        """Do an iteration for each of the momenta betas, float32 (k,)."""
        for beta in betas:
            z = self._theta + beta * (self._theta - self._before)
            residual = self._y - self._forward(z)
            u = z + self._step * self._adjoint(residual)
            self._before = self._theta
            # The soft threshold: what is clipped away.
            self._theta = u - np.clip(u, -self._limit, self._limit)

    def image(self) -> Floats:
        """Return Psi theta, float32 (n_rows, n_cols), newtons."""
        return self._basis.synthesis(self._theta)

    def _forward(self, theta: Floats) -> Floats:
        """A theta."""
        image = self._basis.synthesis(theta)
        return self._phi.forward(image.reshape(-1)[self._taxels])

    def _adjoint(self, residual: Floats) -> Floats:
        """A^T residual."""
        image = np.zeros(self._shape, dtype=np.float32)
        image.reshape(-1)[self._taxels] = self._phi.adjoint(residual)
        return self._basis.analysis(image)


def momenta(iterations: int) -> list[float]:
    """Return the momentum (t_k - 1) / t_(k+1) that each iteration begins with: 0, 0, 0.28, ..."""
    betas = [0.0]
    t = 1.0
    while len(betas) < iterations:
        t_next = (1 + math.sqrt(1 + 4 * t * t)) / 2
        betas.append((t - 1) / t_next)
        t = t_next
    return betas


class FistaSolver(Solver):
    """Basis pursuit denoising by `Fista`, frame after frame.

    A constant number of iterations of step 1/L, L = `phi.lipschitz`. A frame starts from the
    theta of the last one, the first from 0; the momentum starts anew with each frame. Negative
    forces of the final image are set to 0, which is not carried to the next frame.

    The same measurements give the same bits on one machine with one number of BLAS threads; with
    any number of these, where `phi` is "sbhe" and the grid is of 64 x 64 taxels or fewer.

    Parameters
    ----------
    phi, basis, mask
        As in `Solver`.
    iterations : int
        1..1000. The paper: 10, 20 or 30.
    lambda_n : float
        Weight of the l1 norm, newtons, at least 0. It belongs to the scale of Phi: the paper's
        0.1 is for rows of +1 and -1, of length sqrt(32). Measurements by orthonormal rows are
        sqrt(32) times smaller, the squared residual 32 times, and so is the lambda of the same
        problem: 0.1 / 32 = 0.003125 N.
    fast : str
        Use of compiled loops, for "sbhe" and "haar": "auto" (where numba is installed), "on" or
        "off". The forces are the same to within 1e-5 N.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: the paper, sections IV-C and V-A; Beck, Teboulle, "A fast iterative
    shrinkage-thresholding algorithm for linear inverse problems", SIAM J. Imaging Sciences 2(1),
    2009, section 4, FISTA with constant step size.
    """

    name = "fista"
    is_l1 = True
    lambdas_n = (0.0006, 0.015)
    least_iterations = 15
    has_loops = True
    calibrated = (1.33, 0.4)

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 30,
        lambda_n: float = 0.1 / 32,
        fast: str = "auto",
    ) -> None:
        super().__init__(phi, basis, mask)
        self.iterations = whole_number(
            "fista", "iterations", iterations, 1, MAX_ITERATIONS
        )
        self.lambda_n = newtons("fista", "lambda_n", lambda_n)
        self.n_steps = self.iterations
        self._momenta = np.array(momenta(self.iterations), dtype=np.float32)
        self._fista: Fista | CompiledFista
        # A subclass may have changed what the operators do.
        layout = block_layout(phi)
        is_of_blocks = layout is not None and layout.blocks is not None
        if use_compiled(fast) and is_of_blocks and type(basis) is HaarBasis:
            from .fast import CompiledFista  # needs numba

            assert layout is not None
            self._fista = CompiledFista(layout, basis, self.mask, self.lambda_n)
        else:
            self._fista = Fista(phi, basis, self.mask, self.lambda_n)

    @property
    def theta(self) -> Floats:
        """Coefficients that the next frame starts from, float32 (n_rows, n_cols), newtons."""
        return self.basis.analysis(self._fista.image())

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._checked_y(y)
        if warm is not None:
            warm = self._checked_warm(warm)
        self._fista.begin(y, warm)
        self._steps_left = self.n_steps

    def solve(self, y: Floats, warm: Floats | None = None) -> Floats:
        # A step of the user's own has to be called.
        if type(self).step is not FistaSolver.step:
            return super().solve(y, warm)
        # All iterations in one call of a compiled loop.
        self.setup(y, warm)
        self._fista.advance(self._momenta)
        return self.finish()

    def step(self) -> None:
        self._count_step()
        n_done = self.n_steps - self._steps_left
        self._fista.advance(self._momenta[n_done - 1 : n_done])

    def finish(self) -> Floats:
        return self._final_forces(self._fista.image())

    def reset(self) -> None:
        self._fista.reset()
        self.watch = None
