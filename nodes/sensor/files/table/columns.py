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
    COL_WORDS,
    ROW_WORDS,
    last_part,
    matching,
    stated_columns,
)
from sparseskin.nodes.sensor.layout.times import (
    CLOCK_UNIT,
    FEW_RISING,
    ISO,
    RISING,
    SAME_STEPS,
    are_likely,
    clock_ns,
    dated_clock_ns,
    is_epoch,
    is_time_name,
    iso_ns,
    named_unit,
    rise,
    which_times,
)

from .sample import (
    FRAME_WORDS,
    MAX_SHOWN,
    Line,
    TableHead,
    is_value,
)
from .text import Dialect

MAX_UNEVEN = 5.0
"""Largest ratio of the steps of times in a few lines, of a column at an end, where the shape shows
that one is no taxel; chosen: a frame may be late."""
SOURCE_WORDS = [
    "side",
    "hand",
    "foot",
    "finger",
    "sensor",
    "sensor_id",
    "sensor_name",
    "device",
    "device_id",
    "skin",
    "patch",
    "mat",
    "board",
    "module",
]
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


def find_times(head: TableHead) -> None:
    """Find the column of the times, and their unit. Raises UnstatedError if several may be it."""
    head.time = _time_column(head)
    if head.time is None:
        return
    head.nanoseconds = _nanoseconds_beside(head, head.time)
    if head.nanoseconds is not None:
        head.time_unit = "ns"
        return
    unit = _text_unit(head.cells(head.time)) or named_unit(head.names[head.time])
    head.time_unit = head.layout.time_unit or unit


def time_of_rows(
    names: Sequence[str], rows: npt.NDArray[Any], layout: Layout, where: str
) -> tuple[int | None, tuple[str, ...]]:
    """The column of the times in rows of numbers, (k, n), and what is to be said."""
    width = rows.shape[1]
    head = TableHead(layout, where, Dialect(","), width, numeric=range(width))
    head.names = names or ("",) * width
    # As texts, so that one set of rules finds times in tables and in arrays.
    for k, row in enumerate(rows[:MAX_ROWS].tolist()):
        head.data.append(Line(k, "", tuple(map(str, row))))
    return _time_column(head), head.notes


def _time_column(head: TableHead) -> int | None:
    layout = head.layout
    if layout.time:
        ends = {"none": None, "first": 0, "last": head.width - 1}
        if layout.time in ends:
            return ends[layout.time]
        columns = matching(layout.time, head.names, head.width, head.name, "time")
        if len(columns) > 1:
            fault = f"time: {shown(layout.time)} names {len(columns)} columns, not one"
            raise SourceError(f"{head.name}: {fault}")
        return columns[0]
    if head.dialect.has_prefix:
        return 0

    # Names first, then texts that are times, then dates.
    by_name = [k for k, name in enumerate(head.names) if name and is_time_name(name)]
    by_name = [k for k in by_name if _holds_values(head.cells(k))]
    without_numbers = [k for k in range(head.width) if k not in head.numeric]
    texts = [k for k in without_numbers if _text_unit(head.cells(k))]
    unindexed = [k for k in head.numeric if not head.is_indexed(k)]
    dates = [k for k in unindexed if is_epoch(head.numbers(k))]
    for candidates in (by_name, texts, dates):
        # Nanoseconds beside seconds are one time.
        parts = {_nanoseconds_beside(head, k) for k in candidates}
        columns = [k for k in candidates if k not in parts]
        if len(columns) > 1:
            fault = f"{head.name}: {len(columns)} columns may be the times"
            raise UnstatedError.between(fault, "time", _keys(head, columns))
        if columns:
            if candidates is dates:
                head.notes += (
                    f"column {head.label(columns[0])} holds dates: the times",
                )
            return columns[0]

    # With a stated rate the file is read without times.
    column = None
    if layout.rate_hz is None:
        column = _other_texts(head)
    if column is None:
        column = _time_at_an_end(head)
    if column is None and layout.rate_hz is None:
        _ask_for_times(head)
    return column


def _holds_values(cells: Sequence[str]) -> bool:
    """True if most cells are values; one that is none is refused where it stands."""
    return 2 * sum(map(is_value, cells)) > len(cells)


