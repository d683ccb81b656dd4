"""Clocks of a graph, and the offset between the clocks of two hosts.

Time is passed to a node, never read by it. The offset is found by exchanges of four time stamps:
clock A notes t1 when it sends a question, clock B notes t2 when the question arrives and t3 when
its answer is sent, A notes t4 when that arrives. With delays d1 and d2 of the two messages,
t2 - t1 = d1 + o and t4 - t3 = d2 - o: half the difference is the offset o up to (d1 - d2) / 2,
at most half of the round trip d1 + d2, however unequal the delays. So of many exchanges the one
with the shortest round trip is the best, unless it is so old that the clocks have drifted.

Source: D. L. Mills, RFC 5905 (NTP), sections 8 and 10: on-wire protocol and clock filter.
"""

import time
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple, Protocol

WINDOW = 64
"""Number of exchanges that are kept."""
DRIFT_PPM = 100.0
"""Largest drift between two free quartz clocks, parts per million: 50 each."""
MAX_CONTRADICTIONS = 3
"""After so many exchanges that contradict the earlier ones, these are dropped: a clock was set."""


class Clock(Protocol):
    """The clock of a graph."""

    def now_ns(self) -> int:
        """Time now, nanoseconds since the epoch; it never decreases."""
        ...


def wall_offset_ns() -> int:
    """Difference of the time of day and the monotonic clock now, nanoseconds."""
    # The monotonic clock of Linux is one for all processes of a host.
    return time.time_ns() - time.monotonic_ns()


class SystemClock:
    """The monotonic clock of the host, shifted to the time of day once, at start: nodes of a graph
    share `offset_ns`, so that their stamps agree, and setting the time of day has no effect.
    """

    def __init__(self, offset_ns: int | None = None) -> None:
        if offset_ns is None:
            offset_ns = wall_offset_ns()
        self.offset_ns = offset_ns

    def now_ns(self) -> int:
        return time.monotonic_ns() + self.offset_ns


class ManualClock:
    """A clock that moves only by `advance`: for tests and offline runs."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        return self._now_ns

    def advance(self, ns: int) -> None:
        """Advance by `ns` nanoseconds, 0 or more."""
        if ns < 0:
            raise ValueError(f"a clock never goes back: {ns} ns")
        self._now_ns += ns


@dataclass(frozen=True)
class ClockEstimate:
    """The other clock less ours, and the bound of its error: half the round trip, drift since."""

    offset_ns: int
    uncertainty_ns: int


SAME_CLOCK = ClockEstimate(0, 0)
"""Estimate of a host's own clock."""


class _Exchange(NamedTuple):
    at_ns: int
    offset_ns: int
    round_trip_ns: int

    def uncertainty_ns(self, now_ns: int) -> int:
        drift_ns = abs(now_ns - self.at_ns) * DRIFT_PPM / 1e6
        # One more for the halves that `//` drops, here and in the offset.
        return self.round_trip_ns // 2 + 1 + round(drift_ns)


class ClockOffset:
    """Estimates the clock of one other host from the last exchanges with it."""

    def __init__(self) -> None:
        self._exchanges: deque[_Exchange] = deque(maxlen=WINDOW)
        self._contradictions = 0

    def add(self, t1_ns: int, t2_ns: int, t3_ns: int, t4_ns: int) -> bool:
        """Add an exchange: t1 and t4 are times on our clock, t2 and t3 on the other one.

        Return False for one that is not used: its times decrease, or it contradicts those before.
        """
        # The other host may send any numbers.
        round_trip_ns = (t4_ns - t1_ns) - (t3_ns - t2_ns)
        if t4_ns < t1_ns or t3_ns < t2_ns or round_trip_ns < 0:
            return False

        offset_ns = ((t2_ns - t1_ns) + (t3_ns - t4_ns)) // 2
        exchange = _Exchange(t4_ns, offset_ns, round_trip_ns)
        estimate = self.estimate(t4_ns)
        if estimate is not None:
            difference_ns = abs(offset_ns - estimate.offset_ns)
            # One alone may be wrong; several in a row mean that a clock was set.
            if difference_ns > estimate.uncertainty_ns + exchange.uncertainty_ns(t4_ns):
                self._contradictions += 1
                if self._contradictions < MAX_CONTRADICTIONS:
                    return False
                self._exchanges.clear()

        self._contradictions = 0
        self._exchanges.append(exchange)
        return True

    def estimate(self, now_ns: int) -> ClockEstimate | None:
        """Best estimate at `now_ns` of our clock; None before the first exchange."""
        if not self._exchanges:
            return None
        # The quickest round trip bounds the offset best, until the clocks have drifted since.
        best = min(
            self._exchanges, key=lambda exchange: exchange.uncertainty_ns(now_ns)
        )
        return ClockEstimate(best.offset_ns, best.uncertainty_ns(now_ns))
