"""FISTA for basis pursuit denoising, the paper's method: `fista` to be read, `FistaSolver` to run.

`tests/nodes/reconstructor/solvers/test_fista.py` shows that they agree.
"""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.numerics.compiled import use_compiled
from sparseskin.nodes.reconstructor.bases.base import Basis

from .backends import make_descent
from .base import MAX_ITERATIONS, Solver, newtons, whole_number


def fista(
    phi: Phi,
    basis: Basis,
    y: Floats,
    *,
    iterations: int = 30,
    lambda_n: float = 0.1 / 32,
    mask: Mask | None = None,
    start: Floats | None = None,
) -> tuple[Floats, Floats]:
    r"""Reconstruct one frame: the method itself, without the buffers of `FistaSolver`.

    Basis pursuit denoising, with A = Phi R Psi and R the restriction to the existing taxels:

        min over theta of  1/2 ||A theta - y||_2^2 + lambda ||theta||_1,    x = max(0, Psi theta)

    FISTA with constant step 1/L, L >= the largest eigenvalue of A A^T. From z_1 = theta_0 = start
    and t_1 = 1, for k = 1, 2, ..., iterations:

        u_k       = z_k + 1/L A^T (y - A z_k)                    (gradient step)
        theta_k   = sign(u_k) max(0, |u_k| - lambda / L)         (soft threshold)
        t_{k+1}   = (1 + sqrt(1 + 4 t_k^2)) / 2
        z_{k+1}   = theta_k + (t_k - 1) / t_{k+1} (theta_k - theta_{k-1})      (momentum)

    Parameters
    ----------
    phi, basis, iterations, lambda_n, mask
        As in `FistaSolver`.
    y : ndarray of float32, shape (m,)
        Measurements, newtons.
    start : ndarray of float32, shape (n_rows, n_cols), optional
        theta of the last frame for a warm start, newtons; None: 0.

    Returns
    -------
    forces, theta : ndarray of float32, shape (n_rows, n_cols)
        x, 0 where no taxel exists; and the theta to start the next frame from. Newtons.
    """
    shape = (basis.n_rows, basis.n_cols)
    exists = np.ones(shape, dtype=np.bool_) if mask is None else mask

    def forward(theta: Floats) -> Floats:  # A theta
        return phi.forward(basis.synthesis(theta)[exists])

    def adjoint(residual: Floats) -> Floats:  # A^T residual
        image = np.zeros(shape, dtype=np.float32)
        image[exists] = phi.adjoint(residual)
        return basis.analysis(image)

    step = np.float32(1 / phi.lipschitz)
    theta = np.zeros(shape, dtype=np.float32) if start is None else start
    z = theta
    for beta in momenta(iterations + 1)[1:]:
        u = z + step * adjoint(y - forward(z))
        before, theta = theta, np.sign(u) * np.maximum(np.abs(u) - np.float32(lambda_n) * step, 0)
        z = theta + np.float32(beta) * (theta - before)
    forces = np.where(exists, np.maximum(basis.synthesis(theta), 0), np.float32(0))
    return forces, theta


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
    """The problem and the iteration of `fista`, on buffers that are made once.

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
        self.iterations = whole_number("fista", "iterations", iterations, 1, MAX_ITERATIONS)
        self.lambda_n = newtons("fista", "lambda_n", lambda_n)
        self.n_steps = self.iterations
        self._momenta = np.array(momenta(self.iterations), dtype=np.float32)
        self._descent = make_descent(phi, basis, self.taxels, use_compiled(fast))
        weights = self._descent.weights
        # Two buffers that are swapped by each iteration: the newest theta and the one before it.
        self._thetas: Floats = np.zeros((2, weights.size), dtype=np.float32)
        self._newest = 0
        threshold: Floats = (self.lambda_n * self._descent.step_size * weights).astype(np.float32)
        self._descent.prepare(self._thetas, threshold)

    @property
    def theta(self) -> Floats:
        """Coefficients that the next frame starts from, float32 (n_rows, n_cols), newtons."""
        return self.basis.analysis(self._newest_image())

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._checked_y(y)
        newest, other = self._thetas[self._newest], self._thetas[1 - self._newest]
        if warm is not None:
            self._descent.coefficients_of(self._checked_warm(warm), newest)
        self._descent.set_measurements(y)
        np.copyto(other, newest)
        # Both buffers are equal now. BLAS may round a product by which row is which, so that each
        # frame begins with the same one.
        self._newest = 0
        self._steps_left = self.n_steps

    def solve(self, y: Floats, warm: Floats | None = None) -> Floats:
        if type(self).step is not FistaSolver.step:  # a step of the user's own
            return super().solve(y, warm)
        self.setup(y, warm)
        self._iterate(0, self.n_steps)
        return self.finish()

    def step(self) -> None:
        self._count_step()
        done = self.n_steps - self._steps_left
        self._iterate(done - 1, done)

    def finish(self) -> Floats:
        return self._final_forces(self._newest_image())

    def reset(self) -> None:
        self._thetas.fill(0)

    def _newest_image(self) -> Floats:
        image = np.empty(self.mask.shape, dtype=np.float32)
        self._descent.image_of(self._thetas[self._newest], image)
        return image

    def _iterate(self, begin: int, end: int) -> None:
        """Do the iterations of these numbers, the first being 0."""
        self._descent.iterate(self._newest, self._momenta[begin:end])
        self._newest = (self._newest + end - begin) % 2
