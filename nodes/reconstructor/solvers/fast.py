"""FISTA iterations in compiled loops, for the scrambled block Hadamard ensemble."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.phi.hadamard import side_by_side
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.nodes.numerics.compiled import MAX_PLACES, ready
from sparseskin.nodes.numerics.kernels import (
    fista,
    fista_large,
    tiled_image,
)
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis, level_sizes


class Tiling:
    """The order of a grid's samples and coefficients in which a level of Haar is a few long runs.

    Both sides are halved as long as both are even; partners stand a quarter of a part apart, and
    the sums of a level lie in the first quarter of its part. The rest lies at the begin,
    row by row, and is transformed by itself.

    Attributes
    ----------
    order : ndarray of uint32, shape (n,)
        Place p of a tiled vector holds the sample order[p] of the flat grid.
    cells : ndarray of intp, shape (n,)
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
        self.cells: Indices = np.empty(index.size, dtype=np.intp)
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


def in_planes(cells: Indices, levels: int) -> Indices:
    """Return the cells with partners half a part apart: even rows first, even columns first.

    Both sides of `cells` are divisible by 2^levels; each level works within the last's quarters.
    """
    if levels == 0:
        return cells.reshape(-1)
    planes = [cells[down::2, right::2] for down in (0, 1) for right in (0, 1)]
    return np.concatenate([in_planes(plane, levels - 1) for plane in planes])


class CompiledFista:
    """As `Fista`, for the scrambled block Hadamard ensemble and Haar; all iterations in a call.

    With orthonormal rows L = 1, and the gradient step replaces the measured Hadamard coefficients
    of the image by y. Coefficients are held in the order and scale of `Tiling`.
    """

    def __init__(self, phi: SbhePhi, basis: HaarBasis, mask: Mask, lambda_n: float) -> None:
        n_cells = basis.n_rows * basis.n_cols
        small = n_cells <= MAX_PLACES
        self._loop = fista if small else fista_large
        ready(self._loop, tiled_image)
        self._phi, self._basis = phi, basis
        self._tiling = tiling = Tiling(basis.n_rows, basis.n_cols)
        self._theta, self._before, self._z = np.zeros((3, n_cells), dtype=np.float32)
        columns, groups = side_by_side(phi.sizes)
        self._kept = np.argsort(columns)[phi.rows]
        place_of_cell = np.argsort(tiling.order)
        # The transform is not scaled: there and back multiplies by the size of the block.
        keep = np.empty(phi.n, dtype=np.float32)
        for start, size, count in groups:
            keep[start : start + size * count] = 1 / size
        keep[self._kept] = 0
        self._measured = np.zeros(phi.n, dtype=np.float32)
        self._scratch = np.zeros(tiling.n_scratch, np.float32)
        places = place_of_cell[np.flatnonzero(mask)[phi.permutation[columns]]]
        self._tables = (
            *(tiling.weights * tiling.weights, np.float32(lambda_n) * tiling.weights),
            *(self._z, np.zeros(phi.n, np.float32)),
            places.astype(np.uint16 if small else np.uint32),
            *(keep, self._measured, groups, tiling.grid, self._scratch),
        )

    def reset(self) -> None:
        """As in `Fista`."""
        self._theta.fill(0)

    def begin(self, y: Floats, warm: Floats | None) -> None:
        """As in `Fista`."""
        if warm is not None:
            coefficients = self._basis.analysis(warm).reshape(-1)[self._tiling.cells]
            np.multiply(coefficients, self._tiling.weights, self._theta)
        np.copyto(self._before, self._theta)
        self._measured[self._kept] = y * self._phi.scale

    def advance(self, betas: Floats) -> None:
        """As in `Fista`."""
        self._loop(self._theta, self._before, betas, *self._tables)
        if betas.size % 2:  # each iteration swaps the two
            self._theta, self._before = self._before, self._theta

    def image(self) -> Floats:
        """As in `Fista`."""
        image = np.empty((self._basis.n_rows, self._basis.n_cols), np.float32)
        t, flat = self._tiling, image.reshape(-1)
        tiled_image(self._theta, t.order, t.grid, self._z, self._scratch, flat)
        return image
