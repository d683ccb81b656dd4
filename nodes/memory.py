"""Memory of queues that were long once, given back to the system."""

from __future__ import annotations

import ctypes
import functools
import math
import os
from collections.abc import Callable
from pathlib import Path

GROWN_BYTES = 1_000_000
"""So much more resident memory than the least there was is worth looking through."""
STARTED_CALLS = 20
"""Calls after which what a start took is free: then it is looked through once."""
MOST_CALLS = 64
"""Calls from one look at memory that stays in use to the next."""


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """`malloc_trim` of glibc; None where the C library has none."""
    try:
        trim: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None
    return trim


class FreeMemory:
    """Hands what is free back to the system, where the C library would keep it.

    Messages that wait are allocated by one thread and freed by another, in between others that
    stay; so glibc keeps the whole of a queue for as long as the process lives, at its writer as
    at its reader.
    """

    def __init__(self) -> None:
        self._least = math.inf
        self._pause = self._wait = 1
        self._n_calls = 0

    def give_back(self) -> None:
        """Give back what is free, where memory is above the least that it was: takes a millisecond.

        To be called now and then. What is above it for good is looked through ever more seldom.
        """
        trim = _trim()
        if trim is None:
            return
        self._n_calls += 1
        if self._n_calls == STARTED_CALLS:
            trim(0)
        resident = _resident_bytes()
        if resident <= self._least + GROWN_BYTES:
            self._least = min(self._least, resident)
            self._pause = self._wait = 1
            return
        self._wait -= 1
        if not self._wait:
            trim(0)
            self._pause = self._wait = min(2 * self._pause, MOST_CALLS)


def _resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
