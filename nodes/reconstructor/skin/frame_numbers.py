"""Numbers of the measurements of a frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY

from .vectors import Comparison

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


def frame_numbers(comparison: Comparison, n_read: int, *, was_read: bool) -> FrameNumbers:
    """Return the numbers of a frame whose row subset was read before, or was not."""
    repeated = 0.0
    if was_read:
        change = comparison.change / (SAME * comparison.largest + TINY)
        repeated = 1 / (1 + min(change, CLEAR_CHANGE) ** 8)

    # Of this frame alone: one frame of garbage must not blind those after it.
    floor = max(RESOLUTION**2 * comparison.power, TINY)
    return FrameNumbers(n_read, floor, repeated, is_silent=comparison.largest == 0)