def _nanoseconds_beside(head: TableHead, time: int) -> int | None:
    """The column with the nanoseconds of a column of seconds, as sec and nsec of ROS."""
    seconds = SECONDS.fullmatch(head.names[time].lower())
    for k, name in enumerate(head.names):
        part = NANOSECONDS.fullmatch(name.lower())
        if seconds is not None and part is not None and part[1] == seconds[1]:
            return k
    return None


def _other_texts(head: TableHead) -> int | None:
    """The column of times of day behind dates of any form, where it is stated to be read so. Raises
    SourceError if a column holds texts that look like times, or is named as they are, of a form
    that is not read.
    """
    for k, name in enumerate(head.names):
        cells = head.cells(k)
        is_named = bool(name) and is_time_name(name)
        # Not dropped: stamps of even steps in place of these would look like a measurement.
        if k in head.numeric or not (is_named or all(map(TIME_LIKE.search, cells))):
            continue
        are_dated = all(dated_clock_ns(cell) is not None for cell in cells)
        if are_dated and head.layout.time_unit == CLOCK_UNIT:
            return k
        fault = f"column {head.label(k)} holds {shown(cells[0])}, like a time"
        if are_dated:
            fault += ", whose date has two meanings: state time_unit=clock for its time of day"
            raise UnstatedError(f"{head.name}: {fault}", {"time_unit": CLOCK_UNIT})
        forms = "2026-03-12T10:15:02.120, 12.03.2026 10:15:02.120 or 10:15:02.120"
        ways = "write the times so, or state rate_hz, or time=none"
        raise SourceError(f"{head.name}: {fault}; times that are read: {forms}; {ways}")
    return None


def _time_at_an_end(head: TableHead) -> int | None:
    """The first or last column of a table without names, if it has one more than the stated shape,
    and is the only one of the two that rises.
    """
    is_one_more = len(head.numeric) - 1 == head.layout.n_stated
    if head.headers or head.layout.columns or not is_one_more or len(head.data) < 2:
        return None
    rising = {}
    for word, k in _ends(head).items():
        if rise(head.numbers(k)):
            rising[word] = k
    # In a few lines a reading may rise, too, but not in even steps.
    are_clear = all(rise(head.numbers(k), MAX_UNEVEN) for k in rising.values())
    if len(rising) > 1 or not are_clear:
        verb = "rises"
        if len(rising) > 1:
            verb = "rise"
        fault = f"{head.name}: the {' and the '.join(rising)} column {verb}"
        raise UnstatedError.between(fault, "time", [*rising], "columns")
    # A column 0, 1, 2, ... may count the lines.
    for k in rising.values():
        if not _counts(head.numbers(k)):
            head.notes += (f"column {head.label(k)} rises in all lines: the times",)
            return k
    return None


def _ends(head: TableHead) -> dict[str, int]:
    """The first and the last column of numbers, as `time` states them."""
    return {"first": head.numeric[0], "last": head.numeric[-1]}


def _ask_for_times(head: TableHead) -> None:
    """Raise UnstatedError if a column that nothing names rises in all lines: likely the times.

    A column whose name has a number, or that is stated, is a taxel; one that rises by 1 counts.
    """
    n_least = RISING
    if any(head.names):
        n_least = FEW_RISING
    if len(head.data) < n_least:
        return
    taxels = stated_columns(head.layout.columns, head.names, head.width, head.name)
    rising = []
    for k in head.numeric:
        is_named = head.is_indexed(k) or head.names[k].lower() in FRAME_WORDS
        if k not in taxels and not is_named and are_likely(head.numbers(k), SAME_STEPS):
            rising.append(k)
    # Where all columns rise, it is the load that does.
    if not rising or len(rising) == len(head.numeric):
        return
    columns = "columns rise"
    if len(rising) == 1:
        columns = "column rises"
    fault = f"{head.name}: {len(rising)} {columns} in all lines"
    raise which_times(fault, _keys(head, rising), len(head.data))


def ask_for_time(head: TableHead, frame: int) -> None:
    """Raise UnstatedError if a column that states frames holds other numbers than whole ones, and
    is not read as times.
    """
    numbers = head.numbers(frame)
    is_decided = head.time is not None or head.layout.time or head.layout.rate_hz
    if not is_decided and not (numbers == np.rint(numbers)).all():
        fault = (
            f"{head.name}: column {head.label(frame)} numbers frames, or is the times"
        )
        raise UnstatedError.between(fault, "time", [*_keys(head, [frame]), "none"])


