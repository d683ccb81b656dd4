"""Checks of numbers that come from outside: messages, launch files, drivers, users' own code."""

import math
from typing import Any, TypeGuard

import numpy as np

INT64_MAX = (1 << 63) - 1
"""Largest whole number that a message may hold."""
HUGE = 1 << 256
"""Whole numbers of this size count as infinite: beyond any range in use, and near that of float."""


def is_whole(
    value: Any, low: float = -math.inf, high: float = math.inf
) -> TypeGuard[int]:
    """True for an integer in [low, high], NumPy's too; True and False are none."""
    # bool is a subclass of int.
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        return False
    return bool(low <= value <= high)


def is_real(
    value: Any, low: float = -math.inf, high: float = math.inf
) -> TypeGuard[float]:
    """True for a finite number in [low, high], NumPy's too; True and False are none."""
    # An integer may be too large to be converted to float.
    if isinstance(value, int):
        return is_whole(value, low, high) and abs(value) < HUGE
    if not isinstance(value, float | np.integer | np.floating):
        return False
    return math.isfinite(value) and bool(low <= value <= high)
