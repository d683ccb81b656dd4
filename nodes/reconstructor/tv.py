"""Total variation: forces that are even but for edges, and edges where the last frame had them."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.image_solver import ImageSolver
from sparseskin.nodes.reconstructor.parameters import newtons
from sparseskin.nodes.reconstructor.solver import Mask

#: Steps on the dual variables for each step on the image.
INNER = 2
DUAL_STEP = 0.25
#: A difference of the last frame of so many lambdas has half its weight.
EDGE = 5.0


class TvSolver(ImageSolver):
    """min over x >= 0 of 1/2 ||Phi x - y||^2 + lambda sum_i w_i |difference_i x|.

    Differences between neighbours along rows and columns (anisotropic total variation), with
    weights w = e / (e + |difference of the last frame|), e = 5 lambda: an edge that was there
    costs little to be there again. Each gradient step is followed by two projected gradient
    steps on the dual variables, which are kept from frame to frame.

    Parameters
    ----------
    phi, mask
        As in `Solver`.
    basis : Basis
        Gives the size of the grid.
    iterations : int
        1..1000.
    lambda_n : float
        Weight of the total variation, newtons, at least 0, for orthonormal rows of Phi.

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

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 20,
        lambda_n: float = 0.005,
    ) -> None:
        super().__init__(phi, basis, mask, iterations=iterations)
        self.lambda_n = newtons(self.name, "lambda_n", lambda_n)
        rows, cols = self.mask.shape
        # Where both neighbours exist.
        self._pairs = (
            (self.mask[1:] & self.mask[:-1]).astype(np.float32),
            (self.mask[:, 1:] & self.mask[:, :-1]).astype(np.float32),
        )
        self._limits: list[Floats] = [np.zeros_like(pairs) for pairs in self._pairs]
        self._duals: list[Floats] = [np.zeros_like(pairs) for pairs in self._pairs]
        self._u: Floats = np.zeros((rows, cols), dtype=np.float32)

    def reset(self) -> None:
        """Forget all earlier frames: the next one starts from 0."""
        super().reset()
        for dual in self._duals:
            dual.fill(0)

    def _begin(self) -> None:
        limit = self.lambda_n * self._projection.step_size
        edge = np.float32(EDGE * self.lambda_n + 1e-30)
        for axis, pairs in enumerate(self._pairs):
            difference = np.abs(np.diff(self._image, axis=axis))
            self._limits[axis] = np.float32(limit) * pairs * (edge / (edge + difference))

    def _iterate(self) -> None:
        self._descend(self._image)
        np.add(self._gradient, self._image, self._u)
        for _ in range(INNER):
            image = self._primal()
            for axis, (dual, limit) in enumerate(zip(self._duals, self._limits, strict=True)):
                dual += np.float32(DUAL_STEP) * np.diff(image, axis=axis)
                np.clip(dual, -limit, limit, out=dual)
        np.copyto(self._image, self._primal())

    def _primal(self) -> Floats:
        """The image that belongs to the duals: u less their divergence, cut off at 0."""
        down, right = self._duals
        image = self._u.copy()
        image[:-1] += down
        image[1:] -= down
        image[:, :-1] += right
        image[:, 1:] -= right
        np.maximum(image, 0, out=image)
        np.multiply(image, self._inside, image)
        return image
