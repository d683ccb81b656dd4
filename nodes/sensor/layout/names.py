"""Taxels among named numbers: families of names, channels, places in a grid."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import chain

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError

from .layout import Layout, UnstatedError, listed

NORMAL = "z"
"""The channel that is read of x, y and z: the force along the normal of the skin."""
AXIS = re.compile(r"(?:^|(?<=[^a-z]))[ft]?([xyz])(?=$|[^a-z])")
"""A letter of an axis in a name in small letters, as in p3_z, z_3, taxels[3].z, fz12."""
ROW_WORDS = ("r", "row", "rows", "y", "line")
COL_WORDS = ("c", "col", "cols", "column", "x")
MAX_SHOWN = 6
LONG_FORMS = {
    3: ("frames,taxels,value",),
    4: ("frames,rows,cols,value", "frames,cols,rows,value"),
}
"""`axes` of tables with a line for each taxel, by the number of their columns."""


Family = tuple[str, str]
"""Names that differ in their numbers alone: the names with # for each number, and the channel that
they state, "" for none.
"""


@dataclass(frozen=True)
class Selection:
    """Columns of the taxels, in order, and what is to be said about the choice. Where names state
    rows and columns, `shape` is known, and the order is row after row.
    """

    columns: tuple[int, ...]
    shape: tuple[int, int] | None = None
    notes: tuple[str, ...] = ()


def select(
    layout: Layout, names: Sequence[str], usable: Sequence[int], where: str
) -> Selection:
    """The taxels among columns, of which `usable` hold numbers and are no times.

    Columns that are stated are used. Else taxels are the columns whose names have numbers; of
    several families the only ones that fill the stated shape; of x, y and z the normal one.
    Raises SourceError if there are none, UnstatedError if there are several ways.
    """
    # What is stated is not doubted: a text column among them is refused at its first cell.
    if layout.columns.strip():
        columns = stated_columns(layout.columns, names, len(names), where)
        channel = layout.channel.lower()
        if channel:
            numeric = set(usable).intersection(columns)
            columns = [k for k in columns if k in numeric]
            columns = [k for k in columns if _channel_of(names[k]) == channel]
        if not columns:
            fault = f"channel: no column of {layout.channel!r} among the stated ones"
            raise SourceError(f"{where}: {fault}")
        return _placed(layout, names, columns, ())
    columns, notes = _chosen(layout, names, usable, where)
    return _placed(layout, names, columns, notes)


def stated_columns(text: str, names: Sequence[str], n: int, where: str) -> list[int]:
    """The columns of a list such as "s*,70-72": names, patterns, numbers from 1. Raises
    SourceError if a part of it is none.
    """
    # A dictionary keeps the order in which they are stated, and each column once.
    columns: dict[int, None] = {}
    for part in filter(None, map(str.strip, text.split(","))):
        columns |= dict.fromkeys(matching(part, names, n, where, "columns"))
    return list(columns)


def matching(
    part: str, names: Sequence[str], n: int, where: str, key: str
) -> list[int]:
    """The columns of a name, a pattern, a number from 1 or a range. Raises SourceError if none."""

    # A number may be a name, too: then it is the name.
    numbers = re.fullmatch(r"(\d{1,7})(?:-(\d{1,7}))?", part)
    columns: list[int] = []
    if numbers and part not in names:
        begin = int(numbers[1])
        end = int(numbers[2] or numbers[1])
        if 1 <= begin <= end <= n:
            columns = list(range(begin - 1, end))
    else:
        columns = [k for k, name in enumerate(names) if name == part]
        columns = columns or [
            k for k, name in enumerate(names) if fnmatchcase(name, part)
        ]
    if not columns:
        header = "no header"
        if any(names):
            header = listed([*map(printable, names)])
        allowed = "allowed: names, patterns as s*, numbers from 1 as 2-65"
        raise SourceError(
            f"{where}: {key}: {part[:40]!r} is none of {n} columns ({header}); {allowed}"
        )
    return columns


def _families(names: Sequence[str], usable: Sequence[int]) -> dict[Family, list[int]]:
    """Columns whose names hold numbers, by the family of these, in order of their first one."""
    families: dict[Family, list[int]] = {}
    for k in usable:
        pattern = pattern_of(names[k])
        if "#" in pattern:
            families.setdefault((pattern, _channel_of(names[k])), []).append(k)
    return families


def _channel_of(name: str) -> str:
    """The channel that a name states, "" for none."""
    axis = AXIS.search(name.lower())
    if axis is None:
        return ""
    return axis[1]


def pattern_of(name: str) -> str:
    """A name with # for each number."""
    return re.sub(r"\d+", "#", name)


