"""Times of a source: their unit, and stamps that rise."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
import numpy.typing as npt

from sparseskin.messages.ranges import INT64_MAX
from sparseskin.nodes.errors import SourceError

from .layout import UnstatedError

ISO, CLOCK_UNIT = "iso", "clock"
NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, ISO: 1, CLOCK_UNIT: 1}
"""Nanoseconds of each unit. Stamps of ISO 8601 and times of day are read as nanoseconds."""
TIME_NAME = re.compile(
    r"[%_\s]*(?:field\.|header[._])*(t|times?|times?_?stamps?|stamps?|date|date_?time|elapsed"
    r"|seconds|millis|micros|epoch|clock|time_?steps?)(?![a-z0-9])"
)
"""Begin of the name of a column or array of times, in small letters."""
UNIT_NAME = re.compile(
    r"(?:^|[^a-z])(ns|us|µs|ms|s)(?:ec|econds)?\W*$|(nanos|micros|millis|seconds)$"
)
LONG_UNITS = {"nanos": "ns", "micros": "us", "millis": "ms", "seconds": "s", "µs": "us"}
EPOCH_S = 9.0e8, 4.2e9
"""Seconds since 1970 that can be a date: 1998 to 2103, chosen."""
RATES_HZ = 0.1, 2000.0
"""Rates at which skins are read; chosen: of a bed a frame in 10 s, of boards 2 kHz."""
DAY_NS = 86_400 * 10**9
CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d{1,9})?)")


def is_time_name(name: str) -> bool:
    """True if a column or array of that name holds times."""
    return TIME_NAME.match(name.lower()) is not None


def named_unit(name: str) -> str:
    """Unit in the name of a column or array, as of "time_ms"; "" if there is none."""
    if re.fullmatch(r"%time", name.strip().lower()):
        return "ns"  # as rostopic echo -p prints it
    match = UNIT_NAME.search(name.lower())
    if match is None:
        return ""
    unit = match[1] or match[2]
    return LONG_UNITS.get(unit, unit)


def iso_ns(text: str) -> int | None:
    """Nanoseconds since 1970 of a stamp of ISO 8601, of UTC where it states no zone; None: none."""
    if "-" not in text[1:]:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    zoned = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (zoned - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


def clock_ns(text: str) -> int | None:
    """Nanoseconds since midnight of a time of day; None if a text is none."""
    match = CLOCK.fullmatch(text)
    if match is None:
        return None
    seconds, _, fraction = match[3].replace(",", ".").partition(".")
    whole_s = 3600 * int(match[1]) + 60 * int(match[2]) + int(seconds)
    return whole_s * 10**9 + int(fraction.ljust(9, "0") or 0)


def is_epoch(times: npt.NDArray[np.float64]) -> bool:
    """True if numbers can be dates, in one of the units, and do not fall."""
    return bool(epoch_unit(times)) and bool((np.diff(times) >= 0).all())


def epoch_unit(times: npt.NDArray[np.float64]) -> str:
    """The unit in which all numbers are dates since 1970; "" if there is none."""
    low_s, high_s = EPOCH_S
    for unit in ("s", "ms", "us", "ns"):
        per_s = 1e9 / NS[unit]
        if times.size and (times >= low_s * per_s).all() and (times <= high_s * per_s).all():
            return unit
    return ""


def unit_of(times: Sequence[float], where: str) -> str:
    """Unit of times that state none: that of dates, or the only one in which the median step is
    of a rate at which skins are read. Raises UnstatedError if there are several, or none.
    """
    numbers = np.asarray(times, dtype=np.float64)
    of_dates = epoch_unit(numbers)
    if of_dates:
        return of_dates
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    if not steps.size:
        return "s"
    rates_hz = {
        unit: 1e9 / (float(np.median(steps)) * NS[unit]) for unit in ("s", "ms", "us", "ns")
    }
    low, high = RATES_HZ
    usual = {unit: rate for unit, rate in rates_hz.items() if low <= rate <= high}
    if len(usual) == 1:
        return next(iter(usual))
    ways = " or ".join(f"time_unit={unit} ({rate:.4g} Hz)" for unit, rate in usual.items())
    hint = ways or "time_unit"
    raise UnstatedError(f"{where}: the unit of the times is not stated: state {hint}")


@dataclass
class Stamps:
    """Turns raw times, block by block, into stamps: nanoseconds since the first frame.

    A time that repeats the one before it is 1 ns later, so that stamps rise; `n_repeated` counts
    them. Times of day begin again at midnight.
    """

    unit: str
    n_repeated: int = 0
    n: int = 0
    last_ns: int = -1
    _first: float | int | None = None
    _last_time_ns: int = 0
    _days_ns: int = 0

    def stamps(self, times: Sequence[float | int], where: str) -> npt.NDArray[np.int64]:
        """Stamps, int64 (k,), of times in `unit`, exact for whole numbers. Raises SourceError, with
        the number of the frame from 1, if times fall.
        """
        stamps = np.empty(len(times), dtype=np.int64)
        for k, since_first_ns in enumerate(self._in_ns(times)):
            self.n += 1
            stamps[k] = self._rising(since_first_ns + self._days_ns, where)
        return stamps

    def _rising(self, time_ns: int, where: str) -> int:
        """The stamp of a time, after the one before it."""
        fall_ns = self._last_time_ns - time_ns
        if self.unit == CLOCK_UNIT and fall_ns > DAY_NS // 2:
            self._days_ns += DAY_NS
            time_ns += DAY_NS
            fall_ns -= DAY_NS
        if fall_ns > 0:
            fault = f"the time of frame {self.n} is before that of the one before it"
            ways = "sort or split the file, or state rate_hz to read it without times"
            raise SourceError(f"{where}: {fault}, by {fall_ns / 1e9:.4g} s; {ways}")
        self._last_time_ns = time_ns

        if time_ns <= self.last_ns:
            self.n_repeated += 1
            time_ns = self.last_ns + 1
        if time_ns > INT64_MAX:
            raise SourceError(f"{where}: the recording lasts longer than 2**63 ns")
        self.last_ns = time_ns
        return time_ns

    def _in_ns(self, times: Sequence[float | int]) -> list[int]:
        """Nanoseconds since the first time."""
        if self._first is None and len(times):
            self._first = times[0]
        origin = self._first or 0
        per_unit = NS[self.unit]
        # Python's own numbers: whole ones are exact, whatever their size.
        return [round((time - origin) * per_unit) for time in times]
