"""The begin of a table: where its data begin, names of columns, the kind of its lines."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recording import File
from sparseskin.nodes.sensor.layout.checks import is_missing, shown
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError
from sparseskin.nodes.sensor.layout.names import (
    COL_WORDS,
    ROW_WORDS,
)
from sparseskin.nodes.sensor.layout.times import are_likely, is_time_name, rate_of

from .columns import (
    counters,
    nanoseconds_beside,
    source_column,
    time_column,
    unit_of_column,
)
from .sample import (
    FRAME_WORDS,
    GRID,
    LINES,
    LONG,
    MAX_SHOWN,
    Line,
    LongColumns,
    Place,
    TableHead,
    is_indexed,
    is_number,
    is_value,
)
from .text import COMMENTS, Dialect, dialect_of, pieces

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
    r"\W*([A-Za-z][A-Za-z_ ()\[\]]*?)\W*(\d*\.?\d+)\s*((?:1/)?[A-Za-z/]*)[\s\",;]*"
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
    "value",
    "val",
    "v",
    "force",
    "pressure",
    "reading",
    "data",
    "count",
    "counts",
)
TAXEL_WORDS = (
    "taxel",
    "taxel_id",
    "sensor",
    "sensor_id",
    "channel",
    "cell",
    "electrode",
    "id",
)


def read_head(file: File) -> TableHead:
    """Read the begin of a table. Raises SourceError if it holds no line of numbers, UnstatedError
    if the column of the times is not clear.
    """
    layout = file.layout
    raw = _first_lines(file)
    separator, n_skipped = _excel(raw, layout)
    bodies = [(number, text) for number, text in raw[n_skipped:] if _is_body(text)]
    if not bodies:
        raise SourceError(f"{file.name}: the recording holds no frame")
    dialect = dialect_of([text for _, text in bodies[len(bodies) // 3 :]])
    if separator:
        dialect = dialect._replace(separator=separator)
    lines = [Line(number, text, tuple(dialect.cells(text))) for number, text in bodies]

    # Width, names, and where the data begin.
    head = _sized(dialect, lines)
    lines = [line for line in lines if len(line.cells) in _widths(head)]
    data = _headed(head, lines, raw, n_skipped, file)
    if not data:
        raise SourceError(f"{file.name}: the recording holds no frame")
    head.n_before = data[0].number - 1
    numeric = {k for k in range(head.width) if _is_numeric(data, k, layout)}
    head.numeric = tuple(sorted(numeric | _without_readings(head, data, numeric)))
    if not head.numeric:
        place = f"{file.name}, line {data[0].number}"
        raise SourceError(f"{place}: no column holds numbers; state columns, or skip")

    _find_kind(head, file, raw, data)
    if head.kind == LINES:
        _ask_for_axes(head, layout, data, file.name)
        head.source = source_column(head, layout, data, file.name)
    if head.source is not None:
        data = [line for line in data if line.cells[head.source] == layout.frame_id]
    _rate(head, raw, data[0].number)
    _find_times(head, layout, raw, data, file.name)
    _note_texts(head)
    return head


def _find_times(
    head: TableHead,
    layout: Layout,
    raw: list[tuple[int, str]],
    data: Sequence[Line],
    name: str,
) -> None:
    """Find the columns of the times, and those that are left."""
    # The lines of a block have no times of their own.
    if head.kind == GRID:
        _ask_for_titles(head, layout, raw, name, data[0].number)
    else:
        head.time = time_column(head, layout, data, name)
    if head.time is not None:
        head.nanoseconds = nanoseconds_beside(head, head.time)
        head.time_unit = unit_of_column(head, data, layout)
    no_taxels = (
        head.time,
        head.nanoseconds,
        head.source,
        *counters(head, layout, data, name),
    )
    head.usable = tuple(k for k in head.numeric if k not in no_taxels)


def _note_texts(head: TableHead) -> None:
    """Note decimal commas, and the columns that hold no numbers and no times."""
    if head.dialect.has_decimal_comma:
        head.notes += ("commas are decimal points",)
    texts = [k for k in range(head.width) if k not in head.numeric and k != head.time]
    if texts:
        labels = ", ".join(head.label(k) for k in texts[:MAX_SHOWN])
        if len(texts) > MAX_SHOWN:
            labels += ", ..."
        head.notes += (f"no numbers, and left out: column {labels}",)


def _ask_for_axes(
    head: TableHead, layout: Layout, data: Sequence[Line], name: str
) -> None:
    """Raise UnstatedError if lines have names of taxels, as s0, s1, and are as many as these where
    their number is stated.
    """
    if layout.columns or layout.axes or 0 in head.numeric:
        return
    if head.header and layout.n_stated is None:
        return
    names = [line.cells[0] for line in data if not is_time_name(line.cells[0])]
    patterns = {re.sub(r"\d+", "#", text) for text in names}
    is_one_family = len(patterns) == 1 and "#" in patterns.pop()
    if len(set(names)) < max(2, len(names)) or not is_one_family:
        return
    if layout.n_stated not in (None, len(names)) or FRAME_NAME.match(names[0]):
        return
    fault = f"lines are named {shown(names[0])}, {shown(names[-1])}: which are taxels is not stated"
    ways = "state axes=taxels,frames, or axes=frames,taxels if a line is a frame"
    # Of so many lines as taxels are stated, the names are those of taxels.
    options = [{"axes": "taxels,frames"}] if layout.n_stated else []
    raise UnstatedError(f"{name}: {fault}; {ways}", *options)


def _first_lines(file: File) -> list[tuple[int, str]]:
    """Numbers and texts of the first lines of a file."""
    sample: list[tuple[int, str]] = []
    n_characters = 0
    for piece in pieces(file.file, file.name):
        texts = piece.lines
        # The last line of a file that is still written may be a part of one.
        if piece.is_cut and len(texts) > 2:
            texts = texts[:-1]
        for number, text in enumerate(texts, start=piece.number):
            sample.append((number, text))
            n_characters += len(text)
            is_enough = n_characters > SAMPLE_CHARACTERS and len(sample) >= MIN_SAMPLE
            if is_enough or len(sample) >= MAX_SAMPLE:
                return sample
    return sample


def _excel(raw: list[tuple[int, str]], layout: Layout) -> tuple[str, int]:
    """The separator that the first line states for Excel, and the lines that are not looked at."""
    if not raw:
        return "", layout.skip
    _, text = raw[0]
    match = EXCEL_LINE.fullmatch(text.strip())
    if match is None:
        return "", layout.skip
    return match[1], max(layout.skip, 1)


def _is_body(text: str) -> bool:
    """True if a line is neither blank nor a comment. A header may begin with %."""
    stripped = text.strip()
    return bool(stripped) and not stripped.startswith(("#", "//"))


def _sized(dialect: Dialect, lines: Sequence[Line]) -> TableHead:
    """A head with the number of cells of the lines that hold most numbers: a preamble of settings
    may have more lines than a short table.
    """
    later = lines[len(lines) // 3 :]
    by_width: dict[int, list[Line]] = {}
    for line in later:
        by_width.setdefault(len(line.cells), []).append(line)

    # Numbers in all lines of a width, by those of its last one.
    n_numbers = {}
    for width, of_width in by_width.items():
        n_in_line = sum(map(is_number, of_width[-1].cells))
        n_numbers[width] = len(of_width) * max(1, n_in_line)
    width = max(n_numbers, key=n_numbers.__getitem__)

    # A separator at the end of each line begins no cell.
    ends_empty = all(line.cells[-1] == "" for line in by_width[width])
    has_trailing = width > 1 and ends_empty and dialect.separator != " "
    return TableHead(dialect, width - has_trailing, has_trailing)


def _widths(head: TableHead) -> tuple[int, ...]:
    """Numbers of cells that a line may have."""
    if head.has_trailing:
        return (head.width, head.width + 1)
    return (head.width,)


def _headed(
    head: TableHead,
    lines: list[Line],
    raw: list[tuple[int, str]],
    n_skipped: int,
    file: File,
) -> list[Line]:
    """The lines of data; the head learns the names before them."""
    head.names = ("",) * head.width
    if head.dialect.names:
        head.names = ("",) * head.dialect.has_prefix + head.dialect.names
        return lines
    # A title of as many words as the table has columns stands before the names of these.
    while len(lines) > 2 and _are_names(lines[1].cells[: head.width]):
        lines = lines[1:]
    begin = lines[0]
    cells = begin.cells[: head.width]
    later = lines[1:] or lines[:1]
    is_labelled = len(lines) > 1 and _are_labels(cells, later)
    if file.layout.axis_names:
        # It is stated what a line is: above lines of taxels, numbers are the times.
        is_labelled = is_labelled and _counts_columns(cells)
    elif len(lines) > 1 and not is_labelled and _alone_rises(cells, later):
        fault = f"line {begin.number} rises, as none below"
        ways = (
            "state skip if it labels the columns, axes=frames,taxels if it is a frame"
        )
        raise UnstatedError(f"{file.name}: {fault}: {ways}")
    if is_labelled or (len(lines) > 1 and _is_header(cells, later)):
        # Positions are no names: their digits count nothing.
        if not is_labelled or _counts_columns(cells):
            head.names = tuple(name.strip() for name in cells)
        if is_labelled:
            head.notes += (f"the line {shown(begin.text)} labels the columns",)
        head.header = begin.text
        lines = _without_units(
            head, [line for line in later if line.text != begin.text]
        )
    elif len(lines) == 1 and not any(map(is_number, begin.cells)):
        return []
    else:
        _named_by_comment(head, raw[n_skipped:], begin.number)
        if head.width > 1 and _counts_columns(cells):
            head.notes += (
                "the first line counts: it is read as a frame; skip=1 if it is names",
            )

    if lines and not any(is_value(cell) for cell in lines[0].cells):
        return []
    return lines


def _without_units(head: TableHead, lines: list[Line]) -> list[Line]:
    """The lines below the names, without that of the units."""
    units = lines[0].cells[: head.width]
    is_header = len(lines) > 1 and _is_header(units, lines[1:])
    if not is_header or any(map(is_number, units)):
        return lines
    head.units = lines[0].text
    return lines[1:]


def _are_names(cells: Sequence[str]) -> bool:
    """True if cells are no numbers, and most are names with numbers, or one is that of times."""
    if any(map(is_value, cells)):
        return False
    n_indexed = sum(bool(re.search(r"\d", cell)) for cell in cells)
    return 2 * n_indexed > len(cells) or any(map(is_time_name, cells))


def _is_header(cells: Sequence[str], later: Sequence[Line]) -> bool:
    """True if a line has texts in columns that hold numbers later."""
    for k, cell in enumerate(cells):
        if is_value(cell):
            continue
        below = [line.cells[k] for line in later if k < len(line.cells)]
        n_values = sum(map(is_value, below))

        # A single text above numbers is enough: a name.
        if cell and 2 * n_values > len(below):
            return True
    return False


def _rate(head: TableHead, raw: list[tuple[int, str]], first_number: int) -> None:
    """Learn the rate that a line before the table states."""
    rates: dict[float, str] = {}
    for number, text in raw:
        if number >= first_number:
            break
        match = RATE_LINE.fullmatch(text)
        rate_hz = 0.0
        if match is not None:
            rate_hz = rate_of(match[1], float(match[2]), match[3].lower())
        if rate_hz:
            rates[rate_hz] = text.strip()
    if len(rates) == 1:
        ((head.rate_hz, text),) = rates.items()
        head.notes += (f"the rate is that of the line {shown(text)}",)


def _ask_for_titles(
    head: TableHead,
    layout: Layout,
    raw: list[tuple[int, str]],
    name: str,
    first_number: int,
) -> None:
    """Raise SourceError if lines between the frames of a grid state times, which are not read."""
    if layout.rate_hz is not None or layout.time or head.rate_hz is not None:
        return
    titles = []
    counts: list[float] = []
    counted_lines = []
    for number, text in raw:
        cells = head.dialect.cells(text)
        is_row = len(cells) in _widths(head) and any(map(is_number, cells))
        is_counted = NUMBER_LINE.fullmatch(text)
        if TITLE_TIME.search(text) and not is_row:
            titles.append((number, text.strip()))
        elif is_counted and not is_row:
            counts.append(float(is_counted[1]))
            counted_lines.append((number, text.strip()))
    # Numbers of the frames rise by 1, times do not.
    if len(counts) > 2 and are_likely(np.array(counts)):
        titles += counted_lines
    # One such line is about the whole recording.
    later = [number for number, _ in titles if number > first_number]
    if later and len(titles) > 1:
        number, text = titles[0]
        fault = f"line {number}, {shown(text)}, states a time, which is not read"
        raise SourceError(f"{name}: {fault}; state rate_hz, or time=none")


def _are_labels(cells: Sequence[str], later: Sequence[Line]) -> bool:
    """True if a line of numbers has the numbers or the places of the columns, as no line below."""
    # An index of the lines has no label.
    begin = int(cells[0] == "")
    labels = cells[begin:]
    if not labels or not all(map(is_number, labels)) or not _rises(labels):
        return False
    rows = [line.cells[begin : len(cells)] for line in later]
    are_whole_below = not any(map(_decimals, rows))
    if are_whole_below and all("." in label for label in labels):
        return True
    if len(rows) >= FORMED <= len(labels):
        # A time at an end of the lines has a form of its own.
        parts_of_line = (slice(None), slice(1, None), slice(None, -1))
        if not any(
            _decimals(row[part]) == _decimals(labels[part])
            for row in rows
            for part in parts_of_line
        ):
            return True

    # Frames of a test pattern go on so, perhaps beside their time.
    if not _is_even(labels) or not (len(labels) >= EVEN or begin):
        return False
    return not any(_is_even(part) for row in rows for part in (row, row[1:], row[:-1]))


def _alone_rises(cells: Sequence[str], later: Sequence[Line]) -> bool:
    """True if a long line of numbers rises, and no line below does, perhaps beside its time."""
    if len(cells) < RISING or not _rises(cells):
        return False
    rows = [line.cells[: len(cells)] for line in later]
    return not any(_rises(part) for row in rows for part in (row, row[1:], row[:-1]))


def _numbers(cells: Sequence[str]) -> npt.NDArray[np.float64]:
    """Numbers of cells, NaN for other texts."""
    return np.array([float(cell) if is_number(cell) else np.nan for cell in cells])


def _rises(cells: Sequence[str]) -> bool:
    return bool((np.diff(_numbers(cells)) > 0).all())


def _is_even(cells: Sequence[str]) -> bool:
    """True if numbers rise in steps of one size."""
    steps = np.diff(_numbers(cells))
    return bool((steps > 0).all() and np.allclose(steps, steps[:1], rtol=1e-3))


def _decimals(cells: Sequence[str]) -> int:
    """Most decimals of a cell."""
    return max(len(cell.partition(".")[2]) for cell in cells)


def _counts_columns(cells: Sequence[str]) -> bool:
    """True for 0, 1, 2, ... or 1, 2, 3, ..., perhaps behind an empty cell."""
    counted = [cell for cell in cells if cell]
    n = len(counted)
    return counted in ([*map(str, range(n))], [*map(str, range(1, n + 1))])


def _named_by_comment(
    head: TableHead, raw: list[tuple[int, str]], first_number: int
) -> None:
    """Names of columns in the comment before the data, as np.savetxt writes them."""
    texts_before = [
        text.strip() for number, text in raw if number < first_number and text.strip()
    ]
    if not texts_before or not texts_before[-1].startswith(COMMENTS):
        return
    text = texts_before[-1].lstrip("#%/ ")

    names = tuple(cell.strip() for cell in head.dialect.cells(text))
    has_names = any(map(is_time_name, names)) or any(
        re.search(r"\d", name) for name in names
    )
    if len(names) == head.width and has_names and not any(map(is_number, names)):
        head.names = names


def _is_numeric(data: Sequence[Line], k: int, layout: Layout) -> bool:
    """True if most cells of a column that are not missing are numbers, and some is."""
    markers = layout.missing_texts
    cells = [line.cells[k] for line in data]
    texts = [c for c in cells if not (is_missing(c) or c.lower() in markers)]
    n_numbers = sum(map(is_number, texts))
    return n_numbers > 0 and 2 * n_numbers >= len(texts)


def _without_readings(
    head: TableHead, data: Sequence[Line], numeric: set[int]
) -> set[int]:
    """Columns of missing numbers alone whose names are like those of columns of numbers: taxels
    that are dead.
    """
    patterns = {
        re.sub(r"\d+", "#", head.names[k]) for k in numeric if is_indexed(head, k)
    }
    dead = set()
    for k in range(head.width):
        is_like_others = re.sub(r"\d+", "#", head.names[k]) in patterns
        if (
            is_like_others
            and k not in numeric
            and all(is_missing(row.cells[k]) for row in data)
        ):
            dead.add(k)
    return dead


def _find_kind(
    head: TableHead, file: File, raw: list[tuple[int, str]], data: Sequence[Line]
) -> None:
    """Find whether a frame is a line, a block of lines, or a line for each taxel."""
    layout = file.layout
    head.long = _long_columns(head, layout, data)
    if head.long is not None:
        head.kind = LONG
        sides = " x ".join(str(place.size) for place in head.long.places)
        head.notes += (f"a line for each taxel: {sides}",)
        return
    is_named = head.header or head.dialect.names
    if is_named or layout.columns or layout.time not in ("", "none"):
        return
    n_rows = layout.n_rows
    n_cols = layout.n_cols
    n_stated = layout.n_stated or 0
    fits = n_stated > head.width == n_cols and n_rows is not None

    heights = _block_heights(head, raw, data[0].number)
    if fits and n_rows is not None:
        head.height = n_rows
    elif (
        not n_stated
        and len(heights) > 1
        and len({*heights[:-1]}) == 1
        and heights[0] > 1
    ):
        head.height = heights[0]
    elif file.parts and not n_stated:
        head.height = sum(heights)
    else:
        return
    head.kind = GRID
    head.notes += (
        f"a frame is a block of {head.height} lines of {head.width} readings",
    )


def _block_heights(
    head: TableHead, raw: list[tuple[int, str]], first_number: int
) -> list[int]:
    """Lines of numbers in each block between blank lines or lines of text."""
    heights: list[int] = []
    is_within = False
    for number, text in raw:
        if number < first_number:
            continue
        cells = head.dialect.cells(text)
        if not text.strip():
            cells = []
        is_row = any(map(is_number, cells)) and len(cells) in _widths(head)
        if is_row and is_within:
            heights[-1] += 1
        elif is_row:
            heights.append(1)
        is_within = is_row
    return heights


def _long_columns(
    head: TableHead, layout: Layout, data: Sequence[Line]
) -> LongColumns | None:
    """Columns of frame, row, column and value, or of frame, taxel and value, where the names state
    them.
    """
    names = [name.lower() for name in head.names]

    def only(words: Sequence[str]) -> int | None:
        columns = [k for k in head.numeric if names[k] in words]
        if len(columns) != 1:
            return None
        return columns[0]

    row = only((*ROW_WORDS, "i"))
    col = only((*COL_WORDS, "j"))
    if row is None and col is None:
        col = only(TAXEL_WORDS)
    elif row is None or col is None:
        return None
    value = only(VALUE_WORDS)
    frames = [k for k in head.numeric if names[k] in FRAME_WORDS]
    frames += [k for k in range(head.width) if is_time_name(names[k])]
    if col is None or value is None or not frames:
        return None

    # The first frame shows the sides.
    frame = frames[0]
    key = data[0].cells[frame]
    in_frame = [line.cells for line in data if line.cells[frame] == key]
    columns = [col] if row is None else [row, col]
    stated = [None] if row is None else [layout.n_rows, layout.n_cols]
    places = []
    for column, size in zip(columns, stated, strict=True):
        cells = [of_line[column] for of_line in in_frame]
        if not all(map(str.isdecimal, cells)):
            return None
        numbers = list(map(int, cells))
        begin = min(numbers)
        places.append(Place(column, begin, size or max(numbers) - begin + 1))
    return LongColumns(frame, tuple(places), value)
