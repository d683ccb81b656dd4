"""The result of parsing a recording, and the checks that file formats and drivers share."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.ranges import is_real
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Doubles, Mask
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.layout import (
    EMPTY,
    HOLD,
    MASK,
    ZERO,
    Layout,
    UnstatedError,
)
from sparseskin.nodes.sensor.layout.tally import Tally

MAX_READING = float(np.float32(1e30))
"""Largest reading, chosen: float32 holds it, and the sum of a frame of such readings."""
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "inf", "+inf", "-inf"})
"""Cells of a .csv that hold no finite number."""
COUNTS = "counts"
"""Unit of whole numbers that have none: readings of a converter, which a calibration converts."""
ADD = "; add "
"""What stands in an error before the settings that are missing, as KEY=VALUE, in examples."""
NAN_HINT = "state nan=hold, zero or mask, or missing"
MAX_LINE_BYTES = 1 << 26
"""Longest line of a text file; chosen: a line of 2**20 readings has 20 MB."""
FILLED = {
    ZERO: "set to 0",
    HOLD: "replaced by the last ones",
    MASK: "replaced by the mean of their neighbours",
}
"""What is done with missing readings, for the log."""
BLOCK_NUMBERS = 1 << 20
"""Numbers of a block, about; chosen: 8 MB, so that memory does not grow with the file."""
MAX_EXAMPLES = 8
"""Most candidates that an error lists."""


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


@dataclass(frozen=True, eq=False)
class Head:
    """What the begin of a recording states; None, "" or () where it states nothing.

    An item is a line, a message, a frame of an array. `axes` are those of the numbers of one item;
    of a single axis, `usable` are the entries that hold numbers and are no times.
    """

    axes: tuple[Axis, ...]
    usable: tuple[int, ...] | None = None
    is_timed: bool = False  # `Block.times` are known
    time_unit: str = ""  # of `times.NS`
    time_name: str = ""  # as the file calls it
    unit: str | None = None
    asks_unit: bool = False  # the readings may be of any unit: it has to be stated
    rate_hz: float | None = None
    f_max: float | None = None  # upper end of the range, in `unit`
    pitch_m: float | None = None  # between neighbouring taxels
    mask: Mask | None = None  # (n_rows, n_cols), True where a taxel exists
    points: npt.NDArray[Any] | None = None  # float32 (n_taxels, 6): places, m, and unit normals
    point_rows: npt.NDArray[Any] | None = None  # int32 (n_taxels,): their rows in a file of points
    n_items: int | None = None  # None: the end of the file shows it
    notes: tuple[str, ...] = ()  # for the log: what was taken, where it can be read otherwise


class Block(NamedTuple):
    """Items in a row: their numbers (k, *sizes of the axes), of any real dtype, NaN where the file
    holds no number; and k times in the unit of the head, whole where the file has whole ones.
    """

    numbers: npt.NDArray[Any]
    times: Sequence[int | float] | None = None


class Recording(ABC):
    """An open file of a recording, which is decoded and no more: bytes become numbers, times and
    labels; the layout makes frames of them.
    """

    #: What became of the lines, messages or frames of the last `blocks`.
    tally: Tally

    @abstractmethod
    def head(self) -> Head:
        """Read the begin of the file. Raises SourceError if it is malformed."""

    @abstractmethod
    def blocks(self) -> Iterator[Block]:
        """Read all items from the first one, some `BLOCK_NUMBERS` numbers at a time, each time that
        it is called. Raises SourceError at the first malformed one.
        """


class WholeRecording(Recording):
    """A recording of a format that states all of its layout, and is read whole."""

    def __init__(self) -> None:
        self.tally = Tally("frames")
        self._parsed: Parsed | None = None

    @abstractmethod
    def read(self) -> Parsed:
        """Read the whole recording, once. Raises SourceError if anything in it is malformed."""

    def head(self) -> Head:
        parsed = self._parsed = self._parsed or self.read()
        n_rows, n_cols = parsed.forces.shape[1:]
        return Head(
            (Axis(n_rows, "rows"), Axis(n_cols, "cols")),
            is_timed=parsed.stamp_ns is not None,
            time_unit="ns",
            unit=parsed.unit,
            rate_hz=parsed.rate_hz,
            f_max=parsed.f_max,
            pitch_m=parsed.pitch_m,
            mask=parsed.mask,
            points=parsed.points,
            point_rows=parsed.point_rows,
            n_items=len(parsed.forces),
            notes=parsed.notes,
        )

    def blocks(self) -> Iterator[Block]:
        self.head()
        assert self._parsed is not None
        forces = self._parsed.forces
        stamps = self._parsed.stamp_ns
        self.tally.begin()
        size = frames_per_block(math.prod(forces.shape[1:]))
        for start in range(0, len(forces), size):
            part = forces[start : start + size]
            self.tally.take(len(part), len(part))
            if stamps is None:
                yield Block(part)
            else:
                yield Block(part, stamps[start : start + size])


def frames_per_block(n_numbers: int) -> int:
    """Items of a block, of so many numbers each."""
    return max(1, BLOCK_NUMBERS // max(1, n_numbers))


def shown(text: object, limit: int = 40) -> str:
    """Quote any content of a file so that it fits in one line of an error."""
    quoted = ascii(str(text))
    if len(quoted) <= limit:
        return quoted
    return quoted[: limit - 4] + "...'"


def spelled(text: str, option: Callable[[str], str]) -> str:
    """An error whose missing settings, KEY=VALUE behind `ADD`, are spelled as options."""
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
    examples = islice(candidates.items(), MAX_EXAMPLES)
    texts = ", ".join(f"{printable(candidate)} ({about})" for candidate, about in examples)
    if stated:
        raise SourceError(f"{name}: holds no {key} {shown(stated)}; allowed: {texts or 'none'}")
    if not candidates:
        raise SourceError(f"{name}: holds no {what}")
    if len(candidates) > 1:
        options = [{key: candidate} for candidate in candidates]
        fault = f"holds {len(candidates)} {what}, which is not stated: {texts}"
        raise UnstatedError(f"{name}: {fault}; state {key}", *options)
    return next(iter(candidates))


def rising(stamps: Sequence[int], name: str) -> tuple[int, ...] | None:
    """Stamps since the first; None if some are repeated. SourceError if they fall."""
    for k, (previous, stamp) in enumerate(pairwise(stamps), start=2):
        if stamp < previous:
            raise SourceError(f"{name}: the time of frame {k} is before that of the one before it")
    if len(set(stamps)) < len(stamps):
        return None
    return tuple(stamp - stamps[0] for stamp in stamps)


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
        reason = getattr(error, "strerror", None) or error
        raise SourceError(f"{shown(name, 200)}: cannot be read ({reason})") from error
    except MemoryError:
        raise SourceError(f"{name}: does not fit in memory") from None


def unreadable(name: str, error: Exception) -> SourceError:
    """The error of a file that a library refuses, in one line."""
    text = " ".join(str(error).split())[:200] or type(error).__name__
    return SourceError(f"{name}: cannot be read ({text})")


@dataclass(frozen=True)
class File:
    """An open file of a recording, the names of those that go on with it, and what is stated of
    it. `raw`: a calibration converts the readings, which are of any unit and sign.
    """

    file: IO[bytes]
    name: str
    parts: tuple[str, ...] = ()
    layout: Layout = EMPTY
    raw: bool = False

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
        self._file = file
        self.name = name
        self._line = ""
        self._again = False

    @property
    def where(self) -> str:
        """Place of the line that was read last, for errors."""
        return f"{self.name}, line {self.number}"

    def __next__(self) -> str:
        if not self._again:
            raw = self._file.readline(MAX_LINE_BYTES)
            if not raw:
                raise StopIteration
            # Some programs begin a text with a mark of UTF-8.
            text = raw.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
            self._line = text.removesuffix("\n").removesuffix("\r")

            if len(raw) == MAX_LINE_BYTES:
                raise SourceError(f"{self.where}: is followed by one of {len(raw)} bytes or more")
        self._again = False
        self.number += 1
        return self._line

    def back(self) -> None:
        """Let the line that was read last be read once more."""
        self._again = True
        self.number -= 1


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


def stack_frames(frames: list[npt.NDArray[Any]], where: str) -> Doubles:
    """Stack frames into float64 (n_frames, n_rows, n_cols); SourceError if none, or too many."""
    if not frames:
        raise SourceError(f"{where}: the recording holds no frame")
    try:
        return np.stack(frames).astype(np.float64, copy=False)
    except MemoryError:
        raise SourceError(f"{where}: {len(frames)} frames do not fit in memory") from None
