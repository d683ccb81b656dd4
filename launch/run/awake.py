"""Time without the pauses of this process."""

from __future__ import annotations

import time
from collections.abc import Callable

MAX_STEP_S = 1.0
"""Longest step of the clock; the loop of a launcher reads it ten times a second."""


class AwakeClock:
    """A monotonic clock, in seconds, that stands still while this process does: stopped, frozen
    with its container, or held up. The silence of others is measured by it, for what they sent
    meanwhile is still to be read. `now_s` is a clock that goes on.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._read_s = now_s()
        self._paused_s = 0.0

    def __call__(self) -> float:
        now_s = self._now_s()
        self._paused_s += max(0.0, now_s - self._read_s - MAX_STEP_S)
        self._read_s = now_s
        return now_s - self._paused_s


awake_s = AwakeClock()
"""The clock of the launcher in this process."""
