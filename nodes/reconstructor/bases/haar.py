"""The two-dimensional Haar basis at full depth, on a grid of any size."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices
from sparseskin.nodes.numerics.programs import Call, run

from .base import Basis

MAX_DENSE = 64
"""Samples up to which one product with a matrix is faster than a level after the other (timed)."""
TILE_SIDES = (4, 2)
"""Sides of a tile: two levels in one product, or one."""


class HaarBasis(Basis):
    """Psi = the orthonormal 2-D Haar (Daubechies D2) basis, full depth.

    At each level neighbours are paired along both axes: (a + b) / sqrt(2) goes on to the next
    level, (a - b) / sqrt(2) is a detail. The last sample of an odd side goes on unchanged. A
    side of 1 is done while the other goes on. Coefficients are laid out as a pyramid: at each
    level the approximation top left, details along the columns' direction (axis 1) to its
    right, along the rows' (axis 0) below it, along both diagonally.

    Levels with even sides are products with the matrix of a tile. What they leave, the rest, is
    one product with its matrix if it has 64 samples or fewer, else two products a level.

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
        Length of an inner coefficient buffer; more than n_rows * n_cols, for it also holds the
        approximations of inner levels, which are no coefficients.

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
        self._even = _Tiles((n_rows, n_cols))
        self.order: Indices = self._even.order
        rows, cols = self._even.rest
        self._matrix: Floats | None = None
        self._levels: list[tuple[int, int, Floats, Floats]] = []
        if rows * cols <= MAX_DENSE:
            self._matrix = haar_matrix((rows, cols)).astype(np.float32)
        else:
            for r, k in level_sizes(rows, cols):
                # 1 and 1/2 in place of twice sqrt(1/2), which float32 would round.
                scale = np.sqrt(2) if r > 1 and k > 1 else 1.0
                by_rows, by_cols = level_matrix(r) * scale, level_matrix(k) / scale
                self._levels.append((r, k, by_rows.astype(np.float32), by_cols.astype(np.float32)))
        corner = np.arange(n_rows * n_cols).reshape(n_rows, n_cols)[:rows, :cols]
        cells = np.concatenate([self._even.cells, corner.ravel()])
        real = cells >= 0
        self.n_inner: int = cells.size
        self._cell_of_place: Indices = np.where(real, cells, 0)
        self._place_of_cell: Indices = np.flatnonzero(real)[np.argsort(cells[real])]

        self.place_of_pixel: Indices = np.argsort(self.order)
        self._x = np.empty(self.order.size, dtype=np.float32)
        self._c = np.empty(self.n_inner, dtype=np.float32)
        self._to_c = self.analysis_program(self._x, self._c)
        self._to_x = self.synthesis_program(self._c, self._x)

    def analysis_program(self, x: Floats, c: Floats) -> list[Call]:
        """Return the calls that compute inner coefficients c, (n_inner,), from an image x.

        x, float32 (n_rows * n_cols,), is in the inner `order`; it is not modified.
        """
        even_c, deep_c, rest = self._split(c, x)
        calls = self._even.analysis(x, even_c)
        if self._matrix is not None:
            return [*calls, (np.dot, (self._matrix, rest, deep_c))]
        source, pyramid = rest.reshape(self._even.rest), deep_c.reshape(self._even.rest)
        half = np.empty_like(source)
        for r, k, by_rows, by_cols in self._levels:
            calls.append((np.matmul, (by_rows, source[:r, :k], half[:r, :k])))
            calls.append((np.matmul, (half[:r, :k], by_cols.T, pyramid[:r, :k])))
            source = pyramid
        return calls

    def synthesis_program(self, c: Floats, x: Floats) -> list[Call]:
        """Return the calls that compute the image x from c, which is overwritten."""
        even_c, deep_c, rest = self._split(c, x)
        even = self._even.synthesis(even_c, x)
        if self._matrix is not None:
            return [(np.dot, (deep_c, self._matrix, rest)), *even]
        image, pyramid = rest.reshape(self._even.rest), deep_c.reshape(self._even.rest)
        half = np.empty_like(image)
        calls: list[Call] = []
        for r, k, by_rows, by_cols in reversed(self._levels):
            target = image if (r, k) == image.shape else pyramid
            calls.append((np.matmul, (by_rows.T, pyramid[:r, :k], half[:r, :k])))
            calls.append((np.matmul, (half[:r, :k], by_cols, target[:r, :k])))
        return [*calls, *even]

    def _split(self, c: Floats, x: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the coefficients of even levels and of the rest, and the rest's samples."""
        even_c, deep_c = np.split(c, [self._even.cells.size])
        places = self._even.rest_places
        rest = (even_c if even_c.size else x)[places[0] : places[-1] + 1]
        return even_c, deep_c, rest

    def _analysis(self, image: Floats, out: Floats) -> None:
        image.take(self.order, None, self._x, "clip")
        run(self._to_c)
        self._c.take(self._place_of_cell, None, out, "clip")

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        coefficients.take(self._cell_of_place, None, self._c, "clip")
        run(self._to_x)
        self._x.take(self.place_of_pixel, None, out, "clip")


def level_matrix(n: int) -> Doubles:
    """Return one level along a side of n: approximations first, float64 (n, n), orthonormal."""
    half, level = n // 2, np.zeros((n, n))
    i = np.arange(half)
    level[i, 2 * i] = level[i, 2 * i + 1] = level[n - half + i, 2 * i] = np.sqrt(0.5)
    level[n - half + i, 2 * i + 1] = -np.sqrt(0.5)
    if n % 2:
        level[half, n - 1] = 1
    return level


def level_sizes(rows: int, cols: int) -> list[tuple[int, int]]:
    """Return the size of the approximation that each level begins with."""
    sizes = []
    while rows > 1 or cols > 1:
        sizes.append((rows, cols))
        rows, cols = (rows + 1) // 2, (cols + 1) // 2
    return sizes


def haar_matrix(shape: tuple[int, int]) -> Doubles:
    """Return Psi^T of a small grid, row by row of its pyramid, float64, shape (n, n)."""
    pyramids = np.eye(shape[0] * shape[1]).reshape(-1, *shape)
    for r, k in level_sizes(*shape):
        pyramids[:, :r, :k] = level_matrix(r) @ pyramids[:, :r, :k] @ level_matrix(k).T
    return pyramids.reshape(len(pyramids), -1).T


class _Tiles:
    """Levels of the orthonormal Haar transform while both sides are even, as matrix products.

    Samples are the columns of a matrix, a tile each, in an order in which the first row of a
    product, the sums, is the matrix of the next product's samples. A coefficient buffer holds the
    products one after the other; the sums that went on to the next are no coefficients.

    Attributes
    ----------
    rest : tuple of int
        Rows and columns of the rest: an odd side, or `MAX_DENSE` samples or fewer.
    order : ndarray of intp, shape (n,)
        Place p of the sample buffer holds the sample order[p] of the flat grid.
    cells : ndarray of intp, shape (n_inner,)
        Flat cell of the pyramid of each place of a coefficient buffer; -1 for the sums. Empty
        where there is no product at all.
    rest_places : ndarray of intp
        Where the rest is, row by row: in the coefficient buffer, or the samples if that is empty.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.rest = shape
        width = shape[1]
        stages: list[tuple[int, tuple[int, int]]] = []
        while self.rest[0] * self.rest[1] > MAX_DENSE and (side := _side(self.rest)):
            self.rest = self.rest[0] // side, self.rest[1] // side
            stages.append((side, self.rest))
        self.order: Indices = np.arange(self.rest[0] * self.rest[1])
        parts: list[Indices] = []
        self._parts: list[tuple[int, int, Floats]] = []  # samples and tiles of each product
        for side, tiles in reversed(stages):
            a, b = (k.reshape(-1, 1) for k in np.divmod(np.arange(side * side), side))
            i, j = np.divmod(self.order, tiles[1])
            parts.insert(0, _cells(a, b, i, j, side, tiles, width).ravel())
            self.order = ((i * side + a) * (tiles[1] * side) + j * side + b).ravel()
            matrix = haar_matrix((side, side)).astype(np.float32)
            self._parts.insert(0, (self.order.size, i.size, matrix))
        self.cells: Indices = np.concatenate([np.empty(0, dtype=np.intp), *parts])
        begin = self.cells.size - (self._parts[-1][0] if self._parts else 0)
        self.rest_places: Indices = begin + np.arange(self.rest[0] * self.rest[1])

    def analysis(self, x: Floats, c: Floats) -> list[Call]:
        """Return the calls that turn samples x, shape (n,), into coefficients c, (n_inner,)."""
        calls: list[Call] = []
        for matrix, samples, part in self._products(x, c):
            calls.append((np.dot, (matrix, samples, part)))
        return calls

    def synthesis(self, c: Floats, x: Floats) -> list[Call]:
        """Return the calls of the transposed transform: coefficients c, overwritten, to x."""
        calls: list[Call] = []
        for matrix, samples, part in reversed(self._products(x, c)):
            calls.append((np.dot, (matrix.T.copy(), part, samples)))
        return calls

    def _products(self, x: Floats, c: Floats) -> list[tuple[Floats, Floats, Floats]]:
        """Return matrix, samples and coefficients of each product."""
        products = []
        start, samples = 0, x
        for n, n_tiles, matrix in self._parts:
            part = c[start : start + n].reshape(-1, n_tiles)
            products.append((matrix, samples.reshape(-1, n_tiles), part))
            start, samples = start + n, part[0]
        return products


def _side(shape: tuple[int, int]) -> int:
    """Side of the largest tile that both sides are multiples of; 0 if there is none."""
    return next((side for side in TILE_SIDES if not shape[0] % side and not shape[1] % side), 0)


def _cells(
    a: Indices, b: Indices, i: Indices, j: Indices, side: int, tiles: tuple[int, int], width: int
) -> Indices:
    """Return the cell of coefficient (a, b) of tile (i, j) in a pyramid of so many columns."""
    # Samples a side of a tile's level: 2 for the first of a tile of 4, 1 for the last.
    level = np.where(np.maximum(a, b) >= 2, 2, 1)
    down, right = a >= level, b >= level
    row = level * (i + down * (tiles[0] - 1)) + a
    col = level * (j + right * (tiles[1] - 1)) + b
    cells: Indices = np.where((a == 0) & (b == 0), -1, row * width + col)
    return cells
