"""The begin of a table as it was seen: the lines that are looked at, and what they show."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.layout.checks import is_missing, shown
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.layout.times import clock_ns, iso_ns

from .text import Dialect

MAX_SHOWN = 8
FRAME_WORDS = [
    "frame",
    "frame_id",
    "frame_no",
    "frame_number",
    "sample",
    "index",
    "seq",
    "n",
]
SUMMARY = re.compile(
    r"mean|average|avg|median|max(?:imum)?|min(?:imum)?|sum|total|count|peak|var(?:iance)?|rms"
    r"|std(?:\.? ?dev)?|s\.?d|standard deviation|\d\d?%"
)
"""Words in small letters that name lines below a table which sum it up."""
UNMARKED = re.compile(r"(?=.*[A-F])(?=.*[0-9])[0-9A-F]{2,}|FF+", re.IGNORECASE)
"""Texts that may be hexadecimal numbers."""
HEXADECIMAL = re.compile(r"0[xX][0-9a-fA-F]{1,16}")


class Line(NamedTuple):
    """A line of the sample: its number from 1, its text, and its cells."""

    number: int
    text: str
    cells: Sequence[str]


class LongColumns(NamedTuple):
    """Columns of a table with a line for each taxel."""

    frame: int  # a number, or the time
    places: tuple[int, ...]  # row and column, or the taxel alone
    value: int

    @property
    def columns(self) -> tuple[int, ...]:
        """All of them."""
        return (self.frame, *self.places, self.value)


class DataLine(NamedTuple):
    """A line of data: its text, its number in the file, and whether something else stands between
    it and the one before.
    """

    text: str
    number: int
    begins: bool


class Parsed(NamedTuple):
    """Lines of data, their numbers (k, width), NaN where there is none, and their times."""

    lines: Sequence[DataLine]
    numbers: Doubles
    times: list[int | float] | None


@dataclass
class TableHead:
    """What is stated of a table, the lines of its begin, and what these show."""

    layout: Layout
    name: str  # of the file, for errors
    dialect: Dialect
    width: int  # cells of a line
    raw: list[Line] = field(default_factory=list)  # all lines of the begin
    data: list[Line] = field(default_factory=list)  # those of them that hold readings
    n_before: int = 0  # lines before the first one of data
    is_labelled: bool = False  # the names are positions: a line of 1, 2, 3, ...
    headers: tuple[str, ...] = ()  # the lines of the names
    has_summary: bool = False  # lines below the data may sum them up
    units: str = ""  # the line of units
    names: Sequence[str] = ()
    usable: tuple[int, ...] = ()  # columns of numbers that are no times
    numeric: Sequence[int] = ()  # columns of numbers
    time: int | None = None
    nanoseconds: int | None = None  # column with those of a time in seconds
    time_unit: str = ""
    rate_hz: float | None = None  # as a line before the table states it
    height: int = 0  # lines of a frame of a grid; 0: no grid
    are_numbered: bool = (
        False  # a line of one number stands before each frame of a grid
    )
    n_labels: int = 0  # columns before its readings: the numbers of the rows
    long: LongColumns | None = None
    taxels: dict[str, int] = field(
        default_factory=dict
    )  # their names, in a column of texts
    source: int | None = None  # column by which lines of one skin are chosen
    notes: tuple[str, ...] = ()

    @property
    def is_plain(self) -> bool:
        """True if a frame is a line, and neither a block of lines nor one for each taxel."""
        return not self.height and self.long is None

    def label(self, column: int) -> str:
        """The name of a column, or its number from 1."""
        name = self.names[column]
        if name:
            return shown(name)
        return str(column + 1)

    def is_indexed(self, column: int) -> bool:
        """True if the name of a column holds a number, as those of taxels do."""
        return any(map(str.isdigit, self.names[column]))

    def cells(self, column: int) -> list[str]:
        """The cells of a column in the sample."""
        return [line.cells[column] for line in self.data]

    def numbers(self, column: int) -> npt.NDArray[np.float64]:
        """Numbers of a column in the sample; NaN where there is none."""
        return numbers_of(self.cells(column))

    def summary_of(self, cells: Sequence[str]) -> str | None:
        """The word by which a line sums up those above it, "" if its cells are empty; None of
        others.
        """
        for cell in (cells[0], cells[-1]):
            word = cell.strip(" .:").lower()
            if SUMMARY.fullmatch(word):
                return word
        if any(cells):
            return None
        return ""


def numbers_of(cells: Sequence[str]) -> npt.NDArray[np.float64]:
    """Numbers of cells, NaN for other texts."""
    numbers = (number_of(cell) for cell in cells)
    return np.array([np.nan if number is None else number for number in numbers])


def number_of(cell: str) -> float | None:
    """The number in a cell; None if it is none, or one of Python's literals such as 1_0."""
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return float(int(cell, 16)) if HEXADECIMAL.fullmatch(cell) else None


def is_number(cell: str) -> bool:
    """True if a cell is a number."""
    return number_of(cell) is not None


def is_value(cell: str) -> bool:
    """True if a cell is a number, a time, or states that there is none."""
    if is_number(cell) or is_missing(cell):
        return True
    return iso_ns(cell) is not None or clock_ns(cell) is not None
