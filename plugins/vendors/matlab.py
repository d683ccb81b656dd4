"""Arrays of numbers in files of MATLAB, .mat: those of version 5 to 7, and 7.3, which is HDF5."""

import io
import math
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, NamedTuple

import numpy as np

from sparseskin.nodes.numerics.array_blocks import InflatedSection, Section, StoredArray
from sparseskin.nodes.numerics.array_files import (
    MAX_GROWN_BYTES,
    MAX_GROWTH,
    ArrayFileError,
)
from sparseskin.nodes.sensor.files.arrays import StoredArrays, refusing
from sparseskin.nodes.sensor.files.dataset_recording import DatasetRecording
from sparseskin.nodes.sensor.files.datasets import MAX_ARRAYS, ArrayFile
from sparseskin.nodes.sensor.files.recording import File

from .hdf5 import Hdf5File, is_hdf5

# Format: "MAT-File Format", The MathWorks, the chapter on level 5.
_HEAD_BYTES = 128
_MATRIX = 14
_COMPRESSED = 15
"""Types of elements: an array, and one in a stream of zlib."""
_INT8 = 1
_INT32 = 5
_UINT32 = 6
_STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""Types of the numbers as they stand in the file; whole float64 numbers stand there as integers."""
_STRUCT = 2
_CLASSES = {
    6: "f8",
    7: "f4",
    8: "i1",
    9: "u1",
    10: "i2",
    11: "u2",
    12: "i4",
    13: "u4",
    14: "i8",
    15: "u8",
}
"""Classes of arrays of numbers in MATLAB."""
_COMPLEX = 0x0800
_LOGICAL = 0x0200
_MAX_DEPTH = 16
"""Structures within structures, chosen."""
_MAX_AXES = 32
_MAX_TEXT_BYTES = 1 << 20
"""Longest names of an array, or of the fields of a structure."""


class MatlabRecording(DatasetRecording):
    """The frames of a .mat; arrays in structures are named as in MATLAB, log.left.forces. Its users
    have the frames along any axis.
    """

    def __init__(self, file: File) -> None:
        # Version 7.3 is HDF5 behind a block of 512 bytes.
        begin = file.file.read(_HEAD_BYTES + 512)
        file.file.seek(0)
        arrays: ArrayFile
        if is_hdf5(begin) or is_hdf5(begin[512:]):
            arrays = Hdf5File(file, is_matlab=True)
        else:
            arrays = MatlabFile(file)
        super().__init__(file, arrays)


class _Tag(NamedTuple):
    """Begin of an element: its type, its bytes, and those of its padding."""

    kind: int
    n_bytes: int
    padding: int


@dataclass
class _Part:
    """An element of the file, and a stream through it."""

    open: Callable[[], IO[bytes]]
    stream: IO[bytes]
    order: str
    at: int = 0
    #: Bytes that are left of an element that stands in its tag.
    short: bytes = b""

    def read(self, n: int) -> bytes:
        """The next bytes; ArrayFileError if the element ends before."""
        raw = self.short[:n]
        self.short = self.short[n:]
        raw += self.stream.read(n - len(raw))
        self.at += len(raw)
        if len(raw) < n:
            raise ArrayFileError("an array ends too early")
        return raw

    def skip(self, n: int) -> None:
        # In pieces: a size that a file states must not fill the memory.
        while n > 0:
            n -= len(self.read(min(n, 1 << 20)))

    def tag(self) -> _Tag:
        """The begin of the next element."""
        raw = self.read(8)
        kind, n_bytes = struct.unpack(f"{self.order}II", raw)
        if kind >> 16:
            # A short one: its bytes, at most four, stand in place of their number.
            self.short = raw[4:]
            self.at -= 4
            n_bytes = kind >> 16
            kind &= 0xFFFF
            if n_bytes > 4:
                raise ArrayFileError("an array is malformed")
            return _Tag(kind, n_bytes, 4 - n_bytes)
        return _Tag(kind, n_bytes, -n_bytes % 8)

    def small(self, kind: int, limit: int) -> bytes:
        """The bytes of the next element, which must be of a type, and no longer than `limit`."""
        # Flags, sides and names: a file cannot make them long.
        tag = self.tag()
        if tag.kind != kind or tag.n_bytes > limit:
            raise ArrayFileError("an array is malformed")
        raw = self.read(tag.n_bytes)
        self.skip(tag.padding)
        return raw

    def numbers(self, kind: int, limit: int) -> tuple[int, ...]:
        raw = self.small(kind, 4 * limit)
        n = len(raw) // 4
        letter = "i" if kind == _INT32 else "I"
        return struct.unpack(f"{self.order}{n}{letter}", raw[: 4 * n])


class MatlabFile(StoredArrays):
    """The arrays of numbers of a .mat of version 5 to 7. Raises SourceError if it is malformed."""

    separator = "."
    has_frames_first = False

    def __init__(self, file: File) -> None:
        super().__init__(file.name)
        self._file = file.file
        with refusing(f"{file.name}: cannot be read"):
            self._list()

    def _list(self) -> None:
        n_bytes = self._file.seek(0, io.SEEK_END)
        self._limit = max(MAX_GROWN_BYTES, MAX_GROWTH * n_bytes)
        self._file.seek(0)
        heading = self._file.read(_HEAD_BYTES)
        # The writer's own bytes of "MI": they state the order of all others.
        order = {b"IM": "<", b"MI": ">"}.get(heading[126:])
        if order is None:
            raise ArrayFileError(
                "no MATLAB file of version 5 or later; save it with -v7"
            )

        at = _HEAD_BYTES
        while at + 8 <= n_bytes and len(self.stored) < MAX_ARRAYS:
            self._file.seek(at)
            kind, size = struct.unpack(f"{order}II", self._file.read(8))
            # A copy that was cut off, or a size that is wrong.
            if at + 8 + size > n_bytes:
                raise ArrayFileError("the file ends within an array")
            if kind in (_MATRIX, _COMPRESSED):
                self._add_element(kind, at + 8, size, order)
            at += 8 + size

    def _add_element(self, kind: int, start: int, size: int, order: str) -> None:
        section = Section if kind == _MATRIX else InflatedSection

        def opened() -> IO[bytes]:
            return io.BufferedReader(section(self._file, start, size))

        part = _Part(opened, opened(), order)
        # A stream of zlib holds one element, with a head of its own.
        if kind == _COMPRESSED:
            tag = part.tag()
            if tag.kind != _MATRIX:
                return
            size = tag.n_bytes
        self._add_matrix(part, "", size, can_seek=kind == _MATRIX, depth=0)

    def _add_matrix(
        self, part: _Part, path: str, size: int, can_seek: bool, depth: int
    ) -> None:
        """Add the array of numbers, or those of the structure, that begins here."""
        if not size:
            return
        if size > self._limit:
            raise ArrayFileError(
                f"an array would have {size} bytes; at most {self._limit}"
            )

        end = part.at + size
        flags = part.numbers(_UINT32, 2)
        sides = part.numbers(_INT32, _MAX_AXES)
        name = part.small(_INT8, _MAX_TEXT_BYTES).decode("latin-1")
        path = path or name
        if not flags or min(sides, default=-1) < 0:
            raise ArrayFileError("an array is malformed")

        # Of several structures in an array none has a name of its own: they are left out.
        kind = flags[0] & 0xFF
        if kind == _STRUCT and math.prod(sides) == 1 and depth < _MAX_DEPTH:
            self._add_fields(part, path, can_seek, depth)
        elif kind in _CLASSES:
            self._add_numbers(part, path, flags[0], sides, can_seek)

        # Within a structure others follow.
        if depth:
            part.skip(end - part.at)

    def _add_fields(self, part: _Part, path: str, can_seek: bool, depth: int) -> None:
        (length,) = part.numbers(_INT32, 1)
        text = part.small(_INT8, _MAX_TEXT_BYTES)
        if not 1 <= length <= len(text):
            return
        names = [text[at : at + length] for at in range(0, len(text), length)]
        for name in names:
            field = name.partition(b"\0")[0].decode("latin-1")
            tag = part.tag()
            if tag.kind != _MATRIX:
                raise ArrayFileError("a structure is malformed")
            self._add_matrix(part, f"{path}.{field}", tag.n_bytes, can_seek, depth + 1)

    def _add_numbers(
        self, part: _Part, path: str, flags: int, sides: tuple[int, ...], can_seek: bool
    ) -> None:
        tag = part.tag()
        stored = _STORED.get(tag.kind)
        if stored is None:
            raise ArrayFileError("numbers of an unknown type")
        dtype = np.dtype(part.order + stored)
        n_bytes = math.prod(sides) * dtype.itemsize
        # A length is believed once it agrees with the sides.
        if n_bytes != tag.n_bytes or n_bytes > self._limit:
            sides_text = " x ".join(map(str, sides[:8]))
            raise ArrayFileError(f"states {sides_text} numbers in {tag.n_bytes} bytes")
        at = part.at

        @contextmanager
        def opened() -> Iterator[IO[bytes]]:
            stream = part.open()
            _Part(part.open, stream, part.order).skip(at)
            yield stream

        kind = _CLASSES[flags & 0xFF]
        if flags & _COMPLEX:
            kind = "c16"
        if flags & _LOGICAL:
            kind = "?"
        dtype_seen = np.dtype(kind)
        array = StoredArray(opened, dtype, sides, by_columns=True, can_seek=can_seek)
        self.add(path, array, dtype_seen)
