"""Times of a source: their unit, and stamps that rise."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.ranges import INT64_MAX
from sparseskin.nodes.errors import SourceError

from .layout import UnstatedError

ISO = "iso"
CLOCK_UNIT = "clock"
NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, ISO: 1, CLOCK_UNIT: 1}
NS |= {"min": 60 * 10**9, "h": 3600 * 10**9, "d": 86_400 * 10**9}
"""Nanoseconds of each unit. Stamps of ISO 8601 and times of day are read as nanoseconds."""
UNITS = ("s", "ms", "us", "ns")
"""Units that times have where nothing states it."""
TIME_NAME = re.compile(
    r"[%_\s]*(?:field\.|header[._])*(t|ts|times?|times?_?stamps?|stamps?|date|date_?time|elapsed"
    r"|(?:milli|micro|nano|[mnuµ])?(?:secs?|seconds)|millis|micros|epoch|clock|time_?steps?)"
    r"(?![a-z0-9])|[mnuµ]s\s*$"
)
"""Begin of the name of a column or array of times, in small letters."""
UNIT_NAME = re.compile(
    r"(?:(?:^|[^a-z])(?P<short>ns|us|µs|ms|s)"
    r"|[^a-z](?P<rare>min|hr?|d)"
    r"|(?P<part>nano|micro|milli|[num]|µ)?(?:secs?|seconds?)"
    r"|(?P<arduino>nanos|micros|millis)"
    r"|(?P<long>mins|minute|hour|hr|day)s?)\W*$"
)
LONG_UNITS = {
    **dict.fromkeys(("nanos", "nano", "n"), "ns"),
    **dict.fromkeys(("micros", "micro", "u", "µs", "µ"), "us"),
    **dict.fromkeys(("millis", "milli", "m"), "ms"),
    **{"mins": "min", "minute": "min", "hour": "h", "hr": "h", "day": "d"},
}
RATE_NAME = re.compile(
    r"(?:(?:sampl\w*|frame|scan|acquisition|capture|recording|data|log\w*|channel) ?)?"
    r"(?:rates?|freq\w*)(?: in)?(?: hz| fps)?|fs(?: hz)?|fps"
)
PERIOD_NAME = re.compile(
    r"(?:seconds per frame|dt|ts|time ?step"
    r"|(?:sampl\w*|frame) ?(?:interval|period|time)|scan (?:interval|period))(?: in)?"
    r"(?: ([a-z]+))?"
)
"""Names of rates in hertz, and of times between frames, as words in small letters."""
RATE_UNITS = ("", "hz", "fps", "1/s", "/s", "samples/s", "frames/s")
EPOCH_S = 9.0e8, 4.2e9
"""Seconds since 1970 that can be a date: 1998 to 2103, chosen."""
FIRST_YEAR = 1998
LAST_YEAR = 2103
RATES_HZ = 0.1, 2000.0
"""Rates at which skins are read; chosen: of a bed a frame in 10 s, of boards 2 kHz."""
DATE = re.compile(
    r"(?:(?P<y>\d{4})[-/](?P<m>\d{1,2})[-/](?P<d>\d{1,2})"
    r"|(?P<day>\d{1,2})[-. ](?P<month>\d{1,2}|[A-Za-z]{3})[-. ](?P<year>\d{4})"
    r"|(?P<first>\d{1,2})/(?P<second>\d{1,2})/(?P<last>\d{4}))(?:$|[ T]+)"
)
"""A date at the begin of a text. Of 3/12/2026 the order is that of the country."""
MONTHS = [
    "jan",
    "feb",
    "mar",
    "apr",
    "may",
    "jun",
    "jul",
    "aug",
    "sep",
    "oct",
    "nov",
    "dec",
]
BASIC_DATE = re.compile(r"(\d{8})[T_ ]?(\d{6})(?:[.,]?(\d{1,9}))?")
"""Dates without separators, as 20260312T101502.120 or 20260312101502."""
USUAL_WRAP = 1 << 32
"""Units of time until clocks of microcontrollers are 0 again."""
DAY_NS = 86_400 * 10**9
RISING = 8
"""Least numbers that rise as times do, or of a line that is asked about if it rises. Derived: eight
without a trend rise once in 40,000."""
FEW_RISING = 4
SAME_STEPS = 1.001
"""The same of numbers that rise in steps of one size, by this ratio."""
CLOCK = re.compile(
    r"(?:(\d+) days? )?(?:(\d{1,2}):|(?=[\d:]+[.,]))([0-5]?\d):([0-6]\d)"
    r"(?:[.,](\d{1,9})|:(\d{3}))?(?:\s*([ap])\.?m\.?)?",
    re.IGNORECASE,
)
"""A time of day, perhaps of 12 hours, or minutes and seconds with a fraction; LabVIEW has a colon
before milliseconds, pandas days before the time.
"""


def is_time_name(name: str) -> bool:
    """True if a column or array of that name holds times."""
    return TIME_NAME.match(name.lower()) is not None


def named_unit(name: str) -> str:
    """Unit in the name of a column or array, as of "time_ms"; "" if there is none."""
    if re.fullmatch(r"%time", name.strip().lower()):
        return "ns"  # as rostopic echo -p prints it
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    match = UNIT_NAME.search(words)
    # As "hundredths of a second".
    if match is None or re.search(r"tenth|hundred|1/", words):
        return ""
    unit = next(filter(None, match.groups()), "s")
    return LONG_UNITS.get(unit, unit)


def rate_of(name: str, number: float, unit: str = "") -> float:
    """Frames per second that a number of that name and unit states; 0 if it states none."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()
    words = re.sub(r"[^a-z]+", " ", words).strip()
    if not 0 < number < math.inf:
        return 0.0
    if RATE_NAME.fullmatch(words) and unit in RATE_UNITS:
        return number
    # Programs state the rate, or its inverse.
    period = PERIOD_NAME.fullmatch(words)
    if period is None:
        return 0.0
    # Of a time between frames, the unit may stand behind the name.
    period_unit = named_unit(f"_{period[1] or unit or 's'}")
    if not period_unit:
        return 0.0
    return 1e9 / (number * NS[period_unit])