def _keys(head: TableHead, columns: Sequence[int]) -> list[str]:
    """Names of columns, or their numbers from 1, as `time` states them."""
    return [head.names[k] or str(k + 1) for k in columns]


def counters(head: TableHead) -> list[int]:
    """A column at an end of a table without names that counts its lines, which is no taxel. Raises
    UnstatedError if it may be the times, of one frame in a second or a millisecond.
    """
    has_no_names = not any(head.names) and head.is_plain and head.time is None
    if not has_no_names or len(head.data) < 3 or len(head.numeric) < 2:
        return []
    counting = {word: k for word, k in _ends(head).items() if _counts(head.numbers(k))}
    # Where both ends count, it is a test pattern.
    if len(counting) != 1:
        return []
    ((word, column),) = counting.items()
    label = head.label(column)
    if not head.layout.time and head.layout.rate_hz is None:
        fault = f"{head.name}: column {label} counts lines, or is the times"
        raise UnstatedError.between(fault, "time", ["none", word])
    head.notes += (f"column {label} counts lines, and is left out",)
    return [column]


def source_column(head: TableHead) -> int | None:
    """The column by which the lines of one skin are chosen, where a name states that there is one.
    Raises UnstatedError if lines are of several skins, and none is stated.
    """
    frame_id = head.layout.frame_id
    names_of_columns = [last_part(name) for name in head.names]
    columns = [k for k, name in enumerate(names_of_columns) if name in SOURCE_WORDS]
    if not head.layout.columns:
        columns += [k for k in range(head.width) if _takes_turns(head, k)]
    # Two skins that are read as one would be a force that jumps with each frame.
    for k in columns:
        skins = list(dict.fromkeys(head.cells(k)))
        if frame_id in skins:
            return k
        if len(skins) > 1:
            texts = ", ".join(map(shown, skins[:MAX_SHOWN]))
            fault = f"column {head.label(k)} names {len(skins)} skins, {texts}"
            answer = "frame_id"
            if names_of_columns[k] not in SOURCE_WORDS:
                # Numbers that take turns may be a state, as a temperature.
                answer += ", or columns, those of the taxels, if these are no skins"
            options = [{"frame_id": skin} for skin in skins[:MAX_SHOWN]]
            raise UnstatedError(f"{head.name}: {fault}: state {answer}", *options)
    if frame_id:
        fault = f"frame_id: no column states {shown(frame_id)}"
        raise SourceError(f"{head.name}: {fault}")
    return None


def _takes_turns(head: TableHead, k: int) -> bool:
    """True if a column that is no taxel and no time has a few values that take turns in the lines:
    texts, or numbers 0, 1, 0, 1 under a name without a number.
    """
    cells = head.cells(k)
    skins = list(dict.fromkeys(cells))
    n = len(skins)
    name = last_part(head.names[k])
    is_no_skin = name in (*ROW_WORDS, *COL_WORDS) or is_time_name(name)
    if is_no_skin or not 1 < n <= MAX_SKINS or n == len(cells):
        return False
    if k in head.numeric:
        # Numbers that repeat may be readings of a coarse converter; a round is no accident.
        goes_round = all(cell == skins[at % n] for at, cell in enumerate(cells))
        is_named = bool(head.names[k]) and not head.is_indexed(k)
        is_whole = all(map(str.isdecimal, skins))
        return is_named and is_whole and goes_round and len(cells) >= MIN_ROUNDS * n
    n_turns = sum(cell != cell_before for cell_before, cell in pairwise(cells))
    return n_turns > MIN_TURNS * len(cells) and not any(map(is_value, skins))


def _counts(numbers: npt.NDArray[np.float64]) -> bool:
    """True for 0, 1, 2, ... or 1, 2, 3, ..."""
    return numbers[0] in (0, 1) and bool((np.diff(numbers) == 1).all())


def _text_unit(cells: Sequence[str]) -> str:
    """ISO or CLOCK_UNIT of texts that are times; "" of others."""
    if all(iso_ns(cell) is not None for cell in cells):
        return ISO
    if all(clock_ns(cell) is not None for cell in cells):
        return CLOCK_UNIT
    return ""
