"""Proximal gradient solvers that iterate on the image: ISTA, FISTA with x >= 0, reweighted, TV."""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis

from .backends import make_projection
from .base import MAX_ITERATIONS, Solver, newtons, whole_number
from .fista import momenta

#: A coefficient of this many lambdas in the last frame has half its weight.
REWEIGHTED_HALF = 3.0
#: TV: steps on the dual variables for each step on the image, and their length. 1/4 is the longest
#: that converges for one axis (Chambolle 2004).
DUAL_STEPS, DUAL_STEP = 2, 0.25
#: TV: a difference of this many lambdas in the last frame has half its weight.
TV_HALF = 5.0


class ImageSolver(Solver):
    """A constant number of iterations on an image, starting from the image of the last frame.

    Parameters
    ----------
    phi, basis, mask
        As in `Solver`.
    iterations : int
        1..1000.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.
    """

    #: The sum of squares of larger ones could overflow float32.
    y_max = 1e14

    def __init__(
        self, phi: Phi, basis: Basis, mask: Mask | None = None, *, iterations: int
    ) -> None:
        super().__init__(phi, basis, mask)
        self.iterations = whole_number(self.name, "iterations", iterations, 1, MAX_ITERATIONS)
        self.n_steps = self.iterations
        self._projection = make_projection(phi)
        n = phi.n
        self._cell_of_place = self.taxels[self._projection.order]
        self._place_of_cell = np.full(self.mask.size, n, dtype=np.intp)
        self._place_of_cell[self._cell_of_place] = np.arange(n)
        self._image, self._gradient = np.zeros((2, *self.mask.shape), dtype=np.float32)
        self._places = np.zeros((1, n), dtype=np.float32)
        self._back_and_zero = np.zeros(n + 1, dtype=np.float32)
        self._y = np.zeros(self._projection.n_rows, dtype=np.float32)
        self._r = np.zeros((1, self._projection.n_rows), dtype=np.float32)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        self._projection.rows_of(self._checked_y(y), self._y)
        if warm is not None:
            np.multiply(self._checked_warm(warm), self._inside, self._image)
        self._begin()
        self._steps_left = self.n_steps

    def step(self) -> None:
        self._count_step()
        self._iterate()

    def finish(self) -> Floats:
        return self._final_forces(self._image.copy())

    def reset(self) -> None:
        self._image.fill(0)

    def _begin(self) -> None:
        """Prepare a frame that starts from `_image`."""

    @abstractmethod
    def _iterate(self) -> None:
        """Do one iteration; the estimate is left in `_image`."""

    def _descend(self, image: Floats) -> float:
        """Write Phi^T (y - Phi image) / L to `_gradient`; return the RMS of y - Phi image, newtons.

        Cells without a taxel get 0.
        """
        image.reshape(-1).take(self._cell_of_place, None, self._places[0], "clip")
        self._projection.forward(self._places, self._r)
        np.subtract(self._y, self._r[0], self._r[0])
        self._projection.adjoint(self._r[0], self._back_and_zero[:-1])
        flat = self._gradient.reshape(-1)
        self._back_and_zero.take(self._place_of_cell, None, flat, "clip")
        return math.sqrt(float(np.dot(self._r[0], self._r[0])) / self.phi.m)


class PenalisedSolver(ImageSolver):
    """A solver of 1/2 ||Phi x - y||^2 + lambda R(x); a subclass defines R.

    Parameters
    ----------
    phi, basis, mask
        As in `Solver`.
    iterations : int, optional
        1..1000. None: `default_iterations`.
    lambda_n : float, optional
        Weight of R, newtons, at least 0, for orthonormal rows of Phi. None: `default_lambda_n`.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.
    """

    default_iterations = 20
    default_lambda_n = 0.1 / 32

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int | None = None,
        lambda_n: float | None = None,
    ) -> None:
        iterations = self.default_iterations if iterations is None else iterations
        super().__init__(phi, basis, mask, iterations=iterations)
        lambda_n = self.default_lambda_n if lambda_n is None else lambda_n
        self.lambda_n = newtons(self.name, "lambda_n", lambda_n)
        self._lambda_step = self.lambda_n * self._projection.step_size
        self._allocate()

    @abstractmethod
    def _allocate(self) -> None:
        """Make the buffers of the subclass."""


class L1Solver(PenalisedSolver):
    """R(x) = ||W Psi^T x||_1, by soft thresholding."""

    def _allocate(self) -> None:
        #: Threshold of all coefficients, or of each.
        self._limit: Floats | np.float32 = np.float32(self._lambda_step)
        self._theta, self._clipped = np.zeros((2, *self.mask.shape), dtype=np.float32)

    def _soft_step(self, z: Floats) -> None:
        """Set `_image` to Psi soft(Psi^T (z - gradient / L), limit)."""
        self._descend(z)
        np.add(self._gradient, z, self._gradient)
        self.basis.analysis(self._gradient, self._theta)
        np.clip(self._theta, -self._limit, self._limit, out=self._clipped)
        np.subtract(self._theta, self._clipped, self._theta)
        self.basis.synthesis(self._theta, self._image)


class IstaSolver(L1Solver):
    """Iterative soft thresholding: FISTA without its momentum, for comparison.

    min over theta of 1/2 ||Phi R Psi theta - y||^2 + lambda ||theta||_1, then x = Psi theta:
    theta <- soft(theta + Psi^T Phi^T (y - Phi Psi theta) / L, lambda / L), from the theta of the
    last frame. Parameters and Raises as in `PenalisedSolver`.

    Notes
    -----
    Source: Daubechies, Defrise, De Mol, "An iterative thresholding algorithm for linear inverse
    problems with a sparsity constraint", Comm. Pure Appl. Math. 57(11), 2004.
    """

    name = "ista"
    default_iterations = 50

    def _iterate(self) -> None:
        self._soft_step(self._image)


