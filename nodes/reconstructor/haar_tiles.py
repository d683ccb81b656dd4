"""Haar levels as products with the matrix of a small tile: the quick way while sides are even."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Call, Floats, Indices

SIDES = (4, 2)
"""Sides of a tile: two levels in one product, or one."""


class HaarTiles:
    """Levels of the orthonormal Haar transform, as long as both sides come out even.

    Samples are kept as the columns of a matrix, a tile each, in an order in which the first row
    of what a product leaves, the sums, is the matrix of the next product's samples.

    A coefficient buffer holds what the products leave, one after the other; the sums that went on
    to the next are no coefficients.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the grid.
    few : int
        No product where so many samples, or fewer, are left.

    Attributes
    ----------
    rest : tuple of int
        Rows and columns of what is left.
    order : ndarray of intp, shape (n,)
        Place p of the sample buffer holds the sample order[p] of the flat grid.
    cells : ndarray of intp, shape (n_inner,)
        Flat cell of the pyramid of each place of a coefficient buffer; -1 for the sums. Empty
        where there is no product at all.
    rest_places : ndarray of intp
        Where the rest is, row by row: in the coefficient buffer, or the samples if that is empty.
    """

    def __init__(self, shape: tuple[int, int], few: int) -> None:
        self.rest = shape
        width = shape[1]
        stages: list[tuple[int, tuple[int, int]]] = []
        while self.rest[0] * self.rest[1] > few and (side := _side(self.rest)):
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


def haar_matrix(shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Return Psi^T of a small grid, row by row of its pyramid, float64, shape (n, n)."""
    rows, cols = shape
    pyramids = np.eye(rows * cols).reshape(rows * cols, rows, cols)
    while rows > 1 or cols > 1:
        corner = pyramids[:, :rows, :cols]
        pyramids[:, :rows, :cols] = _paired(_paired(corner).swapaxes(1, 2)).swapaxes(1, 2)
        rows, cols = (rows + 1) // 2, (cols + 1) // 2
    return pyramids.reshape(len(pyramids), -1).T


def _paired(samples: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return approximations and then details along axis 1, of samples of shape (k, n, other)."""
    n_paired = samples.shape[1] // 2 * 2
    a, b = samples[:, 0:n_paired:2], samples[:, 1:n_paired:2]
    halves = (a + b) / np.sqrt(2), samples[:, n_paired:], (a - b) / np.sqrt(2)
    return np.concatenate(halves, axis=1)


def _side(shape: tuple[int, int]) -> int:
    """Side of the largest tile that both sides are multiples of; 0 if there is none."""
    return next((side for side in SIDES if not shape[0] % side and not shape[1] % side), 0)


def _cells(
    a: Indices,
    b: Indices,
    i: Indices,
    j: Indices,
    side: int,
    tiles: tuple[int, int],
    width: int,
) -> Indices:
    """Return the cell of coefficient (a, b) of tile (i, j) in a pyramid of so many columns."""
    # Samples a side of a tile's level: 2 for the first of a tile of 4, 1 for the last.
    level = np.where(np.maximum(a, b) >= 2, 2, 1)
    down, right = a >= level, b >= level
    row = level * (i + down * (tiles[0] - 1)) + a
    col = level * (j + right * (tiles[1] - 1)) + b
    cells: Indices = np.where((a == 0) & (b == 0), -1, row * width + col)
    return cells
