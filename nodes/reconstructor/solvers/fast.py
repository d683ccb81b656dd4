"""FISTA iterations in compiled loops, for the scrambled block Hadamard ensemble."""

import numpy as np

from sparseskin.nodes.compressor.phi.base import BlockLayout
from sparseskin.nodes.compressor.phi.hadamard import side_by_side
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import fista, haar_image
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis, level_sizes


class CompiledFista:
    """As `Fista`, for the scrambled block Hadamard ensemble and Haar; all iterations in a call.

    With orthonormal rows L = 1, and the gradient step replaces the measured Hadamard coefficients
    of the image by y. Coefficients have the scale of the kernel `haar`: theta times weights.
    """

    def __init__(
        self, layout: BlockLayout, basis: HaarBasis, mask: Mask, lambda_n: float
    ) -> None:
        ready(fista, haar_image)
        self._basis = basis
        sizes = layout.sizes
        n = sum(sizes)
        #: Size of the block of each row, and of each column, of W.
        block_sizes = np.repeat(sizes, sizes)
        of_rows = block_sizes[layout.rows].astype(np.float32)
        self._scale = np.reciprocal(np.sqrt(of_rows))

        self._theta = np.zeros(mask.size, np.float32)
        self._before = np.zeros(mask.size, np.float32)
        self._z = np.zeros(mask.size, np.float32)
        self._half = np.zeros(mask.size, np.float32)

        #: A level of sums and differences without the factor 1 / sqrt(2) along each axis.
        weights = np.ones(mask.shape, dtype=np.float32)
        for rows, cols in level_sizes(*mask.shape):
            weights[:rows, :cols] *= 0.5
        self._weights: Floats = weights.reshape(-1)

        columns, groups = side_by_side(sizes)
        place_of_column = np.argsort(columns)
        self._kept = place_of_column[layout.rows]
        # The transform is not scaled: there and back multiplies by the size of the block.
        of_columns = block_sizes[columns].astype(np.float32)
        keep = np.reciprocal(of_columns)
        # Measured coefficients are replaced by y.
        keep[self._kept] = 0
        self._measured = np.zeros(n, dtype=np.float32)
        self._grid = np.array(mask.shape, dtype=np.int64)
        cells = np.flatnonzero(mask)
        places = cells[layout.permutation[columns]]
        self._tables = (
            self._weights * self._weights,
            np.float32(lambda_n) * self._weights,
            self._z,
            np.zeros(n, np.float32),
            places.astype(np.uint32),
            keep,
            self._measured,
            groups,
            self._grid,
            self._half,
        )

    def reset(self) -> None:
        """As in `Fista`."""
        self._theta.fill(0)

    def begin(self, y: Floats, warm: Floats | None) -> None:
        """As in `Fista`."""
        if warm is not None:
            theta = self._basis.analysis(warm).reshape(-1)
            np.multiply(theta, self._weights, self._theta)
        np.copyto(self._before, self._theta)
        self._measured[self._kept] = y * self._scale

    def advance(self, betas: Floats) -> None:
        """As in `Fista`."""
        fista(self._theta, self._before, betas, *self._tables)
        # Each iteration swaps the two.
        if betas.size % 2:
            self._theta, self._before = self._before, self._theta

    def image(self) -> Floats:
        """As in `Fista`."""
        image = self._theta.copy()
        haar_image(image, self._grid, self._half)
        return image.reshape(self._basis.n_rows, self._basis.n_cols)
