"""The begin of a table: where its data begin, names of columns, the kind of its lines."""

from __future__ import annotations

import re

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recording import File
from sparseskin.nodes.sensor.layout.checks import is_missing, shown
from sparseskin.nodes.sensor.layout.layout import UnstatedError, listed
from sparseskin.nodes.sensor.layout.names import (
    pattern_of,
)
from sparseskin.nodes.sensor.layout.times import are_likely, is_time_name, rate_of

from .columns import ask_for_time, counters, find_times, source_column
from .labels import find_data
from .long import long_columns
from .sample import (
    UNMARKED,
    Line,
    TableHead,
    is_number,
)
from .text import dialect_of, is_body, pieces

MAX_SAMPLE = 1000
MIN_SAMPLE = 50
SAMPLE_CHARACTERS = 1 << 17
"""Lines of the begin that are looked at, at most and at least, and their characters from which on
there are no more. Chosen: a thousand frames of a glove, a hundred of 16 x 16, in 0.1 s.
"""
RATE_LINE = re.compile(
    r"\W*([A-Za-z][A-Za-z_ ()\[\]]*?)\W*(\d*\.?\d+)(?:[\s,;]+\2)*\s*((?:1/)?[A-Za-z/]*)"
    r"[\s\",;]*"
)
"""Lines before a table that may state its rate, or the time from frame to frame."""
TITLE_TIME = re.compile(
    r"\d:\d\d[:.]\d|\b(?:t|ts|time|times?tamp|stamp|elapsed)\b[^\w.+-]*\d"
    r"|\d\s*(?:ns|us|ms|s|sec|seconds)\b",
    re.IGNORECASE,
)
"""Times in lines between frames."""
NUMBER_LINE = re.compile(r"[^\w.+-]*[A-Za-z_]*\W*?(\d+(?:\.\d+)?)\W*")
"""Lines between frames with one number."""
FRAME_NAME = re.compile(r"frame|img|image|sample|row|line|t\d|\W*\d", re.IGNORECASE)
"""Begin of names of frames, and of rows of a grid, which are none of taxels."""
EXCEL_LINE = re.compile(r"sep=(.)", re.IGNORECASE)


def read_head(file: File) -> TableHead:
    """Read the begin of a table. Raises SourceError if it holds no line of numbers, UnstatedError
    if the column of the times is not clear.
    """
    head = _sampled(file)
    find_data(head)
    if not head.data:
        raise _without_numbers(head)
    head.n_before = head.data[0].number - 1
    _find_numeric(head)
    _find_kind(head, bool(file.parts))
    if head.is_plain:
        _check_axes(head)
        head.source = source_column(head)
    # What is found in the times has to be that of one skin.
    source = head.source
    if source is not None:
        skin = head.layout.frame_id
        head.data = [line for line in head.data if line.cells[source] == skin]
    _find_rate(head)

    # The lines of a block have no times of their own.
    if head.height:
        _find_titles(head)
    else:
        find_times(head)
    no_taxels = (head.time, head.nanoseconds, source, *counters(head))
    columns = head.numeric
    if head.long is not None:
        columns = head.long.columns
        ask_for_time(head, head.long.frame)
    head.usable = tuple(k for k in columns if k not in no_taxels)
    _note_texts(head)
    return head


def _without_numbers(head: TableHead) -> SourceError:
    """The error that no line holds numbers, with one that should."""
    lines = [line for line in head.raw if is_body(line.text)]
    number, text, _ = lines[-1]
    fault = f"line {number}, {shown(text.strip())}, holds no column of numbers"
    return SourceError(f"{head.name}: the recording holds no frame: {fault}")


