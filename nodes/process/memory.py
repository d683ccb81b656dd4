"""Return of freed memory to the system after queues were long."""

import ctypes
import functools
import math
import os
from collections.abc import Callable

from .proc import resident_bytes

GROWN_BYTES = 1_000_000
"""Growth of resident memory over its minimum that makes a trim worth its time."""
EVERY = 20
"""Calls between two trims; memory of the start is free at the first of them."""


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """`malloc_trim` of glibc; None where the C library has none."""
    return getattr(ctypes.CDLL(None), "malloc_trim", None)


class FreeMemory:
    """Returns freed memory to the system where the C library would keep it.

    Waiting messages are allocated by one thread and freed by another, between others that stay,
    so glibc keeps the memory of a long queue until the process ends, in writers and readers.
    """

    def __init__(self) -> None:
        self._least, self._n_calls = math.inf, 0

    def trim(self) -> None:
        """Trim at the 20th call, and at every 20th where resident memory is above its minimum.

        Call it periodically; a trim takes a millisecond.
        """
        trim, self._n_calls = _trim(), self._n_calls + 1
        if trim is None or self._n_calls % EVERY:
            return
        try:
            resident = resident_bytes(os.getpid())
            if self._n_calls == EVERY or resident > self._least + GROWN_BYTES:
                trim(0)
                resident = resident_bytes(os.getpid())
        except OSError:  # no descriptor is free
            return
        self._least = min(self._least, resident)
