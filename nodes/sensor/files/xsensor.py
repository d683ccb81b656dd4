"""XSENSOR sensors: the text export (.csv) of their software, in its own unit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles, Mask

from .parsed import (
    Parsed,
    check_grid,
    parse_number,
    parse_reading,
    parse_whole,
    shown,
    stack_frames,
    text_lines,
)

_N_HEAD_LINES = 100
"""Lines searched for the keyword of the readings; header and first frame have some 65 before it."""
_TIME = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:\.\d{1,9})?)")
_DAY_S = 86400.0
_PEAK_ROUNDING = 0.011
"""Allowed difference of a stated peak, in the file's unit: both have two decimals."""
_AREA_ROUNDING = 0.02
"""Relative difference of a stated area that rounding explains: the side of a sensel has two
decimals of some 0.5 to 2 cm."""


def is_xsensor(raw: bytes) -> bool:
    """True if the content begins as an export of XSENSOR does."""
    lines = raw[: 1 << 16].removeprefix(b"\xef\xbb\xbf").split(b"\n", _N_HEAD_LINES)
    if lines[0].startswith(b"File:"):
        return True
    return any(line.startswith(b"SENSELS") for line in lines[:_N_HEAD_LINES])


@dataclass(frozen=True)
class _Sensor:
    """What each frame states about the sensor; lengths in cm."""

    name: str
    n_rows: int
    n_cols: int
    width_cm: float | None
    height_cm: float | None
    area_cm2: float | None


def parse_xsensor(raw: bytes, name: str) -> Parsed:
    """Read an XSENSOR text export.

    A frame holds one sensor or more (a pair of insoles), and groups of their sensels: the first
    sensor is read. Its peak is compared with the one that the frame states. An empty cell is one
    without a sensel. Where there is none, but the stated total area is less than that of the
    grid, cells that read 0 in all frames are taken as such: an insole's export has zeros outside
    its outline. The rate is the mean one by the times of the frames, which are printed to 1 ms.

    Parameters
    ----------
    raw : bytes
        Content of the file.
    name : str
        Name of the file, for errors.

    Returns
    -------
    Parsed
        `forces` float64, shape (n_frames, Rows, Columns), in the file's Units.

    Raises
    ------
    SourceError
        If a header or frame is missing, cut short or malformed, a reading is not a finite
        number >= 0, frames differ in sensor, grid or mask or one is left out, times fall, or a
        peak is not the largest reading of its frame.
    """
    reader = _Reader(text_lines(raw), name)
    unit = reader.header_unit()
    frames: list[Doubles] = []
    times: list[float | None] = []
    first: _Sensor | None = None
    first_number = 0
    mask: Mask | None = None
    while (number := reader.next_frame()) is not None:
        where = reader.where
        if frames and number != first_number + len(frames):
            raise SourceError(
                f"{where}: frame {number} comes where frame {first_number + len(frames)} should"
            )
        first_number = first_number if frames else number
        sensor, time_s, frame, exists = reader.frame(number)
        if first is None:
            first, mask = sensor, exists
        elif (sensor.name, frame.shape) != (first.name, (first.n_rows, first.n_cols)):
            raise SourceError(
                f"{where}: frame {number} is {sensor.n_rows} x {sensor.n_cols} of sensor "
                f"{shown(sensor.name)}, the first one {first.n_rows} x {first.n_cols} of "
                f"{shown(first.name)}"
            )
        elif mask is not None and not np.array_equal(mask, exists):
            row, col = np.argwhere(mask != exists)[0]
            raise SourceError(
                f"{where}: frame {number} has its empty cells (no sensel) elsewhere than the first "
                f"frame, e.g. at row {row}, column {col}; a mask must not change"
            )
        times.append(time_s)
        frames.append(frame)
    forces = stack_frames(frames, name)
    assert first is not None
    assert mask is not None
    if mask.all() and _is_part(first):
        mask = forces.max(axis=0) > 0
    stamps = _stamps(times, name)
    return Parsed(
        forces=forces,
        unit=unit,
        rate_hz=(len(stamps) - 1) * 1e9 / stamps[-1] if stamps and len(stamps) > 1 else None,
        stamp_ns=stamps,
        pitch_m=first.width_cm / 100
        if first.width_cm is not None and first.width_cm == first.height_cm
        else None,
        mask=None if mask.all() or not mask.any() else mask,
    )


def xsensor_shape(raw: bytes, name: str) -> tuple[int, int, int | None]:
    """Rows, columns and number of sensels of a recording, from the first frame of its file; None
    where other frames decide which cells are sensels.

    Raises
    ------
    SourceError
        If header or first frame are malformed.
    """
    reader = _Reader(text_lines(raw), name)
    reader.header_unit()
    number = reader.next_frame()
    if number is None:
        raise SourceError(f"{name}: the recording holds no frame")
    sensor, _, _, exists = reader.frame(number)
    decided = not (exists.all() and _is_part(sensor))
    return sensor.n_rows, sensor.n_cols, int(exists.sum()) if decided else None


def _is_part(sensor: _Sensor) -> bool:
    """True if the stated area is less than that of the whole grid."""
    if sensor.width_cm is None or sensor.height_cm is None or sensor.area_cm2 is None:
        return False
    grid_cm2 = sensor.n_rows * sensor.n_cols * sensor.width_cm * sensor.height_cm
    return sensor.area_cm2 < (1 - _AREA_ROUNDING) * grid_cm2


