"""Lines above and below the readings of a table: names, units, positions, summaries."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.sensor.layout.checks import shown
from sparseskin.nodes.sensor.layout.layout import UnstatedError
from sparseskin.nodes.sensor.layout.names import COL_WORDS, ROW_WORDS
from sparseskin.nodes.sensor.layout.times import RISING, is_time_name

from .sample import Line, TableHead, is_number, is_value, numbers_of
from .text import comment_mark, is_body

EVEN = 4
"""Least length of a line with even steps, as 0, 1, 2, ..., that is a header. Chosen: of readings up
to 10 one frame in 10,000 reads so."""
FORMED = 4
"""Least length of a line that is a header as it rises and no line below has as many decimals; and
least number of these lines. Chosen."""
MAX_LEVELS = 4
"""Most lines of which each has a part of the names of columns."""


def find_data(head: TableHead) -> None:
    """Find the lines of data, and what stands above and below them.

    Sets `data`, `names`, `headers`, `units`, `is_labelled`, `has_summary`, and adds to `notes`.
    Raises UnstatedError if a line may be a frame or label the columns.
    """
    lines = [line for line in head.raw[head.n_before :] if is_body(line.text)]
    lines = [line for line in lines if len(line.cells) == head.width]
    head.names = ("",) * head.width
    if head.dialect.names:
        head.names = head.dialect.names
        if head.dialect.has_prefix:
            head.names = ("", *head.dialect.names)
        head.data = lines
        return

    lines = _without_summary(head, lines)
    while len(lines) > 1:
        levels = _find_levels(head, lines)
        if levels is not None:
            _apply_levels(head, lines, levels)
            break
        # A spreadsheet writes a title with as many cells as the table, most of them empty.
        if not _is_title(lines[0]):
            break
        lines = lines[1:]
    if not head.headers:
        _find_header(head, lines)
    if head.data and not any(map(is_value, head.data[0].cells)):
        head.data = []


def _without_summary(head: TableHead, lines: list[Line]) -> list[Line]:
    """Lines without those at the end that sum the table up, as "Mean", or are empty."""
    n = len(lines)
    while n > 1 and head.summary_of(lines[n - 1].cells) is not None:
        n -= 1
    words = [head.summary_of(line.cells) for line in lines[n:]]
    words = [word for word in words if word]
    # Words that come again are labels, as of a grip with most force.
    head.has_summary = len(set(words)) == len(words)
    if head.has_summary:
        return lines[:n]
    return lines


def _is_title(line: Line) -> bool:
    """True if a line is a text, and most of its cells are empty."""
    begin, *rest_of_line = line.cells
    is_text = bool(begin) and not is_value(begin)
    return is_text and 2 * sum(map(bool, rest_of_line)) < len(rest_of_line)


class Levels(NamedTuple):
    """Names of columns of which several lines have a fragment each."""

    names: list[str]
    n_lines: int
    word: str  # "row", "col" ... in the first cell of the last line, before numbers; or ""


def _find_levels(head: TableHead, lines: Sequence[Line]) -> Levels | None:
    """Names of which the first lines have a fragment each, as of pandas or of merged cells of a
    spreadsheet; None if there are none.
    """
    # The first column may be an index, whose cell names the level.
    names = ["index"] + [""] * (head.width - 1)
    for n, line in enumerate(lines[:MAX_LEVELS], start=1):
        cells = _filled(line.cells)
        if not _are_fragments(names, cells):
            return None
        word = ""
        if cells[0].lower() in (*ROW_WORDS, *COL_WORDS):
            word = cells[0]
        names = _with_fragments(names, cells, word, is_first=n == 1)
        if len(set(names)) < head.width:
            continue

        # Each column has a name of its own now. Cells that are names without the lines above stand
        # below a title.
        are_names = len(set(cells)) == head.width
        if are_names or n in (1, len(lines)) or not _are_above_data(lines, n):
            return None
        return Levels(names, n, word)
    return None


def _with_fragments(
    names: Sequence[str], cells: Sequence[str], word: str, is_first: bool
) -> list[str]:
    """Names with the fragments of the next line behind them; a word stands before its numbers."""
    fragments = list(cells)
    for k, cell in enumerate(cells):
        if cell.isdecimal():
            fragments[k] = f"{word}{cell}"
    if is_first:
        return fragments
    pairs = zip(names, fragments, strict=True)
    return ["_".join(filter(None, pair)) for pair in pairs]


def _are_above_data(lines: Sequence[Line], n: int) -> bool:
    """True if the first n lines have a text, or an index begins below them."""
    # Frames of a few small numbers count, too: without either they are no names.
    if any(cell and not is_value(cell) for cell in lines[0].cells):
        return True
    *begins_above, begin_below = [line.cells[0] for line in lines[: n + 1]]
    return bool(begin_below) and not any(begins_above)


def _apply_levels(head: TableHead, lines: Sequence[Line], levels: Levels) -> None:
    """Set the names of several lines, and the data below."""
    names = list(levels.names)
    n = levels.n_lines
    data = list(lines[n:])
    # The line below may name the index.
    if len(data) > 1 and _is_title(data[0]):
        names[0] = data[0].cells[0]
        n += 1
        data = data[1:]
    elif levels.word:
        names[0] = ""
    head.data = data
    head.names = tuple(names)
    head.headers = tuple(line.text for line in lines[:n])
    head.notes += (f"the names are those of {n} lines",)


def _filled(cells: Sequence[str]) -> list[str]:
    """Cells, of which an empty one has the text of the one before it."""
    filled: list[str] = []
    for cell in cells:
        filled.append(cell or "".join(filled[-1:]))
    return filled


def _are_fragments(names: Sequence[str], cells: Sequence[str]) -> bool:
    """True if cells are texts, or numbers that count the columns of each name above them."""
    groups: dict[str, dict[str, None]] = {}
    for name, cell in zip(names, cells, strict=True):
        groups.setdefault(name, {})[cell] = None
    for group in groups.values():
        if any(map(is_value, filter(None, group))) and not _count_columns([*group]):
            return False
    return True


def _find_header(head: TableHead, lines: list[Line]) -> None:
    """Find the line of names, and that of units, or the names in the line before."""
    # A title of as many words as the table has columns stands before the names of these.
    while len(lines) > 2 and _are_names(lines[1].cells):
        lines = lines[1:]
    top, *later = lines
    cells = top.cells
    # The top line may stand above each frame of a grid.
    below = [line for line in later if line.text != top.text]
    rows = [line.cells for line in below]
    is_repeated = 0 < len(below) < len(later)

    # Of tables of whole numbers a top line is read as:
    #
    #   0,1,2,3        labels of the columns, and their names
    #   0.5,1.5,2.5    labels, but no names: positions, whose digits count nothing
    #   s0,s1,s2       names, no labels
    #   4,7,9          a frame
    counts = _count_columns(cells)
    head.is_labelled = _is_label_line(head, cells, rows, is_repeated)
    if head.is_labelled or _is_header(cells, rows):
        if counts or not head.is_labelled:
            head.names = tuple(cell.strip() for cell in cells)
        if head.is_labelled:
            head.notes += (f"the line {shown(top.text)} labels the columns",)
        head.headers = (top.text,)
        head.data = below
        _drop_units(head)
        return

    _check_no_label(head, top, rows)
    head.data = lines
    _name_by_line_before(head, top.number)
    if head.width > 1 and counts:
        note = "the first line counts: it is read as a frame; skip=1 if it is names"
        head.notes += (note,)


def _is_label_line(
    head: TableHead,
    cells: Sequence[str],
    rows: Sequence[Sequence[str]],
    is_repeated: bool,
) -> bool:
    """True if a line has the numbers or the places of the columns below."""
    counts = _count_columns(cells)
    # Where the axes are stated, other rising numbers above lines of taxels are the times.
    if head.layout.axes and not counts:
        return False
    if counts and is_repeated:
        return True
    return bool(rows) and _are_labels(cells, rows)


def _drop_units(head: TableHead) -> None:
    """Drop the line of units below the names, if there is one."""
    if len(head.data) < 2:
        return
    units, *later = head.data
    rows = [line.cells for line in later]
    cells = units.cells
    if _is_header(cells, rows) and not any(map(is_number, cells)):
        head.units = units.text
        head.data = later


def _are_names(cells: Sequence[str]) -> bool:
    """True if cells are no numbers, and most are names with numbers, or one is that of times."""
    cells = [cell for cell in cells if cell]
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

    slices = _slices_without_time(rows)
    if all("." in label for label in labels) and not any(map(_decimals, slices)):
        return True
    decimals_of_labels = list(map(_decimals, _slices_without_time([labels])))
    is_alike = any(form in decimals_of_labels for form in map(_decimals, slices))
    if not is_alike and len(rows) >= FORMED <= len(labels):
        return True
    # Frames of a test pattern go on so.
    is_long = len(labels) >= EVEN or bool(begin)
    return is_long and _is_even(labels) and not any(map(_is_even, slices))


def _check_no_label(
    head: TableHead, first: Line, rows: Sequence[Sequence[str]]
) -> None:
    """Raise UnstatedError if a long line of numbers rises, and no line below does: it may be a
    frame, or label the columns.
    """
    cells = first.cells
    if head.layout.axes or not rows or len(cells) < RISING or not _rises(cells):
        return
    if not any(map(_rises, _slices_without_time(rows))):
        fault = f"line {first.number} rises, as none below"
        ways = "skip if it labels the columns, axes=frames,taxels if it is a frame"
        raise UnstatedError(f"{head.name}: {fault}: state {ways}")


def _slices_without_time(rows: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Each row whole, without its first, and without its last cell: one of these may be a time,
    which rises and has decimals of its own.
    """
    return [cells for row in rows for cells in (row, row[1:], row[:-1])]


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
    mark = comment_mark(text)
    if mark:
        text = text.lstrip("#%/ ")
    names = head.dialect.cells(text)
    if len(names) == head.width - 1:
        names = ["", *names]
    elif len(names) == head.width + 1:
        names = names[:-1]
    n_indexed = sum(bool(re.search(r"\d", name)) for name in names)
    if mark:
        are_names = n_indexed > 0 or any(map(is_time_name, names))
    else:
        # A title of so many words has no numbers in most of them.
        are_names = 2 * n_indexed > len(names)
    if (
        len(names) == head.width
        and are_names
        and not any(map(is_value, filter(None, names)))
    ):
        head.names = tuple(names)
        head.headers = ()
        # Comments are no lines of the table.
        if not mark:
            head.headers = (earlier[-1],)
