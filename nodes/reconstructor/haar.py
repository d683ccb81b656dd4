"""The two-dimensional Haar basis at full depth, on a grid of any size."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Call, Floats, Indices, gather, run
from sparseskin.nodes.reconstructor.basis import Basis
from sparseskin.nodes.reconstructor.haar_tiles import HaarTiles, haar_matrix
from sparseskin.nodes.reconstructor.halving import Bands, Halvings

MAX_DENSE = 64
"""Samples whose transform by a matrix is quicker than by halvings."""


class HaarBasis(Basis):
    """Psi = the orthonormal 2-D Haar (Daubechies D2) basis, full depth.

    At each level neighbours are paired along both axes: (a + b) / sqrt(2) goes on to the next
    level, (a - b) / sqrt(2) is a detail. The last sample of an odd side goes on unchanged. A
    side of 1 is done while the other goes on. Coefficients are laid out as a pyramid: at each
    level the approximation top left, details along the columns' direction (axis 1) to its
    right, along the rows' (axis 0) below it, along both diagonally.

    Where a side is odd, or gets odd after some halvings, the rest is padded to powers of two
    inside, so such sizes (33 x 33) cost as much as the next power of two. A rest of 64 samples or
    fewer is one product with its matrix instead, and even levels are products with that of a tile.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels.

    Attributes
    ----------
    order : ndarray of intp, shape (n_rows * n_cols,)
        Place p of an inner image buffer holds the pixel order[p] of the flat image.
    place_of_pixel : ndarray of intp, shape (n_rows * n_cols,)
        The inverse: pixel i of the flat image stands at place place_of_pixel[i].
    n_inner : int
        Length of an inner coefficient buffer, the padding included.
    weights : ndarray of float32, shape (n_inner,)
        What the inner transform T lacks to be orthonormal: theta = weights * T image; all 1 where
        nothing is padded. Weight 0: a place of the padding, no coefficient.

    Raises
    ------
    SolverError
        If the grid is empty.

    Notes
    -----
    Source: the paper, section IV-A.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        super().__init__(n_rows, n_cols)
        # First as many levels as come out even; what is left goes through one matrix, or is
        # padded and halved on.
        self._even = HaarTiles((n_rows, n_cols), few=MAX_DENSE)
        self.order: Indices = self._even.order
        rows, cols = self._even.rest
        self._matrix: Floats | None = None
        if rows * cols <= MAX_DENSE:
            self._matrix = haar_matrix((rows, cols)).astype(np.float32)
            corner = np.arange(n_rows * n_cols).reshape(n_rows, n_cols)[:rows, :cols]
            deep = Bands(corner.ravel(), np.ones(corner.size))
        else:
            deep = self._pad_rest(rows, cols)
        cells = np.concatenate([self._even.cells, deep.cells])
        real = cells >= 0
        self.n_inner: int = cells.size
        # The sums of even levels are no coefficients, but are overwritten on the way back.
        self.weights: Floats = np.ones(self.n_inner, dtype=np.float32)
        deep_weights = self.weights[self._even.cells.size :]
        deep_weights[:] = 0
        deep_real = deep.cells >= 0
        deep_weights[deep_real] = 1 / np.sqrt(deep.energies[deep_real])
        self._cell_of_place: Indices = np.where(real, cells, 0)
        self._place_of_cell: Indices = np.flatnonzero(real)[np.argsort(cells[real])]

        self.place_of_pixel: Indices = np.argsort(self.order)
        self._x = np.empty(self.order.size, dtype=np.float32)
        self._c = np.empty(self.n_inner, dtype=np.float32)
        self._to_c = self.analysis_program(self._x, self._c)
        self._to_x = self.synthesis_program(self._c, self._x)

    def _pad_rest(self, rows: int, cols: int) -> Bands:
        """Prepare the halvings of a padded rest; return where their coefficients belong."""
        padded = (_next_power_of_two(rows), _next_power_of_two(cols))
        self._padded = Halvings(padded)
        gain = np.outer(_gains(rows, padded[0]), _gains(cols, padded[1]))
        i, j = np.divmod(self._padded.order, padded[1])
        inside = (i < rows) & (j < cols)
        sample = np.where(inside, i * cols + j, 0)
        self._pad: Indices = self._even.rest_places[sample]
        self._pad_gain: Floats = gain.reshape(-1)[self._padded.order].astype(np.float32)
        self._unpad: Indices = np.flatnonzero(inside)[np.argsort(sample[inside])]
        self._unpad_gain: Floats = self._pad_gain[self._unpad]
        return self._padded.bands((rows, cols), gain**2, self.n_cols)

    def analysis_program(self, x: Floats, c: Floats) -> list[Call]:
        """Return the calls that compute c = T x.

        Parameters
        ----------
        x : ndarray of float32, shape (n_rows * n_cols,)
            Image in the inner `order`; left as it is.
        c : ndarray of float32, shape (n_inner,)
            `weights` * c are the coefficients.
        """
        even_c, deep_c, rest = self._split(c, x)
        calls = self._even.analysis(x, even_c)
        if self._matrix is not None:
            return [*calls, (np.dot, (self._matrix, rest, deep_c))]
        d = np.empty(self._pad.size, dtype=np.float32)
        return [
            *calls,
            gather(even_c if even_c.size else x, self._pad, d),
            (np.multiply, (d, self._pad_gain, d)),
            *self._padded.analysis(d, deep_c),
        ]

    def synthesis_program(self, c: Floats, x: Floats) -> list[Call]:
        """Return the calls that compute x = T^T c.

        Parameters
        ----------
        c : ndarray of float32, shape (n_inner,)
            `weights` * coefficients; overwritten.
        x : ndarray of float32, shape (n_rows * n_cols,)
            Image in the inner `order`.
        """
        even_c, deep_c, rest = self._split(c, x)
        even = self._even.synthesis(even_c, x)
        if self._matrix is not None:
            return [(np.dot, (deep_c, self._matrix, rest)), *even]
        d = np.empty(self._pad.size, dtype=np.float32)
        return [
            *self._padded.synthesis(deep_c, d),
            gather(d, self._unpad, rest),
            (np.multiply, (rest, self._unpad_gain, rest)),
            *even,
        ]

    def _split(self, c: Floats, x: Floats) -> tuple[Floats, Floats, Floats]:
        """Return what even levels leave, what comes of the rest, and where the rest itself is."""
        even_c, deep_c = np.split(c, [self._even.cells.size])
        places = self._even.rest_places
        rest = (even_c if even_c.size else x)[places[0] : places[-1] + 1]
        return even_c, deep_c, rest

    def _analysis(self, image: Floats, out: Floats) -> None:
        image.take(self.order, None, self._x, "clip")
        run(self._to_c)
        np.multiply(self._c, self.weights, self._c)
        self._c.take(self._place_of_cell, None, out, "clip")

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        coefficients.take(self._cell_of_place, None, self._c, "clip")
        np.multiply(self._c, self.weights, self._c)
        run(self._to_x)
        self._x.take(self.place_of_pixel, None, out, "clip")


def _next_power_of_two(size: int) -> int:
    return 1 << (size - 1).bit_length()


def _gains(size: int, padded: int) -> npt.NDArray[np.float64]:
    """Return what each sample of one axis is multiplied by, so that sums need no more scaling.

    A pair's sum is sqrt(2) times its approximation; an unpaired sample has to be as large,
    sqrt(2) for each level at which it, or the sum it went into, is left over. The padding gets
    0. Shape (padded,).
    """
    sample = np.arange(padded)
    gains = np.where(sample < size, 1.0, 0.0)
    left, level = size, 0
    while left > 1:
        if left % 2:
            gains[sample >> level == left - 1] *= np.sqrt(2)
        left = (left + 1) // 2
        level += 1
    return gains
