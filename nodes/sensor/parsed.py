"""What every file format is parsed into, and the checks that text formats share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE
from sparseskin.nodes.errors import SourceError

from .source import Mask

MAX_READING = 1e30
"""Largest reading: float32 holds it, and the sum of a whole frame of it."""


@dataclass(frozen=True, eq=False)
class Parsed:
    """A recording as its file states it, before range, crop and rate are settled.

    Attributes
    ----------
    forces : ndarray of a real number, shape (n_frames, n_rows, n_cols)
        Readings in `unit`, each >= 0 and finite wherever a taxel exists.
    unit : str or None
        Unit that the file states; None where it states none.
    rate_hz : float or None
        Frame rate that the file states.
    stamp_ns : tuple of int or None
        Time of each frame since the first, in nanoseconds, strictly increasing; None where the
        file gives no times of its own.
    pitch_m : float or None
        Distance between neighbouring taxels in metres.
    mask : ndarray of bool, shape (n_rows, n_cols), or None
        True where a taxel exists.
    f_max : float or None
        Range that the file states, in `unit`.
    """

    forces: npt.NDArray[Any]
    unit: str | None = None
    rate_hz: float | None = None
    stamp_ns: tuple[int, ...] | None = None
    pitch_m: float | None = None
    mask: Mask | None = None
    f_max: float | None = None


def shown(text: object, limit: int = 40) -> str:
    """Quote what a file held so that it fits in one line of an error, whatever its bytes."""
    quoted = ascii(str(text))
    return quoted if len(quoted) <= limit else quoted[: limit - 4] + "...'"


def read_bytes(name: str) -> bytes:
    """Read a whole file.

    Raises
    ------
    SourceError
        If it is missing, no regular file, not readable, larger than memory or empty.
    """
    path = Path(name)
    try:
        if path.is_dir():
            raise SourceError(f"{name}: is a directory; name one file in it")
        if not path.exists():
            raise SourceError(f"{name}: there is no such file")
        if not path.is_file():
            raise SourceError(f"{name}: is no regular file")
        raw = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise SourceError(f"{shown(name, 200)}: cannot be read ({reason or error})") from error
    except MemoryError:
        raise SourceError(f"{name}: does not fit in memory") from None
    if not raw:
        raise SourceError(f"{name}: the file is empty")
    return raw


def check_readings(forces: npt.NDArray[Any], name: str) -> None:
    """Refuse what is no reading, naming the first such frame and cell (from 0).

    Parameters
    ----------
    forces : ndarray of a real number, shape (n_frames, n_rows, n_cols)
        Readings; 0 in masked cells.

    Raises
    ------
    SourceError
        If a reading is not finite, below 0 or above 1e30.
    """
    with np.errstate(all="ignore"):
        values = forces.astype(np.float64)
    for what, bad in (
        ("is not finite", ~np.isfinite(values)),
        ("is below 0; a range starts at 0", values < 0),
        (f"is above {MAX_READING:g}", values > MAX_READING),
    ):
        if bad.any():
            frame, row, col = np.argwhere(bad)[0]
            value = values[frame, row, col]
            raise SourceError(f"{name}: frame {frame}, row {row}, column {col}: {value:g} {what}")


def text_lines(raw: bytes) -> list[str]:
    """Split a text file into lines numbered as an editor numbers them.

    Latin-1 maps every byte to a character, so no byte can fail to decode; the formats here are
    ASCII but for a superscript two. `str.splitlines` would also split at form feeds.
    """
    lines = raw.removeprefix(b"\xef\xbb\xbf").decode("latin-1").split("\n")
    return [line.removesuffix("\r") for line in lines]


def parse_number(token: str, where: str) -> float:
    """Read one number of a file.

    Parameters
    ----------
    token : str
        The number as the file has it.
    where : str
        Place for the error, e.g. "foot.lst, line 12".

    Raises
    ------
    SourceError
        If it is not a plain decimal number, or not finite.
    """
    try:
        # float() would read the Python literal 1_0 as ten.
        value = math.nan if "_" in token else float(token)
    except ValueError:
        raise SourceError(f"{where}: {shown(token)} is not a number") from None
    if not math.isfinite(value):
        raise SourceError(f"{where}: {shown(token)} is not a finite number")
    return value


def parse_reading(token: str, where: str, row: int, col: int) -> float:
    """Read one taxel's reading; `row` and `col` (from 0) name the cell in the error.

    Raises
    ------
    SourceError
        If it is not a number, not finite, below 0 or above 1e30.
    """
    value = parse_number(token, f"{where}, row {row}, column {col}")
    if value < 0:
        raise SourceError(
            f"{where}, row {row}, column {col}: {shown(token)} is below 0; a range starts at 0"
        )
    if value > MAX_READING:
        raise SourceError(
            f"{where}, row {row}, column {col}: {shown(token)} is above {MAX_READING:g}"
        )
    return value


def parse_whole(token: str, where: str, low: int, high: int) -> int:
    """Read a whole number in [low, high].

    Raises
    ------
    SourceError
        If it is none, or out of that range.
    """
    # Nine digits hold every count of rows or frames; int() of a million digits would not end.
    if not (token.isascii() and token.isdigit() and len(token) <= 9):
        raise SourceError(f"{where}: {shown(token)} is not a whole number in {low}..{high}")
    value = int(token)
    if not low <= value <= high:
        raise SourceError(f"{where}: {value} is outside {low}..{high}")
    return value


def check_grid(n_rows: int, n_cols: int, where: str) -> None:
    """Refuse a grid of taxels that no message could carry.

    Raises
    ------
    SourceError
        If a side is outside 1..4096 or the grid has more than 2**20 cells.
    """
    if not (1 <= n_rows <= MAX_SIDE and 1 <= n_cols <= MAX_SIDE):
        raise SourceError(
            f"{where}: {n_rows} rows x {n_cols} columns; allowed are 1..{MAX_SIDE} of each"
        )
    if n_rows * n_cols > MAX_ELEMENTS:
        raise SourceError(
            f"{where}: {n_rows} x {n_cols} = {n_rows * n_cols} cells; at most {MAX_ELEMENTS}"
        )


def stack_frames(frames: list[npt.NDArray[Any]], where: str) -> npt.NDArray[np.float64]:
    """Stack frames of equal shape into (n_frames, n_rows, n_cols).

    Raises
    ------
    SourceError
        If there are none, or they do not fit in memory.
    """
    if not frames:
        raise SourceError(f"{where}: the recording holds no frame")
    try:
        return np.stack(frames).astype(np.float64, copy=False)
    except MemoryError:
        raise SourceError(f"{where}: {len(frames)} frames do not fit in memory") from None
