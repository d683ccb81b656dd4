"""The result of parsing a recording, and the checks that file formats and drivers share."""

from __future__ import annotations

import math
import re
import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE
from sparseskin.messages.ranges import is_real
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.numerics.arrays import Doubles, Mask

MAX_READING = float(np.float32(1e30))
"""Largest reading, chosen: float32 holds it, and the sum of a frame of such readings."""
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "inf", "+inf", "-inf"})
"""Cells of a .csv that hold no finite number."""
COUNTS = "counts"
"""Unit of whole numbers that have none: readings of a converter, which a calibration converts."""
ADD = "; add "
"""What stands in an error before the settings that are missing, as KEY=VALUE, in examples."""
NAN_HINT = f"{ADD}nan=hold, or zero or mask"
NEGATIVE_HINT = f"{ADD}negative=zero, or mask (offset raises every force until the lowest is 0)"
MAX_LINE_BYTES = 1 << 26
"""Longest line of a text file; chosen: a line of 2**20 readings has 20 MB."""
REFUSE, ZERO, HOLD, OFFSET, MASK = "refuse", "zero", "hold", "offset", "mask"
NAN_WAYS = (REFUSE, ZERO, HOLD, MASK)
"""Readings that are NaN or infinite: refused; or, as `MissingReadings`, they become 0, the last
reading of their taxel (0 before the first), or the mean of its neighbours, where the taxels without
any reading are masked."""
FILLED = {
    ZERO: "set to 0",
    HOLD: "replaced by the last ones",
    MASK: "replaced by the mean of their neighbours",
}
"""What is done with missing readings, for the log."""
NEGATIVE_WAYS = (REFUSE, ZERO, OFFSET, MASK)
"""Readings below 0: the file is refused; they become 0; the lowest reading is subtracted from all;
or their taxels are masked."""


READ_AS = ("n_rows", "n_cols", "unit", "f_max", "rate_hz", "columns", "topic", "nan", "negative")
"""What may be stated of a file: arguments of `open_file`, and the ways of its `Policy`."""


@dataclass(frozen=True)
class Policy:
    """Ways to treat invalid readings, one of `NAN_WAYS` and one of `NEGATIVE_WAYS`. `raw`: a
    calibration converts the readings, which are of any unit, and below 0 where that is refused.
    """

    nan: str = REFUSE
    negative: str = REFUSE
    raw: bool = False

    def __post_init__(self) -> None:
        for name, ways in (("nan", NAN_WAYS), ("negative", NEGATIVE_WAYS)):
            if (way := getattr(self, name)) not in ways:
                raise SourceError(f"{name}: {shown(way)} is not known{nearest_of(str(way), ways)}")

    @property
    def masks(self) -> bool:
        """True if the readings decide which cells are taxels."""
        return MASK in (self.nan, self.negative)


DEFAULT_POLICY = Policy()


@dataclass(frozen=True, eq=False)
class Parsed:
    """A recording as its file states it; None where the file does not state a property."""

    #: Real numbers of shape (n_frames, n_rows, n_cols), or (n_frames, n_cells), row after row,
    #: where their shape is not stated; each >= 0 and finite wherever a taxel exists.
    forces: npt.NDArray[Any]
    unit: str | None = None
    rate_hz: float | None = None
    stamp_ns: tuple[int, ...] | None = None  # of each frame since the first, strictly increasing
    pitch_m: float | None = None  # between neighbouring taxels
    mask: Mask | None = None  # (n_rows, n_cols), True where a taxel exists
    f_max: float | None = None  # upper end of the range, in `unit`
    points: npt.NDArray[Any] | None = None  # float32 (n_taxels, 6): places, m, and unit normals
    point_rows: npt.NDArray[Any] | None = None  # int32 (n_taxels,): their rows in a file of points
    notes: tuple[str, ...] = ()  # for the log: what was taken, where the file can be read otherwise


class Head(NamedTuple):
    """What the begin of a recording states: shape of a frame, (n_rows, n_cols), or (n_cells,) where
    it is not stated; the number of taxels, None where later frames decide which cells are taxels;
    its unit, None where there is none; True if it has a rate or stamps.
    """

    shape: tuple[int, ...]
    n_taxels: int | None
    unit: str | None = None
    is_timed: bool = True


class Recording(ABC):
    """An open file of a recording. Each method is called once, `head` first if at all."""

    def head(self) -> Head:
        """Read the begin of the file, or all of it; SourceError if it is malformed."""
        found = self.read()
        shape, mask = found.forces.shape[1:], found.mask
        timed = found.rate_hz is not None or found.stamp_ns is not None
        n_taxels = math.prod(shape) if mask is None else int(mask.sum())
        return Head(shape, n_taxels, found.unit, timed)

    @abstractmethod
    def read(self) -> Parsed:
        """Read the whole recording; SourceError if anything in it is malformed."""


