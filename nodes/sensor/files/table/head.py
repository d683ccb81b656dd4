"""The begin of a table: where its data begin, names of columns, the kind of its lines."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recording import File
from sparseskin.nodes.sensor.layout.checks import is_missing, shown
from sparseskin.nodes.sensor.layout.layout import UnstatedError, listed
from sparseskin.nodes.sensor.layout.names import (
    COL_WORDS,
    ROW_WORDS,
    last_part,
    pattern_of,
)
from sparseskin.nodes.sensor.layout.times import are_likely, is_time_name, rate_of

from .columns import counters, find_times, source_column
from .sample import (
    FRAME_WORDS,
    GRID,
    LINES,
    LONG,
    TAXEL_WORDS,
    Line,
    LongColumns,
    Place,
    TableHead,
    is_number,
    is_value,
    numbers_of,
)
from .text import COMMENTS, dialect_of, pieces

MAX_SAMPLE = 1000
MIN_SAMPLE = 50
SAMPLE_CHARACTERS = 1 << 17
"""Lines of the begin that are looked at, at most and at least, and their characters from which on
there are no more. Chosen: a thousand frames of a glove, a hundred of 16 x 16, in 0.1 s.
"""
EVEN = 4
"""Least length of a line with even steps, as 0, 1, 2, ..., that is a header. Chosen: of readings up
to 10 one frame in 10,000 reads so."""
RISING = 8
"""Least length of a line that is asked about if it rises. Derived: one of 40,000 random frames
does."""
FORMED = 4
"""The same of one that rises and has another number of decimals than all lines below, and least
number of these. Chosen."""
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
VALUE_WORDS = (
    *("value", "val", "v", "force", "pressure", "reading", "data", "count", "counts"),
)


def read_head(file: File) -> TableHead:
    """Read the begin of a table. Raises SourceError if it holds no line of numbers, UnstatedError
    if the column of the times is not clear.
    """
    head = _sampled(file)
    _find_data(head)
    if not head.data:
        raise SourceError(f"{file.name}: the recording holds no frame")
    head.n_before = head.data[0].number - 1
    _find_numeric(head)
    _find_kind(head, bool(file.parts))
    if head.kind == LINES:
        _ask_for_axes(head)
        head.source = source_column(head)
    # What is found in the times has to be that of one skin.
    source = head.source
    if source is not None:
        skin = head.layout.frame_id
        head.data = [line for line in head.data if line.cells[source] == skin]
    _find_rate(head)

    # The lines of a block have no times of their own.
    if head.kind == GRID:
        _ask_for_titles(head)
    else:
        find_times(head)
    no_taxels = (head.time, head.nanoseconds, source, *counters(head))
    head.usable = tuple(k for k in head.numeric if k not in no_taxels)
    _note_texts(head)
    return head


def _sampled(file: File) -> TableHead:
    """A head with the first lines, and the number of cells of those that hold most numbers: a
    preamble of settings may have more lines than a short table.
    """
    texts = _first_lines(file)
    n_skipped = file.layout.skip
    separator = ""
    excel = EXCEL_LINE.fullmatch(texts[0].strip()) if texts else None
    if excel is not None:
        separator = excel[1]
        n_skipped = max(n_skipped, 1)
    # The last two thirds: a preamble stands before them.
    bodies = [text for text in texts[n_skipped:] if _is_body(text)]
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
    has_trailing = width > 1 and ends_empty and dialect.separator != " "
    head = TableHead(file.layout, file.name, dialect, width - has_trailing)
    head.has_trailing = has_trailing
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


def _is_body(text: str) -> bool:
    """True if a line is neither blank nor a comment. A header may begin with %."""
    stripped = text.strip()
    return bool(stripped) and not stripped.startswith(("#", "//"))


def _find_data(head: TableHead) -> None:
    """Find the lines of data, and the names before them."""
    lines = [line for line in head.raw[head.n_before :] if _is_body(line.text)]
    lines = [line for line in lines if head.has_width(line.cells)]
    head.names = ("",) * head.width
    if head.dialect.names:
        head.names = ("",) * head.dialect.has_prefix + head.dialect.names
        head.data = lines
        return
    # A title of as many words as the table has columns stands before the names of these.
    while len(lines) > 2 and _are_names(lines[1].cells[: head.width]):
        lines = lines[1:]
    top, *later = lines
    cells = top.cells[: head.width]

    # Numbers above lines of taxels are the times.
    counts = _count_columns(cells)
    # Labels may stand above each frame of a grid.
    rows = [line.cells[: head.width] for line in later if line.text != top.text]
    is_repeated = counts and 0 < len(rows) < len(later)
    is_labelled = is_repeated or (bool(rows) and _are_labels(cells, rows))
    is_labelled = is_labelled and (counts or not head.layout.axes)
    head.is_labelled = is_labelled
    if is_labelled or _is_header(cells, rows):
        # Positions are no names: their digits count nothing.
        if not is_labelled or counts:
            head.names = tuple(cell.strip() for cell in cells)
        if is_labelled:
            head.notes += (f"the line {shown(top.text)} labels the columns",)
        head.header = top.text
        head.data = [line for line in later if line.text != top.text]
        _drop_units(head)
    else:
        _ask_for_label(head, top, rows)
        head.data = lines
        _name_by_line_before(head, top.number)
        if head.width > 1 and counts:
            note = "the first line counts: it is read as a frame; skip=1 if it is names"
            head.notes += (note,)
    if head.data and not any(map(is_value, head.data[0].cells)):
        head.data = []


def _drop_units(head: TableHead) -> None:
    """Drop the line of units below the names, if there is one."""
    if len(head.data) < 2:
        return
    units, *later = head.data
    rows = [line.cells for line in later]
    cells = units.cells[: head.width]
    if _is_header(cells, rows) and not any(map(is_number, cells)):
        head.units = units.text
        head.data = later


def _are_names(cells: Sequence[str]) -> bool:
    """True if cells are no numbers, and most are names with numbers, or one is that of times."""
    if any(map(is_value, cells)):
        return False
    n_indexed = sum(bool(re.search(r"\d", cell)) for cell in cells)
    return 2 * n_indexed > len(cells) or any(map(is_time_name, cells))


def _is_header(cells: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
    """True if a line has texts in columns that hold numbers below."""
    for k, cell in enumerate(cells):
        if not cell or is_value(cell):
            continue
        n_values = sum(is_value(row[k]) for row in rows)
        # A single text above numbers is enough: a name. Others may be numbers, as of pandas.
        if 2 * n_values > len(rows):
            return True
    return False


def _are_labels(cells: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
    """True if a line of numbers has the numbers or the places of the columns, as no line below."""
    # An index of the lines has no label.
    begin = int(cells[0] == "")
    labels = cells[begin:]
    if not labels or not all(map(is_number, labels)):
        return False
    rows = [row[begin:] for row in rows]
    if _count_columns(labels):
        # Names in any order; the same order makes even what a test pattern has below.
        order = sorted(range(len(labels)), key=lambda k: int(labels[k]))
        labels = [labels[k] for k in order]
        rows = [[row[k] for k in order] for row in rows]
    if not _rises(labels):
        return False

    parts = _parts(rows)
    if all("." in label for label in labels) and not any(map(_decimals, parts)):
        return True
    forms = list(map(_decimals, _parts([labels])))
    is_alike = any(form in forms for form in map(_decimals, parts))
    if not is_alike and len(rows) >= FORMED <= len(labels):
        return True
    # Frames of a test pattern go on so.
    is_long = len(labels) >= EVEN or bool(begin)
    return is_long and _is_even(labels) and not any(map(_is_even, parts))


def _ask_for_label(head: TableHead, first: Line, rows: Sequence[Sequence[str]]) -> None:
    """Raise UnstatedError if a long line of numbers rises, and no line below does."""
    cells = first.cells[: head.width]
    if head.layout.axes or not rows or len(cells) < RISING or not _rises(cells):
        return
    if not any(map(_rises, _parts(rows))):
        fault = f"line {first.number} rises, as none below"
        ways = "skip if it labels the columns, axes=frames,taxels if it is a frame"
        raise UnstatedError(f"{head.name}: {fault}: state {ways}")


def _parts(rows: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Rows, and what stands in them beside a time at an end, which has a form of its own."""
    return [part for row in rows for part in (row, row[1:], row[:-1])]


