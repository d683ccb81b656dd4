"""Windows and tiles of a skin, which the denoisers of solver `skin` take and return."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from sparseskin.nodes.numerics.arrays import AnyArray, Floats, Indices, Mask

TILE = 8
"""Side of a tile, in taxels."""
WINDOW = 12
"""Side of the window around a tile that it is denoised from, in taxels."""
WINDOW_MARGIN = (WINDOW - TILE) // 2
MARGIN = WINDOW_MARGIN + TILE - 1
"""Cells around the skin, of the windows at any shift."""
SHIFTS = tuple(
    (5 * i % TILE, (3 * i + i // TILE * 5) % TILE) for i in range(TILE * TILE)
)
"""Shifts of the tiles, rows and columns, in the order of iterations: each once in 64."""
REFERENCE_WINDOWS = 81
"""Windows of a skin of 64 x 64, for which `STANDS_OUT` was derived."""


def inner(windows: Floats) -> Floats:
    """The tile of each window: (t, 144) to (t, 64)."""
    side = slice(WINDOW_MARGIN, WINDOW_MARGIN + TILE)
    n = windows.shape[:-1]
    squares = windows.reshape(*n, WINDOW, WINDOW)
    tiles = squares[..., side, side]
    return tiles.reshape(*n, TILE * TILE)


class Tiles:
    """Windows and tiles of a skin at each of `SHIFTS`, cut from a canvas with a margin around it.

    A cell of the canvas without a taxel reads the nearest one among its eight neighbours. A vector
    of taxels ends with a 0, which it reads where there is none.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns.
    cells : ndarray of intp, shape (n,)
        Flat cell of each place in the vector of taxels.

    Attributes
    ----------
    shape, cells
        As passed.
    places : ndarray of intp, shape (n_rows, n_cols)
        Place in the vector of taxels of each cell; n where none exists.
    canvas : ndarray of intp, shape (n_rows + 2 MARGIN, n_cols + 2 MARGIN)
        Place in the vector of taxels that each cell reads.
    shares : tuple of ndarray of float32, shape (t,)
        Part of the taxels that lie in each tile, of each shift.
    most : int
        Largest number of tiles at any shift.
    strictness : float
        Factor of `STANDS_OUT`, above 0 to 1: of fewer windows, noise exceeds less in any case.
        Derived: the largest of n normal numbers grows with the root of log n.
    """

    def __init__(self, shape: tuple[int, ...], cells: Indices) -> None:
        n = len(cells)
        self.shape = shape
        self.cells = cells

        self.places = np.full(shape, n, dtype=np.intp)
        self.places.reshape(-1)[cells] = np.arange(n)

        # Cell -1 has no taxel: those that are near none read it.
        mask = self.places < n
        place_of_cell = np.append(self.places.reshape(-1), n)
        nearest = place_of_cell[nearest_taxels(mask)]
        self.canvas = np.pad(nearest, MARGIN, constant_values=n)

        exists = np.pad(mask, MARGIN).astype(np.float32)
        shares = []
        for number in range(len(SHIFTS)):
            tiles = inner(self.cut(exists, number))
            shares.append(tiles.sum(axis=1) / np.float32(n))
        self.shares = tuple(shares)
        self.most = max(map(len, shares))

        # One more along a side than fit: where it is shifted, both ends have a part of one.
        n_windows = math.prod(-(-side // TILE) + 1 for side in shape)
        power = math.log(n_windows) / math.log(REFERENCE_WINDOWS)
        self.strictness = min(max(math.sqrt(power), 1e-6), 1.0)

    def cut(self, canvas: AnyArray, number: int) -> AnyArray:
        """Windows of a canvas at a shift, by its number: (rows, columns) to (t, 144)."""
        row, col = (MARGIN - WINDOW_MARGIN - shift for shift in SHIFTS[number])
        shifted = canvas[row:, col:]
        side = (WINDOW, WINDOW)
        at_each_cell = np.lib.stride_tricks.sliding_window_view(shifted, side)
        windows = at_each_cell[::TILE, ::TILE]
        return windows.reshape(-1, WINDOW * WINDOW)

    def windows(self, taxels: Floats, number: int) -> Floats:
        """Windows of a vector of taxels, (n + 1,), at a shift: (t, 144)."""
        return self.cut(taxels[self.canvas], number)

    def taxels(self, tiles: AnyArray, number: int) -> AnyArray:
        """The vector of taxels, (n,), of tiles at a shift, (t, 64)."""
        n_rows, n_cols = self.shape
        row, col = SHIFTS[number]
        n_across = -(-(n_cols + col) // TILE)
        squares = tiles.reshape(-1, n_across, TILE, TILE)
        image = squares.swapaxes(1, 2).reshape(-1, n_across * TILE)
        skin = image[row : row + n_rows, col : col + n_cols]
        return skin.reshape(-1)[self.cells]


def tiles_of(shape: tuple[int, ...], cells: Indices) -> Tiles:
    """Return the tiles of a skin, as of `Tiles`: the same ones for skins that are alike."""
    return _tiles(shape, np.asarray(cells, dtype=np.intp).tobytes())


@lru_cache(maxsize=16)
def _tiles(shape: tuple[int, ...], cells: bytes) -> Tiles:
    return Tiles(shape, np.frombuffer(cells, dtype=np.intp))


def nearest_taxels(mask: Mask) -> Indices:
    """Return for each cell the flat cell of the nearest taxel, within its eight neighbours.

    mask, bool (n_rows, n_cols), is True where a taxel exists. The result is intp (n_rows, n_cols);
    n_rows * n_cols where there is none.
    """
    if mask.all():
        return np.arange(mask.size).reshape(mask.shape)
    # Half the time of the start of a process: only where it is needed.
    from scipy import ndimage

    distance, (row, col) = ndimage.distance_transform_edt(~mask, return_indices=True)
    # A diagonal neighbour is at 1.41.
    is_neighbour = distance < 1.5
    nearest = row * mask.shape[1] + col
    return np.where(is_neighbour, nearest, mask.size)


def neighbours_of(tiles: Tiles) -> Indices:
    """Return the places of the next and the previous neighbour of each taxel along rows and
    columns: intp (next or previous, rows or columns, n). A missing neighbour is the taxel itself.
    """
    places = tiles.places
    n = len(tiles.cells)
    exists = places < n
    edged = np.pad(places, 1, constant_values=n)
    following = (edged[2:, 1:-1], edged[1:-1, 2:])
    previous = (edged[:-2, 1:-1], edged[1:-1, :-2])

    neighbours = np.empty((2, 2, n), dtype=np.intp)
    for side, shifted in enumerate((following, previous)):
        for axis, neighbour in enumerate(shifted):
            or_itself = np.where(neighbour < n, neighbour, places)
            of_taxels = neighbours[side, axis]
            of_taxels[places[exists]] = or_itself[exists]
    return neighbours