def are_likely(numbers: npt.NDArray[Any], max_uneven: float = math.inf) -> bool:
    """True if numbers rise as times do: not by 1, as a counter, and `rise`."""
    steps = np.diff(numbers.astype(np.float64))
    is_counter = not (steps > 0).all() or (steps == 1).all()
    return not is_counter and rise(numbers, max_uneven)


def rise(numbers: npt.NDArray[Any], max_uneven: float = math.inf) -> bool:
    """True if numbers rise, or a few of them in steps of about one size: `max_uneven` times the
    least one at most.
    """
    steps = np.diff(numbers.astype(np.float64))
    if not ((steps >= 0).all() and (steps > 0).any()):
        return False
    if len(numbers) >= RISING or math.isinf(max_uneven):
        return True
    return len(steps) > 1 and bool(steps.max() <= max_uneven * steps.min())


def which_times(fault: str, keys: Sequence[str], n: int) -> UnstatedError:
    """The error that columns or arrays of n numbers, which rise, may be the times."""
    # In a few even steps rise loads, too: nothing is proposed.
    if n < RISING:
        return UnstatedError.between(fault, "time", [*keys, "none"])
    otherwise = "time=none, if these are no times"
    return UnstatedError.between(fault, "time", keys, otherwise)


def iso_ns(text: str) -> int | None:
    """Nanoseconds since 1970 of a stamp of ISO 8601, or with a date as 12.03.2026, 2026/03/12,
    12-Mar-2026 or 20260312101502, of UTC where it states no zone; None: none.
    """
    basic = BASIC_DATE.fullmatch(text)
    if basic is not None:
        text = f"{basic[1]}T{basic[2]}.{basic[3] or 0}"
    elif "-" not in text[1:] and "/" not in text and "." not in text:
        return None  # most cells are whole numbers
    date = DATE.match(text)
    clock = None
    if date is not None:
        # The clock is read apart: it may have 12 hours, or nanoseconds.
        time = text[date.end() :]
        clock = clock_ns(time)
        text = _iso_date(date, time)
        if clock is None and time:
            text += f"T{time.replace(',', '.')}"
    elif basic is None:
        return None

    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    # Other numbers of so many digits are no dates of a recording.
    if basic is not None and not FIRST_YEAR <= moment.year <= LAST_YEAR:
        return None
    if not moment.tzinfo:
        moment = moment.replace(tzinfo=UTC)
    since_epoch = moment - datetime(1970, 1, 1, tzinfo=UTC)
    return since_epoch // timedelta(microseconds=1) * 1000 + (clock or 0)


def _iso_date(date: re.Match[str], time: str) -> str:
    """A date as 2026-03-12; "" if it has several meanings, or none."""
    parts = date.groupdict("")
    year = parts["y"] or parts["year"] or parts["last"]
    day = parts["d"] or parts["day"]
    month = parts["m"] or parts["month"]
    if month.lower() in MONTHS:
        month = str(1 + MONTHS.index(month.lower()))
    elif parts["last"]:
        # Where a clock has 12 hours the month comes first; else a day above 12 shows it.
        month = parts["first"]
        day = parts["second"]
        if int(month) > 12:
            month, day = day, month
        elif int(day) <= 12 and not time.lower().rstrip(".").endswith("m"):
            return ""
    if not month.isdecimal():
        return ""
    return f"{year}-{int(month):02}-{int(day):02}"


