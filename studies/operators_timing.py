"""How long a call takes on a busy machine, and what the machine could do at best."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: A window of calls that is timed at once: shorter than a time slice, so that most of them are
#: not interrupted, and the median is of those.
WINDOW_US = 150.0
WINDOWS = 101


def median_us(function: Callable[[], object], windows: int = WINDOWS) -> float:
    """Median time of a call, in microseconds, over short windows of calls.

    Parameters
    ----------
    function : callable
        What is timed; called some more times before.
    windows : int
        How many windows.
    """
    function()
    begin_ns = time.perf_counter_ns()
    function()
    once_us = max((time.perf_counter_ns() - begin_ns) / 1e3, 0.05)
    calls = max(1, round(WINDOW_US / once_us))
    spans_us = []
    for _ in range(windows):
        begin_ns = time.perf_counter_ns()
        for _ in range(calls):
            function()
        spans_us.append((time.perf_counter_ns() - begin_ns) / 1e3 / calls)
    return float(np.median(spans_us))


def once_us(function: Callable[[], object]) -> float:
    """Time of one call, in microseconds."""
    begin_ns = time.perf_counter_ns()
    function()
    return (time.perf_counter_ns() - begin_ns) / 1e3


@dataclass(frozen=True)
class Machine:
    """What one core does at best, measured beside what it is compared with.

    Attributes
    ----------
    flops_per_us : float
        Sums and products of a float32 matrix product, 256 x 256, in a microsecond.
    bytes_per_us : float
        Bytes read and written by a copy of the size in question, in a microsecond.
    """

    flops_per_us: float
    bytes_per_us: float

    def flop_floor_us(self, flops: float) -> float:
        """Least time of so many operations."""
        return flops / self.flops_per_us

    def memory_floor_us(self, n_bytes: float) -> float:
        """Least time of so many bytes read and written."""
        return n_bytes / self.bytes_per_us


def measured_machine(n: int, windows: int = WINDOWS) -> Machine:
    """Measure them, the copy on vectors of n float32."""
    side = 256
    a, b, c = (np.ones((side, side), dtype=np.float32) for _ in range(3))
    product_us = median_us(lambda: np.dot(a, b, c), windows)
    source, target = np.ones(n, dtype=np.float32), np.ones(n, dtype=np.float32)
    copy_us = median_us(lambda: np.copyto(target, source), windows)
    return Machine(2 * side**3 / product_us, 8 * n / copy_us)
