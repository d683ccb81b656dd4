"""Frames in .csv as `sparseskin bag export --to csv` writes them: described, below a header."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import INT64_MAX, is_real
from sparseskin.nodes.errors import SourceError

from .arrays import parsed_arrays
from .parsed import (
    Head,
    Lines,
    Parsed,
    Policy,
    Recording,
    check_grid,
    parse_frame,
    parse_mask,
    parse_whole,
    shown,
    stack_frames,
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


class OwnCsvRecording(Recording):
    """The exported frames of a topic.

    Raises
    ------
    SourceError
        If the topic has no taxels, a line is malformed, a stamp is not after the one before, or a
        reading is not allowed.
    """

    def __init__(self, lines: Lines, policy: Policy) -> None:
        self._lines, self._policy = lines, policy
        self._stated, self._columns, self._shape = _head(lines)

    def head(self) -> Head:
        mask, unit = self._stated.get("mask"), self._stated.get("unit")
        n_taxels = math.prod(self._shape) if mask is None else int(mask.sum())
        return Head(*self._shape, n_taxels, None if unit is None else str(unit))

    def read(self) -> Parsed:
        columns, name = self._columns, self._lines.name
        first = columns.index("r0c0")
        at = columns.index("stamp_ns") if "stamp_ns" in columns else None
        frames, stamps = [], []
        for line in self._lines:
            if not line.strip():
                continue
            where, tokens = self._lines.where, line.split(",")
            if len(tokens) != len(columns):
                raise SourceError(f"{where}: holds {len(tokens)} cells, its header {len(columns)}")
            if at is not None:
                stamps.append(_stamp(tokens[at], where))
            cells = tokens[first : first + math.prod(self._shape)]
            frames.append(parse_frame(cells, where, self._shape, self._policy))
        arrays = {**self._stated, "forces": stack_frames(frames, name)}
        return parsed_arrays(arrays | ({"stamp_ns": np.array(stamps)} if stamps else {}), name)


def _head(lines: Lines) -> tuple[dict[str, npt.NDArray[Any]], list[str], tuple[int, int]]:
    """Read to the first frame: what the file states of the skin, as arrays of an .npz, the names of
    its columns, and the shape of a frame.
    """
    title, stated, names = (next(lines, "") for _ in range(3))
    if names.startswith(POINT_ROWS):
        names = next(lines, "")
    if not stated.startswith("# {") or len(stated) > _MAX_DEPTH_LINE:
        raise SourceError(
            f"{lines.name}, line 2: expected the description of the skin, '# {{...}}'"
        )
    try:
        described = json.loads(stated.removeprefix("# "))
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{lines.name}, line 2: {shown(error, 80)}") from error
    skin = described.get("skin", {})
    columns = [column.strip() for column in names.split(",")]
    cells = [match for column in columns if (match := _CELL.fullmatch(column))]
    if not cells or not isinstance(skin, dict):
        topic = title.removeprefix(FIRST_LINE)
        raise SourceError(
            f"{lines.where}: {shown(topic)} holds no taxels; allowed are taxels, truth and "
            "reconstruction"
        )
    last = cells[-1]
    n_rows, n_cols = (parse_whole(side, lines.where, 0, MAX_SIDE) + 1 for side in last.groups())
    check_grid(n_rows, n_cols, lines.name)
    expected = [f"r{k // n_cols}c{k % n_cols}" for k in range(n_rows * n_cols)]
    first = columns.index(cells[0][0])
    if columns[first : first + len(expected)] != expected:
        fault = f"the columns are not r0c0..{last[0]}, row after row"
        raise SourceError(f"{lines.where}: {fault}")
    return _stated(skin, lines.name, (n_rows, n_cols)), columns, (n_rows, n_cols)


def _stamp(token: str, where: str) -> int:
    if not (token.isascii() and token.isdigit() and len(token) <= 19 and int(token) <= INT64_MAX):
        raise SourceError(f"{where}: stamp_ns is {shown(token)}; expected nanoseconds")
    return int(token)


def _stated(skin: dict[str, Any], name: str, shape: tuple[int, int]) -> dict[str, npt.NDArray[Any]]:
    """What a file states of its skin; a property that is not as written by an export is none."""
    found: dict[str, npt.NDArray[Any]] = {}
    for key in ("rate_hz", "pitch_m", "f_max"):
        if is_real(skin.get(key), 1e-9, 1e30):
            found[key] = np.array(float(skin[key]))
    if isinstance(skin.get("unit"), str) and skin["unit"]:
        found["unit"] = np.array(skin["unit"])
    if (rows := skin.get("mask")) is not None:
        found["mask"] = parse_mask(rows, shape, f"{name}, line 2: mask")
    return found
