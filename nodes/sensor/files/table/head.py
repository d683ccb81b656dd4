"""The begin of a table: where its data begin, names of columns, times, the kind of its lines."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recording import File, is_missing, shown
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError
from sparseskin.nodes.sensor.layout.names import (
    COL_WORDS,
    ROW_WORDS,
    matching,
    stated_columns,
)
from sparseskin.nodes.sensor.layout.times import (
    CLOCK_UNIT,
    ISO,
    clock_ns,
    is_epoch,
    is_time_name,
    iso_ns,
    named_unit,
)

from .text import COMMENTS, Dialect, dialect_of, pieces

MAX_SAMPLE = 1000
"""Lines of the begin that are looked at; chosen: a thousand frames."""
COUNTED = 4
"""Least length of a line 0, 1, 2, ... that is a header, chosen: no frame of real readings is so."""
MAX_SHOWN = 8
RISING_LINES = 8
"""Least lines in which times rise; chosen: eight readings without a trend rise once in 40,000."""
EXCEL_LINE = re.compile(r"sep=(.)", re.IGNORECASE)
VALUE_WORDS = ("value", "val", "v", "force", "pressure", "reading", "data", "count", "counts")
FRAME_WORDS = ("frame", "frame_id", "frame_no", "frame_number", "sample", "index", "seq", "n")

TAXEL_WORDS = ("taxel", "taxel_id", "sensor", "sensor_id", "channel", "cell", "electrode", "id")
SOURCE_WORDS = (
    *("side", "hand", "foot", "finger", "sensor", "sensor_id", "sensor_name", "device"),
    *("device_id", "skin", "patch", "mat", "board", "module"),
)
"""Names of columns that state which skin a line is of."""
SECONDS = re.compile(r"(.*?)(?:secs?|seconds)")
NANOSECONDS = re.compile(r"(.*?)(?:nsecs?|nanosecs?|nanoseconds)")
TIME_LIKE = re.compile(r"\d[:h]\d\d(?!\d)|\d[-/.]\d{1,2}[-/.]\d")
"""In texts that are times of a day or dates."""

LINES, GRID, LONG = "lines", "grid", "long"
"""Kinds of tables: a frame a line; a frame a block of lines, one a row; a line for each taxel."""


@dataclass
class TableHead:
    """What the begin of a table shows."""

    dialect: Dialect
    width: int  # cells of a line
    has_trailing: bool = False  # a separator ends each line
    n_before: int = 0  # lines before the first one of data
    dropped: Counter[str] = field(default_factory=Counter)  # of these lines, by name
    header: str = ""  # the line of the names
    names: tuple[str, ...] = ()
    usable: tuple[int, ...] = ()  # columns of numbers that are no times
    numeric: tuple[int, ...] = ()  # columns of numbers
    time: int | None = None
    nanoseconds: int | None = None  # column with those of a time in seconds
    time_unit: str = ""
    kind: str = LINES
    height: int = 1  # lines of a frame of a grid
    long: LongColumns | None = None
    source: int | None = None  # column by which lines of one skin are chosen
    notes: tuple[str, ...] = ()

    def label(self, column: int) -> str:
        """The name of a column, or its number from 1."""
        return shown(self.names[column]) if self.names[column] else str(column + 1)


@dataclass(frozen=True)
class LongColumns:
    """Columns of a table with a line for each taxel, and the sides of a frame."""

    frame: int  # a number, or the time
    row: int | None  # None: `col` counts all taxels
    col: int
    value: int
    first_row: int = 0
    first_col: int = 0
    n_rows: int = 1
    n_cols: int = 1


@dataclass(frozen=True)
class _Line:
    """A line of the sample: its number from 1, its text, and its cells."""

    number: int
    text: str
    cells: tuple[str, ...]


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
    if bodies[0][1].lstrip().startswith("{"):
        raise SourceError(f"{file.name}: lines of JSON are not read; write a table, as .csv")
    dialect = dialect_of([text for _, text in bodies[len(bodies) // 3 :]])
    if separator:
        dialect = dialect._replace(separator=separator)
    lines = [_Line(number, text, tuple(dialect.cells(text))) for number, text in bodies]

    head = _sized(dialect, lines)
    lines = [line for line in lines if len(line.cells) in _widths(head)]
    data = _headed(head, lines, raw, n_skipped)
    if not data:
        raise SourceError(f"{file.name}: the recording holds no frame")
    _count_before(head, raw, data[0].number, layout, bool(separator))
    numeric = {k for k in range(head.width) if _is_numeric(data, k, layout)}
    head.numeric = tuple(sorted(numeric | _without_readings(head, data, numeric)))
    if not head.numeric:
        place = f"{file.name}, line {data[0].number}"
        raise SourceError(f"{place}: no column holds numbers; state columns, or skip")

    _find_kind(head, file, raw, data)
    if head.kind == LINES:
        head.source = _source_column(head, layout, data, file.name)
    if head.source is not None:
        data = [line for line in data if line.cells[head.source] == layout.frame_id]
    if head.dialect.has_decimal_comma:
        head.notes += ("commas are decimal points",)
    if head.kind != GRID:
        head.time = _time_column(head, layout, data, file.name)
    if head.time is not None:
        head.nanoseconds = _nanoseconds_beside(head, head.time)
        head.time_unit = _unit_of_column(head, data, layout)
    no_taxels = (head.time, head.nanoseconds, head.source, *_counters(head, data))
    head.usable = tuple(k for k in head.numeric if k not in no_taxels)
    _note_texts(head)
    return head


def _note_texts(head: TableHead) -> None:
    """Note the columns that hold no numbers and no times."""
    texts = [k for k in range(head.width) if k not in head.numeric and k != head.time]
    if texts:
        labels = ", ".join(head.label(k) for k in texts[:MAX_SHOWN])
        further = ", ..." if len(texts) > MAX_SHOWN else ""
        head.notes += (f"no numbers, and left out: column {labels}{further}",)


def is_number(cell: str) -> bool:
    """True if a cell is a number; not one of Python's literals such as 1_0."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _first_lines(file: File) -> list[tuple[int, str]]:
    """Numbers and texts of the first lines of a file."""
    first: list[tuple[int, str]] = []
    for piece in pieces(file.file, file.name):
        texts = piece.lines[:-1] if piece.is_cut and len(piece.lines) > 2 else piece.lines
        room = MAX_SAMPLE - len(first)
        first += islice(enumerate(texts, start=piece.number), room)
        if len(first) >= MAX_SAMPLE:
            break
    return first


