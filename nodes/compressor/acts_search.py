"""Which taxels to read, decided from those that were just read: coarse first, then where it
matters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.errors import PhiError

#: A reading is a force where it is above so many standard deviations of an untouched taxel's
#: noise, and above this part of the range: 0.01 N of 2.5 N.
SIGMAS, RANGE_FRACTION = 4.0, 0.004
#: The first, evenly spaced readings take at most this part of all: the rest is for refining.
COARSE_PART = 0.25
#: Readings are taken in so many turns or more, each decided from those before it.
TURNS = 8

Read = Callable[[Indices], Floats]


def force_threshold(sigma_end: float, f_max: float) -> float:
    """Least reading that is taken for a force, in the unit of its arguments.

    Parameters
    ----------
    sigma_end : float
        Standard deviation of an untouched taxel's noise; 0 where it is not known.
    f_max : float
        Upper end of the taxels' range.
    """
    return max(SIGMAS * sigma_end, RANGE_FRACTION * f_max)


class ActsSearch:
    """Reads m taxels of a frame, each chosen by what the ones before it said.

    First a coarse lattice of every s-th taxel both ways. Then, in turns, taxels of lattices of
    s / 2, s / 4 ... 1 beside ones that bear a force: those between the most different readings
    that are furthest apart come first, for there an interpolation is most wrong. Where nothing
    is left to refine, the lattice is made finer everywhere, which may find more to refine. A
    frame's choice depends on that frame alone.

    Parameters
    ----------
    exists : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    m : int
        Number of taxels to read, 1..n.
    threshold : float
        Readings above it are forces.

    Raises
    ------
    PhiError
        If m is not in 1..n.

    Notes
    -----
    Source: the binary sampling of Slepyan et al., arXiv 2410.13847; that it follows differences
    of readings, for the sake of interpolation, is ours.
    """

    def __init__(self, exists: npt.NDArray[np.bool_], m: int, threshold: float) -> None:
        n = int(np.count_nonzero(exists))
        if not 1 <= m <= n:
            raise PhiError(f"acts: m = {m} is not allowed; allowed: 1..{n} (n = {n} taxels)")
        self.m = m
        self._threshold = threshold
        self._taxel_of_cell = np.full(exists.shape, -1, dtype=np.intp)
        self._taxel_of_cell[exists] = np.arange(n)
        self._numbers = np.arange(exists.size).reshape(exists.shape)
        self._steps = _steps(exists, m)
        self._offset = self._steps[0] // 2
        # Where no taxel is, or none was read yet, nothing is known.
        self._readings = np.empty(exists.shape, dtype=np.float32)
        self._unread = np.empty(exists.shape, dtype=np.bool_)
        self._score = np.empty(exists.shape, dtype=np.float32)
        self._exists = exists.copy()

    def places(self, read: Read) -> Indices:
        """Read a frame.

        Parameters
        ----------
        read : callable
            Takes numbers of taxels, intp, shape (k,); returns what they read, float32.

        Returns
        -------
        ndarray of intp, shape (m,)
            The taxels that were read, ascending.
        """
        self._readings.fill(-np.inf)
        np.copyto(self._unread, self._exists)
        left = self.m - self._take(self._lattice(self._steps[0]), self.m, read)
        while left:
            most = min(left, max(1, self.m // TURNS))
            chosen = self._to_refine(most)
            if not chosen.size:
                chosen = self._to_explore(most)
            left -= self._take(chosen, left, read)
        return np.sort(self._taxel_of_cell[self._exists & ~self._unread])

    def _take(self, cells: Indices, most: int, read: Read) -> int:
        """Read cells, the first `most` of them; how many that were."""
        cells = cells[:most]
        self._unread.reshape(-1)[cells] = False
        self._readings.reshape(-1)[cells] = read(self._taxel_of_cell.reshape(-1)[cells])
        return int(cells.size)

    def _lattice(self, step: int) -> Indices:
        """Cells of a lattice that were not read yet."""
        cells: Indices = self._part(self._numbers, step)[self._part(self._unread, step)]
        return cells

    def _part(self, grid: npt.NDArray[Any], step: int) -> npt.NDArray[Any]:
        """The cells of a lattice, also those that were read."""
        first = self._offset % step
        return grid[first::step, first::step]

    def _to_refine(self, most: int) -> Indices:
        """Cells beside a force, the most telling first."""
        self._score.fill(-1)
        for step in self._steps[1:]:
            highest, lowest = _around(self._part(self._readings, step))
            wanted = self._part(self._unread, step) & (highest > self._threshold)
            score = self._part(self._score, step)
            np.maximum(score, (highest - lowest) * np.float32(step), out=score, where=wanted)
        cells = np.flatnonzero(self._score >= 0)
        order = np.argsort(-self._score.reshape(-1)[cells], kind="stable")
        return cells[order[:most]]

    def _to_explore(self, most: int) -> Indices:
        """Cells of the coarsest lattice that was not read whole, spread evenly over it."""
        for step in self._steps:
            cells = self._lattice(step)
            if cells.size:
                return cells[np.linspace(0, cells.size - 1, min(most, cells.size)).astype(np.intp)]
        raise AssertionError("every taxel is read, and m are not")


def _steps(exists: npt.NDArray[np.bool_], m: int) -> list[int]:
    """Steps of the lattices, from the coarsest to 1, each half of the one before."""
    step = 1
    while step < max(exists.shape):
        first = step // 2
        if np.count_nonzero(exists[first::step, first::step]) <= max(1, COARSE_PART * m):
            break
        step *= 2
    return [step >> k for k in range(step.bit_length())]


def _around(known: Floats) -> tuple[Floats, Floats]:
    """Highest and lowest of what is known among each cell and its eight neighbours.

    -inf and +inf where nothing is.
    """
    n_rows, n_cols = known.shape
    high = np.pad(known, 1, constant_values=-np.inf)
    low = np.where(high == -np.inf, np.float32(np.inf), high)
    for axis, size in ((0, n_rows), (1, n_cols)):
        parts = [[slice(None), slice(None)] for _ in range(3)]
        for shift, part in enumerate(parts):
            part[axis] = slice(shift, shift + size)
        first, second, third = (tuple(part) for part in parts)
        high = np.maximum(np.maximum(high[first], high[second]), high[third])
        low = np.minimum(np.minimum(low[first], low[second]), low[third])
    return high, low
