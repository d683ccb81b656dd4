"""The four neighbours of each taxel, on any grid, for vectors in any order."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.calls import Floats, Indices


class Neighbours:
    """Gathers what stands beside each taxel; a taxel stands for a neighbour that it has not.

    Parameters
    ----------
    place_of_cell : ndarray of intp, shape (n_rows, n_cols)
        Where a vector of taxels holds each cell of the grid; n where no taxel exists.
    n : int
        Number of taxels.

    Attributes
    ----------
    after, before : ndarray of float32, shape (2, n)
        What `gather` found in the next and in the last row, and column.
    places : tuple of ndarray of intp, shape (2, n)
        Where it finds that, of after and of before.
    """

    def __init__(self, place_of_cell: Indices, n: int) -> None:
        self.places = _places(place_of_cell, n, -1), _places(place_of_cell, n, 1)
        self.after = np.zeros((2, n), dtype=np.float32)
        self.before = np.zeros((2, n), dtype=np.float32)

    def gather(self, x: Floats) -> None:
        """Fill `after` and `before` from a vector of taxels, float32 (n,)."""
        after, before = self.places
        x.take(after, None, self.after, "clip")
        x.take(before, None, self.before, "clip")


def _places(place_of_cell: Indices, n: int, shift: int) -> Indices:
    """Return the place of the neighbour of each place along rows and columns, (2, n)."""
    found = np.empty((2, n), dtype=np.intp)
    exists = place_of_cell < n
    for axis in (0, 1):
        other = np.roll(place_of_cell, shift, axis=axis)
        edge = [slice(None), slice(None)]
        edge[axis] = slice(-1, None) if shift < 0 else slice(0, 1)
        other[tuple(edge)] = n
        other = np.where(other < n, other, place_of_cell)
        found[axis, place_of_cell[exists]] = other[exists]
    return found