def _excel(raw: list[tuple[int, str]], layout: Layout) -> tuple[str, int]:
    """The separator that the first line states for Excel, and the lines that are not looked at."""
    setting = EXCEL_LINE.fullmatch(raw[0][1].strip()) if raw else None
    separator = setting[1] if setting else ""
    return separator, max(layout.skip, int(bool(separator)))


def _is_body(text: str) -> bool:
    """True if a line is neither blank nor a comment. A header may begin with %."""
    stripped = text.strip()
    return bool(stripped) and not stripped.startswith(("#", "//"))


def _sized(dialect: Dialect, lines: Sequence[_Line]) -> TableHead:
    """A head with the number of cells of the lines that hold most numbers: a preamble of settings
    may have more lines than a short table.
    """
    later = lines[len(lines) // 3 :]
    n_lines = Counter(len(line.cells) for line in later)
    last_lines = {len(line.cells): line for line in later}
    n_numbers = {
        width: n * max(1, sum(map(is_number, last_lines[width].cells)))
        for width, n in n_lines.items()
    }
    width = max(n_numbers, key=n_numbers.__getitem__)
    of_width = [line for line in later if len(line.cells) == width]
    has_trailing = width > 1 and all(line.cells[-1] == "" for line in of_width)
    has_trailing = has_trailing and dialect.separator != " "
    return TableHead(dialect, width - has_trailing, has_trailing)


def _widths(head: TableHead) -> tuple[int, ...]:
    """Numbers of cells that a line may have."""
    return (head.width, head.width + 1) if head.has_trailing else (head.width,)


def _headed(
    head: TableHead, lines: list[_Line], raw: list[tuple[int, str]], n_skipped: int
) -> list[_Line]:
    """The lines of data; the head learns the names before them."""
    head.names = ("",) * head.width
    # A title of as many words as the table has columns stands before the names of these.
    while len(lines) > 2 and _are_names(lines[1].cells[: head.width]):
        lines = lines[1:]
    first, later = lines[0], lines[1:] or lines[:1]
    if len(lines) > 1 and _is_header(first.cells[: head.width], later):
        head.names = tuple(name.strip() for name in first.cells[: head.width])
        head.header = first.text
        head.dropped["header"] += 1
        lines = [line for line in later if line.text != first.text]
        units = lines[0].cells[: head.width]
        is_units = len(lines) > 1 and _is_header(units, lines[1:])
        if is_units and not any(map(is_number, units)):
            head.dropped["line of units"] += 1
            lines = lines[1:]
    elif len(lines) == 1 and not any(map(is_number, first.cells)):
        return []
    else:
        _named_by_comment(head, raw[n_skipped:], first.number)
        if head.width > 1 and _counts_columns(first.cells[: head.width]):
            head.notes += ("the first line counts: it is read as a frame; skip=1 if it is names",)
    if lines and not any(_is_value(cell) for cell in lines[0].cells):
        return []
    return lines


def _are_names(cells: Sequence[str]) -> bool:
    """True if cells are no numbers, and most are names with numbers, or one is that of times."""
    if any(map(_is_value, cells)):
        return False
    n_indexed = sum(bool(re.search(r"\d", cell)) for cell in cells)
    return 2 * n_indexed > len(cells) or any(map(is_time_name, cells))


def _is_header(cells: Sequence[str], later: Sequence[_Line]) -> bool:
    """True if a line has texts in columns that hold numbers later; or it counts the columns, as
    programs name them that know no names.
    """
    if _counts_columns(cells) and len(cells) >= COUNTED:
        # Frames of a test pattern count on.
        return not _steps_by_one(later[0].cells[: len(cells)])
    for k, cell in enumerate(cells):
        if _is_value(cell):
            continue
        below = [line.cells[k] for line in later if k < len(line.cells)]
        n_values = sum(map(_is_value, below))
        if cell and 2 * n_values > len(below):
            return True
    return False


def _steps_by_one(cells: Sequence[str]) -> bool:
    numbers = [float(cell) for cell in cells if is_number(cell)]
    return len(numbers) == len(cells) and bool((np.diff(numbers) == 1).all())


def _counts_columns(cells: Sequence[str]) -> bool:
    """True for 0, 1, 2, ... or 1, 2, 3, ..., perhaps behind an empty cell."""
    counted = [cell for cell in cells if cell]
    n = len(counted)
    return counted in ([*map(str, range(n))], [*map(str, range(1, n + 1))])


def _is_value(cell: str) -> bool:
    """True if a cell is a number, a time, or states that there is none."""
    return is_number(cell) or is_missing(cell) or bool(iso_ns(cell) or clock_ns(cell) is not None)


def _named_by_comment(head: TableHead, raw: list[tuple[int, str]], first_number: int) -> None:
    """Names of columns in the comment before the data, as np.savetxt writes them."""
    texts_before = [text.strip() for number, text in raw if number < first_number and text.strip()]
    if not texts_before or not texts_before[-1].startswith(COMMENTS):
        return
    text = texts_before[-1].lstrip("#%/ ")
    names = tuple(cell.strip() for cell in head.dialect.cells(text))
    has_names = any(map(is_time_name, names)) or any(re.search(r"\d", name) for name in names)
    if len(names) == head.width and has_names and not any(map(is_number, names)):
        head.names = names


def _count_before(
    head: TableHead, raw: list[tuple[int, str]], first_number: int, layout: Layout, has_sep: bool
) -> None:
    """Count the lines before the data by their names."""
    texts_before = [text for number, text in raw if number < first_number]
    head.n_before = len(texts_before)
    head.dropped["line of the separator"] += int(has_sep)
    n_skipped = max(0, min(layout.skip, len(texts_before)) - int(has_sep))
    head.dropped["skipped lines"] += n_skipped
    unskipped = texts_before[max(layout.skip, int(has_sep)) :]
    n_blank = sum(not text.strip() for text in unskipped)
    n_comments = sum(not _is_body(text) and bool(text.strip()) for text in unskipped)
    head.dropped["blank lines"] += n_blank
    head.dropped["comments"] += n_comments
    n_others = len(texts_before) - head.dropped.total()
    if n_others:
        head.dropped["lines before the table"] += n_others


def _is_numeric(data: Sequence[_Line], k: int, layout: Layout) -> bool:
    """True if most cells of a column that are not missing are numbers, and some is."""
    cells = [line.cells[k] for line in data]
    texts = [
        cell for cell in cells if not (is_missing(cell) or cell.lower() in layout.missing_texts)
    ]
    n_numbers = sum(map(is_number, texts))
    return n_numbers > 0 and 2 * n_numbers >= len(texts)


def _without_readings(head: TableHead, data: Sequence[_Line], numeric: set[int]) -> set[int]:
    """Columns of missing numbers alone whose names are like those of columns of numbers: taxels
    that are dead.
    """
    patterns = {re.sub(r"\d+", "#", head.names[k]) for k in numeric if _is_indexed(head, k)}
    dead = set()
    for k in range(head.width):
        is_like_others = re.sub(r"\d+", "#", head.names[k]) in patterns
        if is_like_others and k not in numeric and all(is_missing(row.cells[k]) for row in data):
            dead.add(k)
    return dead


def _find_kind(
    head: TableHead, file: File, raw: list[tuple[int, str]], data: Sequence[_Line]
) -> None:
    """Find whether a frame is a line, a block of lines, or a line for each taxel."""
    layout = file.layout
    head.long = _long_columns(head, layout, data)
    if head.long is not None:
        head.kind = LONG
        head.notes += (f"a line for each taxel: {head.long.n_rows} x {head.long.n_cols}",)
        return
    if head.header or layout.columns or layout.time not in ("", "none"):
        return
    n_rows, n_cols = layout.n_rows, layout.n_cols
    setting = layout.n_stated or 0
    fits = setting > head.width == n_cols and n_rows is not None
    heights = _block_heights(head, raw, data[0].number)
    if fits and n_rows is not None:
        head.height = n_rows
    elif not setting and len(heights) > 1 and len({*heights[:-1]}) == 1 and heights[0] > 1:
        head.height = heights[0]
    elif file.parts and not setting:
        head.height = sum(heights)
    else:
        return
    head.kind = GRID
    head.notes += (f"a frame is a block of {head.height} lines of {head.width} readings",)


def _block_heights(head: TableHead, raw: list[tuple[int, str]], first_number: int) -> list[int]:
    """Lines of numbers in each block between blank lines or lines of text."""
    heights: list[int] = []
    is_within = False
    for number, text in raw:
        if number < first_number:
            continue
        cells = head.dialect.cells(text) if text.strip() else []
        is_row = any(map(is_number, cells)) and len(cells) in _widths(head)
        if is_row and is_within:
            heights[-1] += 1
        elif is_row:
            heights.append(1)
        is_within = is_row
    return heights


def _long_columns(head: TableHead, layout: Layout, data: Sequence[_Line]) -> LongColumns | None:
    """Columns of frame, row, column and value, or of frame, taxel and value, where the names state
    them.
    """
    names = [name.lower() for name in head.names]

    def only(words: Sequence[str]) -> int | None:
        columns = [k for k in head.numeric if names[k] in words]
        return columns[0] if len(columns) == 1 else None

    row, col = only((*ROW_WORDS, "i")), only((*COL_WORDS, "j"))
    if row is None and col is None:
        col = only(TAXEL_WORDS)
    elif row is None or col is None:
        return None
    value = only(VALUE_WORDS)
    frames = [k for k in head.numeric if names[k] in FRAME_WORDS]
    frames += [k for k in range(head.width) if is_time_name(names[k])]
    if col is None or value is None or not frames:
        return None

    key = data[0].cells[frames[0]]
    first = [line for line in data if line.cells[frames[0]] == key]
    places = [[line.cells[k] for k in (row, col) if k is not None] for line in first]
    if not all(cell.isdecimal() for place in places for cell in place):
        return None
    numbers = np.array(places, dtype=np.int64)
    low, high = numbers.min(axis=0).tolist(), numbers.max(axis=0).tolist()
    sides = [end - begin + 1 for begin, end in zip(low, high, strict=True)]
    if row is None:
        return LongColumns(frames[0], None, col, value, 0, low[0], 1, sides[0])
    n_rows, n_cols = layout.n_rows or sides[0], layout.n_cols or sides[1]
    return LongColumns(frames[0], row, col, value, low[0], low[1], n_rows, n_cols)


def _source_column(head: TableHead, layout: Layout, data: Sequence[_Line], name: str) -> int | None:
    """The column by which the lines of one skin are chosen, where a name states that there is one.
    Raises UnstatedError if lines are of several skins, and none is stated.
    """
    columns = [k for k, label in enumerate(head.names) if label.lower() in SOURCE_WORDS]
    for k in columns:
        values = list(dict.fromkeys(line.cells[k] for line in data))
        if layout.frame_id in values:
            return k
        if len(values) > 1:
            listed = ", ".join(map(shown, values[:MAX_SHOWN]))
            fault = f"column {head.label(k)} names {len(values)} skins, {listed}"
            options = [{"frame_id": value} for value in values[:MAX_SHOWN]]
            raise UnstatedError(f"{name}: {fault}: state frame_id", *options)
    if layout.frame_id:
        raise SourceError(f"{name}: frame_id: no column states {shown(layout.frame_id)}")
    return None


def _time_column(head: TableHead, layout: Layout, data: Sequence[_Line], name: str) -> int | None:
    """The column of the times. Raises UnstatedError if there may be several."""
    if layout.time == "none":
        return None
    if layout.time:
        ends = {"first": 0, "last": head.width - 1}
        setting = ends.get(layout.time)
        return setting if setting is not None else _stated_time(head, layout.time, name)
    if head.dialect.has_prefix:
        return 0
    by_name = [k for k, one in enumerate(head.names) if one and is_time_name(one)]
    by_name = [k for k in by_name if _holds_values(data, k)]
    by_name = _without_nanoseconds(head, by_name)
    texts = [k for k in range(head.width) if k not in head.numeric and _text_unit(data, k)]
    dates = [k for k in head.numeric if not _is_indexed(head, k) and is_epoch(_column(data, k))]
    dates = _without_nanoseconds(head, dates)
    for candidates, note in ((by_name, ""), (texts, ""), (dates, "holds dates")):
        if len(candidates) > 1:
            labels = " or ".join(f"time={head.label(k)}" for k in candidates)
            options = [{"time": head.names[k] or str(k + 1)} for k in candidates]
            fault = f"{len(candidates)} columns may be the times: state {labels}"
            raise UnstatedError(f"{name}: {fault}", *options)
        if candidates:
            if note:
                head.notes += (f"column {head.label(candidates[0])} {note}: the times",)
            return candidates[0]
    if layout.rate_hz is None:
        _ask_for_texts(head, data, name)
    column = _time_at_an_end(head, layout, data, name)
    if column is None and layout.rate_hz is None:
        _ask_for_times(head, layout, data, name)
    return column


def _holds_values(data: Sequence[_Line], k: int) -> bool:
    """True if most cells of a column are values; one that is none is refused where it stands."""
    return 2 * sum(_is_value(line.cells[k]) for line in data) > len(data)


def _without_nanoseconds(head: TableHead, columns: Sequence[int]) -> list[int]:
    """Columns of times without those of nanoseconds beside one of seconds, which are one time."""
    parts = {_nanoseconds_beside(head, k) for k in columns}
    return [k for k in columns if k not in parts]


def _nanoseconds_beside(head: TableHead, time: int) -> int | None:
    """The column with the nanoseconds of a column of seconds, as sec and nsec of ROS."""
    match = SECONDS.fullmatch(head.names[time].lower())
    if match is None:
        return None
    for k, name in enumerate(head.names):
        part = NANOSECONDS.fullmatch(name.lower())
        if part is not None and part[1] == match[1]:
            return k
    return None


def _ask_for_texts(head: TableHead, data: Sequence[_Line], name: str) -> None:
    """Raise SourceError if a column holds texts that look like times, of a form that is not
    read.
    """
    for k in range(head.width):
        if k in head.numeric:
            continue
        if all(TIME_LIKE.search(line.cells[k]) for line in data):
            fault = f"column {head.label(k)} holds {shown(data[0].cells[k])}, like a time"
            forms = "2026-03-12T10:15:02.120, 12.03.2026 10:15:02.120 or 10:15:02.120"
            ways = "write the times so, or state rate_hz, or time=none"
            raise SourceError(f"{name}: {fault}; times that are read: {forms}; {ways}")


def _stated_time(head: TableHead, text: str, name: str) -> int:
    columns = matching(text, head.names, head.width, name, "time")
    if len(columns) > 1:
        raise SourceError(f"{name}: time: {shown(text)} names {len(columns)} columns, not one")
    return columns[0]


def _time_at_an_end(
    head: TableHead, layout: Layout, data: Sequence[_Line], name: str
) -> int | None:
    """The first or last column of a table without names, if it has one more than the stated shape,
    and is the only one of the two that rises.
    """
    is_one_more = layout.n_stated is not None and len(head.numeric) == layout.n_stated + 1
    if head.header or layout.columns or not is_one_more or len(data) < 2:
        return None
    ends = {"first": head.numeric[0], "last": head.numeric[-1]}
    rising = {word: k for word, k in ends.items() if _rises(_column(data, k))}
    if len(rising) > 1:
        options = [{"time": word} for word in rising]
        fault = "the first and the last column rise: state time=first or time=last, or columns"
        raise UnstatedError(f"{name}: {fault}", *options)
    for k in rising.values():
        if not _counts(_column(data, k)):
            head.notes += (f"column {head.label(k)} rises in all lines: the times",)
            return k
    return None


def _ask_for_times(head: TableHead, layout: Layout, data: Sequence[_Line], name: str) -> None:
    """Raise UnstatedError if a column that nothing names rises in all lines: likely the times.

    A column whose name has a number, or that is stated, is a taxel; one that rises by 1 counts.
    """
    if len(data) < RISING_LINES:
        return
    taxels: list[int] = []
    if layout.columns.strip():
        taxels = stated_columns(layout.columns, head.names, head.width, name)
    rising = []
    for k in head.numeric:
        is_named = _is_indexed(head, k) or head.names[k].lower() in FRAME_WORDS
        steps = np.diff(_column(data, k))
        if k not in taxels and not is_named and (steps > 0).all() and (steps != 1).any():
            rising.append(k)
    if not rising or len(rising) == len(head.numeric):
        return
    labels = [f"time={head.label(k)}" for k in rising[:MAX_SHOWN]]
    further = ", ..." if len(rising) > MAX_SHOWN else ""
    columns = "column rises" if len(rising) == 1 else "columns rise"
    ways = f"state {', '.join(labels)}{further} or, if these are no times, time=none"
    options = [{"time": head.names[k] or str(k + 1)} for k in rising]
    raise UnstatedError(f"{name}: {len(rising)} {columns} in all lines: {ways}", *options)


def _counters(head: TableHead, data: Sequence[_Line]) -> list[int]:
    """A column at an end of a table without names that counts its lines, which is no taxel."""
    if head.header or head.kind != LINES or head.time is not None or len(data) < 3:
        return []
    counting = [k for k in {head.numeric[0], head.numeric[-1]} if _counts(_column(data, k))]
    if len(counting) == 1:
        head.notes += (f"column {head.label(counting[0])} counts lines, and is left out",)
        return counting
    return []


def _counts(numbers: np.ndarray[tuple[int], np.dtype[np.float64]]) -> bool:
    """True for 0, 1, 2, ... or 1, 2, 3, ..."""
    return numbers.size > 1 and numbers[0] in (0, 1) and bool((np.diff(numbers) == 1).all())


def _rises(numbers: np.ndarray[tuple[int], np.dtype[np.float64]]) -> bool:
    steps = np.diff(numbers)
    return bool((steps >= 0).all() and (steps > 0).any())


def _column(data: Sequence[_Line], k: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Numbers of a column of the sample; NaN where there is none."""
    cells = [line.cells[k] for line in data]
    return np.array([float(cell) if is_number(cell) else np.nan for cell in cells])


def _is_indexed(head: TableHead, k: int) -> bool:
    return any(character.isdigit() for character in head.names[k])


def _text_unit(data: Sequence[_Line], k: int) -> str:
    """ISO or CLOCK_UNIT of a column of texts that are times; "" of others."""
    cells = [line.cells[k] for line in data]
    if all(iso_ns(cell) is not None for cell in cells):
        return ISO
    return CLOCK_UNIT if all(clock_ns(cell) is not None for cell in cells) else ""


def _unit_of_column(head: TableHead, data: Sequence[_Line], layout: Layout) -> str:
    assert head.time is not None
    if head.nanoseconds is not None:
        return "ns"
    if layout.time_unit:
        return layout.time_unit
    return _text_unit(data, head.time) or named_unit(head.names[head.time])
