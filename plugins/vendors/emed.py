"""Novel emed platforms: the text export (.lst), one page a frame, pressure in kPa."""

import re
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.files.recording import (
    Block,
    Head,
    Lines,
    WholeRecording,
)
from sparseskin.nodes.sensor.layout.checks import parse_number, parse_whole, shown

from .movies import (
    KPA_CM2_IN_NEWTONS,
    LARGEST_NUMBER,
    check_number,
    parse_reading,
    parse_shape,
    stack_frames,
)

_MATRIX = re.compile(r"Matrix:\s*(\S*)")
_AREA = re.compile(r"Sensor area:\s*(\S+)\s*(\S*)")
_PERIOD = re.compile(r"Time/picture:\s*(\S+)\s*(\S*)")
_SIZE = re.compile(r"Sensor size:\s*([^x\s]+)x(\S+)\s*(\S*)")
_PICTURE = re.compile(r"Pict-No\.:\s*(\S*)")

Stated: TypeAlias = dict[re.Pattern[str], tuple[re.Match[str], str]]
"""Properties of a page, each with its place: where one stands twice, the last."""
_SUM_ROUNDING_N = 0.0051
"""Force sums are printed to 0.01 N."""
_CELL_ROUNDING_KPA = 0.005
"""Pressures are printed to 0.01 kPa."""


@dataclass(frozen=True)
class _Header:
    """Properties of the platform, stated on each page."""

    n_rows: int
    n_cols: int
    area_cm2: float
    period_ms: float
    pitch_m: float | None

    @property
    def newtons_per_kpa(self) -> float:
        return self.area_cm2 * KPA_CM2_IN_NEWTONS


class EmedRecording(WholeRecording):
    """An emed text export.

    A page lists only the rows and columns that were touched at some time, labelled from 1; they are
    put in their places on the full matrix of the platform. Pages without a `Pict-No.`, or where it
    is no number (the peak pictures MVP and MPP), are not frames. Where pages hold a Force column
    and row, the total force is compared with the readings, which also verifies that the pressures
    are in kPa: the file does not state their unit. `forces` are float64, newtons: pressure times
    sensor area. Raises SourceError if a page is cut short or does not fit its header, a frame is
    missing, a reading is not a finite number >= 0, or a total force is not the sum of its readings.
    """

    def __init__(self, lines: Lines) -> None:
        super().__init__()
        self._lines = lines
        first_page = self._next_page()
        if first_page is None:
            raise SourceError(
                f"{lines.name}: no page with a line 'Pict-No.: 1'; not an emed text export"
            )
        self._header, self._first_number = first_page

    def read(self) -> tuple[Head, Block]:
        header = self._header
        first_number = self._first_number
        name = self._lines.name
        frames = [self._table(first_number)]
        page = self._next_page()
        while page is not None:
            page_header, number = page
            where = self._lines.where
            if page_header != header:
                raise SourceError(
                    f"{where}: the header of frame {number} differs from the first one"
                )
            check_number(number, first_number + len(frames), where)
            frames.append(self._table(number))
            page = self._next_page()

        period_ns = header.period_ms * 1e6
        rate_hz = 1000.0 / header.period_ms
        head = Head(
            unit="N",
            rate_hz=rate_hz,
            pitch_m=header.pitch_m,
        )
        forces = stack_frames(frames, name) * header.newtons_per_kpa
        stamp_ns = [round(k * period_ns) for k in range(len(frames))]
        return head, Block(forces, stamp_ns)

    def _next_page(self) -> tuple[_Header, int] | None:
        """Read to the table of the next frame: its header and number; None at the end."""
        properties: Stated = {}
        for line in self._lines:
            for pattern in (_MATRIX, _AREA, _PERIOD, _SIZE):
                match = pattern.search(line)
                if match:
                    properties[pattern] = (match, self._lines.where)

            picture = _PICTURE.search(line)
            if picture is None:
                continue
            if picture[1].isdigit():
                where = self._lines.where
                header = _parse_header(properties, where)
                return header, parse_whole(picture[1], where, 0, LARGEST_NUMBER)
            # Peak pictures are no frames.
            properties = {}
        return None

    def _table(self, number: int) -> Doubles:
        """Read the table of a frame, kPa, onto the full matrix, float64 (n_rows, n_cols)."""
        lines = self._lines
        header = self._header
        start = self._lines.where
        line = next((line for line in lines if line.strip(" \t")), "\f")
        if line.startswith("\f"):
            raise SourceError(f"{start}: frame {number} has no table")
        where = lines.where
        columns, has_sums = _columns(line, header.n_cols, where)

        kpa = np.zeros((header.n_rows, header.n_cols))
        row_before = -1
        n_cells = 1 + len(columns) + has_sums
        for line in lines:
            where = lines.where
            if line.startswith("\f"):
                if has_sums:
                    break
                lines.back()
                return kpa

            cells = [cell.strip() for cell in line.rstrip(" \t").split("\t")]
            if len(cells) != n_cells:
                raise SourceError(
                    f"{where}: frame {number} has {len(cells)} cells in this row, "
                    f"its header row {n_cells}"
                )
            if cells[0] == "Force" and has_sums:
                _check_total(parse_number(cells[-1], where), kpa, header, where)
                return kpa

            row = parse_whole(cells[0], f"{where}, row label", 1, header.n_rows) - 1
            if row <= row_before:
                raise SourceError(
                    f"{where}: row {row + 1} comes after row {row_before + 1}"
                )
            row_before = row
            # The last cell may be the sum of the row.
            place = f"{where}, frame {number}"
            for col, token in zip(columns, cells[1:], strict=False):
                kpa[row, col] = parse_reading(token, place, row, col)
        raise SourceError(
            f"{where}: frame {number} is cut short before the end of its table"
        )


