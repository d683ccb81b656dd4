"""How far the clock of another host is ahead, found by exchanges of four time stamps.

Clock A notes t1 as it asks, clock B notes t2 as the question comes and t3 as its answer goes, A
notes t4 as that comes. If the two ways take d1 and d2, then t2 - t1 = d1 + o and
t4 - t3 = d2 - o: half the difference of the two is the offset o up to (d1 - d2) / 2, and that is
at most half of the round trip d1 + d2, however unequal the ways. So of many exchanges the one
with the shortest round trip tells most, as long as it is not so old that the clocks have drifted.

Source: D. L. Mills, RFC 5905 (NTP), sections 8 and 10: on-wire protocol and clock filter.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

WINDOW = 64
"""Exchanges that are kept."""
DRIFT_PPM = 100.0
"""Two free quartz clocks part by at most this: 50 ppm each."""
MAX_CONTRADICTIONS = 3
"""So many exchanges in a row that cannot be true of the same clock: it was set, begin anew."""


@dataclass(frozen=True)
class ClockEstimate:
    """What is known of another clock.

    Attributes
    ----------
    offset_ns : int
        How far it is ahead of ours: our time is theirs less this.
    uncertainty_ns : int
        The true offset lies within this of `offset_ns`: half of the round trip, and the drift
        since.
    """

    offset_ns: int
    uncertainty_ns: int


SAME_CLOCK = ClockEstimate(0, 0)
"""What is known of a host's own clock."""


@dataclass(frozen=True)
class _Exchange:
    at_ns: int
    offset_ns: int
    round_trip_ns: int

    def uncertainty_ns(self, now_ns: int) -> int:
        drift_ns = abs(now_ns - self.at_ns) * DRIFT_PPM / 1e6
        return self.round_trip_ns // 2 + 1 + round(drift_ns)


class ClockOffset:
    """Keeps the last exchanges with one other host, and knows the best of them."""

    def __init__(self) -> None:
        self._exchanges: deque[_Exchange] = deque(maxlen=WINDOW)
        self._contradictions = 0

    def add(self, t1_ns: int, t2_ns: int, t3_ns: int, t4_ns: int) -> bool:
        """Take in one exchange.

        Parameters
        ----------
        t1_ns, t4_ns : int
            When the question went and the answer came, on our clock.
        t2_ns, t3_ns : int
            When the question came and the answer went, on theirs.

        Returns
        -------
        bool
            False for an exchange that is not used: its times run backwards, or it cannot be true
            together with those before.
        """
        round_trip_ns = (t4_ns - t1_ns) - (t3_ns - t2_ns)
        if t4_ns < t1_ns or t3_ns < t2_ns or round_trip_ns < 0:
            return False
        offset_ns = ((t2_ns - t1_ns) + (t3_ns - t4_ns)) // 2
        exchange = _Exchange(t4_ns, offset_ns, round_trip_ns)
        known = self.estimate(t4_ns)
        if known is not None:
            apart_ns = abs(offset_ns - known.offset_ns)
            if apart_ns > known.uncertainty_ns + exchange.uncertainty_ns(t4_ns):
                self._contradictions += 1
                if self._contradictions < MAX_CONTRADICTIONS:
                    return False
                self._exchanges.clear()
        self._contradictions = 0
        self._exchanges.append(exchange)
        return True

    def estimate(self, now_ns: int) -> ClockEstimate | None:
        """The best that is known at `now_ns` of our clock; None before the first exchange."""
        if not self._exchanges:
            return None
        best = min(self._exchanges, key=lambda exchange: exchange.uncertainty_ns(now_ns))
        return ClockEstimate(best.offset_ns, best.uncertainty_ns(now_ns))