def shown(text: object, limit: int = 40) -> str:
    """Quote any content of a file so that it fits in one line of an error."""
    quoted = ascii(str(text))
    return quoted if len(quoted) <= limit else quoted[: limit - 4] + "...'"


def spelled(text: str, option: Callable[[str], str]) -> str:
    """An error whose missing settings, KEY=VALUE behind `ADD`, are spelled as options."""
    what, add, settings = text.partition(ADD)
    return what + add + re.sub(r"(?<!\S)([a-z_]+)=", lambda found: option(found[1]), settings)


def choose(
    found: Mapping[str, str],
    stated: str | None,
    name: str,
    what: str,
    key: str = "topic",
    more: str = "",
) -> str:
    """The key of one of several things in a file, each with a few words on it: the stated one, or
    the only one. Raises SourceError if there is none, or not one; `key` is the setting, `more` what
    else is missing.
    """
    listed = ", ".join(f"{printable(key)} ({about})" for key, about in [*found.items()][:8])
    if len(found) == 1 and stated is None:
        return next(iter(found))
    if stated in found:
        return str(stated)
    if not found:
        raise SourceError(f"{name}: holds no {what}")
    if stated is not None:
        raise SourceError(f"{name}: holds no {key} {shown(stated)}; allowed: {listed}")
    first = shlex.quote(printable(next(iter(found))))
    raise SourceError(f"{name}: holds {len(found)} {what}: {listed}{ADD}{key}={first}{more}")


def rising(stamps: Sequence[int], name: str) -> tuple[int, ...] | None:
    """Stamps since the first; None if some are repeated. SourceError if they fall."""
    for k, (before, stamp) in enumerate(pairwise(stamps), start=2):
        if stamp < before:
            raise SourceError(f"{name}: the time of frame {k} is before that of the one before it")
    return tuple(s - stamps[0] for s in stamps) if len(set(stamps)) == len(stamps) else None


def shape_text(n_cells: int) -> str:
    """Settings of a shape of so many cells, the most square one."""
    n_rows = max(k for k in range(1, math.isqrt(n_cells) + 1) if n_cells % k == 0)
    return f"n_rows={n_rows} n_cols={n_cells // n_rows}"


@contextmanager
def reading(name: str) -> Iterator[IO[bytes]]:
    """Open a file that is read within the context. Raises SourceError if it is missing, no regular
    file, not readable, larger than memory or empty.
    """
    path = Path(name)
    try:
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
        reason = error.strerror if isinstance(error, OSError) else None
        raise SourceError(f"{shown(name, 200)}: cannot be read ({reason or error})") from error
    except MemoryError:
        raise SourceError(f"{name}: does not fit in memory") from None


def unreadable(name: str, error: Exception) -> SourceError:
    """The error of a file that a library refuses, in one line."""
    text = " ".join(str(error).split())[:200] or type(error).__name__
    return SourceError(f"{name}: cannot be read ({text})")


@dataclass(frozen=True)
class File:
    """An open file of a recording, the names of those that go on with it, and what is stated of it:
    `columns` of a table, as in `TableRecording`, or the field of a point cloud; `topic` of a
    recording, or name of an array.
    """

    file: IO[bytes]
    name: str
    parts: tuple[str, ...] = ()
    n_rows: int | None = None
    n_cols: int | None = None
    columns: str | None = None
    topic: str | None = None
    policy: Policy = DEFAULT_POLICY

    @property
    def lines(self) -> Lines:
        """Its lines, for formats of text."""
        return Lines(self.file, self.name)


