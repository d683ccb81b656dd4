"""Messages of ROS 2 in CDR, the form in which DDS sends them: written and read without a loop in
Python over their bytes.

Source: OMG DDS-XTypes 1.3, section 7.4 (plain CDR, little endian); definitions of the messages:
common_interfaces of ROS 2.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats

HEAD = b"\x00\x01\x00\x00"
"""Encapsulation header: plain CDR, little endian."""
MAX_STRING = 1 << 16
MAX_SIDE = 4096
MAX_DIMENSIONS = 8
UINT32, FLOAT32 = 6, 7
"""Numbers of the types of a field in sensor_msgs/PointField."""
FORMATS = {
    "32FC1": "f4",
    "64FC1": "f8",
    "16UC1": "u2",
    "mono16": "u2",
    "16SC1": "i2",
    "8UC1": "u1",
    "mono8": "u1",
    "32SC1": "i4",
}
"""Encodings of sensor_msgs/Image that hold one number a pixel, and the dtype of each."""


class _Body:
    """Bytes of a message behind its encapsulation header, aligned as CDR asks for."""

    def __init__(self) -> None:
        self.data = bytearray()

    def put(self, form: str, *values: object) -> None:
        size = struct.calcsize(form[-1])
        self.data += bytes(-len(self.data) % size)
        self.data += struct.pack(f"<{form}", *values)

    def text(self, value: str) -> None:
        raw = value.encode() + b"\0"
        self.put("I", len(raw))
        self.data += raw


@lru_cache(maxsize=64)
def _image_middle(frame_id: str, n_rows: int, n_cols: int) -> bytes:
    body = _Body()
    body.put("iI", 0, 0)
    body.text(frame_id)
    body.put("II", n_rows, n_cols)
    body.text("32FC1")
    body.put("B", 0)
    body.put("I", 4 * n_cols)
    body.put("I", 4 * n_rows * n_cols)
    return bytes(body.data[8:])


def image(stamp: tuple[int, int], frame_id: str, forces: Floats) -> bytes:
    """A sensor_msgs/Image in 32FC1 of forces (n_rows, n_cols), with its stamp in s and ns."""
    middle = _image_middle(frame_id, *forces.shape)
    data = np.ascontiguousarray(forces, "<f4").tobytes()
    return b"".join((HEAD, struct.pack("<iI", *stamp), middle, data))


@lru_cache(maxsize=64)
def _cloud_middle(frame_id: str, n_points: int, has_rows: bool) -> bytes:
    body = _Body()
    body.put("iI", 0, 0)
    body.text(frame_id)
    body.put("II", 1, n_points)
    fields = [(name, FLOAT32) for name in ("x", "y", "z", "force")]
    fields += [("row", UINT32)] * has_rows
    body.put("I", len(fields))
    for k, (name, kind) in enumerate(fields):
        body.text(name)
        body.put("I", 4 * k)
        body.put("B", kind)
        body.put("I", 1)
    step = 4 * len(fields)
    body.put("B", 0)
    body.put("II", step, step * n_points)
    body.put("I", step * n_points)
    return bytes(body.data[8:])


def cloud(stamp: tuple[int, int], frame_id: str, points: npt.NDArray[np.float32]) -> bytes:
    """A sensor_msgs/PointCloud2 of points (n, 4): x, y, z in metres, and the force; or (n, 5), the
    last being the bits of uint32, the row of a file of points.
    """
    middle = _cloud_middle(frame_id, len(points), points.shape[1] == 5)
    data = np.ascontiguousarray(points, "<f4").tobytes()
    return b"".join((HEAD, struct.pack("<iI", *stamp), middle, data, b"\x01"))


@lru_cache(maxsize=64)
def _array_begin(n_rows: int, n_cols: int) -> bytes:
    body = _Body()
    body.put("I", 2)
    for label, size, stride in (("rows", n_rows, n_rows * n_cols), ("cols", n_cols, n_cols)):
        body.text(label)
        body.put("II", size, stride)
    body.put("I", 0)
    body.put("I", n_rows * n_cols)
    return bytes(body.data)


def array(forces: Floats) -> bytes:
    """A std_msgs/Float32MultiArray of forces (n_rows, n_cols), row after row."""
    data = np.ascontiguousarray(forces, "<f4").tobytes()
    return b"".join((HEAD, _array_begin(*forces.shape), data))


class Received(NamedTuple):
    """A message that was read: its stamp in nanoseconds, None where it has none, and its values of
    shape (n_rows, n_cols).
    """

    stamp_ns: int | None
    values: npt.NDArray[np.generic]


class _Reader:
    """Reads CDR of either byte order; SourceError where it is cut or states what is not there."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] or data[1] > 1:
            raise SourceError("not plain CDR")
        self.order = "<" if data[1] else ">"
        self._data = data
        self._at = 4

    def take(self, form: str) -> tuple[int, ...]:
        self._at += -(self._at - 4) % struct.calcsize(form[-1])
        size = struct.calcsize(f"={form}")
        if self._at + size > len(self._data):
            raise SourceError("is cut off")
        found = struct.unpack_from(self.order + form, self._data, self._at)
        self._at += size
        return found

    def text(self) -> str:
        (size,) = self.take("I")
        if size > MAX_STRING:
            raise SourceError(f"a text of {size} bytes; at most {MAX_STRING}")
        raw = self.raw(size)
        return raw.rstrip(b"\0").decode(errors="replace")

    def raw(self, size: int) -> bytes:
        if self._at + size > len(self._data):
            raise SourceError("is cut off")
        found = self._data[self._at : self._at + size]
        self._at += size
        return found


