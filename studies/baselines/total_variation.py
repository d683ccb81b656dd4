"""Total variation: a proximal gradient solver that iterates on the image."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.solvers.base import (
    MAX_ITERATIONS,
    Solver,
    newtons,
    whole_number,
)

#: Steps on the dual variables for each step on the image, and their length. 1/4 is the longest
#: that converges for one axis (Chambolle 2004).
DUAL_STEPS = 2
DUAL_STEP = 0.25
#: A difference of this many lambdas in the last frame has half its weight.
HALF = 5.0


class TvSolver(Solver):
    """min over x >= 0 of 1/2 ||Phi x - y||^2 + lambda sum_i w_i |difference_i x|.

    Differences between neighbours along rows and columns (anisotropic total variation), with
    weights w = e / (e + |difference of the last frame|), e = 5 lambda: edges of the last frame are
    penalised less. A constant number of iterations, of which the first one starts from the image of
    the last frame: each gradient step is followed by two projected gradient steps on the dual
    variables, which are kept from frame to frame. The basis gives the size of the grid alone.

    Parameters
    ----------
    phi, basis, mask
        As in `Solver`.
    iterations : int
        1..1000.
    lambda_n : float
        Weight of the differences, newtons, at least 0, for orthonormal rows of Phi.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: Chambolle, "An algorithm for total variation minimization and applications", J. Math.
    Imaging and Vision 20, 2004, for the dual; Candes, Wakin, Boyd, "Enhancing sparsity by
    reweighted l1 minimization", J. Fourier Anal. Appl. 14, 2008, for the weights.
    """

    name = "tv"
    uses_basis = False
    lambdas_n = (0.002, 0.03)
    least_iterations = 10

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 20,
        lambda_n: float = 0.005,
    ) -> None:
        super().__init__(phi, basis, mask)
        self.n_steps = whole_number(
            self.name, "iterations", iterations, 1, MAX_ITERATIONS
        )
        self.lambda_n = newtons(self.name, "lambda_n", lambda_n)
        self._step = np.float32(1 / phi.lipschitz)
        self._lambda_step = np.float32(self.lambda_n / phi.lipschitz)
        self._image: Floats = np.zeros(self.mask.shape, dtype=np.float32)
        # 1 where both neighbours exist.
        self._pairs = (
            (self.mask[1:] & self.mask[:-1]).astype(np.float32),
            (self.mask[:, 1:] & self.mask[:, :-1]).astype(np.float32),
        )
        self._limits: list[Floats] = [np.zeros_like(pairs) for pairs in self._pairs]
        self._duals: list[Floats] = [np.zeros_like(pairs) for pairs in self._pairs]

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        self._y = self._checked_y(y).copy()
        if warm is not None:
            np.multiply(self._checked_warm(warm), self._inside, self._image)
        half = np.float32(HALF * self.lambda_n + 1e-30)
        for axis, pairs in enumerate(self._pairs):
            difference = np.abs(np.diff(self._image, axis=axis))
            weights = half / (half + difference)
            self._limits[axis] = self._lambda_step * pairs * weights
        self._steps_left = self.n_steps

    def step(self) -> None:
        self._count_step()
        residual = self._y - self.phi.forward(self._image.reshape(-1)[self.taxels])
        u = self._image.copy()
        u.reshape(-1)[self.taxels] += self._step * self.phi.adjoint(residual)
        for _ in range(DUAL_STEPS):
            image = self._primal(u)
            for axis, dual in enumerate(self._duals):
                dual += np.float32(DUAL_STEP) * np.diff(image, axis=axis)
                limit = self._limits[axis]
                np.clip(dual, -limit, limit, out=dual)
        self._image = self._primal(u)

    def finish(self) -> Floats:
        return self._final_forces(self._image.copy())

    def reset(self) -> None:
        self.watch = None
        for array in (self._image, *self._duals):
            array.fill(0)

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
