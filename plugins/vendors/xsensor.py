"""XSENSOR sensors: the text export (.csv) of their software, in its own unit."""

import math
import re
from typing import NamedTuple

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles, Mask
from sparseskin.nodes.sensor.files.recording import (
    Block,
    Head,
    Lines,
    WholeRecording,
)
from sparseskin.nodes.sensor.layout.checks import parse_number, parse_whole, shown

from .movies import (
    LARGEST_NUMBER,
    check_mask,
    check_number,
    parse_shape,
    read_cells,
    stack_frames,
    stamps,
)

_N_HEAD_LINES = 100
"""Lines searched for the keyword of the readings; header and first frame have some 65 before it."""
_TIME = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:\.\d{1,9})?)")
_PEAK_ROUNDING = 0.011
"""Allowed difference of a stated peak, in the file's unit: both have two decimals."""
_AREA_ROUNDING = 0.02
"""Relative difference of a stated area that rounding explains: the side of a sensel has two
decimals of some 0.5 to 2 cm."""


Entries = dict[str, tuple[str, str]]
"""From a keyword to its value and its place in the file."""


def is_xsensor(raw: bytes) -> bool:
    """True if the content begins as an export of XSENSOR does."""
    lines = raw[: 1 << 16].removeprefix(b"\xef\xbb\xbf").split(b"\n", _N_HEAD_LINES)
    if lines[0].startswith(b"File:"):
        return True
    return any(line.startswith(b"SENSELS") for line in lines[:_N_HEAD_LINES])


class _Frame(NamedTuple):
    """First sensor, pitch, True if a part of the grid; time of day, s; readings; mask."""

    sensor: str
    pitch_m: float | None
    is_part: bool
    time_s: float | None
    readings: Doubles
    exists: Mask


