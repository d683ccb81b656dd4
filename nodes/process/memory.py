"""Return of freed memory to the system after queues were long."""

import contextlib
import ctypes
import math
import os

from .proc import resident_bytes

GROWN_BYTES = 1_000_000
"""Growth of resident memory over its minimum that makes a trim worth its time."""
EVERY = 20
"""Calls between two trims; memory of the start is free at the first of them."""


class FreeMemory:
    """Returns freed memory to the system where the C library would keep it.

    Waiting messages are allocated by one thread and freed by another, between others that stay,
    so glibc keeps the memory of a long queue until the process ends, in writers and readers.
    """

    def __init__(self) -> None:
        self._least_bytes = math.inf
        self._n_calls = 0
        # Of glibc alone.
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)

    def trim(self) -> None:
        """Trim at the 20th call, and at every 20th where resident memory is above its minimum; to
        be called periodically. A trim takes a millisecond.
        """
        self._n_calls += 1
        if self._trim is None or self._n_calls % EVERY:
            return
        # Where no descriptor is free, /proc cannot be read.
        with contextlib.suppress(OSError):
            resident = resident_bytes(os.getpid())
            if self._n_calls == EVERY or resident > self._least_bytes + GROWN_BYTES:
                self._trim(0)
                resident = resident_bytes(os.getpid())
            self._least_bytes = min(self._least_bytes, resident)
