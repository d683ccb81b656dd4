"""Columns of a table that are no taxels: times, counters, and names of several skins."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.checks import shown
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError
from sparseskin.nodes.sensor.layout.names import (
    matching,
    stated_columns,
)
from sparseskin.nodes.sensor.layout.times import (
    CLOCK_UNIT,
    ISO,
    are_likely,
    clock_ns,
    is_epoch,
    is_time_name,
    iso_ns,
    named_unit,
)

from .sample import (
    FRAME_WORDS,
    LINES,
    MAX_SHOWN,
    Line,
    TableHead,
    column_of,
    holds_values,
    is_indexed,
    is_value,
)
from .text import Dialect

RISING_LINES = 8
"""Least lines in which times rise; chosen: eight readings without a trend rise once in 40,000."""
SOURCE_WORDS = (
    *("side", "hand", "foot", "finger", "sensor", "sensor_id", "sensor_name", "device"),
    *("device_id", "skin", "patch", "mat", "board", "module"),
)
"""Names of columns that state which skin a line is of."""
MAX_ROWS = 100
"""Rows of numbers that are looked at, chosen."""
MAX_SKINS = 16
"""Most skins whose lines take turns in one table; chosen."""
MIN_ROUNDS = 3
"""Least rounds in which numbers repeat that are those of skins; chosen."""
MIN_TURNS = 1 / 3
"""Least part of the lines whose text is not that of the line before, where texts are names of
skins; chosen: a label of what goes on changes rarely."""
SECONDS = re.compile(r"(.*?)(?:secs?|seconds)")
NANOSECONDS = re.compile(r"(.*?)(?:nsecs?|nanosecs?|nanoseconds)")
TIME_LIKE = re.compile(r"\d[:h]\d\d(?!\d)|\d[-/.]\d{1,2}[-/.]\d")
"""In texts that are times of a day or dates."""


def time_column(
    head: TableHead, layout: Layout, data: Sequence[Line], name: str
) -> int | None:
    """The column of the times. Raises UnstatedError if there may be several."""
    if layout.time == "none":
        return None
    if layout.time:
        ends = {"first": 0, "last": head.width - 1}
        if layout.time in ends:
            return ends[layout.time]
        return _stated_time(head, layout.time, name)
    if head.dialect.has_prefix:
        return 0
    by_name = [k for k, label in enumerate(head.names) if label and is_time_name(label)]
    by_name = [k for k in by_name if holds_values(data, k)]
    by_name = _without_nanoseconds(head, by_name)

    texts = [
        k for k in range(head.width) if k not in head.numeric and _text_unit(data, k)
    ]
    dates = [
        k
        for k in head.numeric
        if not is_indexed(head, k) and is_epoch(column_of(data, k))
    ]
    dates = _without_nanoseconds(head, dates)

    # Names first, then texts that are times, then dates.
    for candidates, note in ((by_name, ""), (texts, ""), (dates, "holds dates")):
        if len(candidates) > 1:
            fault = f"{name}: {len(candidates)} columns may be the times"
            raise UnstatedError.between(fault, "time", _keys(head, candidates))
        if candidates:
            if note:
                head.notes += (f"column {head.label(candidates[0])} {note}: the times",)
            return candidates[0]
    # With a stated rate the file is read without times.
    if layout.rate_hz is None:
        _ask_for_texts(head, data, name)
    column = _time_at_an_end(head, layout, data, name)
    if column is None and layout.rate_hz is None:
        _ask_for_times(head, layout, data, name)
    return column


def time_of_rows(
    names: Sequence[str], rows: npt.NDArray[Any], layout: Layout, where: str
) -> tuple[int | None, tuple[str, ...]]:
    """The same of rows of numbers, (k, n), and what is to be said."""
    names = tuple(names) or ("",) * rows.shape[1]
    everything = tuple(range(rows.shape[1]))
    head = TableHead(Dialect(","), len(names), names=names, numeric=everything)
    lines = [
        Line(k, "", tuple(map(str, row)))
        for k, row in enumerate(rows[:MAX_ROWS].tolist())
    ]
    return time_column(head, layout, lines, where), head.notes


def _without_nanoseconds(head: TableHead, columns: Sequence[int]) -> list[int]:
    """Columns of times without those of nanoseconds beside one of seconds, which are one time."""
    parts = {nanoseconds_beside(head, k) for k in columns}
    return [k for k in columns if k not in parts]


def nanoseconds_beside(head: TableHead, time: int) -> int | None:
    """The column with the nanoseconds of a column of seconds, as sec and nsec of ROS."""
    match = SECONDS.fullmatch(head.names[time].lower())
    if match is None:
        return None
    for k, name in enumerate(head.names):
        part = NANOSECONDS.fullmatch(name.lower())
        if part is not None and part[1] == match[1]:
            return k
    return None


def _ask_for_texts(head: TableHead, data: Sequence[Line], name: str) -> None:
    """Raise SourceError if a column holds texts that look like times, or is named as they are, of a
    form that is not read.
    """
    for k in range(head.width):
        if k in head.numeric:
            continue
        is_named = bool(head.names[k]) and is_time_name(head.names[k])
        if is_named or all(TIME_LIKE.search(line.cells[k]) for line in data):
            fault = (
                f"column {head.label(k)} holds {shown(data[0].cells[k])}, like a time"
            )
            forms = "2026-03-12T10:15:02.120, 12.03.2026 10:15:02.120 or 10:15:02.120"
            ways = "write the times so, or state rate_hz, or time=none"
            raise SourceError(f"{name}: {fault}; times that are read: {forms}; {ways}")


def _stated_time(head: TableHead, text: str, name: str) -> int:
    columns = matching(text, head.names, head.width, name, "time")
    if len(columns) > 1:
        raise SourceError(
            f"{name}: time: {shown(text)} names {len(columns)} columns, not one"
        )
    return columns[0]


def _time_at_an_end(
    head: TableHead, layout: Layout, data: Sequence[Line], name: str
) -> int | None:
    """The first or last column of a table without names, if it has one more than the stated shape,
    and is the only one of the two that rises.
    """
    is_one_more = (
        layout.n_stated is not None and len(head.numeric) == layout.n_stated + 1
    )
    if head.header or layout.columns or not is_one_more or len(data) < 2:
        return None

    ends = {"first": head.numeric[0], "last": head.numeric[-1]}
    rising: dict[str, int] = {}
    for word, k in ends.items():
        if _rises(column_of(data, k)):
            rising[word] = k
    if len(rising) > 1:
        fault = f"{name}: the first and the last column rise"
        raise UnstatedError.between(fault, "time", [*rising], "columns")
    # A column 0, 1, 2, ... may count the lines.
    for k in rising.values():
        if not _counts(column_of(data, k)):
            head.notes += (f"column {head.label(k)} rises in all lines: the times",)
            return k
    return None


def _ask_for_times(
    head: TableHead, layout: Layout, data: Sequence[Line], name: str
) -> None:
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
        is_named = is_indexed(head, k) or head.names[k].lower() in FRAME_WORDS
        if k in taxels or is_named:
            continue
        if are_likely(column_of(data, k)):
            rising.append(k)
    # Where all columns rise, it is the load that does.
    if not rising or len(rising) == len(head.numeric):
        return

    columns = "column rises" if len(rising) == 1 else "columns rise"
    fault = f"{name}: {len(rising)} {columns} in all lines"
    otherwise = "time=none, if these are no times"
    raise UnstatedError.between(fault, "time", _keys(head, rising), otherwise)


def _keys(head: TableHead, columns: Sequence[int]) -> list[str]:
    """Names of columns, or their numbers from 1, as `time` states them."""
    return [head.names[k] or str(k + 1) for k in columns]


def counters(
    head: TableHead, layout: Layout, data: Sequence[Line], name: str
) -> list[int]:
    """A column at an end of a table without names that counts its lines, which is no taxel. Raises
    UnstatedError if it may be the times, of one frame in a second or a millisecond.
    """
    if any(head.names) or head.kind != LINES or head.time is not None or len(data) < 3:
        return []
    ends = {"first": head.numeric[0], "last": head.numeric[-1]}
    counting = {word: k for word, k in ends.items() if _counts(column_of(data, k))}
    if len(counting) == 1 and len(head.numeric) > 1:
        ((word, column),) = counting.items()
        if not layout.time and layout.rate_hz is None:
            fault = f"{name}: column {head.label(column)} counts lines, or is the times"
            raise UnstatedError.between(fault, "time", ["none", word])
        head.notes += (f"column {head.label(column)} counts lines, and is left out",)
        return [column]
    return []


def source_column(
    head: TableHead, layout: Layout, data: Sequence[Line], name: str
) -> int | None:
    """The column by which the lines of one skin are chosen, where a name states that there is one.
    Raises UnstatedError if lines are of several skins, and none is stated.
    """
    columns = [k for k, label in enumerate(head.names) if label.lower() in SOURCE_WORDS]
    if not layout.columns:
        unnamed = [k for k in range(head.width) if k not in columns]
        columns += [k for k in unnamed if _takes_turns(head, data, k)]
    for k in columns:
        values = list(dict.fromkeys(line.cells[k] for line in data))
        if layout.frame_id in values:
            return k
        if len(values) > 1:
            skins = ", ".join(map(shown, values[:MAX_SHOWN]))
            fault = f"column {head.label(k)} names {len(values)} skins, {skins}"
            options = [{"frame_id": value} for value in values[:MAX_SHOWN]]
            raise UnstatedError(f"{name}: {fault}: state frame_id", *options)
    if layout.frame_id:
        raise SourceError(
            f"{name}: frame_id: no column states {shown(layout.frame_id)}"
        )
    return None


def _takes_turns(head: TableHead, data: Sequence[Line], k: int) -> bool:
    """True if a column that is no taxel and no time has a few values that take turns in the lines:
    texts, or numbers 0, 1, 0, 1 under a name without a number.
    """
    cells = [line.cells[k] for line in data]
    values = list(dict.fromkeys(cells))
    if not 1 < len(values) <= MAX_SKINS or len(values) == len(cells):
        return False
    if k in head.numeric:
        n = len(values)
        goes_round = all(cell == values[at % n] for at, cell in enumerate(cells))
        is_named = bool(head.names[k]) and not is_indexed(head, k)
        is_whole = all(map(str.isdecimal, values))
        return is_named and is_whole and goes_round and len(cells) >= MIN_ROUNDS * n
    if any(map(is_value, values)):
        return False
    n_turns = sum(cell != cell_before for cell_before, cell in pairwise(cells))
    return n_turns > MIN_TURNS * len(cells)


def _counts(numbers: np.ndarray[tuple[int], np.dtype[np.float64]]) -> bool:
    """True for 0, 1, 2, ... or 1, 2, 3, ..."""
    return (
        numbers.size > 1
        and numbers[0] in (0, 1)
        and bool((np.diff(numbers) == 1).all())
    )


def _rises(numbers: np.ndarray[tuple[int], np.dtype[np.float64]]) -> bool:
    steps = np.diff(numbers)
    return bool((steps >= 0).all() and (steps > 0).any())


def _text_unit(data: Sequence[Line], k: int) -> str:
    """ISO or CLOCK_UNIT of a column of texts that are times; "" of others."""
    cells = [line.cells[k] for line in data]
    if all(iso_ns(cell) is not None for cell in cells):
        return ISO
    if all(clock_ns(cell) is not None for cell in cells):
        return CLOCK_UNIT
    return ""


def unit_of_column(head: TableHead, data: Sequence[Line], layout: Layout) -> str:
    assert head.time is not None
    if head.nanoseconds is not None:
        return "ns"
    if layout.time_unit:
        return layout.time_unit
    return _text_unit(data, head.time) or named_unit(head.names[head.time])