def _rises(cells: Sequence[str]) -> bool:
    return bool((np.diff(numbers_of(cells)) > 0).all())


def _is_even(cells: Sequence[str]) -> bool:
    """True if numbers rise in steps of one size."""
    steps = np.diff(numbers_of(cells))
    return bool((steps > 0).all() and np.allclose(steps, steps[:1], rtol=1e-3))


def _decimals(cells: Sequence[str]) -> int:
    """Most decimals of a cell."""
    return max((len(cell.partition(".")[2]) for cell in cells), default=0)


def _count_columns(cells: Sequence[str]) -> bool:
    """True for 0, 1, 2, ... or 1, 2, 3, ... in any order, perhaps behind an empty cell."""
    counted = [cell for cell in cells if cell]
    counted.sort(key=lambda cell: (len(cell), cell))
    n = len(counted)
    counts = ([*map(str, range(n))], [*map(str, range(1, n + 1))])
    return n > 0 and counted in counts


def _name_by_line_before(head: TableHead, first_number: int) -> None:
    """Names of columns in the line before the data: a comment, as np.savetxt writes it, or a line
    of one name more, of a last column that is empty, or one less, of an index.
    """
    earlier = [line.text for line in head.raw if line.number < first_number]
    earlier = [text for text in earlier if text.strip()]
    if not earlier:
        return
    text = earlier[-1].strip()
    is_comment = text.startswith(COMMENTS)
    names = head.dialect.cells(text.lstrip("#%/ ") if is_comment else text)
    n_indexed = sum(bool(re.search(r"\d", name)) for name in names)
    # A title of so many words has no numbers in most of them.
    are_words = all(re.fullmatch(r'"?[A-Za-z_][\w.]*"?', name) for name in names)
    if not is_comment and are_words and 2 * n_indexed > len(names):
        if len(names) == head.width - 1:
            names = ["", *names]
        names = names[: max(head.width, len(names) - 1)]
        head.header = earlier[-1]
    has_names = n_indexed or any(map(is_time_name, names))
    if len(names) == head.width and has_names and not any(map(is_number, names)):
        head.names = tuple(names)
    else:
        head.header = ""


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
        n_numbers = sum(map(is_number, cells))
        if n_numbers and 2 * n_numbers >= len(cells):
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
    # It may be stated that a frame is a line.
    if layout.axes:
        return
    head.long = _long_columns(head)
    if head.long is not None:
        head.kind = LONG
        sides = " x ".join(str(place.size) for place in head.long.places)
        head.notes += (f"a line for each taxel: {sides}",)
        return
    n_headers = sum(line.text == head.header for line in head.raw)
    # Positions above each frame name no columns.
    are_positions = head.is_labelled and n_headers > 1
    is_named = bool(head.header) and not are_positions
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
    head.kind = GRID
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
    return head.has_width(line.cells) and any(map(is_number, line.cells))


