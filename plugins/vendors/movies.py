"""What exports of grids, a frame after the other, have in common: cells, their mask, and times."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import AnyArray, Doubles, Mask
from sparseskin.nodes.sensor.files.recording import Lines
from sparseskin.nodes.sensor.layout.arrangement import check_grid
from sparseskin.nodes.sensor.layout.checks import (
    MAX_READING,
    parse_number,
    parse_whole,
    shown,
)

LARGEST_NUMBER = 999_999_999
"""Largest number of a frame."""
KPA_CM2_IN_NEWTONS = 0.1
_DAY_S = 86400.0


def parse_reading(token: str, where: str, row: int, col: int) -> float:
    """Read the reading of a cell (row, col), from 0; SourceError if it is not in [0, 1e30]."""
    where = f"{where}, row {row}, column {col}"
    value = parse_number(token, where)
    if value < 0:
        raise SourceError(f"{where}: {shown(token)} is below 0; a range starts at 0")
    if value > MAX_READING:
        raise SourceError(f"{where}: {shown(token)} is beyond {MAX_READING:g}")
    return value


def parse_shape(rows: tuple[str, str], cols: tuple[str, str]) -> tuple[int, int]:
    """Read the sides of a grid, each a text and its place; SourceError if one is not allowed."""
    n_rows = parse_whole(*rows, 1, MAX_SIDE)
    n_cols = parse_whole(*cols, 1, MAX_SIDE)
    check_grid(n_rows, n_cols, rows[1])
    return n_rows, n_cols


def read_cells(
    lines: Lines, shape: tuple[int, int], number: int, keyword: str, absent: str
) -> tuple[Doubles, Mask]:
    """Read the readings of a frame, and the mask of sensels that exist, both of its shape; blank
    lines are skipped, `absent`, in upper case, stands in a cell without a sensel. SourceError if
    rows or cells are missing or too many, by the `keyword` of their number, or a reading is
    malformed.
    """
    n_rows, n_cols = shape
    label = f"frame {number}"
    readings = np.zeros(shape)
    exists = np.ones(shape, dtype=np.bool_)
    row = 0
    while row < n_rows:
        line = next(lines, None)
        if line is None:
            raise SourceError(
                f"{lines.where}: the file ends in {label}, which needs {n_rows} rows"
            )
        cells = [cell.strip() for cell in line.split(",")]
        if not any(cells):
            continue

        # A spreadsheet fills lines up with empty cells.
        where = f"{lines.where}, {label}"
        while len(cells) > n_cols and not cells[-1]:
            cells.pop()
        if len(cells) != n_cols:
            raise SourceError(
                f"{where}: row {row} has {len(cells)} cells, {keyword} is {n_cols}"
            )

        # A cell without a sensel reads 0.
        for col, token in enumerate(cells):
            if token.upper() == absent:
                exists[row, col] = False
            else:
                readings[row, col] = parse_reading(token, where, row, col)
        row += 1
    return readings, exists


def check_mask(
    first_exists: Mask, exists: Mask, number: int, where: str, what: str
) -> None:
    """Raise SourceError if the cells of a frame that hold a sensel are others than the first's."""
    if not np.array_equal(first_exists, exists):
        row, col = np.argwhere(first_exists != exists)[0]
        raise SourceError(
            f"{where}: frame {number} has its {what} cells (no sensel) elsewhere than the first "
            f"frame, e.g. at row {row}, column {col}; a mask must not change"
        )


def check_number(number: int, expected: int, where: str) -> None:
    """Raise SourceError if a frame does not follow the one before it."""
    if number != expected:
        raise SourceError(
            f"{where}: frame {number} comes where frame {expected} should; a recording is one "
            "measurement with no frame left out"
        )


def stamps(
    times: Sequence[float | None], name: str, of_day: bool = False
) -> tuple[int, ...] | None:
    """Nanoseconds since the first frame; None if times, in s, are missing or repeated. SourceError
    if they fall, but for times of day at midnight.
    """
    times_stated = [time for time in times if time is not None]
    if not times_stated or len(times_stated) != len(times):
        return None
    if not all(abs(time) <= 1e9 for time in times_stated):
        raise SourceError(f"{name}: frame times lie outside 0..1e9 s")

    stamps_ns = [0]
    n_days = 0
    for earlier, time in pairwise(times_stated):
        # From the last minutes of a day to the first ones of the next.
        is_midnight = of_day and earlier - time > _DAY_S / 2
        if is_midnight:
            n_days += 1
        seconds = time - times_stated[0] + n_days * _DAY_S
        stamps_ns.append(round(seconds * 1e9))
    return _rising(stamps_ns, name)


def _rising(stamps: Sequence[int], name: str) -> tuple[int, ...] | None:
    """Stamps since the first; None if some are repeated. SourceError if they fall."""
    for k, (previous, stamp) in enumerate(pairwise(stamps), start=2):
        if stamp < previous:
            raise SourceError(
                f"{name}: the time of frame {k} is before that of the one before it"
            )
    if len(set(stamps)) < len(stamps):
        return None
    return tuple(stamp - stamps[0] for stamp in stamps)


def stack_frames(frames: list[AnyArray], where: str) -> Doubles:
    """Stack frames into float64 (n_frames, n_rows, n_cols); SourceError if none, or too many."""
    if not frames:
        raise SourceError(f"{where}: the recording holds no frame")
    try:
        return np.stack(frames).astype(np.float64, copy=False)
    except MemoryError:
        raise SourceError(
            f"{where}: {len(frames)} frames do not fit in memory"
        ) from None