class FistaNonnegSolver(L1Solver):
    """FISTA with the constraint x >= 0 in every iteration.

    min over x >= 0 of 1/2 ||Phi x - y||^2 + lambda ||Psi^T x||_1:
    x <- max(0, Psi soft(Psi^T (z - gradient / L), lambda / L)), with FISTA's momentum. Thresholding
    first and clipping then is not the exact proximal step of both terms together, which has no
    closed form; it is one step of alternating between them. Parameters and Raises as in
    `PenalisedSolver`.

    Notes
    -----
    Source: Beck, Teboulle, "Fast gradient-based algorithms for constrained total variation image
    denoising and deblurring problems", IEEE Trans. Image Processing 18(11), 2009, for momentum
    under a constraint.
    """

    name = "fista_nonneg"
    default_lambda_n = 0.00625

    def _allocate(self) -> None:
        super()._allocate()
        self._z, self._before = np.zeros((2, *self.mask.shape), dtype=np.float32)
        # After the last step a momentum is computed, too.
        self._momenta = np.array(momenta(self.iterations + 1), dtype=np.float32)

    def _begin(self) -> None:
        np.copyto(self._z, self._image)

    def _iterate(self) -> None:
        x, z = self._image, self._z
        np.copyto(self._before, x)
        self._soft_step(z)
        np.maximum(x, 0, out=x)
        np.multiply(x, self._inside, x)
        np.subtract(x, self._before, z)
        np.multiply(z, self._momenta[self.n_steps - self._steps_left], z)
        np.add(z, x, z)


class ReweightedSolver(FistaNonnegSolver):
    """Reweighted l1: coefficients that were large in the last frame are shrunk less.

    min over x >= 0 of 1/2 ||Phi x - y||^2 + lambda sum_i w_i |theta_i|, theta = Psi^T x, with
    w_i = e / (e + |theta_i of the last frame|), e = 3 lambda: RWL1-DF under the dynamics x(t) =
    x(t-1). w is 1 in the first frame. Iterations as in `FistaNonnegSolver`; parameters and Raises
    as in `PenalisedSolver`.

    Notes
    -----
    Source: Charles, Balavoine, Rozell, "Dynamic filtering of time-varying sparse signals via l1
    minimization", IEEE Trans. Signal Processing 64(21), 2016.
    """

    name = "reweighted"
    default_lambda_n = 0.0125

    def _begin(self) -> None:
        super()._begin()
        half = np.float32(REWEIGHTED_HALF * self.lambda_n + 1e-30)
        last = np.abs(self.basis.analysis(self._image, self._theta))
        self._limit = np.float32(self._lambda_step) * half / (half + last)


class TvSolver(PenalisedSolver):
    """min over x >= 0 of 1/2 ||Phi x - y||^2 + lambda sum_i w_i |difference_i x|.

    Differences between neighbours along rows and columns (anisotropic total variation), with
    weights w = e / (e + |difference of the last frame|), e = 5 lambda: edges of the last frame are
    penalised less. Each gradient step is followed by two projected gradient steps on the dual
    variables, which are kept from frame to frame. The basis gives the size of the grid alone.
    Parameters and Raises as in `PenalisedSolver`.

    Notes
    -----
    Source: Chambolle, "An algorithm for total variation minimization and applications", J. Math.
    Imaging and Vision 20, 2004, for the dual; Candes, Wakin, Boyd, "Enhancing sparsity by
    reweighted l1 minimization", J. Fourier Anal. Appl. 14, 2008, for the weights.
    """

    name = "tv"
    default_lambda_n = 0.005

    def _allocate(self) -> None:
        # 1 where both neighbours exist.
        self._pairs = (
            (self.mask[1:] & self.mask[:-1]).astype(np.float32),
            (self.mask[:, 1:] & self.mask[:, :-1]).astype(np.float32),
        )
        self._limits: list[Floats] = [np.zeros_like(pairs) for pairs in self._pairs]
        self._duals: list[Floats] = [np.zeros_like(pairs) for pairs in self._pairs]
        self._u: Floats = np.zeros_like(self._image)

    def reset(self) -> None:
        super().reset()
        for dual in self._duals:
            dual.fill(0)

    def _begin(self) -> None:
        half = np.float32(TV_HALF * self.lambda_n + 1e-30)
        for axis, pairs in enumerate(self._pairs):
            difference = np.abs(np.diff(self._image, axis=axis))
            self._limits[axis] = (
                np.float32(self._lambda_step) * pairs * (half / (half + difference))
            )

    def _iterate(self) -> None:
        self._descend(self._image)
        np.add(self._gradient, self._image, self._u)
        for _ in range(DUAL_STEPS):
            image = self._primal()
            for axis, (dual, limit) in enumerate(zip(self._duals, self._limits, strict=True)):
                dual += np.float32(DUAL_STEP) * np.diff(image, axis=axis)
                np.clip(dual, -limit, limit, out=dual)
        np.copyto(self._image, self._primal())

    def _primal(self) -> Floats:
        """Return the image of the dual variables: max(0, u - their divergence)."""
        down, right = self._duals
        image = self._u.copy()
        image[:-1] += down
        image[1:] -= down
        image[:, :-1] += right
        image[:, 1:] -= right
        np.maximum(image, 0, out=image)
        np.multiply(image, self._inside, image)
        return image