def _sampled(file: File) -> TableHead:
    """A head with the first lines, and the number of cells of those that hold most numbers: a
    preamble of settings may have more lines than a short table.
    """
    texts = _first_lines(file)
    n_skipped = file.layout.skip
    separator = ""
    if texts:
        excel = EXCEL_LINE.fullmatch(texts[0].strip())
        if excel is not None:
            separator = excel[1]
            n_skipped = max(n_skipped, 1)
    # The last two thirds: a preamble stands before them.
    bodies = [text for text in texts[n_skipped:] if is_body(text)]
    if not bodies:
        raise SourceError(f"{file.name}: the recording holds no frame")
    later = bodies[len(bodies) // 3 :]
    dialect = dialect_of(later)
    if separator:
        dialect = dialect._replace(separator=separator)

    by_width: dict[int, list[list[str]]] = {}
    for text in later:
        cells = dialect.cells(text)
        by_width.setdefault(len(cells), []).append(cells)
    # Numbers in all lines of a width, by those of its last one.
    n_numbers = {
        width: len(rows) * max(1, sum(map(is_number, rows[-1])))
        for width, rows in by_width.items()
    }
    width = max(n_numbers, key=n_numbers.__getitem__)

    # A separator at the end of each line begins no cell.
    ends_empty = all(cells[-1] == "" for cells in by_width[width])
    if width > 1 and ends_empty and dialect.separator != " ":
        width -= 1
    dialect = dialect._replace(n_cells=width)
    head = TableHead(file.layout, file.name, dialect, width)
    head.n_before = n_skipped
    for number, text in enumerate(texts, start=1):
        head.raw.append(Line(number, text, dialect.cells(text)))
    return head


def _first_lines(file: File) -> list[str]:
    sample: list[str] = []
    n_characters = 0
    for piece in pieces(file.file, file.name):
        texts = piece.lines
        # The last line of a file that is still written may be a part of one.
        if piece.is_cut and len(texts) > 2:
            texts = texts[:-1]
        for text in texts:
            sample.append(text)
            n_characters += len(text)
            is_enough = n_characters > SAMPLE_CHARACTERS and len(sample) >= MIN_SAMPLE
            if is_enough or len(sample) >= MAX_SAMPLE:
                return sample
    return sample


def _find_numeric(head: TableHead) -> None:
    """Find the columns of which most cells that are not missing are numbers, and some is; and those
    of missing numbers alone that are named like these: taxels that are dead.
    """
    # Most, not all: one damaged cell is refused where it stands, and hides no column.
    empty = []
    numeric = []
    markers = head.layout.missing_texts
    for k in range(head.width):
        cells = [cell for cell in head.cells(k) if not is_missing(cell)]
        if not cells:
            empty.append(k)
        cells = [cell for cell in cells if cell.lower() not in markers]
        texts = [cell for cell in cells if not is_number(cell)]
        n_numbers = len(cells) - len(texts)
        # Hexadecimal numbers are refused where they stand, as damaged ones are.
        may_be_numbers = all(map(UNMARKED.fullmatch, texts))
        if n_numbers and (may_be_numbers or n_numbers >= len(texts)):
            numeric.append(k)
    patterns = {pattern_of(head.names[k]) for k in numeric if head.is_indexed(k)}
    dead = [k for k in empty if pattern_of(head.names[k]) in patterns]
    head.numeric = tuple(sorted({*numeric, *dead}))
    if not head.numeric:
        place = f"{head.name}, line {head.n_before + 1}"
        raise SourceError(f"{place}: no column holds numbers; state columns, or skip")


def _find_kind(head: TableHead, has_parts: bool) -> None:
    """Find whether a frame is a line, a block of lines, or a line for each taxel."""
    layout = head.layout
    head.long = long_columns(head)
    # It may be stated that a frame is a line.
    if head.long is not None or layout.axes:
        return
    n_headers = sum(line.text in head.headers for line in head.raw)
    # Positions above each frame name no columns.
    are_positions = head.is_labelled and n_headers > 1
    is_named = bool(head.headers) and not are_positions
    if (
        is_named
        or head.dialect.names
        or layout.columns
        or layout.time not in ("", "none")
    ):
        return

    n_stated = layout.n_stated or 0
    heights = _block_heights(head)
    # The last block may be cut: two whole ones show that all have one height.
    is_even = len(heights) > 1 and len({*heights[:-1]}) == 1 and heights[0] > 1
    is_even = is_even and (len(heights) > 2 or len({*heights}) == 1)
    head.n_labels = _n_labels(head, layout.n_rows or heights[0])
    width = head.width - head.n_labels
    if n_stated > width == layout.n_cols:
        head.height = layout.n_rows or 1
    elif is_even and not n_stated:
        head.height = heights[0]
    elif has_parts and not n_stated:
        head.height = sum(heights)
    else:
        head.n_labels = 0
        return
    note = f"a frame is a block of {head.height} lines of {width} readings"
    if head.n_labels:
        note += ", behind the numbers of the rows"
    head.notes += (note,)


def _n_labels(head: TableHead, height: int) -> int:
    """1 if the first column counts the lines of each frame, else 0."""
    numbers = head.numbers(0)
    if height < 2 or head.width < 2 or len(numbers) < 2 * height:
        return 0
    expected = numbers[0] + np.arange(len(numbers)) % height
    return int(numbers[0] in (0, 1) and np.array_equal(numbers, expected))


def _is_row(head: TableHead, line: Line) -> bool:
    return len(line.cells) == head.width and any(map(is_number, line.cells))


def _block_heights(head: TableHead) -> list[int]:
    """Lines of numbers in each block between blank lines or lines of text."""
    heights = [0]
    for line in head.raw:
        is_row = line.number > head.n_before and _is_row(head, line)
        if is_row and line.text not in head.headers:
            heights[-1] += 1
        elif heights[-1]:
            heights.append(0)
    return [height for height in heights if height]


def _check_axes(head: TableHead) -> None:
    """Raise UnstatedError if lines have names of taxels, as s0, s1, and are as many as these where
    their number is stated.
    """
    n_stated = head.layout.n_stated
    if head.layout.columns or head.layout.axes or 0 in head.numeric:
        return
    names = [name for name in head.cells(0) if not is_time_name(name)]
    patterns = {pattern_of(name) for name in names}
    is_one_family = len(patterns) == 1 and "#" in patterns.pop()
    if len(set(names)) < max(2, len(names)) or not is_one_family:
        return
    are_taxels = n_stated == len(names) or (n_stated is None and not head.headers)
    if not are_taxels or FRAME_NAME.match(names[0]):
        return
    lines = f"lines are named {shown(names[0])}, {shown(names[-1])}"
    ways = "state axes=taxels,frames, or axes=frames,taxels if a line is a frame"
    # Of so many lines as taxels are stated, the names are those of taxels.
    options: list[dict[str, str]] = []
    if n_stated:
        options.append({"axes": "taxels,frames"})
    fault = f"{lines}: which are taxels is not stated; {ways}"
    raise UnstatedError(f"{head.name}: {fault}", *options)


def _find_rate(head: TableHead) -> None:
    """Find the rate that a line before the table states."""
    rates: dict[float, str] = {}
    for line in head.raw:
        match = RATE_LINE.fullmatch(line.text)
        if match is not None and line.number <= head.n_before:
            rate_hz = rate_of(match[1], float(match[2]), match[3].lower())
            rates[rate_hz] = line.text.strip()
    # Several rates are those of several devices: none is chosen.
    rates.pop(0.0, None)
    if len(rates) == 1:
        ((head.rate_hz, text),) = rates.items()
        head.notes += (f"the rate is that of the line {shown(text)}",)


def _find_titles(head: TableHead) -> None:
    """Find numbers between the frames of a grid. Raises SourceError if lines between them state
    times, which are not read.
    """
    between = [line for line in head.raw if not _is_row(head, line)]
    titles = [line for line in between if TITLE_TIME.search(line.text)]
    counted = []
    counts = []
    for line in between:
        match = NUMBER_LINE.fullmatch(line.text)
        if match is not None and line not in titles:
            counted.append(line)
            counts.append(float(match[1]))
    head.are_numbered = len(counts) > 2
    # Numbers of the frames rise by 1, times do not.
    if head.are_numbered and are_likely(np.array(counts)):
        titles += counted
    # One such line is about the whole recording.
    is_later = any(line.number > head.n_before for line in titles)
    is_decided = head.layout.rate_hz or head.layout.time or head.rate_hz
    if is_later and len(titles) > 1 and not is_decided:
        number, text, _ = titles[0]
        fault = (
            f"line {number}, {shown(text.strip())}, states a time, which is not read"
        )
        raise SourceError(f"{head.name}: {fault}; state rate_hz, or time=none")


def _note_texts(head: TableHead) -> None:
    """Note decimal commas, and the columns that hold no numbers and no times."""
    if head.dialect.comma == ".":
        head.notes += ("commas are decimal points",)
    texts = [k for k in range(head.width) if k not in head.numeric and k != head.time]
    if texts:
        labels = listed([head.label(k) for k in texts])
        head.notes += (f"no numbers, and left out: column {labels}",)
