"""The clock of a source: its stamps, mapped to the graph's clock.

A frame with the stamp x on the clock of its source arrives at y, later by a delay that varies, by
milliseconds over USB, but is never less than some least one. So the points (x, y - x) lie on and
above a line: its slope is the drift of the two clocks, its height their offset and the least delay,
which nothing in the stamps tells apart from it. Of all lines below the points, that of the least
sum of distances to them is the edge of their lower convex hull at their mean x. The points are the
least delayed frame of each period, so that memory and time are bounded.

Sources: the line, S. B. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew from
network delay measurements", INFOCOM 1999; by the hull, L. Zhang, Z. Liu, C. H. Xia, "Clock
synchronization algorithms for network measurements", INFOCOM 2002.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean, pstdev
from typing import Any

Point = tuple[float, float]
"""Nanoseconds since the first frame on the clock of the source; of the arrival, less those."""


@dataclass(frozen=True)
class ClockTuning:
    """Constants of the mapping; all chosen, but the last, which is fitted."""

    # Time of which the least delayed frame is kept, at first and later: doubled once there are
    # `n_periods` of them.
    first_ns: float = 62.5e6
    period_ns: float = 5e8
    #: Most periods that are kept: 32 s, in which a quartz hardly drifts.
    n_periods: int = 64
    settle_ns: float = 2e9  # length of a line before it is used
    settle_frames: int = 20  # and its number of frames
    #: Length of a line whose drift is not believed before that is logged.
    doubt_ns: float = 1e10
    #: Largest drift that is believed: the RC oscillator of an ATmega328P is within 10 % (data
    #: sheet, calibrated internal oscillator).
    most_drift: float = 0.1
    # A frame that is earlier than the line by so much is of a clock that was set; so are all frames
    # of the time `patience_ns`, if they are later by as much.
    step_ns: float = 1e7
    patience_ns: float = 5e9
    #: Standard deviation of the slope in mean heights of the points over the line, per number of
    #: points and length: 8 to 12 for uniform and exponential delays at 10 to 1000 frames a second,
    #: 22 for delays of a gamma distribution, shape 2, of which the least are rare (simulated).
    spread: float = 25.0


TUNING = ClockTuning()


def line_below(points: Iterable[Point]) -> tuple[Point, float] | None:
    """The line below all points with the least sum of distances to them: a point of it, and its
    slope; None if they have the same x.
    """
    hull: list[Point] = []
    total = 0.0
    n = 0.0
    for x, y in sorted(points):
        total += x
        n += 1
        if hull and hull[-1][0] == x:
            continue
        # A point of the hull that is above the line to the new one is none.
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) > (x - x0) * (y1 - y0):
                break
            hull.pop()
        hull.append((x, y))

    # The edge at the mean of x.
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 * n >= total:
            return (x0, y0), (y1 - y0) / (x1 - x0)
    return None


class DeviceClock:
    """Maps stamps of a source to the graph's clock. Until it has settled, and where its stamps do
    not run as they should, a frame has the time of its arrival.

    `tick_ns` is the unit of a stamp, which begins at 0 again after `wrap` ticks (None: never).
    `log` receives a line if the clock was set, or its stamps cannot be used, with the `name` of the
    source.
    """

    def __init__(
        self,
        name: str,
        log: Callable[[str], object],
        tick_ns: float = 1.0,
        wrap: int | None = None,
    ) -> None:
        self._name = name
        self._log = log
        self._tick_ns = tick_ns
        self._wrap = wrap
        self._n_restarts = 0
        self._is_doubted = False
        self._last_ns: int | None = None
        self._begin(0, 0, 0)

    def map(self, stamp: int, arrived_ns: int) -> int:
        """Time of the next frame on the graph's clock, nanoseconds, by its stamp in ticks and its
        arrival, which does not decrease: after that of the one before, and never later than its
        arrival, but for a nanosecond between frames that arrive at once.
        """
        time_ns = arrived_ns
        was_settled = False
        if self._advance(stamp, arrived_ns):
            # By the line as it was before this frame: `_add` may draw it anew.
            late_ns = self._y - self._x - self._line(self._x)
            was_settled = self._is_settled
            if was_settled and late_ns < -TUNING.step_ns:
                self._restart(stamp, arrived_ns)
            else:
                if was_settled:
                    time_ns -= max(0, round(late_ns))
                self._add(late_ns)

        # Stamps rise, by a nanosecond at least.
        if self._last_ns is not None:
            time_ns = max(time_ns, self._last_ns + 1)
        self._last_ns = time_ns
        if was_settled and self._begun == self._y:
            self._sampled.append((self._x, self._y, time_ns - self._origin_ns))
        return time_ns

    def state(self) -> dict[str, Any]:
        """Figures for the operator: `clock`, "source", or "arrival" while frames have the time of
        their arrival; `clock_restarts`, times that it was set or started again. Of a source also
        by how much its clock is fast, `clock_drift_ppm`, with its standard deviation
        `clock_drift_sd_ppm`; and standard deviations from the line, over the last `n_periods`, of
        arrivals (`clock_jitter_before_ms`) and times of frames (`clock_jitter_after_ms`).
        """
        if not self._is_settled:
            return {"clock": "arrival", "clock_restarts": self._n_restarts}

        # The sd of the slope falls with the number of points and the length of the line.
        heights = [height - self._line(x) for x, height in self._points]
        length = len(heights) * (self._points[-1][0] - self._points[0][0])
        drift_sd = TUNING.spread * fmean(heights) / length

        # The slope is in nanoseconds of the source, the drift in those of the graph.
        drift = 1 / (1 + self._slope) - 1
        arrivals = [(x, arrived) for x, arrived, _ in self._sampled]
        times = [(x, time) for x, _, time in self._sampled]
        return {
            "clock": "source",
            "clock_drift_ppm": round(drift * 1e6, 2),
            "clock_drift_sd_ppm": round(drift_sd * 1e6, 2),
            "clock_jitter_before_ms": self._jitter_ms(arrivals),
            "clock_jitter_after_ms": self._jitter_ms(times),
            "clock_restarts": self._n_restarts,
        }

    def _jitter_ms(self, times: Sequence[Point]) -> float:
        """Standard deviation from the line of times, each behind the stamp of its frame."""
        if not times:
            return 0.0
        late_ns = [time - x - self._line(x) for x, time in times]
        return round(pstdev(late_ns) / 1e6, 4)

    def _begin(self, stamp: int, arrived_ns: int, n: int = 1) -> None:
        """Forget all before a frame; it is the first of the line."""
        self._stamp = stamp
        self._origin_ns = arrived_ns
        self._n = n
        self._ticks = 0

        # Nanoseconds since the first frame, on the clock of the source and of the graph.
        self._x = 0.0
        self._y = 0.0
        self._begun = 0.0  # of the graph, at the begin of the period
        self._in_time = 0.0  # of the graph, at the last frame that was not late

        # The line, by a point of it; the lowest point of this period, and those of the others.
        self._at = (0.0, 0.0)
        self._slope = 0.0
        self._is_settled = False
        self._period_ns = TUNING.first_ns
        self._least = (0.0, 0.0)
        self._points: list[Point] = []
        self._sampled: deque[tuple[float, float, float]] = deque(
            maxlen=TUNING.n_periods
        )

    def _restart(self, stamp: int, arrived_ns: int) -> None:
        if self._is_settled:
            self._n_restarts += 1
            self._log(
                f"{self._name}: its clock was set or started again; it is mapped anew"
            )
        self._begin(stamp, arrived_ns)

    def _advance(self, stamp: int, arrived_ns: int) -> bool:
        """Set both times to those of a frame; False if a line begins with it."""
        # A drift does not last for a silence as long.
        y = float(arrived_ns - self._origin_ns)
        if not self._n or y - self._y > TUNING.n_periods * TUNING.period_ns:
            self._begin(stamp, arrived_ns)
            return False

        ahead = stamp - self._stamp
        if self._wrap is not None:
            # The number of wraps follows from the time that has passed meanwhile.
            passed = (y - self._y) / self._tick_ns
            if self._is_settled:
                passed /= 1 + self._slope
            ahead %= self._wrap
            ahead += self._wrap * round((passed - ahead) / self._wrap)
        if ahead * self._tick_ns < -TUNING.step_ns:
            self._restart(stamp, arrived_ns)
            return False

        self._stamp = stamp
        self._ticks += ahead
        self._n += 1
        self._x = self._ticks * self._tick_ns
        self._y = y
        return True

    def _line(self, x: float) -> float:
        """Height of the line at a time of the source."""
        x_at, height_at = self._at
        return height_at + self._slope * (x - x_at)

    def _lower(self, a: Point, b: Point) -> Point:
        """The one of two points that is lower over the line."""
        a_x, a_height = a
        b_x, b_height = b
        if b_height - a_height < self._slope * (b_x - a_x):
            return b
        return a

    def _add(self, late_ns: float) -> None:
        """Add a frame that is later than the line by `late_ns`."""
        point = self._x, self._y - self._x

        # A frame that is earlier than all others moves the line down to it.
        if late_ns < 0:
            x, height = self._at
            self._at = x, height + late_ns
        if late_ns < TUNING.step_ns or not self._is_settled:
            self._in_time = self._y
        if self._y - self._begun < self._period_ns:
            self._least = self._lower(self._least, point)
            return

        # Late frames alone, for long: the clock was set.
        if self._y - self._in_time > TUNING.patience_ns:
            self._restart(self._stamp, self._origin_ns + round(self._y))
            return
        self._end_period(point)

    def _end_period(self, point: Point) -> None:
        """Draw the line anew with the lowest point of a period; the next one begins."""
        points = self._points
        points.append(self._least)
        self._least = point
        self._begun = self._y

        # Longer periods from now on: of two neighbours the lower point stays.
        if len(points) == TUNING.n_periods and self._period_ns < TUNING.period_ns:
            points[:] = map(self._lower, points[::2], points[1::2])
            self._period_ns *= 2
        elif len(points) > TUNING.n_periods:
            del points[0]

        line = line_below(self._points)
        if line is not None:
            self._at, self._slope = line

        # A line is used once it is long enough, and its drift can be that of a clock.
        is_good = line is not None and abs(self._slope) <= TUNING.most_drift
        is_long = self._y >= TUNING.settle_ns and self._n >= TUNING.settle_frames
        self._is_settled = is_good and is_long

        if not is_good and self._y >= TUNING.doubt_ns and not self._is_doubted:
            self._is_doubted = True
            self._log(
                f"{self._name}: its stamps do not run as time does, within "
                f"{TUNING.most_drift:.0%}; frames have the time of their arrival"
            )