def _check_grid(n_rows: int, n_cols: int) -> None:
    if not (1 <= n_rows <= MAX_SIDE and 1 <= n_cols <= MAX_SIDE):
        raise SourceError(f"{n_rows} x {n_cols} taxels; allowed are 1..{MAX_SIDE} each")


def read_image(data: bytes) -> Received:
    """Read a sensor_msgs/Image of one number a pixel.
    Raises SourceError if it is none, or states sizes that do not fit together.
    """
    body = _Reader(data)
    seconds, nanoseconds = body.take("iI")
    body.text()
    n_rows, n_cols = body.take("II")
    encoding = body.text()
    (is_big,) = body.take("B")
    step, size = body.take("II")
    _check_grid(n_rows, n_cols)
    if encoding not in FORMATS:
        raise SourceError(f"encoding {encoding[:32]!r}; allowed are {', '.join(FORMATS)}")
    dtype = np.dtype((">" if is_big else "<") + FORMATS[encoding])
    if step < n_cols * dtype.itemsize or size != step * n_rows:
        raise SourceError(f"step {step} and {size} bytes for {n_rows} x {n_cols} of {encoding}")
    lines = np.frombuffer(body.raw(size), np.uint8).reshape(n_rows, step)
    values = np.ascontiguousarray(lines[:, : n_cols * dtype.itemsize]).view(dtype)
    stamp_ns = seconds * 1_000_000_000 + nanoseconds
    return Received(stamp_ns or None, values)


def read_array(data: bytes) -> Received:
    """Read a std_msgs/Float32MultiArray of two dimensions.
    Raises SourceError if it is none, or states sizes that do not fit together.
    """
    body = _Reader(data)
    (n_dimensions,) = body.take("I")
    if n_dimensions > MAX_DIMENSIONS:
        raise SourceError(f"{n_dimensions} dimensions; expected 2: rows, columns")
    shape = []
    for _ in range(n_dimensions):
        body.text()
        shape.append(body.take("II")[0])
    (offset,) = body.take("I")
    (size,) = body.take("I")
    if len(shape) != 2:
        raise SourceError(f"{len(shape)} dimensions; expected 2: rows, columns")
    n_rows, n_cols = shape
    _check_grid(n_rows, n_cols)
    if offset + n_rows * n_cols > size:
        raise SourceError(f"{size} numbers, from {offset} on, for {n_rows} x {n_cols}")
    values = np.frombuffer(body.raw(4 * size), f"{body.order}f4")
    return Received(None, values[offset : offset + n_rows * n_cols].reshape(n_rows, n_cols))