def _columns(line: str, n_cols: int, where: str) -> tuple[list[int], bool]:
    """Columns of a table by the line of their labels, from 0, and True if sums follow them."""
    corner, *labels = line.rstrip(" \t").split("\t")
    if corner.strip():
        raise SourceError(
            f"{where}: {shown(corner)} stands where a row of column labels should"
        )
    has_sums = bool(labels) and labels[-1].strip() == "Force"
    # The last column is that of the sums of the rows.
    if has_sums:
        labels.pop()
    columns = []
    for label in labels:
        number = parse_whole(label.strip(), f"{where}, column label", 1, n_cols)
        columns.append(number - 1)
    if any(column <= previous for previous, column in pairwise(columns)):
        raise SourceError(f"{where}: the column labels do not rise")
    return columns, has_sums


def _parse_header(properties: Stated, where: str) -> _Header:
    """The header of the page whose `Pict-No.` stands at a place."""

    def find(pattern: re.Pattern[str], expected: str) -> tuple[re.Match[str], str]:
        if pattern not in properties:
            raise SourceError(f"{where}: the page before it states no '{expected}'")
        return properties[pattern]

    def quantity(
        pattern: re.Pattern[str], expected: str, noun: str, unit: str
    ) -> list[float]:
        match, place = find(pattern, f"{expected} {unit}")
        *numbers, unit_stated = match.groups()

        # A superscript two has one byte or two, by the encoding of the file.
        if not re.fullmatch(unit.replace("2", r"\S*"), unit_stated):
            raise SourceError(
                f"{place}: {noun} in {shown(unit_stated)}; allowed is {unit}"
            )
        return [parse_number(number, place, 1e-6, 1e6) for number in numbers]

    matrix, place = find(_MATRIX, "Matrix: COLUMNSxROWS")
    cols, _, rows = matrix[1].partition("x")
    place = f"{place}, Matrix"
    n_rows, n_cols = parse_shape((rows, place), (cols, place))

    (area_cm2,) = quantity(_AREA, "Sensor area: ...", "sensor area", "cm2")
    (period_ms,) = quantity(_PERIOD, "Time/picture: ...", "time per picture", "ms")
    width_cm, height_cm = quantity(_SIZE, "Sensor size: ...x...", "sensor size", "cm")
    # A skin has one pitch; oblong sensors have two.
    pitch_m = width_cm / 100 if width_cm == height_cm else None
    return _Header(n_rows, n_cols, area_cm2, period_ms, pitch_m)


def _check_total(force_n: float, kpa: Doubles, header: _Header, where: str) -> None:
    """Compare the total force of a frame with its readings, to the precision of printed digits."""
    total_n = float(kpa.sum()) * header.newtons_per_kpa
    rounding = np.count_nonzero(kpa) * _CELL_ROUNDING_KPA * header.newtons_per_kpa
    if abs(force_n - total_n) > _SUM_ROUNDING_N + rounding:
        raise SourceError(
            f"{where}: Force is {force_n:g} N, but the readings add up to {total_n:g} N (pressure "
            "in kPa times sensor area)"
        )
