"""Messages of ROS that are frames by themselves: images, point clouds and arrays."""

from __future__ import annotations

import re
from math import prod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.arrangement import Axis
from sparseskin.nodes.sensor.layout.checks import choose
from sparseskin.nodes.sensor.layout.layout import UnstatedError
from sparseskin.plugins.bridges.cdr import CLOUD, IMAGE

from .decoding import Message

ENCODING = re.compile(r"(8|16|32|64)([USF])C([1-9])|mono(8|16)")
"""Encodings of sensor_msgs/Image that are read: bits, kind and numbers per pixel."""
ALLOWED = "8UC1, 8SC1, 16UC1, 16SC1, 32SC1, 32FC1, 64FC1, as C3 of three axes, mono8 and mono16"
KINDS_OF_NUMBERS = {
    "U": "u",
    "S": "i",
    "F": "f",
}
FIELDS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""Dtypes of a field of sensor_msgs/PointCloud2, by the number of its type."""
PLACES = re.compile(r"[xyzt]|(n|normal_)[xyz]|rgba?|ring|row|index|time.*|curvature")
"""Fields of a point cloud that are no readings."""
_NUMBERS = "Float32 Float64 Int8 Int16 Int32 Int64 UInt8 UInt16 UInt32 UInt64"
ARRAYS = tuple(f"std_msgs/msg/{name}MultiArray" for name in _NUMBERS.split())
KINDS = (IMAGE, CLOUD, *ARRAYS)
"""Types of messages that are frames by themselves."""
MAX_NUMBERS = 16 * MAX_ELEMENTS
"""Most numbers of a message that is read."""
MAX_DIMS = 8


class EmptyMessageError(SourceError):
    """A message without a number."""


class Numbers(NamedTuple):
    """The numbers of a message, and their axes."""

    values: npt.NDArray[Any]
    axes: tuple[Axis, ...]


def grid_of(message: Message, field: str = "") -> Numbers:
    """The numbers of a message of `KINDS`; of a point cloud those of a field, or of the only one
    that is neither place nor normal. Raises EmptyMessageError if there are none, SourceError if it
    states sizes that do not fit together, UnstatedError if it has several such fields.
    """
    if message.kind == IMAGE:
        return _image(message)
    if message.kind == CLOUD:
        return _cloud(message, field)
    return _array(message)


def fields_of(message: Message, readings: bool = False) -> dict[str, str]:
    """Fields of a point cloud, and the dtype of each; none of other messages. `readings`: without
    those that are places, normals, colours or times.
    """
    if message.kind != CLOUD:
        return {}
    dtypes = {}
    for field in message["fields"]:
        name = field["name"]
        # A type that is not known is left out: its size is not known either.
        if not 1 <= field["datatype"] < len(FIELDS):
            continue
        if readings and PLACES.fullmatch(name):
            continue
        dtypes[name] = FIELDS[field["datatype"]]
    return dtypes


def _image(message: Message) -> Numbers:
    encoding = message["encoding"]
    match = ENCODING.fullmatch(encoding)
    if match is None:
        raise SourceError(
            f"encoding {printable(encoding[:32])!r}; allowed are {ALLOWED}"
        )
    # mono8 and mono16 are unsigned numbers without a count of channels.
    n_bits = int(match[1] or match[4])
    code = KINDS_OF_NUMBERS[match[2] or "U"] + str(n_bits // 8)
    if code in ("f1", "f2"):
        raise SourceError(f"encoding {encoding!r}; allowed are {ALLOWED}")

    n_channels = int(match[3] or 1)
    # The bytes of a pixel, whose numbers follow each other.
    pitch = n_channels * n_bits // 8
    values = _cells(message, message["step"], pitch, 0, code, n_channels)
    axes = [Axis(message["height"], "rows"), Axis(message["width"], "cols")]
    if n_channels == 3:
        axes.append(Axis(n_channels, "xyz"))
    elif n_channels > 1:
        axes.append(Axis(n_channels, "channel"))
    return Numbers(values, tuple(axes))


def _cloud(message: Message, field: str) -> Numbers:
    readable = fields_of(message, readings=not field)
    name = choose(readable, field, "point cloud", "fields of readings", "field")
    of_name = next(field for field in message["fields"] if field["name"] == name)
    count = max(1, of_name["count"])
    row_step = message["row_step"]
    point_step = message["point_step"]
    offset = of_name["offset"]
    values = _cells(message, row_step, point_step, offset, readable[name], count)
    height = message["height"]
    width = message["width"]
    # An unordered cloud states a height of 1.
    axes = [Axis(height, "rows"), Axis(width, "cols")]
    if height == 1 or width == 1:
        axes = [Axis(height * width, "taxels")]
    if count > 1:
        axes.append(Axis(count, "channel"))
    return Numbers(values.reshape([axis.size for axis in axes]), tuple(axes))


def _cells(
    message: Message, step: int, pitch: int, offset: int, code: str, n: int
) -> npt.NDArray[Any]:
    """The numbers of each cell, (height, width) or (height, width, n), at an offset in each `pitch`
    bytes of each `step` bytes.
    """
    n_rows = message["height"]
    n_cols = message["width"]
    data = message["data"]
    if n_rows * n_cols == 0:
        raise EmptyMessageError("holds no number")
    if n_rows * n_cols * n > MAX_NUMBERS:
        raise SourceError(f"{n_rows} x {n_cols} taxels; at most {MAX_NUMBERS} numbers")

    # Its own order: that of the encapsulation may differ.
    order = ">" if message["is_bigendian"] else "<"
    dtype = np.dtype(order + code)
    end = offset + n * dtype.itemsize
    if step < n_cols * pitch or data.size != step * n_rows or end > pitch:
        sizes = f"{n_rows} x {n_cols} of {pitch} bytes"
        raise SourceError(
            f"rows of {step} bytes, {data.size} bytes in all, for {sizes}"
        )

    # Rows and cells may have padding.
    shape = (n_rows, n_cols, n)
    strides = (step, pitch, dtype.itemsize)
    values: npt.NDArray[Any] = np.ndarray(shape, dtype, data, offset, strides)
    if n == 1:
        return values[..., 0]
    return values


def _array(message: Message) -> Numbers:
    """The numbers of a MultiArray, by the sizes, labels and strides of its dimensions."""
    data = message["data"]
    offset = message["layout"]["data_offset"]
    dims = message["layout"]["dim"]
    if data.size == 0:
        raise EmptyMessageError("holds no number")
    if len(dims) > MAX_DIMS:
        raise SourceError(f"{len(dims)} dimensions; at most {MAX_DIMS}")

    sizes = [int(dim["size"]) for dim in dims]
    if not any(sizes):
        # Its dimensions state nothing.
        numbers = data[offset:]
        return Numbers(numbers, (Axis(numbers.size, "taxels"),))
    if 0 in sizes:
        raise EmptyMessageError("holds no number")

    axes = tuple(_axis(int(dim["size"]), str(dim["label"])) for dim in dims)
    strides = [int(dim["stride"]) for dim in dims]
    steps = _steps(sizes, strides, data.size - offset)
    strides_bytes = [step * data.itemsize for step in steps]
    # Within the data, as `_steps` has checked.
    values = np.ndarray(sizes, data.dtype, data, offset * data.itemsize, strides_bytes)
    return Numbers(values, axes)


def _axis(size: int, label: str) -> Axis:
    """An axis, with the names of its entries where its label is a list of them."""
    names = tuple(name.strip() for name in label.split(","))
    # A label such as "fx,fy,fz" names each entry of its dimension.
    if len(names) == size > 1:
        return Axis(size, "channel", names)
    return Axis(size, label)


def _steps(sizes: list[int], strides: list[int], n: int) -> list[int]:
    """Numbers from one entry of each dimension to the next, of n numbers.

    The stride of a dimension is the size of one of its entries' lists: entry (i, j) stands at
    stride[1] i + j. Where the numbers are as many as the sizes, no other order is possible.
    """
    if prod(sizes) == n:
        return [prod(sizes[at + 1 :]) for at in range(len(sizes))]

    # Entries of a list must not overlap, and the last one must be among the numbers.
    steps = [*strides[1:], 1]
    spans = [size * step for size, step in zip(sizes, steps, strict=True)]
    is_nested = all(span <= step for span, step in zip(spans[1:], steps, strict=False))
    last_place = sum(spans) - sum(steps)
    if is_nested and last_place < n and spans[0] == n:
        return steps

    shape = " x ".join(map(str, sizes))
    fault = f"its dimensions {shape} with strides {strides} do not fit its {n} numbers"
    raise UnstatedError(
        f"{fault}; state field=data to read all of them", {"field": "data"}
    )