class _Reader:
    """The lines of an export, read one after the other; blank ones hold commas alone."""

    def __init__(self, lines: list[str], name: str) -> None:
        self._lines = lines
        self._name = name
        self._index = 0
        self.where = f"{name}, line 1"

    def _next(self) -> tuple[str, str] | None:
        """Return first cell and rest of the next line that is not blank; None at the end."""
        while self._index < len(self._lines):
            line = self._lines[self._index].rstrip(", \t")
            self._index += 1
            if line:
                self.where = f"{self._name}, line {self._index}"
                keyword, _, rest = line.partition(",")
                return keyword.strip(), rest.strip(", \t")
        return None

    def header_unit(self) -> str:
        """Read to the first frame; return the unit of the readings."""
        unit = ""
        while (entry := self._next()) is not None and entry[0] != "FRAME":
            if entry[0] == "Units:":
                unit = entry[1]
        if entry is None:
            raise SourceError(f"{self._name}: holds no line FRAME; not an export of frames")
        if not unit:
            raise SourceError(f"{self._name}: the header states no Units")
        self._index -= 1
        return unit

    def next_frame(self) -> int | None:
        """Read to the next line FRAME, over further sensors and groups; return its number."""
        while (entry := self._next()) is not None:
            if entry[0] == "FRAME":
                return parse_whole(entry[1], self.where, 0, 999_999_999)
        return None

    def frame(self, number: int) -> tuple[_Sensor, float | None, Doubles, Mask]:
        """Read the first sensor of a frame: what it states, time in s, readings and mask."""
        begin = self.where
        stated: dict[str, tuple[str, str]] = {}
        while (entry := self._next()) is not None and entry[0] != "SENSELS":
            if entry[0] in ("FRAME", "GROUP") or (entry[0] == "SENSOR" and "SENSOR" in stated):
                entry = None
                break
            # "Peak Pressure (mmHg)": without its unit.
            stated.setdefault(entry[0].partition(" (")[0], (entry[1], self.where))
        if entry is None:
            raise SourceError(f"{begin}: frame {number} has no line SENSELS with readings")
        for keyword in ("SENSOR", "Rows", "Columns"):
            if keyword not in stated:
                raise SourceError(f"{begin}: frame {number} states no {keyword}")
        n_rows = parse_whole(*stated["Rows"], 1, MAX_SIDE)
        n_cols = parse_whole(*stated["Columns"], 1, MAX_SIDE)
        check_grid(n_rows, n_cols, stated["Rows"][1])

        def length(keyword: str) -> float | None:
            return parse_number(*stated[keyword], 1e-4, 1e6) if keyword in stated else None

        sensor = _Sensor(
            stated["SENSOR"][0],
            n_rows,
            n_cols,
            length("Sensel Width"),
            length("Sensel Height"),
            length("Total Area"),
        )
        time_s = _seconds(*stated["Time"]) if "Time" in stated else None
        readings, exists = self._grid(n_rows, n_cols, number)
        if "Peak Pressure" in stated:
            peak = parse_number(*stated["Peak Pressure"])
            if abs(peak - readings.max()) > _PEAK_ROUNDING:
                raise SourceError(
                    f"{stated['Peak Pressure'][1]}: frame {number} states a peak of {peak:g}, but "
                    f"its largest reading is {readings.max():g}"
                )
        return sensor, time_s, readings, exists

    def _grid(self, n_rows: int, n_cols: int, number: int) -> tuple[Doubles, Mask]:
        rows: list[list[str]] = []
        places: list[str] = []
        while len(rows) < n_rows and self._index < len(self._lines):
            line = self._lines[self._index]
            self._index += 1
            cells = [cell.strip() for cell in line.split(",")]
            if not any(cells):
                continue  # a line between rows
            where = f"{self._name}, line {self._index}, frame {number}"
            while len(cells) > n_cols and not cells[-1]:
                cells.pop()
            if len(cells) != n_cols:
                raise SourceError(
                    f"{where}: row {len(rows)} has {len(cells)} cells, Columns is {n_cols}"
                )
            rows.append(cells)
            places.append(where)
        if len(rows) < n_rows:
            raise SourceError(
                f"{self._name}, line {self._index}: the file ends in frame {number}, which needs "
                f"{n_rows} rows"
            )
        readings, exists = np.zeros((n_rows, n_cols)), np.ones((n_rows, n_cols), dtype=np.bool_)
        for row, (cells, where) in enumerate(zip(rows, places, strict=True)):
            for col, token in enumerate(cells):
                if token:
                    readings[row, col] = parse_reading(token, where, row, col)
                else:
                    exists[row, col] = False
        return readings, exists


def _seconds(text: str, where: str) -> float:
    """Return a time of day, HH:MM:SS.mmm, in seconds."""
    match = _TIME.fullmatch(text)
    hours, minutes, seconds = (float(part) for part in match.groups()) if match else (24, 0, 0)
    if not (hours < 24 and minutes < 60 and seconds < 61):
        raise SourceError(f"{where}: {shown(text)} is no time of day such as 08:21:17.982")
    return 3600 * hours + 60 * minutes + seconds


def _stamps(times: list[float | None], name: str) -> tuple[int, ...] | None:
    """Return nanoseconds since the first frame, or None if times are missing or repeated."""
    known = [time for time in times if time is not None]
    if len(known) != len(times):
        return None
    stamps, days = [0], 0
    for k, (before, time) in enumerate(pairwise(known), start=2):
        # From the last minutes of a day to the first ones of the next.
        days += before - time > _DAY_S / 2
        stamps.append(round((time - known[0] + days * _DAY_S) * 1e9))
        if stamps[-1] < stamps[-2]:
            raise SourceError(
                f"{name}: the time of frame {k} (counted from 1) is before that of the frame "
                "before it"
            )
    return tuple(stamps) if len(set(stamps)) == len(stamps) else None
