"""Tables of text: one frame a line, a block of lines, or a line for each taxel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import IO

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.files.recording import (
    Block,
    File,
    Head,
    Recording,
    frames_per_block,
)
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import (
    NAN_HINT,
    is_missing,
    parse_number,
    reading,
    shown,
)
from sparseskin.nodes.sensor.layout.layout import UnstatedError
from sparseskin.nodes.sensor.layout.tally import Tally
from sparseskin.nodes.sensor.layout.times import (
    CLOCK_UNIT,
    ISO,
    dated_clock_ns,
    iso_ns,
)

from .head import EXCEL_LINE, read_head
from .long import LongFrames
from .sample import UNMARKED, DataLine, Parsed, is_number, is_value, number_of
from .text import comment_mark, pieces

BLANK = "blank lines"
BELOW = "summary line: "
EMPTY = "lines of empty cells"
"""Begin of the name by which a line below the readings is dropped, and that of lines of no text."""
EXACT = float(1 << 53)
"""Largest whole number up to which float64 has all."""


class TableRecording(Recording):
    """Numbers separated by commas, semicolons, tabs, bars or white space.

    Blank lines, comments (`#`, `%`, `//`) and lines before the table are dropped by name. A first
    line with texts where numbers follow is a header. A frame is a line; or a block of lines
    between blank ones, or of the stated rows; or the lines with the same number of a frame, where
    names state row, column and value. A line with another number of cells is an error, but a cut
    last one, which is dropped.
    """

    def __init__(self, file: File) -> None:
        self._file = file
        self._layout = file.layout
        self._head = read_head(file)
        self.tally = Tally("lines")
        self._long = None
        if self._head.long is not None:
            self._long = LongFrames(self._head, self._head.long, self._rows)

    def head(self) -> Head:
        head = self._head
        time_name = ""
        if head.time is not None:
            time_name = f"column {head.label(head.time)}"
        # Axes of a line, of a block of lines, or of the lines of a frame.
        axes: tuple[Axis, ...] = (Axis(head.width, "columns", tuple(head.names)),)
        usable: tuple[int, ...] | None = head.usable
        if head.height:
            width = head.width - head.n_labels
            axes = (Axis(head.height, "rows"), Axis(width, "cols"))
            usable = None
        elif self._long is not None:
            axes = self._long.axes
            usable = None
        return Head(
            axes,
            usable=usable,
            is_timed=head.time is not None,
            time_unit=head.time_unit,
            time_name=time_name,
            asks_unit=True,
            rate_hz=head.rate_hz,
            notes=head.notes,
        )

    @property
    def numeric(self) -> Sequence[int]:
        """The columns of numbers."""
        return self._head.numeric

    def texts_of_lines(self) -> tuple[str, ...]:
        """The first cells of all lines, where these are texts; else ()."""
        if 0 in self._head.numeric:
            return ()
        cells = self._head.dialect.cells
        names = tuple(cells(line.text)[0] for lines in self._lines() for line in lines)
        self.tally.begin()
        return names

    def blocks(self) -> Iterator[Block]:
        self.tally.begin()
        if self._head.height:
            yield from self._grids()
        elif self._long is not None:
            for block, n_lines in self._long.blocks():
                self.tally.take(n_lines, len(block.numbers))
                yield from block.parts()
        else:
            for _, numbers, times in self._rows():
                self.tally.take(len(numbers), len(numbers))
                yield Block(numbers, times)

    def _rows(self) -> Iterator[Parsed]:
        """The lines of data, some at a time."""
        size = frames_per_block(self._head.width)
        for lines in self._lines():
            for start in range(0, len(lines), size):
                yield self._parsed(lines[start : start + size])

    def _lines(self) -> Iterator[list[DataLine]]:
        """The lines of data by pieces."""
        yield from self._lines_of(self._file.file, self._file.name, self._head.n_before)
        for name in self._file.parts:
            with reading(name) as file:
                yield from self._lines_of(file, name, 0)

    def _lines_of(
        self, file: IO[bytes], name: str, n_before: int
    ) -> Iterator[list[DataLine]]:
        begins = True
        # Lines that sum the table up, each once; no readings may follow.
        below: set[str] = set()
        for piece in pieces(file, name):
            lines: list[DataLine] = []
            last_number = piece.number + len(piece.lines) - 1
            # Each line is data, or is counted under a name.
            for number, text in enumerate(piece.lines, start=piece.number):
                if number <= n_before:
                    label = self._before_as(text, number)
                else:
                    label = self._dropped_as(
                        text, piece.is_cut and number == last_number
                    )
                if below and (not label or label in below - {EMPTY}):
                    fault = (
                        f"is below a line that would be left out, {next(iter(below))}"
                    )
                    raise SourceError(f"{name}, line {number}: {fault}; remove that")
                if label == EMPTY or label.startswith(BELOW):
                    below.add(label)
                if label:
                    self.tally.drop(label)
                else:
                    lines.append(DataLine(text, number, begins))
                begins = bool(label)
            yield lines

    def _before_as(self, text: str, number: int) -> str:
        """The name by which a line before the first one of data is dropped."""
        if number == 1 and EXCEL_LINE.fullmatch(text.strip()):
            return "line of the separator"
        if number <= self._layout.skip:
            return "skipped lines"
        label = _empty_as(text)
        if label != BLANK and text in self._head.headers:
            return "header"
        if label != BLANK and text == self._head.units:
            return "line of units"
        return label or "lines before the table"

    def _dropped_as(self, text: str, is_cut: bool) -> str:
        """The name by which a line is dropped; "" of a line of data."""
        head = self._head
        label = _empty_as(text)
        if label:
            return label
        # A logger that was started again appends to its file.
        if text in head.headers:
            return "repeated headers"
        if head.height and not self._is_grid_row(text):
            return "lines between frames"
        if is_cut and len(head.dialect.cells(text)) < head.width:
            return "cut last line"
        if head.has_summary and _may_sum_up(text):
            word = head.summary_of(head.dialect.cells(text))
            if word is not None:
                if not word:
                    return EMPTY
                return BELOW + word
        # What a board prints while it starts.
        if text[0].isalpha() and not self._may_be_data(text):
            return "lines of text"
        # Counted by name: whoever states a skin sees how many lines are those of others.
        if head.source is not None:
            cells = head.dialect.cells(text)
            source = cells[head.source : head.source + 1]
            if source not in ([], [self._layout.frame_id]):
                return "lines of other skins"
        return ""

    def _may_be_data(self, text: str) -> bool:
        """True if a line that begins with a letter may be one of data, or a part of one."""
        head = self._head
        if 0 not in (*head.numeric, head.time):
            return True
        cells = head.dialect.cells(text)
        return len(cells) == head.width or any(map(is_value, cells))

    def _is_grid_row(self, text: str) -> bool:
        """True if a line is one of a grid, perhaps with another number of cells: an error."""
        stripped = text.strip()
        # A row of which one number is left is noticed by the height of its frame.
        if self._head.are_numbered and is_number(stripped):
            return False
        begins_row = stripped[0].isdigit() or stripped[0] in '+-."[('
        # A line may be a time of day.
        if begins_row and ":" not in stripped:
            return True
        cells = self._head.dialect.cells(text)
        is_reading = bool(cells) and (is_number(cells[0]) or is_missing(cells[0]))
        return is_reading and len(cells) == self._head.width

    def _parsed(self, lines: Sequence[DataLine]) -> Parsed:
        # NumPy reads a block at once; what it refuses is read line by line, for the place.
        numbers = None
        if self._head.dialect.is_plain and {*self._head.usable} <= {
            *self._head.numeric
        }:
            numbers = self._numbers_of_plain([line.text for line in lines])
        if numbers is not None and self._has_exact_times(numbers):
            times = None
            if self._head.time is not None:
                times = numbers[:, self._head.time].tolist()
            return Parsed(lines, numbers, times)

        rows = [self._cells(line) for line in lines]
        if numbers is None:
            columns = self._head.usable or self._head.numeric
            numbers = np.full((len(rows), self._head.width), np.nan)
            for k, cells in enumerate(rows):
                for column in columns:
                    numbers[k, column] = self._number(cells[column], lines[k], column)
        times = None
        if self._head.time is not None:
            times = list(map(self._instant, rows, lines))
        return Parsed(lines, numbers, times)

    def _numbers_of_plain(self, texts: Sequence[str]) -> Doubles | None:
        """Numbers of lines that NumPy reads; None if it cannot read one, or may not."""
        head = self._head
        # NumPy splits at any white space where no separator is stated.
        separator: str | None = head.dialect.separator
        if separator == " ":
            separator = None
        columns: Sequence[int] | None = head.numeric
        if len(head.numeric) == head.width:
            columns = None
        if separator is None and columns is not None:
            return None  # NumPy does not check the number of cells
        if separator is not None:
            if texts[0].count(separator) == head.width:
                texts = [text.rstrip().removesuffix(separator) for text in texts]
            if any(text.count(separator) != head.width - 1 for text in texts):
                return None
        try:
            numbers = np.loadtxt(
                texts, delimiter=separator, comments=None, ndmin=2, usecols=columns
            )
        except ValueError:
            return None
        if columns is None and numbers.shape[1] != head.width:
            return None
        # A reading that is missing is refused with its place, which is found line by line.
        if not (self._layout.accepts_missing or np.isfinite(numbers).all()):
            return None
        if columns is None:
            return numbers
        parsed: Doubles = np.full((len(texts), head.width), np.nan)
        parsed[:, list(columns)] = numbers
        return parsed

    def _has_exact_times(self, numbers: Doubles) -> bool:
        """True if float64 holds the times of lines, or there are none. Those that it does not are
        read from the text, as times of day are.
        """
        head = self._head
        if head.time is None:
            return True
        is_text = head.time not in head.numeric or head.time_unit in (ISO, CLOCK_UNIT)
        if is_text or head.nanoseconds is not None:
            return False
        return bool((np.abs(numbers[:, head.time]) < EXACT).all())  # False for a NaN

    def _cells(self, line: DataLine) -> list[str]:
        head = self._head
        cells = head.dialect.cells(line.text)
        if len(cells) == head.width:
            return cells
        fault = f"holds {len(cells)} cells; {head.width} are expected"
        if head.dialect.names:
            fault = "names other values than most lines"
        raise SourceError(f"{self._place(line)}: {fault}")

    def _place(self, line: DataLine) -> str:
        return f"{self._file.name}, line {line.number}"

    def _number(self, cell: str, line: DataLine, column: int) -> float:
        head = self._head
        if head.long is not None and column not in head.numeric:
            return head.taxels.setdefault(cell, len(head.taxels))
        value = number_of(cell)
        if value is not None and (np.isfinite(value) or self._layout.accepts_missing):
            return value
        is_marker = cell.lower() in self._layout.missing_texts
        if is_marker or (is_missing(cell) and self._layout.accepts_missing):
            return np.nan
        fault = f"column {head.label(column)}: {shown(cell)} is not a number"
        fault = f"{self._place(line)}, {fault}"
        if is_missing(cell):
            raise SourceError(f"{fault}; {NAN_HINT}")
        if UNMARKED.fullmatch(cell):
            # The numbers of other lines would be read as decimal ones.
            ways = f"write decimal numbers, or state missing={cell} if it stands for no reading"
            raise SourceError(f"{fault}, but may be a hexadecimal one; {ways}")
        if any(head.is_indexed(k) for k in head.usable) and not head.is_indexed(column):
            # A text beside the taxels may say that the line is none of readings.
            raise SourceError(f"{fault}; remove the line, or the text")
        markers = ",".join(filter(None, (self._layout.missing, cell)))
        raise UnstatedError(fault, {"missing": markers})

    def _instant(self, cells: Sequence[str], line: DataLine) -> int | float:
        """The time of a line in its unit; of texts, or of two columns, in nanoseconds."""
        head = self._head
        assert head.time is not None
        cell = cells[head.time]
        where = f"{self._place(line)}, time"
        if is_missing(cell):
            # Below the names may stand the numbers of samples, or gains.
            fault = f"{where}: {shown(cell)} is not a number"
            raise UnstatedError(fault, {"skip": line.number})
        # Python's whole numbers: float64 has no nanoseconds since 1970.
        if head.nanoseconds is not None:
            seconds = parse_number(cell, where, -1e10, 1e10)
            part_ns = parse_number(cells[head.nanoseconds], where, 0, 1e9)
            return round(seconds) * 10**9 + round(part_ns)
        if head.time_unit in (ISO, CLOCK_UNIT):
            read = iso_ns if head.time_unit == ISO else dated_clock_ns
            instant = read(cell)
            if instant is None:
                fault = f"{shown(cell)} is no time as those before it"
                raise SourceError(f"{where}: {fault}")
            return instant
        if cell.isascii() and cell.isdecimal() and len(cell) < 20:
            return int(cell)
        return parse_number(cell, where, -1e19, 1e19)

    def _grids(self) -> Iterator[Block]:
        """Frames of several lines; a block between other lines is a whole number of frames."""
        height = self._head.height
        # A frame may begin in one piece of the file and end in the next.
        rows = np.empty((0, self._head.width))
        for lines, new_rows, _ in self._rows():
            for k, line in enumerate(lines):
                n_before = (len(rows) + k) % height
                if line.begins and n_before:
                    fault = f"the frame before it has {n_before} lines; {height} are expected"
                    raise SourceError(f"{self._place(line)}: {fault}")
            rows = np.concatenate([rows, new_rows])

            # Frames that are complete; the other lines wait for theirs.
            n_frames = len(rows) // height
            n_whole = n_frames * height
            if n_frames:
                self.tally.take(n_whole, n_frames)
                frames = rows[:n_whole].reshape(n_frames, height, -1)
                yield Block(frames[:, :, self._head.n_labels :])
            rows = rows[n_whole:]
        self.tally.drop("lines of a cut last frame", len(rows))


def _may_sum_up(text: str) -> bool:
    """True if a line may be below the readings: most are not, and are looked at no further."""
    begin = text.lstrip(' \t",;|')[:3]
    end = text.rstrip(' \t".:')[-1:]
    return not begin or begin[0].isalpha() or end.isalpha() or "%" in begin + end


def _empty_as(text: str) -> str:
    """The name by which a line without data is dropped; "" of others."""
    if not text.strip():
        return BLANK
    if comment_mark(text):
        return "comments"
    return ""