def _block_heights(head: TableHead) -> list[int]:
    """Lines of numbers in each block between blank lines or lines of text."""
    heights = [0]
    for line in head.raw:
        is_row = line.number > head.n_before and _is_row(head, line)
        if is_row and line.text != head.header:
            heights[-1] += 1
        elif heights[-1]:
            heights.append(0)
    return [height for height in heights if height]


def _long_columns(head: TableHead) -> LongColumns | None:
    """Columns of frame, row, column and value, or of frame, taxel and value, where the names state
    them.
    """
    names = [last_part(name) for name in head.names]

    def only(words: Sequence[str]) -> int | None:
        columns = [k for k in head.numeric if names[k] in words]
        return columns[0] if len(columns) == 1 else None

    sides = [only((*ROW_WORDS, "i")), only((*COL_WORDS, "j"))]
    stated = [head.layout.n_rows, head.layout.n_cols]
    if sides == [None, None]:
        sides = [only(TAXEL_WORDS)]
        stated = [None]
    value = only(VALUE_WORDS)
    frames = [k for k in head.numeric if names[k] in FRAME_WORDS]
    frames += [k for k in range(head.width) if is_time_name(names[k])]
    if None in sides or value is None or not frames:
        return None

    # The first frame shows the sides.
    keys = head.cells(frames[0])
    n_lines = sum(key == keys[0] for key in keys)
    places = []
    for column, size in zip(sides, stated, strict=True):
        assert column is not None
        cells = head.cells(column)[:n_lines]
        if not all(map(str.isdecimal, cells)):
            return None
        numbers = list(map(int, cells))
        begin = min(numbers)
        places.append(Place(column, begin, size or max(numbers) - begin + 1))
    return LongColumns(frames[0], tuple(places), value)


def _ask_for_axes(head: TableHead) -> None:
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
    are_taxels = n_stated == len(names) or (n_stated is None and not head.header)
    if not are_taxels or FRAME_NAME.match(names[0]):
        return
    lines = f"lines are named {shown(names[0])}, {shown(names[-1])}"
    ways = "state axes=taxels,frames, or axes=frames,taxels if a line is a frame"
    # Of so many lines as taxels are stated, the names are those of taxels.
    options = [{"axes": "taxels,frames"}] if n_stated else []
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


def _ask_for_titles(head: TableHead) -> None:
    """Raise SourceError if lines between the frames of a grid state times, which are not read."""
    layout = head.layout
    if layout.rate_hz is not None or layout.time or head.rate_hz is not None:
        return
    between = [line for line in head.raw if not _is_row(head, line)]
    titles = [line for line in between if TITLE_TIME.search(line.text)]
    counted = []
    counts = []
    for line in between:
        match = NUMBER_LINE.fullmatch(line.text)
        if match is not None and line not in titles:
            counted.append(line)
            counts.append(float(match[1]))
    # Numbers of the frames rise by 1, times do not.
    if len(counts) > 2 and are_likely(np.array(counts)):
        titles += counted
    # One such line is about the whole recording.
    is_later = any(line.number > head.n_before for line in titles)
    if is_later and len(titles) > 1:
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
