"""Tables of text: one frame a line, a block of lines, or a line for each taxel."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import IO

import numpy as np
import numpy.typing as npt

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
from sparseskin.nodes.sensor.layout.times import CLOCK_UNIT, ISO, clock_ns, iso_ns

from .head import EXCEL_LINE, read_head
from .sample import GRID, LONG, is_number
from .text import COMMENTS, pieces

HEXADECIMAL = re.compile(
    r"0[xX][0-9a-fA-F]+|(?=[0-9A-F]*[A-F])(?=[A-F]*[0-9])[0-9A-F]{2,}|FF+"
)
BLANK = "blank lines"
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
        self._accepts_missing = file.layout.accepts_missing
        self._head = read_head(file)
        self.tally = Tally("lines")

    def head(self) -> Head:
        head = self._head
        time_name = ""
        if head.time is not None:
            time_name = f"column {head.label(head.time)}"
        is_of_lines = head.kind != GRID and head.long is None
        return Head(
            self._axes(),
            usable=head.usable if is_of_lines else None,
            is_timed=head.time is not None,
            time_unit=head.time_unit,
            time_name=time_name,
            asks_unit=True,
            rate_hz=head.rate_hz,
            notes=head.notes,
        )

    def _axes(self) -> tuple[Axis, ...]:
        """Axes of a block, of the lines of a frame, or of a line."""
        head = self._head
        if head.kind == GRID:
            return (Axis(head.height, "rows"), Axis(head.width, "cols"))
        if head.long is None:
            return (Axis(head.width, "columns", head.names),)
        return head.long.axes

    @property
    def numeric(self) -> tuple[int, ...]:
        """The columns of numbers."""
        return self._head.numeric

    def texts_of_lines(self) -> tuple[str, ...]:
        """The first cells of all lines, where these are texts; else ()."""
        if 0 in self._head.numeric:
            return ()
        cells = self._head.dialect.cells
        names = tuple(cells(text)[0] for texts, _, _ in self._lines() for text in texts)
        self.tally.begin()
        return names

    def blocks(self) -> Iterator[Block]:
        self.tally.begin()
        if self._head.kind == GRID:
            yield from self._grids()
        elif self._head.kind == LONG:
            yield from self._long()
        else:
            for numbers, times in self._rows():
                self.tally.take(len(numbers), len(numbers))
                yield Block(numbers, times)

    def _rows(self) -> Iterator[tuple[Doubles, list[int | float] | None]]:
        """Numbers of lines (k, width), and their times."""
        size = frames_per_block(self._head.width)
        for texts, numbers, _ in self._lines():
            for start in range(0, len(texts), size):
                part = slice(start, start + size)
                yield self._parsed(texts[part], numbers[part])

    def _lines(self) -> Iterator[tuple[list[str], list[int], list[bool]]]:
        """The lines of data by pieces: texts, numbers in the file, and whether each begins a block
        (something stands between it and the line before).
        """
        head = self._head
        names = (self._file.name, *self._file.parts)
        for k, name in enumerate(names):
            if k == 0:
                yield from self._lines_of(self._file.file, name, head.n_before)
                continue
            with reading(name) as file:
                yield from self._lines_of(file, name, 0)

    def _lines_of(
        self, file: IO[bytes], name: str, n_before: int
    ) -> Iterator[tuple[list[str], list[int], list[bool]]]:
        head = self._head
        begins = True
        for piece in pieces(file, name):
            texts: list[str] = []
            numbers: list[int] = []
            begun: list[bool] = []
            last_number = piece.number + len(piece.lines) - 1
            for number, text in enumerate(piece.lines, start=piece.number):
                # The first reason counts.
                if number <= n_before:
                    label = self._before_as(text, number)
                else:
                    label = self._dropped_as(text)
                if not label and piece.is_cut and number == last_number:
                    label = self._cut_as(text)
                if not label and head.source is not None:
                    label = self._of_other_skin(text)
                if label:
                    self.tally.drop(label)
                    begins = True
                    continue
                texts.append(text)
                numbers.append(number)
                begun.append(begins)
                begins = False
            yield texts, numbers, begun

    def _before_as(self, text: str, number: int) -> str:
        """The name by which a line before the first one of data is dropped."""
        labels = {self._head.header: "header", self._head.units: "line of units"}
        if number == 1 and EXCEL_LINE.fullmatch(text.strip()):
            return "line of the separator"
        if number <= self._layout.skip:
            return "skipped lines"
        empty_as = _empty_as(text)
        if text in labels and empty_as != BLANK:
            return labels[text]
        return empty_as or "lines before the table"

    def _dropped_as(self, text: str) -> str:
        """The name by which a line is dropped; "" of a line of data."""
        label = _empty_as(text)
        if label:
            return label
        # A logger that was started again appends to its file.
        if self._head.header and text == self._head.header:
            return "repeated headers"
        stripped = text.strip()
        begins_row = stripped[0].isdigit() or stripped[0] in '+-."[('
        # A line may be a time of day.
        if self._head.kind == GRID and (not begins_row or ":" in stripped):
            cells = self._head.dialect.cells(text)
            is_row = len(cells) == self._head.width
            is_row = is_row and (is_number(cells[0]) or is_missing(cells[0]))
            if not is_row:
                return "lines between frames"
        return ""

    def _of_other_skin(self, text: str) -> str:
        cells = self._head.dialect.cells(text)
        source = self._head.source or 0
        if len(cells) > source and cells[source] != self._layout.frame_id:
            return "lines of other skins"
        return ""

    def _cut_as(self, text: str) -> str:
        cells = self._head.dialect.cells(text)
        return "cut last line" if len(cells) < self._head.width else ""

    def _parsed(
        self, texts: Sequence[str], numbers: Sequence[int]
    ) -> tuple[Doubles, list[int | float] | None]:
        """Numbers (k, width) and times of lines; NaN where there is no number."""
        parsed = None
        if self._head.dialect.is_plain:
            parsed = self._parsed_fast(texts)
        if parsed is None:
            return self._parsed_slowly(texts, numbers)
        if self._head.time is None:
            return parsed, None
        return parsed, self._times(texts, numbers, parsed)

    def _parsed_fast(self, texts: Sequence[str]) -> Doubles | None:
        """Numbers of lines that NumPy reads; None if it cannot read one, or may not."""
        head = self._head

        # NumPy splits at any white space where no separator is stated.
        separator = None if head.dialect.separator == " " else head.dialect.separator
        columns = None if len(head.numeric) == head.width else head.numeric
        if separator is None and columns is not None:
            return None  # NumPy does not check the number of cells
        if separator is not None:
            if head.has_trailing:
                texts = [text.rstrip().removesuffix(separator) for text in texts]
            if any(text.count(separator) != head.width - 1 for text in texts):
                return None

        try:
            values = np.loadtxt(
                texts, delimiter=separator, comments=None, ndmin=2, usecols=columns
            )
        except ValueError:
            return None
        if columns is not None:
            parsed: Doubles = np.full((len(texts), head.width), np.nan)
            parsed[:, list(columns)] = values
        else:
            parsed = values
        if parsed.shape[1] != head.width:
            return None

        # A reading that is missing is refused with its place, which is found line by line.
        has_all = bool(np.isfinite(parsed[:, list(head.numeric)]).all())
        return parsed if has_all or self._accepts_missing else None

    def _times(
        self, texts: Sequence[str], numbers: Sequence[int], parsed: Doubles
    ) -> list[int | float]:
        """Times of lines; whole numbers beyond the precision of float64 are read from the text."""
        head = self._head
        assert head.time is not None
        is_number_of_unit = head.time in head.numeric and head.time_unit not in (
            ISO,
            CLOCK_UNIT,
        )
        if is_number_of_unit and head.nanoseconds is None:
            times = parsed[:, head.time]
            if np.isfinite(times).all() and np.abs(times).max(initial=0) < EXACT:
                return list(times.tolist())
        lines = [head.dialect.cells(text) for text in texts]
        return [
            self._instant(cells, n) for cells, n in zip(lines, numbers, strict=True)
        ]

    def _parsed_slowly(
        self, texts: Sequence[str], numbers: Sequence[int]
    ) -> tuple[Doubles, list[int | float] | None]:
        head = self._head
        parsed = np.full((len(texts), head.width), np.nan)
        times: list[int | float] = []
        for k, (text, number) in enumerate(zip(texts, numbers, strict=True)):
            cells = head.dialect.cells(text)
            if head.has_trailing and len(cells) == head.width + 1 and not cells[-1]:
                cells.pop()
            if len(cells) != head.width:
                place = f"{self._file.name}, line {number}"
                fault = f"holds {len(cells)} cells; {head.width} are expected"
                if head.dialect.names:
                    fault = "names other values than most lines"
                raise SourceError(f"{place}: {fault}")
            if head.time is not None:
                times.append(self._instant(cells, number))
            for column in head.usable or head.numeric:
                parsed[k, column] = self._number(cells[column], number, column)
        if head.time is None:
            return parsed, None
        return parsed, times

    def _number(self, cell: str, line: int, column: int) -> float:
        if is_number(cell):
            value = float(cell)
            if np.isfinite(value) or self._accepts_missing:
                return value
        place = f"{self._file.name}, line {line}, column {self._head.label(column)}"
        is_marker = cell.lower() in self._layout.missing_texts
        if is_marker or (is_missing(cell) and self._accepts_missing):
            return np.nan
        if is_missing(cell):
            raise SourceError(f"{place}: {shown(cell)} is not a number; {NAN_HINT}")
        fault = f"{place}: {shown(cell)} is not a number"
        if HEXADECIMAL.fullmatch(cell):
            # The numbers of other lines would be read as decimal ones.
            ways = f"write decimal numbers, or state missing={cell} if it stands for no reading"
            raise SourceError(f"{fault}, but may be a hexadecimal one; {ways}")
        raise UnstatedError(fault, {"missing": self._missing_with(cell)})

    def _missing_with(self, cell: str) -> str:
        """The setting `missing` with a further text."""
        return ",".join(filter(None, (self._layout.missing, cell)))

    def _instant(self, cells: Sequence[str], line: int) -> int | float:
        """The time of a line in its unit; of texts, or of two columns, in nanoseconds."""
        head = self._head
        assert head.time is not None
        cell = cells[head.time]
        where = f"{self._file.name}, line {line}, time"
        if head.nanoseconds is not None:
            seconds = parse_number(cell, where, -1e10, 1e10)
            part_ns = parse_number(cells[head.nanoseconds], where, 0, 1e9)
            return round(seconds) * 10**9 + round(part_ns)
        if head.time_unit in (ISO, CLOCK_UNIT):
            parse = iso_ns if head.time_unit == ISO else clock_ns
            instant = parse(cell)
            if instant is None:
                raise SourceError(
                    f"{where}: {shown(cell)} is no time as those before it"
                )
            return instant
        if cell.isascii() and cell.isdecimal() and len(cell) < 20:
            return int(cell)
        return parse_number(cell, where, -1e19, 1e19)

    def _grids(self) -> Iterator[Block]:
        """Frames of several lines; a block between other lines is a whole number of frames."""
        height = self._head.height
        waiting_texts: list[str] = []
        waiting_numbers: list[int] = []
        for texts, numbers, begun in self._lines():
            ends = [k for k, begins in enumerate(begun) if begins] + [len(texts)]
            for start, stop in zip([0, *ends], ends, strict=False):
                if start < len(begun) and begun[start]:
                    self._check_block(len(waiting_texts), numbers[start])
                waiting_texts += texts[start:stop]
                waiting_numbers += numbers[start:stop]

                # Frames that are complete; the other lines wait for theirs.
                n_whole = len(waiting_texts) // height * height
                if n_whole:
                    parsed, _ = self._parsed(
                        waiting_texts[:n_whole], waiting_numbers[:n_whole]
                    )
                    n_frames = n_whole // height
                    self.tally.take(n_whole, n_frames)
                    yield Block(parsed.reshape(n_frames, height, self._head.width))
                    del waiting_texts[:n_whole], waiting_numbers[:n_whole]
        self.tally.drop("lines of a cut last frame", len(waiting_texts))

    def _check_block(self, n_waiting: int, number: int) -> None:
        if n_waiting:
            place = f"{self._file.name}, line {number}"
            fault = f"the frame before it has {n_waiting} lines; {self._head.height} are expected"
            raise SourceError(f"{place}: {fault}")

    def _long(self) -> Iterator[Block]:
        """Frames of a table with a line for each taxel: lines in a row with the same frame."""
        long = self._head.long
        assert long is not None
        rows = np.empty((0, self._head.width))
        times: list[int | float] = []
        for new_rows, new_times in self._rows():
            rows = np.concatenate([rows, new_rows])
            times += new_times or []
            keys = (
                np.array(times)
                if long.frame == self._head.time
                else rows[:, long.frame]
            )
            begins = np.flatnonzero(np.diff(keys, prepend=np.nan) != 0)
            # The last frame may go on in the next lines.
            stop = int(begins[-1])
            if stop:
                yield self._pivoted(rows[:stop], begins[:-1], times)
            rows = rows[stop:]
            times = times[stop:]
        if len(rows):
            yield self._pivoted(rows, np.array([0]), times)

    def _pivoted(
        self, rows: Doubles, begins: npt.NDArray[np.intp], times: Sequence[int | float]
    ) -> Block:
        """Frames of lines, of which each of `begins` is the first of a frame."""
        long = self._head.long
        assert long is not None

        # Number of the frame, row and column of each line.
        counts = np.diff([*begins, len(rows)])
        frame = np.repeat(np.arange(len(begins)), counts)
        sizes = [place.size for place in long.places]
        least_numbers = [place.begin for place in long.places]
        places = rows[:, [place.column for place in long.places]] - least_numbers
        inside = ((places >= 0) & (places < sizes)).all(axis=1)
        if not inside.all():
            names = [axis.label for axis in long.axes]
            k = int(np.argmin(inside))
            text = ", ".join(
                f"{name} {n:g}" for name, n in zip(names, places[k], strict=True)
            )
            sides = " x ".join(map(str, sizes))
            fault = f"{text} is outside {sides}, as of the first frame"
            raise SourceError(f"{self._file.name}: {fault}")

        # Taxels that have no line in a frame are missing.
        shape = (len(begins), *sizes)
        numbers = np.full(shape, np.nan)
        cells = np.ravel_multi_index((frame, *places.T.astype(np.intp)), shape)
        if np.unique(cells).size != len(rows):
            raise SourceError(f"{self._file.name}: a frame holds a taxel twice")
        numbers.flat[cells] = rows[:, long.value]

        self.tally.take(len(rows), len(begins))
        if not times:
            return Block(numbers)
        return Block(numbers, [times[k] for k in begins])


def _empty_as(text: str) -> str:
    """The name by which a line without data is dropped; "" of others."""
    stripped = text.strip()
    if not stripped:
        return BLANK
    return "comments" if stripped.startswith(COMMENTS) else ""
