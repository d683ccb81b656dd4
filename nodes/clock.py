"""Clocks: time is handed to a node, never fetched by it."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Whatever tells the graph's time."""

    def now_ns(self) -> int:
        """Time now, in nanoseconds since the epoch; it never goes back."""
        ...


def wall_offset_ns() -> int:
    """What to add to the monotonic clock, in nanoseconds, to get the time of day now."""
    return time.time_ns() - time.monotonic_ns()


class SystemClock:
    """The monotonic clock of the host, shifted to the time of day once, at start.

    All nodes of a graph are given the same `offset_ns`, so that their stamps agree, and a
    clock that is stepped while they run changes nothing.
    """

    def __init__(self, offset_ns: int | None = None) -> None:
        self.offset_ns = wall_offset_ns() if offset_ns is None else offset_ns

    def now_ns(self) -> int:
        return time.monotonic_ns() + self.offset_ns


class ManualClock:
    """A clock that moves only when told to: for tests and offline runs."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance(self, ns: int) -> None:
        """Move on by `ns` nanoseconds, 0 or more."""
        if ns < 0:
            raise ValueError(f"a clock never goes back: {ns} ns")
        self._now_ns += ns