class Lines(Iterator[str]):
    """The lines of a text file, read one after the other, without their ends. Latin-1 decodes every
    byte; the formats here are ASCII except for a superscript two.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        #: Number of the line that was read last, from 1, as in an editor.
        self.number = 0
        self._file, self.name = file, name
        self._line, self._again = "", False

    @property
    def where(self) -> str:
        """Place of the line that was read last, for errors."""
        return f"{self.name}, line {self.number}"

    def __next__(self) -> str:
        if not self._again:
            raw = self._file.readline(MAX_LINE_BYTES)
            if not raw:
                raise StopIteration
            text = raw.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
            self._line = text.removesuffix("\n").removesuffix("\r")
            if len(raw) == MAX_LINE_BYTES:
                raise SourceError(f"{self.where}: is followed by one of {len(raw)} bytes or more")
        self._again = False
        self.number += 1
        return self._line

    def back(self) -> None:
        """Let the line that was read last be read once more."""
        self._again, self.number = True, self.number - 1


# In all that follows `where` names the place in an error, e.g. "foot.lst, line 12".


def parse_number(token: str, where: str, low: float = -math.inf, high: float = math.inf) -> float:
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
        raise SourceError(f"{where}: {shown(token)} is not a whole number in {low}..{high}")
    value = int(token)
    if not low <= value <= high:
        raise SourceError(f"{where}: {value} is outside {low}..{high}")
    return value


def parse_mask(rows: Any, shape: tuple[int, int], where: str) -> Mask:
    """Read a mask, a text a row of 1 (a taxel) and 0 (none); SourceError if it is none of that
    shape.
    """
    n_rows, n_cols = shape
    row_of = re.compile(f"[01]{{{n_cols}}}")
    texts = isinstance(rows, list) and all(isinstance(row, str) for row in rows)
    if not (texts and len(rows) == n_rows and all(map(row_of.fullmatch, rows))):
        raise SourceError(f"{where}: expected {n_rows} texts of {n_cols} characters 0 and 1")
    return np.array([[cell == "1" for cell in row] for row in rows], dtype=np.bool_)


def check_number(where: str, what: str, value: Any, high: float = MAX_READING) -> None:
    """Raise SourceError unless a stated value is None or a number in [1e-9, high]."""
    if value is not None and not is_real(value, 1e-9, high):
        expected = f"expected a number in 1e-09..{high:g}"
        raise SourceError(f"{where}: {what} = {shown(value)}; {expected}")


def check_unit(where: str, unit: object) -> None:
    """Raise SourceError unless a unit is None or a free text of 1 to 32 printable characters."""
    is_text = isinstance(unit, str) and unit.strip() and unit.isprintable() and len(unit) <= 32
    if unit is not None and not is_text:
        place = f"{where}: unit = {shown(unit)}"
        raise SourceError(f"{place}; expected 1 to 32 printable characters, as N or kPa")


def check_grid(n_rows: int, n_cols: int, where: str) -> None:
    """Raise SourceError unless both sides are in 1..4096 and the cells at most 2**20."""
    n = n_rows * n_cols
    if not (1 <= n_rows <= MAX_SIDE and 1 <= n_cols <= MAX_SIDE):
        sides = f"{n_rows} rows x {n_cols} columns"
        raise SourceError(f"{where}: {sides}; allowed are 1..{MAX_SIDE} of each")
    if n > MAX_ELEMENTS:
        raise SourceError(f"{where}: {n_rows} x {n_cols} = {n} cells; at most {MAX_ELEMENTS}")


def check_stated_shape(
    rows: int, cols: int, n_rows: int | None, n_cols: int | None, where: str
) -> None:
    """Raise SourceError if a stated side, `n_rows` or `n_cols`, is not that of the frames."""
    for what, stated, actual in (("n_rows", n_rows, rows), ("n_cols", n_cols, cols)):
        if stated is not None and stated != actual:
            raise SourceError(f"{where}: {what} = {stated} is stated, but the frames have {actual}")


def check_readings(
    forces: npt.NDArray[Any], where: str, low: float = 0.0, nan: bool = False
) -> None:
    """Raise SourceError, with frame and cell from 0, unless all readings (n_frames, n_rows, n_cols)
    are finite and in [low, 1e30], or NaN where `nan` allows it; 0 in masked cells.
    """
    below = f"is below {low:g}" if low else f"is below 0; a range starts at 0{NEGATIVE_HINT}"
    # A part at a time: a recording of bytes would become eight times as large.
    step = max(1, MAX_ELEMENTS // forces[0].size)
    for first in range(0, len(forces), step):
        with np.errstate(all="ignore"):
            values = forces[first : first + step].astype(np.float64)
        if values.min() >= low and values.max() <= MAX_READING:  # False for a NaN
            continue
        for what, bad in (
            (f"is not finite{NAN_HINT}", ~np.isfinite(values) & (not nan)),
            (below, values < low),
            (f"is above {MAX_READING:g}", values > MAX_READING),
        ):
            for frame, row, col in np.argwhere(bad)[:1]:
                place = f"{where}: frame {first + frame}, row {row}, column {col}"
                raise SourceError(f"{place}: {values[frame, row, col]:.9g} {what}")


def stack_frames(frames: list[npt.NDArray[Any]], where: str) -> Doubles:
    """Stack frames into float64 (n_frames, n_rows, n_cols); SourceError if none, or too many."""
    if not frames:
        raise SourceError(f"{where}: the recording holds no frame")
    try:
        return np.stack(frames).astype(np.float64, copy=False)
    except MemoryError:
        raise SourceError(f"{where}: {len(frames)} frames do not fit in memory") from None
