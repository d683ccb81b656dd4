"""FISTA for basis pursuit denoising, the paper's solver."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.fast import use_compiled
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.descent import make_descent
from sparseskin.nodes.reconstructor.parameters import MAX_ITERATIONS, newtons, whole_number
from sparseskin.nodes.reconstructor.solver import Mask, Solver


class FistaSolver(Solver):
    """min over theta of 1/2 ||Phi R Psi theta - y||^2 + lambda ||theta||_1, then x = Psi theta.

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
        sqrt(32) times smaller, the squared misfit 32 times, and so is the lambda of the same
        problem: 0.1 / 32 = 0.003125 N.
    fast : str
        Whether compiled loops do the work, for "sbhe" and "haar": "auto" (where numba is
        installed), "on" or "off". The forces are the same to within 1e-5 N.

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
        self._momenta = np.array(_momenta(self.iterations), dtype=np.float32)
        self._done = self.iterations  # no frame is begun
        self._inside: Floats = self.mask.astype(np.float32)

        self._descent = make_descent(phi, basis, self.taxels, use_compiled(fast))
        weights = self._descent.weights
        # Two buffers that take turns: the newest theta and the one before it.
        self._thetas: Floats = np.zeros((2, weights.size), dtype=np.float32)
        self._newest = 0
        threshold: Floats = (self.lambda_n * self._descent.step_size * weights).astype(np.float32)
        self._descent.prepare(self._thetas, threshold)

    @property
    def theta(self) -> Floats:
        """Coefficients that the next frame starts from, float32 (n_rows, n_cols), newtons."""
        image = np.empty(self.mask.shape, dtype=np.float32)
        self._descent.image_of(self._thetas[self._newest], image)
        return self.basis.analysis(image)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`."""
        y = self._checked_y(y)
        newest, other = self._thetas[self._newest], self._thetas[1 - self._newest]
        if warm is not None:
            self._descent.coefficients_of(self._checked_warm(warm), newest)
        self._descent.set_measurements(y)
        np.copyto(other, newest)
        self._done = 0

    def solve(self, y: Floats, warm: Floats | None = None) -> Floats:
        """Restore one frame; parameters, Returns and Raises as in `Solver`."""
        if type(self).step is not FistaSolver.step:  # a step of the user's own
            return super().solve(y, warm)
        self.setup(y, warm)
        self._iterate(self.iterations)
        return self.finish()

    def step(self) -> None:
        """Do one iteration of the frame that was begun.

        Raises
        ------
        SolverError
            If the frame has had all its iterations, or none was begun.
        """
        if self._done == self.iterations:
            raise SolverError(f"fista: no step is left of the frame's {self.iterations}")
        self._iterate(1)

    def finish(self) -> Floats:
        """End the frame and return its estimate, as `solve` does."""
        image = np.empty(self.mask.shape, dtype=np.float32)
        self._descent.image_of(self._thetas[self._newest], image)
        np.maximum(image, 0, out=image)
        np.multiply(image, self._inside, out=image)
        if not np.isfinite(image).all():
            self.reset()
            raise SolverError("fista: the iteration diverged: is phi.lipschitz too small?")
        return image

    def reset(self) -> None:
        """Forget all earlier frames: the next one starts from 0."""
        self._thetas.fill(0)

    def _iterate(self, count: int) -> None:
        betas = self._momenta[self._done : self._done + count]
        self._descent.iterate(self._newest, betas)
        self._newest = (self._newest + count) % 2
        self._done += count


def _momenta(iterations: int) -> list[float]:
    """Return beta_k = (t_k - 1) / t_(k+1) of the steps, beginning with the first step's 0."""
    betas = [0.0]
    t = 1.0
    while len(betas) < iterations:
        t_next = (1 + math.sqrt(1 + 4 * t * t)) / 2
        betas.append((t - 1) / t_next)
        t = t_next
    return betas