class XsensorRecording(WholeRecording):
    """An XSENSOR text export; blank lines hold commas alone.

    A frame holds one sensor or more (a pair of insoles), and groups of their sensels: the first
    sensor is read. An empty cell is one without a sensel. Where there is none, but the stated total
    area is less than that of the grid, cells that read 0 in all frames are taken as such: an
    insole's export has zeros outside its outline. The rate is the mean one by the times of the
    frames, printed to 1 ms. `forces` are float64, in the file's Units. Raises SourceError if a
    header or frame is missing, cut short or malformed, a reading is not a finite number >= 0,
    frames differ in sensor, grid or mask or one is left out, times fall, or a peak is not the
    largest reading of its frame.
    """

    def __init__(self, lines: Lines) -> None:
        super().__init__()
        self._lines = lines
        self._unit = self._header_unit()
        self._number = self._next_number() or 0
        self._first = self._frame()

    def read(self) -> tuple[Head, Block]:
        first_frame = self._first
        mask = first_frame.exists
        name = self._lines.name
        frames = [first_frame]
        number = self._next_number()
        while number is not None:
            where = self._lines.where
            check_number(number, self._number + 1, where)
            self._number = number

            frame = self._frame()
            rows, cols = frame.exists.shape
            n_rows, n_cols = mask.shape
            if (frame.sensor, rows, cols) != (first_frame.sensor, n_rows, n_cols):
                raise SourceError(
                    f"{where}: frame {number} is {rows} x {cols} of sensor {shown(frame.sensor)}, "
                    f"the first one {n_rows} x {n_cols} of {shown(first_frame.sensor)}"
                )
            check_mask(mask, frame.exists, number, where, "empty")
            frames.append(frame)
            number = self._next_number()

        forces = stack_frames([frame.readings for frame in frames], name)
        # Where no cell is empty, those that never read a force have no sensel.
        if mask.all() and first_frame.is_part:
            mask = forces.max(axis=0) > 0
        head = Head(
            unit=self._unit,
            pitch_m=first_frame.pitch_m,
            mask=None if mask.all() or not mask.any() else mask,
        )
        times_s = [frame.time_s for frame in frames]
        return head, Block(forces, stamps(times_s, name, of_day=True))

    def _next(self) -> tuple[str, str] | None:
        """First cell and rest of the next line that is not blank; None at the end."""
        for text in self._lines:
            line = text.rstrip(", \t")
            if line:
                keyword, _, value = line.partition(",")
                return keyword.strip(), value.strip(", \t")
        return None

    def _header_unit(self) -> str:
        """Read to the first frame; return the unit of the readings."""
        unit = ""
        entry = self._next()
        while entry is not None and entry[0] != "FRAME":
            if entry[0] == "Units:":
                unit = entry[1]
            entry = self._next()
        if entry is None:
            raise SourceError(
                f"{self._lines.name}: holds no line FRAME; not an export of frames"
            )
        if not unit:
            raise SourceError(f"{self._lines.name}: the header states no Units")
        self._lines.back()
        return unit

    def _next_number(self) -> int | None:
        """Read to the next line FRAME, over further sensors and groups; return its number."""
        entry = self._next()
        while entry is not None:
            if entry[0] == "FRAME":
                return parse_whole(entry[1], self._lines.where, 0, LARGEST_NUMBER)
            entry = self._next()
        return None

    def _frame(self) -> _Frame:
        """Read the first sensor of a frame."""
        number = self._number
        begin = self._lines.where
        entries = self._frame_entries(begin)
        # What a frame must state; all else it may.
        for keyword in ("SENSOR", "Rows", "Columns"):
            if keyword not in entries:
                raise SourceError(f"{begin}: frame {number} states no {keyword}")
        shape = parse_shape(entries["Rows"], entries["Columns"])
        width_cm = _number_or_nan(entries, "Sensel Width")
        height_cm = _number_or_nan(entries, "Sensel Height")
        area_cm2 = _number_or_nan(entries, "Total Area")
        pitch_m = width_cm / 100 if width_cm == height_cm else None
        grid_cm2 = math.prod(shape) * width_cm * height_cm
        # False where one is not stated, and NaN.
        is_part = area_cm2 < (1 - _AREA_ROUNDING) * grid_cm2
        time_s = None
        if "Time" in entries:
            time_s = _seconds(*entries["Time"])

        readings, exists = read_cells(self._lines, shape, number, "Columns", absent="")
        if "Peak Pressure" in entries:
            text, where = entries["Peak Pressure"]
            peak = parse_number(text, where)
            if abs(peak - readings.max()) > _PEAK_ROUNDING:
                raise SourceError(
                    f"{where}: frame {number} states a peak of {peak:g}, but its largest reading "
                    f"is {readings.max():g}"
                )
        sensor, _ = entries["SENSOR"]
        return _Frame(sensor, pitch_m, is_part, time_s, readings, exists)

    def _frame_entries(self, begin: str) -> Entries:
        """Read what a frame, which begins at a place, states before its readings."""
        entries: Entries = {}
        entry = self._next()
        while entry is not None and entry[0] != "SENSELS":
            keyword, value = entry
            is_next = keyword in ("FRAME", "GROUP")
            if is_next or (keyword == "SENSOR" and "SENSOR" in entries):
                entry = None
                break
            # "Peak Pressure (mmHg)": without its unit.
            entries.setdefault(keyword.partition(" (")[0], (value, self._lines.where))
            entry = self._next()
        if entry is None:
            raise SourceError(
                f"{begin}: frame {self._number} has no line SENSELS with readings"
            )
        return entries


def _number_or_nan(entries: Entries, keyword: str) -> float:
    """The number of an entry; NaN if it is not stated."""
    if keyword not in entries:
        return math.nan
    return parse_number(*entries[keyword], 1e-4, 1e6)


def _seconds(text: str, where: str) -> float:
    """Return a time of day, HH:MM:SS.mmm, in seconds."""
    match = _TIME.fullmatch(text)
    if match is not None:
        hours, minutes, seconds = (float(part) for part in match.groups())
        if hours < 24 and minutes < 60 and seconds < 61:
            return 3600 * hours + 60 * minutes + seconds
    raise SourceError(f"{where}: {shown(text)} is no time of day such as 08:21:17.982")
