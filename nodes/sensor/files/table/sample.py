"""The begin of a table as it was seen: the lines that are looked at, and what they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import is_missing, shown
from sparseskin.nodes.sensor.layout.times import (
    clock_ns,
    iso_ns,
)

from .text import Dialect

MAX_SHOWN = 8
FRAME_WORDS = (
    "frame",
    "frame_id",
    "frame_no",
    "frame_number",
    "sample",
    "index",
    "seq",
    "n",
)
LINES = "lines"
GRID = "grid"
LONG = "long"
"""Kinds of tables: a frame a line; a frame a block of lines, one a row; a line for each taxel."""


@dataclass
class TableHead:
    """What the begin of a table shows."""

    dialect: Dialect
    width: int  # cells of a line
    has_trailing: bool = False  # a separator ends each line
    n_before: int = 0  # lines before the first one of data
    header: str = ""  # the line of the names
    units: str = ""  # the line of units
    names: tuple[str, ...] = ()
    usable: tuple[int, ...] = ()  # columns of numbers that are no times
    numeric: tuple[int, ...] = ()  # columns of numbers
    time: int | None = None
    nanoseconds: int | None = None  # column with those of a time in seconds
    time_unit: str = ""
    rate_hz: float | None = None  # as a line before the table states it
    kind: str = LINES
    height: int = 1  # lines of a frame of a grid
    long: LongColumns | None = None
    source: int | None = None  # column by which lines of one skin are chosen
    notes: tuple[str, ...] = ()

    def label(self, column: int) -> str:
        """The name of a column, or its number from 1."""
        name = self.names[column]
        return shown(name) if name else str(column + 1)


class Place(NamedTuple):
    """A column of rows, columns or taxels, its least number, and how many there are."""

    column: int
    begin: int
    size: int


@dataclass(frozen=True)
class LongColumns:
    """Columns of a table with a line for each taxel: of row and column, or of the taxel alone."""

    frame: int  # a number, or the time
    places: tuple[Place, ...]
    value: int

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Axes of a frame."""
        sizes = [place.size for place in self.places]
        if len(sizes) == 1:
            return (Axis(sizes[0], "taxels"),)
        return (Axis(sizes[0], "rows"), Axis(sizes[1], "cols"))


@dataclass(frozen=True)
class Line:
    """A line of the sample: its number from 1, its text, and its cells."""

    number: int
    text: str
    cells: tuple[str, ...]


def is_number(cell: str) -> bool:
    """True if a cell is a number; not one of Python's literals such as 1_0."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def is_value(cell: str) -> bool:
    """True if a cell is a number, a time, or states that there is none."""
    return (
        is_number(cell)
        or is_missing(cell)
        or bool(iso_ns(cell) or clock_ns(cell) is not None)
    )


def holds_values(data: Sequence[Line], k: int) -> bool:
    """True if most cells of a column are values; one that is none is refused where it stands."""
    return 2 * sum(is_value(line.cells[k]) for line in data) > len(data)


def column_of(
    data: Sequence[Line], k: int
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Numbers of a column of the sample; NaN where there is none."""
    numbers = np.full(len(data), np.nan)
    for row, line in enumerate(data):
        if is_number(line.cells[k]):
            numbers[row] = float(line.cells[k])
    return numbers


def is_indexed(head: TableHead, k: int) -> bool:
    return any(character.isdigit() for character in head.names[k])
