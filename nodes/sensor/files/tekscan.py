"""Tekscan sensors: the ASCII movie export (.csv, .asf), in its own unit."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles, Mask

from .parsed import (
    Parsed,
    check_grid,
    parse_number,
    parse_reading,
    parse_whole,
    shown,
    stack_frames,
    text_lines,
)

_FRAME = re.compile(r"Frame\s+(\d+)\s*(?:,\s*([^,]*))?")
_RAW_SUM = re.compile(r"Raw Sum=[\s,]*([^,\s]+)")
_METRES = {
    "mm": 1e-3,
    "millimeters": 1e-3,
    "cm": 1e-2,
    "centimeters": 1e-2,
    "m": 1.0,
    "meters": 1.0,
    "in": 0.0254,
    "inches": 0.0254,
}
_N_HEADER_LINES = 100
"""Lines searched for the end of the header, which has some 30 of them."""

Header = dict[str, tuple[str, str]]
"""From a keyword to its value and its place in the file, "FILE, line N, KEYWORD"."""


def is_tekscan(raw: bytes) -> bool:
    """True if the content has the keywords of a Tekscan header."""
    head = raw[: 1 << 16].split(b"\n", _N_HEADER_LINES)[:_N_HEADER_LINES]
    return any(line.lstrip().startswith((b"DATA_TYPE", b"ASCII_DATA")) for line in head)


def parse_tekscan(raw: bytes, name: str) -> Parsed:
    """Read a Tekscan ASCII movie export.

    `B` marks a cell of the grid without a sensel: it is masked, and its value is 0. Raw counts
    are compared with the `Raw Sum` of each frame. The times of the frames are used where all
    differ; they are printed to 0.01 s, so for fast recordings `SECONDS_PER_FRAME` counts.

    Parameters
    ----------
    raw : bytes
        Content of the file.
    name : str
        Name of the file, for errors.

    Returns
    -------
    Parsed
        `forces` float64, shape (n_frames, ROWS, COLS), in the file's UNITS.

    Raises
    ------
    SourceError
        If a header or frame is missing, cut short or malformed, a reading is not a finite
        number >= 0, the mask changes, or a raw sum is not the sum of its frame.
    """
    lines = text_lines(raw)
    header, start, terminator = _parse_header(lines, name)
    n_rows, n_cols = _shape(header, name)
    unit, _ = _entry(header, "UNITS", name)
    first, last = (
        parse_whole(*header[keyword], 0, 999_999_999) if keyword in header else None
        for keyword in ("START_FRAME", "END_FRAME")
    )
    period_s = None
    if "SECONDS_PER_FRAME" in header:
        period_s = parse_number(*header["SECONDS_PER_FRAME"], 1e-9, 1e6)

    frames: list[Doubles] = []
    times: list[float | None] = []
    mask: Mask | None = None
    number = -1
    index = start
    ended = False
    while index < len(lines):
        line = lines[index].strip(", \t")
        where = f"{name}, line {index + 1}"
        index += 1
        if not line:
            continue
        if ended:
            raise SourceError(f"{where}: {shown(line)} comes after the end mark '{terminator}'")
        if terminator and line == terminator:
            ended = True
            continue
        match = _FRAME.match(line)
        if match is None:
            raise SourceError(f"{where}: {shown(line)} stands where 'Frame N' should")
        number = parse_whole(match[1], where, 0, 999_999_999)
        wanted = number if first is None and not frames else (first or 0) + len(frames)
        if number != wanted:
            raise SourceError(f"{where}: frame {number} comes where frame {wanted} should")
        first = number - len(frames)
        frame, exists = _parse_frame(lines, index, (n_rows, n_cols), f"frame {number}", name)
        index += n_rows
        if mask is None:
            mask = exists
        elif not np.array_equal(mask, exists):
            row, col = np.argwhere(mask != exists)[0]
            raise SourceError(
                f"{where}: frame {number} has its 'B' cells (no sensel) elsewhere than the first "
                f"frame, e.g. at row {row}, column {col}; a mask must not change"
            )
        if unit.lower() == "raw":
            _check_raw_sum(line, float(frame.sum()), where, number)
        times.append(parse_number(match[2], where) if (match[2] or "").strip() else None)
        frames.append(frame)
    if terminator and not ended:
        raise SourceError(f"{name}: the file is cut short, its end mark '{terminator}' is missing")
    if frames and last is not None and number != last:
        raise SourceError(f"{name}: the last frame is {number}, but END_FRAME is {last}")
    return Parsed(
        forces=stack_frames(frames, name),
        unit=unit,
        rate_hz=None if period_s is None else 1.0 / period_s,
        stamp_ns=_stamps(times, name),
        pitch_m=_pitch(header),
        mask=None if mask is None or mask.all() else mask,
    )


def tekscan_shape(raw: bytes, name: str) -> tuple[int, int, int | None]:
    """Rows, columns and number of sensels of a recording, from the begin of its file; None where
    the first frame is not complete there.

    Raises
    ------
    SourceError
        If the header or the first frame is malformed.
    """
    lines = text_lines(raw)[:-1]  # the last one may be cut
    header, start, _ = _parse_header(lines, name)
    shape = _shape(header, name)
    frames = (k for k in range(start, len(lines)) if _FRAME.match(lines[k].strip(", \t")))
    first = next(frames, None)
    if first is None or first + 1 + shape[0] > len(lines):
        return *shape, None
    _, exists = _parse_frame(lines, first + 1, shape, "the first frame", name)
    return *shape, int(exists.sum())


def _shape(header: Header, name: str) -> tuple[int, int]:
    n_rows = parse_whole(*_entry(header, "ROWS", name), 1, MAX_SIDE)
    n_cols = parse_whole(*_entry(header, "COLS", name), 1, MAX_SIDE)
    check_grid(n_rows, n_cols, name)
    return n_rows, n_cols


def _parse_header(lines: list[str], name: str) -> tuple[Header, int, str]:
    """Return the keywords, the index of the first line after them and the end mark ("": none)."""
    header: Header = {}
    for index, line in enumerate(lines[:_N_HEADER_LINES]):
        # A spreadsheet that saved the file again filled each line up with commas.
        keyword, _, value = line.strip(", \t").partition(" ")
        header[keyword] = (value.strip(", \t"), f"{name}, line {index + 1}, {keyword}")
        if keyword == "DATA_TYPE" and header[keyword][0] != "MOVIE":
            raise SourceError(
                f"{name}, line {index + 1}: DATA_TYPE {shown(header[keyword][0])}; "
                "allowed is MOVIE (export the whole recording)"
            )
        if keyword == "ASCII_DATA":
            return header, index + 1, header[keyword][0]
    raise SourceError(f"{name}: no line ASCII_DATA; not a Tekscan ASCII movie export")


def _entry(header: Header, keyword: str, name: str) -> tuple[str, str]:
    if not header.get(keyword, ("", ""))[0]:
        raise SourceError(f"{name}: the header states no {keyword}")
    return header[keyword]


def _pitch(header: Header) -> float | None:
    """Return the distance between sensels in m, or None if not stated, or not one for both axes."""
    pitches = []
    for keyword in ("ROW_SPACING", "COL_SPACING"):
        if keyword not in header:
            return None
        text, where = header[keyword]
        value, _, unit = text.partition(" ")
        metres = _METRES.get(unit.strip().lower())
        if metres is None:
            raise SourceError(f"{where}: unit {shown(unit)}; allowed are {', '.join(_METRES)}")
        pitches.append(parse_number(value, where) * metres)
        if not 1e-6 <= pitches[-1] <= 10:
            raise SourceError(f"{where}: {shown(text)} is outside 0.001 mm..10 m")
    return pitches[0] if pitches[0] == pitches[1] else None


def _parse_frame(
    lines: list[str], start: int, shape: tuple[int, int], label: str, name: str
) -> tuple[Doubles, Mask]:
    """Return the readings of one frame and the mask of existing sensels, both of `shape`."""
    n_rows, n_cols = shape
    if start + n_rows > len(lines):
        raise SourceError(
            f"{name}, line {len(lines)}: the file ends in {label}, which needs {n_rows} rows"
        )
    frame = np.zeros(shape)
    exists = np.ones(shape, dtype=np.bool_)
    for row in range(n_rows):
        where = f"{name}, line {start + row + 1}, {label}"
        cells = [cell.strip() for cell in lines[start + row].split(",")]
        while len(cells) > n_cols and not cells[-1]:
            cells.pop()
        if len(cells) != n_cols:
            raise SourceError(f"{where}: row {row} has {len(cells)} cells, COLS is {n_cols}")
        for col, token in enumerate(cells):
            if token in ("B", "b"):
                exists[row, col] = False
            else:
                frame[row, col] = parse_reading(token, where, row, col)
    return frame, exists


def _check_raw_sum(line: str, total: float, where: str, number: int) -> None:
    match = _RAW_SUM.search(line)
    if match is None:
        return
    stated = parse_number(match[1], where)
    if abs(stated - total) > 0.5:
        raise SourceError(
            f"{where}: frame {number} states Raw Sum {stated:g}, but its cells add up to {total:g}"
        )


def _stamps(times: list[float | None], name: str) -> tuple[int, ...] | None:
    """Return nanoseconds since the first frame, or None if times are missing or repeated."""
    known = [time for time in times if time is not None]
    if not known or len(known) != len(times):
        return None
    if not all(abs(time) <= 1e9 for time in known):
        raise SourceError(f"{name}: frame times lie outside 0..1e9 s")
    stamps = tuple(round((time - known[0]) * 1e9) for time in known)
    steps = [after - before for before, after in pairwise(stamps)]
    if any(step < 0 for step in steps):
        raise SourceError(
            f"{name}: the time of frame {next(i for i, s in enumerate(steps) if s < 0) + 2} "
            "(counted from 1) is before that of the frame before it"
        )
    return None if 0 in steps else stamps
