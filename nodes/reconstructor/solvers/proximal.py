"""Proximal gradient solvers that iterate on the image: FISTA with x >= 0, reweighted, TV."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis

from .base import MAX_ITERATIONS, Solver, newtons, whole_number
from .fista import momenta

#: A coefficient of this many lambdas in the last frame has half its weight.
REWEIGHTED_HALF = 3.0
#: TV: steps on the dual variables for each step on the image, and their length. 1/4 is the longest
#: that converges for one axis (Chambolle 2004).
DUAL_STEPS, DUAL_STEP = 2, 0.25
#: TV: a difference of this many lambdas in the last frame has half its weight.
TV_HALF = 5.0


class PenalisedSolver(Solver):
    """A constant number of iterations on 1/2 ||Phi x - y||^2 + lambda R(x); a subclass defines R.

    The first one starts from the image of the last frame.

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
        super().__init__(phi, basis, mask)
        iterations = self.default_iterations if iterations is None else iterations
        lambda_n = self.default_lambda_n if lambda_n is None else lambda_n
        self.iterations = whole_number(self.name, "iterations", iterations, 1, MAX_ITERATIONS)
        self.lambda_n = newtons(self.name, "lambda_n", lambda_n)
        self.n_steps = self.iterations
        self._step = np.float32(1 / phi.lipschitz)
        self._lambda_step = np.float32(self.lambda_n / phi.lipschitz)
        self._image: Floats = np.zeros(self.mask.shape, dtype=np.float32)
        self._allocate()

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        self._y = self._checked_y(y).copy()
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

    def _descended(self, image: Floats) -> Floats:
        """Return image + Phi^T (y - Phi image) / L, float32 (n_rows, n_cols)."""
        residual = self._y - self.phi.forward(image.reshape(-1)[self.taxels])
        descended = image.copy()
        descended.reshape(-1)[self.taxels] += self._step * self.phi.adjoint(residual)
        return descended

    @abstractmethod
    def _allocate(self) -> None:
        """Make the buffers of the subclass."""


class FistaNonnegSolver(PenalisedSolver):
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
        #: Threshold of all coefficients, or of each.
        self._limit: Floats | np.float32 = self._lambda_step
        self._z: Floats = np.zeros(self.mask.shape, dtype=np.float32)
        # After the last step a momentum is computed, too.
        self._momenta = np.array(momenta(self.iterations + 1), dtype=np.float32)

    def _begin(self) -> None:
        self._z = self._image.copy()

    def _iterate(self) -> None:
        before, x = self._image.copy(), self._image
        theta = self.basis.analysis(self._descended(self._z))
        self.basis.synthesis(theta - np.clip(theta, -self._limit, self._limit), x)
        np.maximum(x, 0, out=x)
        np.multiply(x, self._inside, x)
        self._z = x + self._momenta[self.n_steps - self._steps_left] * (x - before)


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
        last = np.abs(self.basis.analysis(self._image))
        self._limit = self._lambda_step * half / (half + last)


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

    def reset(self) -> None:
        super().reset()
        for dual in self._duals:
            dual.fill(0)

    def _begin(self) -> None:
        half = np.float32(TV_HALF * self.lambda_n + 1e-30)
        for axis, pairs in enumerate(self._pairs):
            difference = np.abs(np.diff(self._image, axis=axis))
            self._limits[axis] = self._lambda_step * pairs * (half / (half + difference))

    def _iterate(self) -> None:
        u = self._descended(self._image)
        for _ in range(DUAL_STEPS):
            image = self._primal(u)
            for axis, (dual, limit) in enumerate(zip(self._duals, self._limits, strict=True)):
                dual += np.float32(DUAL_STEP) * np.diff(image, axis=axis)
                np.clip(dual, -limit, limit, out=dual)
        self._image = self._primal(u)

    def _primal(self, u: Floats) -> Floats:
        """Return the image of the dual variables: max(0, u - their divergence)."""
        down, right = self._duals
        image = u.copy()
        image[:-1] += down
        image[1:] -= down
        image[:, :-1] += right
        image[:, 1:] -= right
        np.maximum(image, 0, out=image)
        np.multiply(image, self._inside, image)
        return image