def clock_ns(text: str) -> int | None:
    """Nanoseconds since midnight of a time of day; None if a text is none."""
    match = CLOCK.fullmatch(text)
    if match is None:
        return None
    hour = int(match[2] or 0)
    if match[7]:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + 12 * (match[7] in "pP")
    hours = 24 * int(match[1] or 0) + hour
    whole_s = 3600 * hours + 60 * int(match[3]) + int(match[4])
    fraction = match[5] or match[6] or "0"
    return whole_s * 10**9 + int(fraction.ljust(9, "0"))


def dated_clock_ns(text: str) -> int | None:
    """The same of a time of day that may stand behind a date, of any form."""
    return clock_ns(DATE.sub("", text, count=1))


def is_epoch(times: npt.NDArray[np.float64]) -> bool:
    """True if numbers can be dates, in one of the units, and do not fall."""
    return bool(epoch_unit(times)) and bool((np.diff(times) >= 0).all())


def epoch_unit(times: npt.NDArray[np.float64]) -> str:
    """The unit in which all numbers are dates since 1970; "" if there is none."""
    low_s, high_s = EPOCH_S
    for unit in UNITS:
        per_s = 1e9 / NS[unit]
        if (
            times.size
            and (times >= low_s * per_s).all()
            and (times <= high_s * per_s).all()
        ):
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
    # A clock that is coarse repeats its times: these steps say nothing of the unit.
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    if not steps.size:
        return "s"

    median_step = float(np.median(steps))
    low_hz, high_hz = RATES_HZ
    rates = {unit: 1e9 / (median_step * NS[unit]) for unit in (*UNITS, "d")}
    usual = {unit: rate for unit, rate in rates.items() if low_hz <= rate <= high_hz}
    if len(usual) == 1 and "d" not in usual:
        return next(iter(usual))
    ways = " or ".join(
        f"time_unit={unit} ({rate:.4g} Hz)" for unit, rate in usual.items()
    )
    fault = f"{where}: the unit of the times is not stated"
    # Days, of a spreadsheet or of MATLAB, where nothing else is usual.
    options: list[dict[str, str]] = []
    if [*usual] == ["d"]:
        options.append({"time_unit": "d"})
    raise UnstatedError(f"{fault}: state {ways or 'time_unit'}", *options)


@dataclass
class Stamps:
    """Turns raw times, block by block, into stamps: nanoseconds since the first frame.

    A time that repeats the one before it is 1 ns later, so that stamps rise; `n_repeated` counts
    them. Times of day begin again at midnight, and others at 0 after
    `wrap` units.
    """

    unit: str
    wrap: int | None = None
    n_repeated: int = 0
    n: int = 0
    last_ns: int = -1
    _first: float | int | None = None
    _last_time_ns: int = 0
    _turns_ns: int = 0

    def stamps(self, times: Sequence[float | int], where: str) -> npt.NDArray[np.int64]:
        """Stamps, int64 (k,), of times in `unit`, exact for whole numbers. Raises SourceError, with
        the number of the frame from 1, if times fall.
        """
        stamps = np.empty(len(times), dtype=np.int64)
        for k, since_first_ns in enumerate(self._in_ns(times)):
            self.n += 1
            stamps[k] = self._rising(since_first_ns + self._turns_ns, where)
        return stamps

    def check(self, where: str) -> None:
        """Raise SourceError if many times repeat the one before them: of a clock of whole seconds,
        or a date alone.
        """
        if self.n > 2 and 3 * self.n_repeated > self.n:
            fault = f"{self.n_repeated} of {self.n} times repeat the one before"
            raise SourceError(f"{where}: {fault}; state another time, or rate_hz")

    @property
    def _turn_ns(self) -> int:
        """Time after which the times begin again; 0: never."""
        if self.unit == CLOCK_UNIT:
            return DAY_NS
        return NS[self.unit] * (self.wrap or 0)

    def _rising(self, time_ns: int, where: str) -> int:
        """The stamp of a time, after the one before it."""

        # A fall by more than half a turn is a turn; a smaller one is a frame out of order.
        fall_ns = self._last_time_ns - time_ns
        if self._turn_ns and fall_ns > self._turn_ns // 2:
            self._turns_ns += self._turn_ns
            time_ns += self._turn_ns
            fall_ns -= self._turn_ns
        if fall_ns > 0:
            fault = f"the time of frame {self.n} is before that of the one before it"
            ways = "sort or split the file, or state rate_hz to read it without times"
            text = f"{where}: {fault}, by {fall_ns / 1e9:.4g} s; {ways}"
            if self.wrap is None and 2 * fall_ns > NS[self.unit] * USUAL_WRAP:
                way = {"time_wrap": USUAL_WRAP}
                raise UnstatedError(
                    f"{text}; or time_wrap, if they begin again at 0", way
                )
            raise SourceError(text)
        self._last_time_ns = time_ns

        # Stamps have to rise strictly, and a frame is not dropped for the clock of its logger.
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
