"""Memory of a queue that was long once, given back to the system."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """`malloc_trim` of glibc; None where the C library has none."""
    try:
        trim: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None
    return trim


def give_back() -> None:
    """Hand what is free back to the system, where the C library would keep it.

    Messages that wait are allocated by ZeroMQ's thread and freed by the node's, in between others
    that stay; so glibc keeps the whole of it for as long as the process lives. Takes milliseconds.
    """
    if (trim := _trim()) is not None:
        trim(0)
