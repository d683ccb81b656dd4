"""What the default solver remembers of a row subset."""

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
    innovation : ndarray of float32, shape (n_read,), or None
        Of the last frame of this subset; None: there was none.
    """

    def __init__(self, rows: Rows) -> None:
        all_ones = np.ones(rows.n, dtype=np.float32)
        self.ones = shared(rows.forward(all_ones)[rows.read])
        self.ones_energy = float(self.ones @ self.ones)
        self.innovation: Floats | None = None
        self._y: Floats | None = None

    def forget(self) -> None:
        """Forget the last frame."""
        self.innovation = None
        self._y = None

    def begin(self, y: Floats) -> FrameNumbers:
        """Return the numbers of measurements y, float32 (m,), the last ones from now on."""
        largest = float(np.abs(y).max())
        repeated = 0.0
        if self._y is not None:
            change = float(np.abs(y - self._y).max()) / (SAME * largest + TINY)
            repeated = 1 / (1 + min(change, CLEAR_CHANGE) ** 8)
        self._y = y.copy()

        # Of this frame alone: one frame of garbage must not blind those after it.
        power = float(np.square(y, dtype=np.float64).sum()) / len(y)
        return FrameNumbers(
            n_read=len(self.ones),
            floor=max(RESOLUTION**2 * power, TINY),
            repeated=repeated,
            is_silent=largest == 0,
        )
