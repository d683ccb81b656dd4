"""The Haar basis at full depth in compiled loops, a frame or a batch of frames."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import haar_analysis, haar_synthesis

from .haar import level_sizes
from .shifted_haar import in_planes


class Tiling:
    """The order of a grid's samples and coefficients in which a level of Haar is a few long runs.

    Both sides are halved as long as both are even; partners stand a quarter of a part apart, and
    the sums of a level lie in the first quarter of its part. The rest lies at the begin,
    row by row, and is transformed by itself.

    Attributes
    ----------
    order : ndarray of uint32, shape (n,)
        Place p of a tiled vector holds the sample order[p] of the flat grid.
    cells : ndarray of uint32, shape (n,)
        Place p holds the coefficient cells[p] of the flat pyramid that `HaarBasis` gives.
    weights : ndarray of float32, shape (n,)
        Scale of each coefficient, as halvings are not scaled.
    grid : ndarray of int64, shape (3,)
        Number of halvings, rows and columns of the rest.
    n_scratch : int
        Length of the work array that the rest needs.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        sides = n_rows | n_cols
        levels = (sides & -sides).bit_length() - 1
        rows, cols = n_rows >> levels, n_cols >> levels
        self.grid = np.array([levels, rows, cols], dtype=np.int64)
        self.n_scratch = rows * cols
        index = np.arange(n_rows * n_cols).reshape(n_rows, n_cols)
        self.order = in_planes(index, levels).astype(np.uint32)
        self.cells = np.empty(index.size, dtype=np.uint32)
        self.weights: Floats = np.empty(index.size, dtype=np.float32)
        for level in range(1, levels + 1):
            # The part of a level: its four bands, of which the first is the next level's part.
            here, q = index[: n_rows >> (level - 1), : n_cols >> (level - 1)], 0
            middle = here.shape[0] // 2, here.shape[1] // 2
            for band in (
                here[: middle[0], : middle[1]],
                here[: middle[0], middle[1] :],
                here[middle[0] :, : middle[1]],
                here[middle[0] :, middle[1] :],
            ):
                self.cells[q : q + band.size] = in_planes(band, levels - level)
                q += band.size
            self.weights[:q] = 0.5**level
        self.cells[: rows * cols] = index[:rows, :cols].ravel()
        self.weights[: rows * cols] = 0.5**levels * _scale_of_sums(rows, cols).ravel()


def _scale_of_sums(rows: int, cols: int) -> Doubles:
    """Return the scale of each coefficient of a pyramid of sums and differences, (rows, cols).

    In such a pyramid a level adds and subtracts without the factor 1 / sqrt(2), and a sample
    without a partner goes on sqrt(2) times as large.
    """
    scale = np.ones((rows, cols))
    for r, c in level_sizes(rows, cols):
        scale[:r, :c] *= np.sqrt(0.5) ** ((r > 1) + (c > 1))
    return scale


class CompiledHaar:
    """Psi and its transpose of a `HaarBasis`; nothing is allocated by either.

    It owns its work arrays: use one per thread.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        ready(haar_analysis, haar_synthesis)
        self.n_rows, self.n_cols = n_rows, n_cols
        self._tiling = Tiling(n_rows, n_cols)
        self._v = np.zeros(n_rows * n_cols, dtype=np.float32)
        self._scratch = np.zeros(self._tiling.n_scratch, dtype=np.float32)

    def analysis(self, images: Floats, out: Floats) -> Floats:
        """Write the coefficients of k images to out, both float32 (k, n), contiguous.

        SolverError if either has another shape or type.
        """
        self._check(images, out)
        t = self._tiling
        haar_analysis(images, t.order, t.cells, t.weights, t.grid, self._v, self._scratch, out)
        return out

    def synthesis(self, coefficients: Floats, out: Floats) -> Floats:
        """Write the images of k sets of coefficients to out; as `analysis`."""
        self._check(coefficients, out)
        t = self._tiling
        haar_synthesis(
            coefficients, t.order, t.cells, t.weights, t.grid, self._v, self._scratch, out
        )
        return out

    def _check(self, given: Floats, out: Floats) -> None:
        shape = (len(given), self.n_rows * self.n_cols)
        for array in (given, out):
            if array.shape != shape or array.dtype != np.float32 or not array.flags.carray:
                raise SolverError(
                    f"basis: an array is {array.dtype} of shape {array.shape}; "
                    f"expected contiguous, writable float32 of shape {shape}"
                )
