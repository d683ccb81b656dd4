"""Words and checks that files, boards, drivers and files of skins share.

In all of them `where` names the place in an error, e.g. "foot.lst, line 12".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np

from sparseskin.messages.ranges import is_real
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Mask

from .layout import UnstatedError

MAX_READING = float(np.float32(1e30))
"""Largest reading, chosen: float32 holds it, and the sum of a frame of such readings."""
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "inf", "+inf", "-inf"})
"""Cells of a .csv that hold no finite number."""
COUNTS = "counts"
"""Unit of whole numbers that have none: readings of a converter, which a calibration converts."""
ADD = "; add "
"""What stands in an error before the settings that are missing, as KEY=VALUE, in examples."""
NAN_HINT = "state nan=hold, zero or mask, or missing"
MAX_EXAMPLES = 8
"""Most candidates that an error lists."""


def shown(text: object, limit: int = 40) -> str:
    """Quote any content of a file so that it fits in one line of an error."""
    quoted = ascii(str(text))
    if len(quoted) <= limit:
        return quoted
    return quoted[: limit - 4] + "...'"


def spelled(text: str, option: Callable[[str], str]) -> str:
    """An error whose missing settings, KEY=VALUE behind `ADD`, are spelled as options."""
    # Behind ADD alone: in the fault KEY=VALUE may be a content of the file.
    fault, add, settings = text.partition(ADD)
    options = re.sub(r"(?<!\S)([a-z_]+)=", lambda match: option(match[1]), settings)
    return fault + add + options


def choose(
    candidates: Mapping[str, str], stated: str, name: str, what: str, key: str = "topic"
) -> str:
    """The key of one of several things in a file, each with a few words on it: the stated one, or
    the only one. Raises SourceError if there is none, UnstatedError if there are several; `key` is
    the setting that states it.
    """
    if stated in candidates:
        return stated
    # A bag may have hundreds of topics; an error is one line.
    examples = islice(candidates.items(), MAX_EXAMPLES)
    texts = ", ".join(
        f"{printable(candidate)} ({about})" for candidate, about in examples
    )
    if stated:
        raise SourceError(
            f"{name}: holds no {key} {shown(stated)}; allowed: {texts or 'none'}"
        )
    if not candidates:
        raise SourceError(f"{name}: holds no {what}")
    if len(candidates) > 1:
        options = [{key: candidate} for candidate in candidates]
        fault = f"holds {len(candidates)} {what}, which is not stated: {texts}"
        raise UnstatedError(f"{name}: {fault}; state {key}", *options)
    return next(iter(candidates))


@contextmanager
def reading(name: str) -> Iterator[IO[bytes]]:
    """Open a file that is read within the context. Raises SourceError if it is missing, no regular
    file, not readable, larger than memory or empty.
    """
    path = Path(name)
    try:
        # Each in words of its own: what open() says of a directory is no help.
        if path.is_dir():
            raise SourceError(f"{name}: is a directory; name one file in it")
        if not path.exists():
            raise SourceError(f"{name}: no such file")
        if not path.is_file():
            raise SourceError(f"{name}: is no regular file")
        if not path.stat().st_size:
            raise SourceError(f"{name}: the file is empty")
        with path.open("rb") as file:
            yield file
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SourceError(f"{shown(name, 200)}: cannot be read ({reason})") from error
    except MemoryError:
        raise SourceError(f"{name}: does not fit in memory") from None


def unreadable(name: str, error: Exception) -> SourceError:
    """The error of a file that a library refuses, in one line."""
    text = " ".join(str(error).split())[:200] or type(error).__name__
    return SourceError(f"{name}: cannot be read ({text})")


def parse_number(
    token: str, where: str, low: float = -math.inf, high: float = math.inf
) -> float:
    """Read a decimal number; SourceError if it is none, not finite or outside [low, high]."""
    try:
        # float() would read the Python literal 1_0 as ten.
        value = math.nan if "_" in token else float(token)
    except ValueError:
        raise SourceError(f"{where}: {shown(token)} is not a number") from None
    if not math.isfinite(value):
        raise SourceError(f"{where}: {shown(token)} is not a finite number")
    if not low <= value <= high:
        raise SourceError(f"{where}: {shown(token)} is outside {low:g}..{high:g}")
    return value


def is_missing(token: str) -> bool:
    """True if a cell is empty or a name of what is no finite number."""
    return token.strip().lower() in _MISSING


def parse_whole(token: str, where: str, low: int, high: int) -> int:
    """Read a whole number; SourceError if it is none, or outside [low, high]."""
    # Nine digits hold every count of rows or frames; int() of a million digits would not end.
    if not (token.isascii() and token.isdigit() and len(token) <= 9):
        raise SourceError(
            f"{where}: {shown(token)} is not a whole number in {low}..{high}"
        )
    value = int(token)
    if not low <= value <= high:
        raise SourceError(f"{where}: {value} is outside {low}..{high}")
    return value


def parse_mask(rows: Any, shape: tuple[int, int], where: str) -> Mask:
    """Read a mask, a text a row of 1 (a taxel) and 0 (none); SourceError if it is none of that
    shape.
    """
    n_rows, n_cols = shape

    # Texts, not numbers: a mask in a file is seen as a picture.
    row_of = re.compile(f"[01]{{{n_cols}}}")
    texts = isinstance(rows, list) and all(isinstance(row, str) for row in rows)
    if not (texts and len(rows) == n_rows and all(map(row_of.fullmatch, rows))):
        raise SourceError(
            f"{where}: expected {n_rows} texts of {n_cols} characters 0 and 1"
        )
    return np.array([[cell == "1" for cell in row] for row in rows], dtype=np.bool_)


def check_number(where: str, what: str, value: Any, high: float = MAX_READING) -> None:
    """Raise SourceError unless a stated value is None or a number in [1e-9, high]."""
    if value is not None and not is_real(value, 1e-9, high):
        expected = f"expected a number in 1e-09..{high:g}"
        raise SourceError(f"{where}: {what} = {shown(value)}; {expected}")


def check_unit(where: str, unit: object) -> None:
    """Raise SourceError unless a unit is None or a free text of 1 to 32 printable characters."""
    is_text = (
        isinstance(unit, str)
        and unit.strip()
        and unit.isprintable()
        and len(unit) <= 32
    )
    if unit is not None and not is_text:
        place = f"{where}: unit = {shown(unit)}"
        raise SourceError(
            f"{place}; expected 1 to 32 printable characters, as N or kPa"
        )