def _chosen(
    layout: Layout, names: Sequence[str], usable: Sequence[int], where: str
) -> tuple[list[int], tuple[str, ...]]:
    """The taxels, and what is to be said. Raises UnstatedError if more than one choice of columns
    is possible, SourceError if none is.
    """
    families = _families(names, usable)
    n_stated = layout.n_stated
    # Three axes first: their families are as large as each other: no shape tells them apart.
    channels = _channels(families)
    if layout.channel or channels:
        channel = layout.channel or NORMAL
        kinds = ", ".join(channels) or "none"
        if channel not in channels:
            fault = f"channel: no columns of {channel!r}; it has {kinds}"
            raise SourceError(f"{where}: {fault}")
        columns = channels[channel]
        if n_stated in (None, len(columns)):
            return columns, (f"channel {channel} of {kinds}",)

    # One family of names: its columns are the taxels.
    ways = list(families.values())
    if n_stated is not None or len(ways) != 1:
        ways = _ways(families, usable)
        ways = [columns for columns in ways if n_stated in (None, len(columns))]
    if len(ways) == 1:
        return ways[0], ()
    if not usable:
        raise SourceError(f"{where}: no column holds numbers; state columns")

    about = f"{len(usable)} columns hold numbers"
    kinds_of_names = [
        f"{len(columns)} named {printable(pattern)}"
        for (pattern, _), columns in families.items()
    ]
    if kinds_of_names:
        about += f" ({'; '.join(kinds_of_names)})"
    if n_stated is not None and not ways:
        needed = f"n_rows x n_cols = {layout.n_rows} x {layout.n_cols} needs {n_stated}"
        hint = "state columns, or another shape"
        forms: Sequence[str] = ()
        if not any(names):
            forms = LONG_FORMS.get(len(names), ())
        if forms:
            hint += f", or axes={forms[0]} if a line is of one taxel"
        options = [{"axes": form} for form in forms]
        raise UnstatedError(f"{where}: {about}, but {needed}; {hint}", *options)
    texts = [_as_text(names, columns) for columns in ways]
    hint = "columns, or n_rows and n_cols"
    if n_stated is not None:
        hint = " or ".join(f"columns={text}" for text in texts[:MAX_SHOWN])
    fault = f"{where}: {about}: which are taxels is not stated: state {hint}"
    raise UnstatedError(fault, *({"columns": text} for text in texts))


def _ways(families: dict[Family, list[int]], usable: Sequence[int]) -> list[list[int]]:
    """The sets of columns that may be the taxels: each family of several names, all of these, all
    names with numbers, and all columns.
    """
    # A family of one, as "battery2", is rarely a skin, but may belong to one.
    large = [columns for columns in families.values() if len(columns) > 1]
    of_large = sorted(chain.from_iterable(large))
    with_numbers = sorted(chain.from_iterable(families.values()))
    distinct: dict[tuple[int, ...], list[int]] = {}
    for columns in (*large, of_large, with_numbers, list(usable)):
        if columns:
            distinct[tuple(sorted(columns))] = columns
    return list(distinct.values())


def _channels(families: dict[Family, list[int]]) -> dict[str, list[int]]:
    """Columns of each of x, y and z, if their families are as large as each other; else {}."""
    by_channel: dict[str, list[int]] = {}
    for (_, channel), columns in families.items():
        if channel:
            by_channel.setdefault(channel, []).extend(columns)
    # An accelerometer beside a skin has letters, too, but fewer of them.
    sizes = {len(columns) for columns in by_channel.values()}
    has_several = len(by_channel) > 1 and NORMAL in by_channel
    if has_several and len(sizes) == 1:
        return by_channel
    return {}


