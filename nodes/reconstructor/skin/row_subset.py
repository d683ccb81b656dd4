"""A row subset of the default solver: its last measurements, compared with those of a frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats, shared

from .rows import Rows

RESOLUTION = float(np.finfo(np.float32).eps)
"""Relative resolution of measurements: a noise below it does not show in them."""
SAME = 1e-6
"""Largest change of measurements, in the largest one, at which half of them counts as repeated:
above the resolution of float32, below that of any converter."""
CLEAR_CHANGE = 1e3
"""The same in `SAME`, beyond which a larger change does not count: its power stays finite."""


class Comparison(NamedTuple):
    """Measurements of a frame, and the last ones of its row subset."""

    power: float  # mean square
    largest: float  # largest absolute value
    change: float  # largest absolute change


class FrameNumbers(NamedTuple):
    """Numbers of the measurements of a frame."""

    n_read: int  # rows read
    floor: float  # least variance: the resolution of the measurements
    repeated: float  # part of the measurements that repeats the last ones of this subset, 0 to 1
    is_silent: bool  # all measurements are 0: nothing presses


class RowSubset:
    """The last measurements of a row subset and their innovation, and Phi 1.

    Parameters
    ----------
    rows : Rows
        W, which reads this row subset now.

    Attributes
    ----------
    ones : ndarray of float32, shape (n_read,)
        Phi 1, in the order of the rows read.
    ones_energy : float
        Its squared length.
    y : ndarray of float32, shape (m,)
        The last measurements of this subset.
    innovation : ndarray of float32, shape (n_read,)
        Of its last frame.
    was_read : bool
        True if there was a frame of this subset; y and innovation are 0 else.
    """

    def __init__(self, rows: Rows, m: int) -> None:
        all_ones = np.ones(rows.n, dtype=np.float32)
        self.ones = shared(rows.forward(all_ones)[rows.read])
        self.ones_energy = float(self.ones @ self.ones)
        self.y = np.zeros(m, dtype=np.float32)
        self.innovation = np.zeros(len(self.ones), dtype=np.float32)
        self.was_read = False

    def keep(self, y: Floats, innovation: Floats) -> None:
        """Keep measurements and innovation of a frame."""
        self.y[:] = y
        self.innovation = innovation
        self.was_read = True

    def numbers(self, comparison: Comparison) -> FrameNumbers:
        """Return the numbers of a frame by its comparison with the last one."""
        repeated = 0.0
        if self.was_read:
            change = comparison.change / (SAME * comparison.largest + TINY)
            repeated = 1 / (1 + min(change, CLEAR_CHANGE) ** 8)

        # Of this frame alone: one frame of garbage must not blind those after it.
        floor = max(RESOLUTION**2 * comparison.power, TINY)
        return FrameNumbers(len(self.ones), floor, repeated, is_silent=comparison.largest == 0)
