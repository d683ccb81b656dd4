"""Interpolation along rows, columns and diagonals, for taxels that are others in each frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from sparseskin.nodes.compressor.calls import Floats, Indices


class LineInterpolation:
    """Values between known ones on a grid's rows, columns and diagonals.

    A cell is the mean of what the lines through it say on which it lies between two known cells:
    each is linear between these, and weighs 1 / (product of the two distances), by which such a
    line errs. Cells found so are known in the next pass, until no cell is between any; for those
    that are left the nearest that was known at first stands. So what is linear stays so, and
    nothing is above or below the known values. It costs about a tenth of a Delaunay triangulation.

    Parameters
    ----------
    wanted : ndarray of bool, shape (n_rows, n_cols)
        True where a value is asked for. Lines go on through the other cells.
    """

    def __init__(self, wanted: npt.NDArray[np.bool_]) -> None:
        self._wanted = wanted.reshape(-1)
        self._places = np.argwhere(np.ones_like(wanted))
        i, j = self._places.T
        n = i.size
        self._cells = np.empty((4, n), dtype=np.intp)
        #: Begin and end of the line that each step is on; steps are numbered through all lines.
        self._first = np.empty((4, n), dtype=np.intp)
        self._last = np.empty((4, n), dtype=np.intp)
        self._steps = np.arange(4 * n).reshape(4, n)
        for k, (line, along) in enumerate(((i, j), (j, i), (i - j, i), (i + j, i))):
            cells = np.lexsort((along, line))
            _, first, length = np.unique(line[cells], return_index=True, return_counts=True)
            self._cells[k] = cells
            self._first[k] = k * n + first.repeat(length)
            self._last[k] = k * n + (first + length - 1).repeat(length)
        # The square of a step's length: it is longer on diagonals.
        self._step2 = np.repeat([1.0, 1.0, 2.0, 2.0], n)

    def fill(self, known: Indices, values: Floats) -> Floats:
        """Return the values of all cells.

        Parameters
        ----------
        known : ndarray of intp, shape (m,)
            Flat numbers of the known cells, m >= 1.
        values : ndarray of float32, shape (m,)

        Returns
        -------
        ndarray of float32, shape (n_rows * n_cols,)
            0 where nothing was asked for and no line leads to.
        """
        filled = np.zeros(self._wanted.size, dtype=np.float32)
        filled[known] = values
        is_known = np.zeros(self._wanted.size, dtype=np.bool_)
        is_known[known] = True
        while not is_known[self._wanted].all():
            found, between = self._between(is_known, filled)
            if not found.size:
                missing = np.flatnonzero(self._wanted & ~is_known)
                nearest = cKDTree(self._places[known]).query(self._places[missing])[1]
                filled[missing] = values[nearest]
                break
            filled[found] = between
            is_known[found] = True
        return filled

    def _between(
        self, is_known: npt.NDArray[np.bool_], filled: Floats
    ) -> tuple[Indices, npt.NDArray[np.float64]]:
        """Return the cells that lie between known ones on some line, and their values."""
        known = is_known[self._cells]
        before = np.maximum.accumulate(np.where(known, self._steps, -1), axis=1)
        beyond = np.where(known, self._steps, self._steps.size)[:, ::-1]
        after = np.minimum.accumulate(beyond, axis=1)[:, ::-1]
        steps = np.flatnonzero((before >= self._first) & (after <= self._last) & ~known)
        before, after = before.take(steps), after.take(steps)
        back, ahead = steps - before, after - steps
        cells = self._cells.take(steps)
        low, high = (filled.take(self._cells.take(ends)) for ends in (before, after))
        weights = 1 / (back * ahead * self._step2.take(steps))
        on_line = (low * ahead + high * back) / (back + ahead)
        totals = np.bincount(cells, weights, is_known.size)
        sums = np.bincount(cells, weights * on_line, is_known.size)
        found = np.flatnonzero(totals)
        return found, sums[found] / totals[found]
