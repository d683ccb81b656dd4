"""Frames in .csv as `sparseskin bag export --to csv` writes them: described, below a header."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from typing import Any

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import INT64_MAX, is_real, is_whole
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Mask

from .parsed import (
    Parsed,
    Policy,
    check_grid,
    parse_reading,
    parse_whole,
    shown,
    stack_frames,
    text_lines,
)

FIRST_LINE = "# sparseskin frames of "
"""Begin of the first line; the topic follows."""
POINT_ROWS = "# point_rows"
"""Begin of the line above the header that states rows of a file of points, where there is one."""
_CELL = re.compile(r"r(\d{1,4})c(\d{1,4})")
_MAX_DEPTH_LINE = 1 << 21
"""Longest description, characters: a mask of 2**20 cells and the rest."""


def is_own_csv(raw: bytes) -> bool:
    """True if the content begins as an exported topic does."""
    return raw.startswith(FIRST_LINE.encode())


def parse_own_csv(raw: bytes, name: str, policy: Policy) -> Parsed:
    """Read the exported frames of a topic.

    Raises
    ------
    SourceError
        If the topic has no taxels, a line is malformed, a stamp is not after the one before, or a
        reading is not allowed.
    """
    lines = text_lines(raw)
    skin, columns, shape, header = _head(lines, name)
    first = columns.index("r0c0")
    at = columns.index("stamp_ns") if "stamp_ns" in columns else None
    frames, stamps = [], []
    for index, line in enumerate(lines[header:], start=header + 1):
        if not line.strip():
            continue
        where = f"{name}, line {index}"
        tokens = line.split(",")
        if len(tokens) != len(columns):
            raise SourceError(f"{where}: holds {len(tokens)} cells, its header {len(columns)}")
        if at is not None:
            stamps.append(_stamp(tokens[at], where))
        cells = [
            parse_reading(token, where, *divmod(k, shape[1]), policy)
            for k, token in enumerate(tokens[first : first + shape[0] * shape[1]])
        ]
        frames.append(np.array(cells).reshape(shape))
    for k, (before, stamp) in enumerate(pairwise(stamps), start=1):
        if stamp <= before:
            raise SourceError(
                f"{name}: stamp {k} is {stamp}, not after the one before it, {before}"
            )
    return Parsed(
        forces=stack_frames(frames, name),
        unit=_text(skin, "unit"),
        rate_hz=_number(skin, "rate_hz"),
        stamp_ns=tuple(stamp - stamps[0] for stamp in stamps) if stamps else None,
        pitch_m=_number(skin, "pitch_m"),
        mask=_mask(skin, shape, name),
        f_max=_number(skin, "f_max"),
    )


def own_csv_shape(raw: bytes, name: str) -> tuple[int, int, int | None]:
    """Rows, columns and number of taxels of exported frames; the last is None without a mask.

    Raises
    ------
    SourceError
        If the topic has no taxels, or description or header are malformed.
    """
    skin, _, shape, _ = _head(text_lines(raw), name)
    mask = _mask(skin, shape, name)
    return *shape, None if mask is None else int(mask.sum())


def _head(lines: list[str], name: str) -> tuple[dict[str, Any], list[str], tuple[int, int], int]:
    """What the file states of the skin, the names of its columns, the shape of a frame, and the
    number of the line with these names, from 1.
    """
    header = 4 if len(lines) > 3 and lines[2].startswith(POINT_ROWS) else 3
    if len(lines) < 3 or not lines[1].startswith("# {") or len(lines[1]) > _MAX_DEPTH_LINE:
        raise SourceError(f"{name}, line 2: expected the description of the skin, '# {{...}}'")
    try:
        described = json.loads(lines[1].removeprefix("# "))
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{name}, line 2: {shown(error, 80)}") from error
    skin = described.get("skin", {})
    columns = [column.strip() for column in lines[header - 1].split(",")]
    cells = [match for column in columns if (match := _CELL.fullmatch(column))]
    if not cells or not isinstance(skin, dict):
        topic = lines[0].removeprefix(FIRST_LINE)
        raise SourceError(
            f"{name}, line {header}: {shown(topic)} holds no taxels; allowed are taxels, truth and "
            "reconstruction"
        )
    last = cells[-1]
    n_rows, n_cols = (
        parse_whole(side, f"{name}, line {header}", 0, MAX_SIDE) + 1 for side in last.groups()
    )
    check_grid(n_rows, n_cols, name)
    expected = [f"r{k // n_cols}c{k % n_cols}" for k in range(n_rows * n_cols)]
    first = columns.index(cells[0][0])
    if columns[first : first + len(expected)] != expected:
        fault = f"the columns are not r0c0..{last[0]}, row after row"
        raise SourceError(f"{name}, line {header}: {fault}")
    return skin, columns, (n_rows, n_cols), header


def _stamp(token: str, where: str) -> int:
    if not (token.isascii() and token.isdigit() and len(token) <= 19 and int(token) <= INT64_MAX):
        raise SourceError(f"{where}: stamp_ns is {shown(token)}; expected nanoseconds")
    return int(token)


def _text(skin: dict[str, Any], key: str) -> str | None:
    value = skin.get(key)
    return value if isinstance(value, str) and value else None


def _number(skin: dict[str, Any], key: str) -> float | None:
    value = skin.get(key)
    return float(value) if is_real(value, 1e-9, 1e30) or is_whole(value, 1) else None


def _mask(skin: dict[str, Any], shape: tuple[int, int], name: str) -> Mask | None:
    rows = skin.get("mask")
    if rows is None:
        return None
    right = isinstance(rows, list) and len(rows) == shape[0]
    if not (right and all(isinstance(r, str) and re.fullmatch("[01]*", r) for r in rows)):
        raise SourceError(f"{name}, line 2: mask; expected {shape[0]} texts of 0 and 1")
    if any(len(row) != shape[1] for row in rows):
        raise SourceError(f"{name}, line 2: mask; expected {shape[1]} of 0 and 1 in each row")
    return np.array([[cell == "1" for cell in row] for row in rows], dtype=np.bool_)
