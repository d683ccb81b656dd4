"""Tables of text, .csv: one frame a line, with or without a header and a column of times."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from itertools import chain

import numpy as np

from sparseskin.nodes.errors import SourceError

from .recording import (
    ADD,
    NAN_HINT,
    REFUSE,
    File,
    Head,
    Parsed,
    Recording,
    is_missing,
    parse_number,
    rising,
    shown,
    stack_frames,
)

_TIME = re.compile(r"(t|time|times?tamp|stamp|date|date_?time|elapsed|seconds|millis)(?![a-z0-9])")
"""Begin of the name of a column of times, in small letters."""
_NS = {"ns": 1, "us": 10**3, "µs": 10**3, "ms": 10**6, "s": 10**9, "ISO 8601": 10**3}
_UNIT = re.compile(r"(?:^|[^a-z])(ns|us|µs|ms|s)(?:ec|econds)?\W*$|^(millis|seconds)$")
_EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"), (1e8, "s"))
"""Least numbers of times since 1970 in each unit, chosen: each is of 1973."""
_COUNTED = 8
"""Least length of a line 0, 1, 2, ... that is a header, chosen: no frame reads so."""
_COLUMNS = "names as s*, numbers as 2-65, time=NAME or time_ms=NAME, separated by commas"


class TableRecording(Recording):
    """Numbers separated by commas, semicolons, tabs or spaces, one frame a line.

    Blank lines and lines that begin with `#` are skipped. A first line with a text, or of 0, 1, 2,
    ..., is a header. The time is the column that `columns` states, or whose name begins as one of
    times does, or that holds ISO 8601 stamps; without a header the first one, where a line has one
    cell more than the stated shape. Taxels are the columns that `columns` states, or else those
    named alike but for numbers, if they are most, or all of numbers. Two numbers in each name are
    row and column of a taxel, where they fill a grid. Raises SourceError if a line has more or
    fewer cells than the first, a reading is no number, or times fall.
    """

    def __init__(self, file: File) -> None:
        self._file, self._lines = file, file.lines
        self._n_stated = (file.n_rows or 0) * (file.n_cols or 0)
        parts = [part.strip() for part in (file.columns or "").split(",") if part.strip()]
        self._times = [part for part in parts if re.match("time(_.s|_s)?=", part)]
        self._parts = [part for part in parts if part not in self._times]
        self._rows = self._cells()
        first = next(self._rows, [])
        self._width, self._names = len(first), first if _is_header(first) else []
        self._first = next(self._rows, []) if self._names else first
        if not self._first:
            raise SourceError(f"{file.name}: the recording holds no frame")
        self._check_width(self._first)
        self._time, self._unit = self._stated_time()
        self._taxels, self._shape = self._arranged(self._found_taxels())

    def head(self) -> Head:
        return Head(self._shape, len(self._taxels), None, self._time is not None)

    def read(self) -> Parsed:
        frames, times = [], []
        for cells in chain([self._first], self._rows):
            self._check_width(cells)
            frames.append(self._readings([cells[k] for k in self._taxels]))
            if self._time is not None:
                times.append(self._instant(cells[self._time]))
        forces = stack_frames(frames, self._lines.name).reshape(-1, *self._shape)
        read = {*self._taxels, self._time}
        others = [self._label(k) for k in range(self._width) if k not in read]
        more = ", ..." if len(others) > 8 else ""
        more += "; the first line is read as a header" if self._names else ""
        left_out = (f"left out: column {', '.join(others[:8])}{more}",) if others else ()
        if self._time is None:
            return Parsed(forces, notes=left_out)
        unit = self._unit or _unit_of(times)
        if not (self._names or self._unit) and set(np.diff(times)) == {1}:
            return Parsed(forces, notes=("column 1 counts lines, and is left out", *left_out))
        stamps = [(time - times[0]) * _NS[unit] for time in times]
        found = rising([round(stamp) for stamp in stamps], self._lines.name)
        note = f"times: column {self._label(self._time)} in {unit}; {len(self._taxels)} taxels: "
        note += f"{self._label(self._taxels[0])} to {self._label(self._taxels[-1])}"
        rate_hz = (len(stamps) - 1) * 1e9 / stamps[-1] if stamps[-1] else None
        return Parsed(forces, rate_hz=rate_hz, stamp_ns=found, notes=(note, *left_out))

    def _cells(self) -> Iterator[list[str]]:
        """The cells of the lines that are neither blank nor comments."""
        lines = (line for line in self._lines if line.strip() and line.lstrip()[0] != "#")
        if (first := next(lines, None)) is None:
            return
        mark = next((mark for mark in ";\t," if mark in first), " ")
        try:
            for line in chain([first], lines):
                cells = next(csv.reader([line], delimiter=mark, skipinitialspace=True))
                # A decimal comma stands where semicolons separate.
                yield [c.strip().replace(",", "." if mark == ";" else ",") for c in cells]
        except csv.Error:
            what = f"field larger than {csv.field_size_limit()} characters, or a line end within"
            raise SourceError(f"{self._lines.where}: no line of a table of text: {what}") from None

    def _check_width(self, cells: Sequence[str]) -> None:
        if len(cells) != self._width:
            place = self._lines.where
            raise SourceError(f"{place}: holds {len(cells)} cells, the first line {self._width}")

    def _label(self, k: int) -> str:
        return shown(self._names[k]) if self._names else str(k + 1)

    def _matching(self, text: str) -> list[int]:
        """The columns of one of `_COLUMNS`."""
        numbers = re.fullmatch(r"(\d{1,7})(?:-(\d{1,7}))?", text)
        if numbers and text not in self._names:
            first, last = int(numbers[1]), int(numbers[2] or numbers[1])
            found = list(range(first - 1, last)) if 1 <= first <= last <= self._width else []
        else:
            found = [k for k, name in enumerate(self._names) if name == text]
            found = found or [k for k, name in enumerate(self._names) if fnmatchcase(name, text)]
        if not found:
            held = f"{', '.join(map(shown, self._names[:8]))}, ..." if self._names else "no header"
            place = f"{self._lines.name}: columns: {shown(text)} is none of {self._width} columns"
            raise SourceError(f"{place} ({held}); allowed: {_COLUMNS}")
        return found

    def _stated_time(self) -> tuple[int | None, str | None]:
        """The column of times, and its unit where that is stated."""
        for part in self._times:
            key, _, name = part.partition("=")
            unit, place = key.removeprefix("time").removeprefix("_"), self._lines.name
            if unit and unit not in _NS:
                raise SourceError(f"{place}: columns: {shown(part)}; allowed: {_COLUMNS}")
            (found, *_) = self._matching(name)
            return found, unit or self._named_unit(found)
        for k, name in enumerate(self._names):
            if _TIME.match(name.lower()) and _is_value(self._first[k]):
                return k, self._named_unit(k)
        for k, cell in enumerate(self._first):
            if _iso(cell) is not None:
                return k, "ISO 8601"
        more = not self._names and not self._parts and self._width == self._n_stated + 1
        return (0, None) if self._n_stated and more else (None, None)

    def _named_unit(self, k: int) -> str | None:
        if _iso(self._first[k]) is not None:
            return "ISO 8601"
        found = _UNIT.search(self._names[k].lower()) if self._names else None
        return None if found is None else found[1] or {"m": "ms", "s": "s"}[found[2][0]]

    def _found_taxels(self) -> list[int]:
        if self._parts:
            found = list(dict.fromkeys(k for part in self._parts for k in self._matching(part)))
            return [k for k in found if k != self._time]
        named = [k for k in range(self._width) if not self._names or self._names[k]]
        found = [k for k in named if k != self._time and _is_value(self._first[k])]
        alike = Counter(self._kind(k) for k in found).most_common(1)
        if alike and "#" in alike[0][0] and 2 * alike[0][1] > len(found):
            found = [k for k in found if self._kind(k) == alike[0][0]]
        if not found:
            place = f"{self._lines.where}: no column holds numbers"
            raise SourceError(f"{place}; state columns: {_COLUMNS}; begin a line of units with #")
        if 0 < self._n_stated < len(filled := [k for k in found if self._first[k]]):
            what = f"{len(filled)} columns hold numbers, but n_rows x n_cols = {self._n_stated}"
            raise SourceError(f"{self._lines.name}: {what}{ADD}{self._to_state(filled[-1])}")
        return found

    def _to_state(self, last: int) -> str:
        """Setting with the taxels up to the column `last`, and a time where there are more."""
        first = last + 2 - self._n_stated if self._n_stated else 1
        return f"columns={'time=1,' * (first > 1 and self._time is None)}{first}-{last + 1}"

    def _kind(self, k: int) -> str:
        """The name of a column with # for its numbers."""
        return re.sub(r"\d+", "#", self._names[k]) if self._names else ""

    def _arranged(self, taxels: list[int]) -> tuple[list[int], tuple[int, ...]]:
        """Columns row after row, and the shape, where their names state it."""
        file, kinds = self._file, {self._kind(k) for k in taxels}
        if len(kinds) == 1 and next(iter(kinds)).count("#") == 2 and not file.n_rows:
            places = {tuple(map(int, re.findall(r"\d+", self._names[k]))): k for k in taxels}
            rows, cols = (len(set(side)) for side in zip(*places, strict=True))
            if rows * cols == len(places) == len(taxels) and min(rows, cols) > 1:
                return [places[place] for place in sorted(places)], (rows, cols)
        return taxels, (len(taxels),)

    def _readings(self, cells: list[str]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        try:
            if "_" not in "".join(cells):
                return np.array([*map(float, cells)])
        except ValueError:
            pass
        where, refused = self._lines.where, self._file.policy.nan == REFUSE
        found = np.full(len(cells), np.nan)
        for k, cell in enumerate(cells):
            place = f"{where}, column {self._label(self._taxels[k])}"
            if not is_missing(cell):
                found[k] = parse_number(cell, place)
            elif refused:
                last = self._width - 1
                is_end = self._taxels[k] == last >= self._n_stated and not self._first[last]
                hint = f", or {self._to_state(last - 1)}" if is_end else ""
                raise SourceError(f"{place}: {shown(cell)} is not a number{NAN_HINT}{hint}")
        return found

    def _instant(self, cell: str) -> float:
        """A time in its unit; ISO 8601 in microseconds."""
        moment = _iso(cell) if self._unit == "ISO 8601" else None
        return moment or parse_number(cell, f"{self._lines.where}, time", -1e19, 1e19)


def _is_header(cells: list[str]) -> bool:
    """True if some cell is no value; or all are 0, 1, 2, ..., as pandas names columns."""
    named = [cell for cell in cells if cell]
    counted = len(named) >= _COUNTED and named == [*map(str, range(len(named)))]
    return counted or not all(map(_is_value, cells))


def _is_value(cell: str) -> bool:
    try:
        return "_" not in cell and float(cell) is not None
    except ValueError:
        return is_missing(cell) or _iso(cell) is not None


def _iso(cell: str) -> int | None:
    """Microseconds since 1970 of a stamp of ISO 8601, of UTC where it states no zone."""
    if "-" not in cell[1:]:
        return None
    try:
        found = datetime.fromisoformat(cell)
    except ValueError:
        return None
    zoned = found if found.tzinfo else found.replace(tzinfo=UTC)
    return (zoned - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)


def _unit_of(times: Sequence[float]) -> str:
    """Unit of numbers that state none, by their size since 1970 or their distance."""
    by_distance = "s" if len(times) < 2 or float(np.median(np.diff(times))) < 1 else "ms"
    return next((unit for least, unit in _EPOCHS if abs(times[0]) > least), by_distance)
