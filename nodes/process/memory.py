"""Return of freed memory to the system after queues were long."""

from __future__ import annotations

import ctypes
import functools
import math
import os
from collections.abc import Callable

from .proc import resident_bytes

GROWN_BYTES = 1_000_000
"""Growth of resident memory over its minimum that makes a trim worth its time."""
STARTED_CALLS = 20
"""Number of the call that trims once, when the memory of the start is free."""
MOST_CALLS = 64
"""Largest number of calls between trims that free nothing."""


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """`malloc_trim` of glibc; None where the C library has none."""
    try:
        trim: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None
    return trim


class FreeMemory:
    """Returns freed memory to the system where the C library would keep it.

    Waiting messages are allocated by one thread and freed by another, between others that stay,
    so glibc keeps the memory of a long queue until the process ends, in writers and readers.
    """

    def __init__(self) -> None:
        self._least = math.inf
        self._pause = self._wait = 1
        self._n_calls = 0

    def trim(self) -> None:
        """Trim if resident memory is above its minimum; takes a millisecond.

        Call it periodically. While trims free nothing, they become ever less frequent.
        """
        trim = _trim()
        if trim is None:
            return
        self._n_calls += 1
        if self._n_calls == STARTED_CALLS:
            trim(0)
        try:
            resident = resident_bytes(os.getpid())
        except OSError:  # no descriptor is free
            return
        if resident <= self._least + GROWN_BYTES:
            self._least = min(self._least, resident)
            self._pause = self._wait = 1
            return
        self._wait -= 1
        if not self._wait:
            trim(0)
            self._pause = self._wait = min(2 * self._pause, MOST_CALLS)
