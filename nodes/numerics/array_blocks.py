"""Arrays whose numbers stand in a stream one after the other, read by blocks along an axis."""

import io
import math
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from .array_files import ArrayFileError
from .arrays import AnyArray

MIN_RUN_BYTES = 1 << 12
"""Bytes read in a row where the entries of an axis are scattered: a page of the file."""
MAX_GATHER_BYTES = 1 << 26
"""Memory of a block whose numbers are scattered, chosen."""
_COPY_BYTES = 1 << 20


@dataclass(frozen=True)
class StoredArray:
    """The numbers of an array in a stream. `open` yields the stream at the first one; `by_columns`:
    the first index varies fastest, as in Fortran and MATLAB.
    """

    open: Callable[[], AbstractContextManager[IO[bytes]]]
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    by_columns: bool = False
    can_seek: bool = False

    def blocks(self, axis: int, size: int) -> Iterator[AnyArray]:
        """Blocks of `size` entries of an axis, the last one shorter: (k, *other sides).

        Numbers that stand in another order in a stream that cannot seek are copied to a temporary
        file first. Raises ArrayFileError if the stream ends before the last number.
        """
        sides = self._sides
        at = axis
        if self.by_columns:
            at = len(sides) - 1 - axis
        with self.open() as stream:
            # Entries stand in a row where no axis outside theirs has more than one.
            if math.prod(sides[:at]) == 1:
                parts = self._in_a_row(stream, sides, at, size)
            else:
                parts = self._scattered(stream, sides, at, size)
            for part in parts:
                block = part.transpose() if self.by_columns else part
                yield np.moveaxis(block, axis, 0)

    @property
    def _sides(self) -> tuple[int, ...]:
        """Sides in the order of the stream, in which the last index varies fastest."""
        return self.shape[::-1] if self.by_columns else self.shape

    def _in_a_row(
        self, stream: IO[bytes], sides: tuple[int, ...], at: int, size: int
    ) -> Iterator[AnyArray]:
        """Parts along an axis with no entries of others between its own."""
        for begin in range(0, sides[at], size):
            n = min(size, sides[at] - begin)
            shape = *sides[:at], n, *sides[at + 1 :]
            yield self._read(stream, shape)

    def _scattered(
        self, stream: IO[bytes], sides: tuple[int, ...], at: int, size: int
    ) -> Iterator[AnyArray]:
        """Parts along an axis whose entries are gathered from all over the stream."""
        n_outer = math.prod(sides[:at])
        n_inner = math.prod(sides[at + 1 :])
        entry_bytes = n_inner * self.dtype.itemsize
        # Longer runs cost fewer reads, and more memory.
        n_for_long_runs = max(size, MIN_RUN_BYTES // max(1, entry_bytes))
        bound = max(size, MAX_GATHER_BYTES // max(1, n_outer * entry_bytes))
        n_gathered = min(n_for_long_runs, bound) // size * size
        with tempfile.TemporaryFile() as copy:
            if not self.can_seek:
                shutil.copyfileobj(stream, copy, _COPY_BYTES)
                copy.seek(0)
                stream = copy
            begin = stream.tell()
            for row in range(0, sides[at], n_gathered):
                n = min(n_gathered, sides[at] - row)
                entries = np.empty((n_outer, n, n_inner), self.dtype)
                for outer in range(n_outer):
                    n_before = outer * sides[at] + row
                    stream.seek(begin + n_before * entry_bytes)
                    entries[outer] = self._read(stream, (n, n_inner))
                shape = *sides[:at], n, *sides[at + 1 :]
                whole = entries.reshape(shape)
                outer_axes = (slice(None),) * at
                for start in range(0, n, size):
                    yield whole[*outer_axes, start : start + size]

    def whole(self) -> AnyArray:
        """The array. Raises ArrayFileError as `blocks` does."""
        with self.open() as stream:
            array = self._read(stream, self._sides)
        return array.transpose() if self.by_columns else array

    def _read(self, stream: Any, shape: tuple[int, ...]) -> AnyArray:
        array = np.empty(shape, self.dtype)
        array_bytes = array.reshape(-1).view(np.uint8)
        buffer = memoryview(array_bytes.data)
        at = 0
        while at < len(buffer):
            # A part at a time: some streams copy what they read.
            n_bytes = stream.readinto(buffer[at : at + _COPY_BYTES])
            if not n_bytes:
                raise ArrayFileError("ends before the last of its numbers")
            at += n_bytes
        return array


class Section(io.RawIOBase):
    """A part of a file, of `n_bytes` from `start`, as a stream. Several may be read in turns."""

    def __init__(self, file: IO[bytes], start: int, n_bytes: int) -> None:
        self._file = file
        self._start = start
        self._end = start + n_bytes
        self._at = start

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        bases = {
            io.SEEK_SET: self._start,
            io.SEEK_CUR: self._at,
            io.SEEK_END: self._end,
        }
        self._at = bases[whence] + offset
        return self.tell()

    def tell(self) -> int:
        return self._at - self._start

    def readinto(self, buffer: Any) -> int:
        part = self._file_bytes(len(buffer))
        buffer[: len(part)] = part
        return len(part)

    def _file_bytes(self, n: int) -> bytes:
        # Another section of the same file may have been read since.
        self._file.seek(self._at)
        n_left = max(0, self._end - self._at)
        part = self._file.read(min(n, n_left))
        self._at += len(part)
        return part


class InflatedSection(Section):
    """A part of a file that zlib compressed, as a stream of what it holds, which cannot seek."""

    def __init__(self, file: IO[bytes], start: int, n_bytes: int) -> None:
        super().__init__(file, start, n_bytes)
        self._decoder = zlib.decompressobj()

    def seekable(self) -> bool:
        return False

    def readinto(self, buffer: Any) -> int:
        """Read some bytes; 0 at the end. Raises ArrayFileError if they are damaged."""
        while not self._decoder.eof:
            # What zlib has not inflated yet, as the buffer was full, comes first.
            packed = self._decoder.unconsumed_tail or self._file_bytes(1 << 16)
            try:
                part = self._decoder.decompress(packed, len(buffer))
            except zlib.error as error:
                raise ArrayFileError(f"cannot be inflated ({error})") from error
            if part:
                buffer[: len(part)] = part
                return len(part)
            if not packed:
                raise ArrayFileError("its compressed numbers end too early")
        return 0
