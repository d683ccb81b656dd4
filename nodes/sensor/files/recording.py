"""The interface of recordings: what the begin of a file states, its items by blocks, its lines."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Mask
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout
from sparseskin.nodes.sensor.layout.tally import Tally

MAX_LINE_BYTES = 1 << 26
"""Longest line of a text file; chosen: a line of 2**20 readings has 20 MB."""
BLOCK_NUMBERS = 1 << 20
"""Numbers of a block, about; chosen: 8 MB, so that memory does not grow with the file."""


@dataclass(frozen=True, eq=False)
class Head:
    """What the begin of a recording states; None, "" or () where it states nothing.

    An item is a line, a message, a frame of an array. `axes` are those of the numbers of one item;
    of a single axis, `usable` are the entries that hold numbers and are no times.
    """

    axes: tuple[Axis, ...] = ()
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
    points: npt.NDArray[Any] | None = (
        None  # float32 (n_taxels, 6): places, m, and unit normals
    )
    point_rows: npt.NDArray[Any] | None = (
        None  # int32 (n_taxels,): their rows in a file of points
    )
    n_items: int | None = None  # None: the end of the file shows it
    notes: tuple[
        str, ...
    ] = ()  # for the log: what was taken, where it can be read otherwise


class Block(NamedTuple):
    """Items in a row: their numbers (k, *sizes of the axes), of any real dtype, NaN where the file
    holds no number; and k times in the unit of the head, whole where the file has whole ones.
    """

    numbers: npt.NDArray[Any]
    times: Sequence[int | float] | None = None

    def parts(self) -> Iterator[Block]:
        """The same by blocks of the usual size."""
        size = frames_per_block(math.prod(self.numbers.shape[1:]))
        for start in range(0, len(self.numbers), size):
            part = slice(start, start + size)
            times = None if self.times is None else self.times[part]
            yield Block(self.numbers[part], times)


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


def gathered(
    items: Iterable[tuple[npt.NDArray[Any], int | float]], tally: Tally
) -> Iterator[Block]:
    """Blocks of items that come one after the other, of one shape, with their times."""
    numbers: list[npt.NDArray[Any]] = []
    times: list[int | float] = []
    for item, time in items:
        numbers.append(item)
        times.append(time)
        # Stacked in blocks: a Python call per frame would cost more than its decoding.
        if len(numbers) == frames_per_block(item.size):
            tally.take(len(numbers), len(numbers))
            yield Block(np.stack(numbers), times)
            numbers = []
            times = []
    if numbers:
        tally.take(len(numbers), len(numbers))
        yield Block(np.stack(numbers), times)


class WholeRecording(Recording):
    """A recording of a format that states all of its layout, and is read whole."""

    def __init__(self) -> None:
        self.tally = Tally("frames")

    @abstractmethod
    def read(self) -> tuple[Head, Block]:
        """Read the whole recording, once: what it states, without axes; its frames, (n_frames,
        n_rows, n_cols), and their stamps in ns, where it has any. Raises SourceError if anything
        in it is malformed.
        """

    def head(self) -> Head:
        head, (frames, stamps) = self._whole
        _, n_rows, n_cols = frames.shape
        return replace(
            head,
            axes=(Axis(n_rows, "rows"), Axis(n_cols, "cols")),
            is_timed=stamps is not None,
            time_unit="ns",
            n_items=len(frames),
        )

    def blocks(self) -> Iterator[Block]:
        _, whole = self._whole
        self.tally.begin()
        for block in whole.parts():
            self.tally.take(len(block.numbers), len(block.numbers))
            yield block

    @cached_property
    def _whole(self) -> tuple[Head, Block]:
        return self.read()


def frames_per_block(n_numbers: int) -> int:
    """Items of a block, of so many numbers each."""
    return max(1, BLOCK_NUMBERS // max(1, n_numbers))


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
                raise SourceError(
                    f"{self.where}: is followed by one of {len(raw)} bytes or more"
                )
        self._again = False
        self.number += 1
        return self._line

    def back(self) -> None:
        """Let the line that was read last be read once more."""
        self._again = True
        self.number -= 1
