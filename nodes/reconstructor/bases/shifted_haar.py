"""Three levels of Haar on tiles of 8 x 8 taxels, laid over the skin at any of several shifts."""

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.programs import Call

TILE = 8
LEVELS = 3
#: Shifts of the tiles (rows, columns): each row and each column of a tile twice.
SHIFTS = tuple((i % TILE, (3 * i + i // TILE * 4) % TILE) for i in range(16))


class ShiftedHaar:
    """Haar coefficients of an image under one of `SHIFTS`.

    Haar represents an edge sparsely only where it lies on its grid. A random shift in each
    iteration prefers no place, at no cost: the shift is part of a gather.

    The tiles cover a canvas, the skin's sides rounded up to multiples of 8, and wrap round at
    its edges. Cells of the canvas without a taxel are 0.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the grid.
    place_of_cell : ndarray of intp, shape (n_rows, n_cols)
        Where the vector of taxels holds each cell of the grid; n where no taxel exists.
    n : int
        Number of taxels.

    Attributes
    ----------
    size : int
        Number of cells of the canvas, and of coefficients.
    weights2 : ndarray of float32, shape (size,)
        The transform T only adds and subtracts: an orthonormal coefficient is
        sqrt(weights2) * T x, and the image T^T (weights2 * T x) is x again.

    Notes
    -----
    Source: random shifts in place of all shifts: Figueiredo, Nowak, "An EM algorithm for
    wavelet-based image restoration", IEEE Trans. Image Processing 12(8), 2003; Kamilov, Bostan,
    Unser, "Wavelet shrinkage with consistent cycle spinning generalizes total variation
    denoising", IEEE Signal Processing Letters 19(4), 2012.
    """

    def __init__(self, shape: tuple[int, int], place_of_cell: Indices, n: int) -> None:
        n_rows, n_cols = (-(-side // TILE) * TILE for side in shape)
        self.size = n_rows * n_cols
        self._n = n
        canvas = np.full((n_rows, n_cols), n, dtype=np.intp)
        canvas[: shape[0], : shape[1]] = place_of_cell
        self._canvas = canvas
        # Partners along the rows, then along the columns, stand half a part apart at each level.
        cells = np.arange(self.size).reshape(n_rows, n_cols)
        self._cells = in_planes(cells, LEVELS)
        self._tables: dict[int, tuple[Indices, Indices]] = {}

        self.weights2: Floats = np.empty(self.size, dtype=np.float32)
        part = self.size
        for level in range(1, LEVELS + 1):
            self.weights2[part // 4 : part] = 0.25**level
            part //= 4
        self.weights2[:part] = 0.25**LEVELS

    def tables(self, shift: int) -> tuple[Indices, Indices]:
        """Return the gathers of one of `SHIFTS`, by its number: intp, shapes (size,) and (n,).

        The first holds the place in the vector of taxels of each place of the canvas, n where there
        is none; the second the place on the canvas of each place of the vector.
        """
        if shift not in self._tables:
            rows, cols = SHIFTS[shift]
            rolled = np.roll(self._canvas, (rows, cols), axis=(0, 1))
            to_canvas = rolled.reshape(-1)[self._cells]
            from_canvas = np.empty(self._n + 1, dtype=np.intp)
            from_canvas[to_canvas] = np.arange(self.size)
            self._tables[shift] = to_canvas, from_canvas[:-1].copy()
        return self._tables[shift]

    def analysis(self, x: Floats, c: Floats, scratch: Floats) -> list[Call]:
        """Return the calls that compute c = T x; all float32 (size,), x is not modified."""
        calls: list[Call] = []
        source, part = x, self.size
        for _ in range(LEVELS):
            calls += _sums_and_differences(source[:part].reshape(1, 2, -1), scratch[:part])
            calls += _sums_and_differences(scratch[:part].reshape(2, 2, -1), c[:part])
            source, part = c, part // 4
        return calls

    def synthesis(self, c: Floats, x: Floats, scratch: Floats) -> list[Call]:
        """Return the calls that compute x = T^T c; all float32 (size,), c is overwritten."""
        calls: list[Call] = []
        parts = [self.size // 4**level for level in range(LEVELS)]
        for part in reversed(parts):
            target = x if part == self.size else c
            calls += _sums_and_differences(c[:part].reshape(2, 2, -1), scratch[:part])
            calls += _sums_and_differences(scratch[:part].reshape(1, 2, -1), target[:part])
        return calls

    def shrinking(self, x: Floats, lambda2: Floats) -> list[Call]:
        """Return the calls that shrink the coefficients of x by the nonnegative garrote.

        g(c) = c max(0, 1 - lambda^2 / c^2) leaves large coefficients all but unbiased. On
        coefficients that are not scaled, the weights w^2 of the synthesis included, it is
        c (w^2 - lambda^2 / max(c^2, lambda^2 / w^2)).

        x, float32 (size,), is an image on the canvas, changed in place; lambda2, float32 (), is
        lambda^2, above 0, read when the calls are made. Source: Gao, "Wavelet shrinkage
        denoising using the non-negative garrote", J. Comput. Graph. Statist. 7(4), 1998.
        """
        c, gain, limit = (np.zeros(self.size, dtype=np.float32) for _ in range(3))
        return [
            *self.analysis(x, c, limit),
            (np.multiply, (c, c, gain)),
            (np.multiply, (1 / self.weights2, lambda2, limit)),
            (partial(np.maximum, gain, limit, out=gain), ()),
            (np.divide, (lambda2, gain, gain)),
            (np.subtract, (self.weights2, gain, gain)),
            (np.multiply, (c, gain, c)),
            *self.synthesis(c, x, limit),
        ]


def _sums_and_differences(source: npt.NDArray[np.float32], target: Floats) -> list[Call]:
    """Return the calls that write sums and differences of pairs along axis 1 of (k, 2, q)."""
    into = target.reshape(source.shape)
    low, high = source[:, 0], source[:, 1]
    return [(np.add, (low, high, into[:, 0])), (np.subtract, (low, high, into[:, 1]))]


def in_planes(cells: Indices, levels: int) -> Indices:
    """Return the cells with partners half a part apart: even rows first, even columns first.

    Both sides of `cells` are divisible by 2^levels; each level works within the last's quarters.
    """
    if levels == 0:
        return cells.reshape(-1)
    planes = [cells[down::2, right::2] for down in (0, 1) for right in (0, 1)]
    return np.concatenate([in_planes(plane, levels - 1) for plane in planes])