def _placed(
    layout: Layout, names: Sequence[str], columns: list[int], notes: tuple[str, ...]
) -> Selection:
    """The columns in the order of the numbers in their names, and their places in a grid."""
    patterns = [pattern_of(names[k]) for k in columns]
    families = list(dict.fromkeys(patterns))
    if not all("#" in family for family in families):
        return Selection(tuple(columns), None, notes)

    numbers: dict[int, tuple[int, ...]] = {}
    for k in columns:
        texts = re.findall(r"\d+", names[k])
        numbers[k] = tuple(map(int, texts))
    if len(families) > 1:
        # As A1, A2, B1, B2: names before their number are one side, if the shape is so.
        pairs = [
            (families.index(pattern), numbers[k][-1])
            for k, pattern in zip(columns, patterns, strict=True)
        ]
        grid = _grid(layout, columns, pairs, ("", ""))
        is_stated = grid is not None and grid.shape == (layout.n_rows, layout.n_cols)
        if grid is not None and is_stated and layout.order == "rows":
            return replace(grid, notes=(*notes, *grid.notes))
        return Selection(tuple(columns), None, notes)

    name = names[columns[0]]
    varying = _grid_numbers(name, [numbers[k] for k in columns])
    if len(varying) == 2:
        outer_at, inner_at = varying
        words = _words(name)
        pairs = [(numbers[k][outer_at], numbers[k][inner_at]) for k in columns]
        grid = _grid(layout, columns, pairs, (words[outer_at], words[inner_at]))
        if grid is not None:
            return replace(grid, notes=(*notes, *grid.notes))

    # By number, not by text: s10 comes after s9.
    by_number = sorted(columns, key=numbers.__getitem__)
    if by_number != columns and len(set(numbers.values())) == len(columns):
        notes = (*notes, "columns are ordered by the numbers in their names")
        columns = by_number
    return Selection(tuple(columns), None, notes)


def _words(name: str) -> list[str]:
    """The word right before each number of a name, in small letters, "" where there is none."""
    words = []
    for part in re.split(r"\d+", name.lower())[:-1]:
        words_of_part = re.findall(r"[a-z]+", part) or [""]
        words.append(words_of_part[-1])
    return words


def _grid_numbers(name: str, numbers: Sequence[tuple[int, ...]]) -> list[int]:
    """Which numbers of the names are rows and columns: two with such words, or all that vary."""
    words = _words(name)
    labelled = [
        at for at, word in enumerate(words) if word in ROW_WORDS or word in COL_WORDS
    ]
    if len(labelled) == 2:
        return labelled
    # Without words, numbers that never change are those of a hand or a board.
    varying = []
    for at in range(len(words)):
        values = {of_name[at] for of_name in numbers}
        if len(values) > 1:
            varying.append(at)
    return varying


def _grid(
    layout: Layout,
    columns: Sequence[int],
    pairs: Sequence[tuple[int, int]],
    words: tuple[str, str],
) -> Selection | None:
    """Columns row after row, where two numbers of each name, behind `words`, are a row and a
    column, and fill a grid; None where they do not, or where nothing states which is which.
    """
    n_outer = len({outer for outer, _ in pairs})
    n_inner = len({inner for _, inner in pairs})
    column_of = dict(zip(pairs, columns, strict=True))
    if not n_outer * n_inner == len(column_of) == len(columns):
        return None

    outer_word, inner_word = words
    is_labelled = outer_word in ROW_WORDS and inner_word in COL_WORDS
    is_labelled |= outer_word in COL_WORDS and inner_word in ROW_WORDS
    if inner_word and not is_labelled:
        return None  # two numbers that count something else, as a sensor and its taxels

    notes: tuple[str, ...] = ()
    if is_labelled:
        rows_first = outer_word in ROW_WORDS
    else:
        # Without words the order of a matrix is meant: row, then column. A stated shape decides.
        stated_shape = (layout.n_rows, layout.n_cols)
        is_reversed = stated_shape == (n_inner, n_outer) != (n_outer, n_inner)
        rows_first = not is_reversed
        order = "row, column" if rows_first else "column, row"
        notes = (f"the parts of the names are {order}",)
    shape = (n_outer, n_inner) if rows_first else (n_inner, n_outer)
    side = 0 if rows_first else 1

    ordered = sorted(pairs, key=lambda pair: (pair[side], pair[1 - side]))
    return Selection(tuple(column_of[pair] for pair in ordered), shape, notes)


def _as_text(names: Sequence[str], columns: Sequence[int]) -> str:
    """The setting `columns` of some columns: a range of numbers, or numbers."""
    begin = columns[0]
    end = columns[-1]
    if list(columns) == list(range(begin, end + 1)):
        return f"{begin + 1}-{end + 1}"
    patterns = {re.sub(r"\d+", "*", names[k]) for k in columns}
    return ",".join(sorted(patterns))


def last_part(name: str) -> str:
    """The last part of a name in lower case, where it is the path of a field, as "field.force"."""
    return name.lower().rsplit(".", 1)[-1]
