"""Messages of ROS as frames of readings: images, point clouds and arrays."""

from __future__ import annotations

import re
from math import prod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.recording import choose

from .cdr import CLOUD, IMAGE, types

FORMATS = {
    **{"32FC1": "f4", "64FC1": "f8", "16UC1": "u2", "mono16": "u2"},
    **{"16SC1": "i2", "8UC1": "u1", "mono8": "u1", "32SC1": "i4"},
}
"""Encodings of sensor_msgs/Image that hold one number a pixel, and the dtype of each."""
FIELDS = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""Dtypes of a field of sensor_msgs/PointCloud2, by the number of its type."""
PLACES = re.compile(r"[xyzt]|(n|normal_)[xyz]|rgba?|ring|row|index|time.*|curvature")
"""Fields of a point cloud that are no readings."""
ARRAYS = tuple(
    f"std_msgs/msg/{kind}MultiArray"
    for kind in ("Float32", "Float64", *(f"{u}Int{n}" for u in ("", "U") for n in (8, 16, 32, 64)))
)
KINDS = (IMAGE, CLOUD, *ARRAYS)
"""Types of messages that can hold frames."""


class Received(NamedTuple):
    """A message that was read: its stamp in nanoseconds, None where it has none, and its values of
    shape (n_rows, n_cols), or (n_cells,) where the message does not state it.
    """

    stamp_ns: int | None
    values: npt.NDArray[np.generic]


def read_frame(kind: str, data: bytes, field: str | None = None, ros: int = 2) -> Received:
    """Read a message of one of `KINDS`, of ROS 2 (CDR) or ROS 1; of a point cloud the stated field,
    or the only one that is neither place nor normal.
    Raises SourceError if it is none, or states sizes that do not fit together.
    """
    from rosbags.serde import SerdeError

    store = types(ros)
    try:
        found = (store.deserialize_cdr if ros == 2 else store.deserialize_ros1)(data, kind)
    except (SerdeError, ValueError) as error:  # of texts that are no UTF-8, too
        raise SourceError(f"no {kind}: {' '.join(str(error).split())[:200]}") from error
    if kind in ARRAYS:
        return Received(None, _array(found))
    values = _image(found) if kind == IMAGE else _cloud(found, field)
    stamp_ns = found.header.stamp.sec * 1_000_000_000 + found.header.stamp.nanosec
    return Received(stamp_ns or None, values)


def _image(found: Any) -> npt.NDArray[np.generic]:
    encoding = found.encoding
    if encoding not in FORMATS:
        raise SourceError(f"encoding {encoding[:32]!r}; allowed are {', '.join(FORMATS)}")
    _check_size(found.height, found.width)
    return _cells(found, found.width, FORMATS[encoding], 0, np.dtype(FORMATS[encoding]).itemsize)


def _cloud(found: Any, field: str | None) -> npt.NDArray[np.generic]:
    fields = {
        one.name: one for one in found.fields if one.count == 1 and one.datatype in range(1, 9)
    }
    wanted = fields if field else {k: v for k, v in fields.items() if not PLACES.fullmatch(k)}
    name = choose(
        {k: FIELDS[v.datatype] for k, v in wanted.items()},
        field,
        "point cloud",
        "fields of readings",
        "columns",
    )
    _check_size(found.height, found.width)
    values = _cells(
        found, found.width, FIELDS[fields[name].datatype], fields[name].offset, found.point_step
    )
    return values if found.height > 1 else values[0]


def _cells(found: Any, n_cols: int, code: str, offset: int, pitch: int) -> npt.NDArray[np.generic]:
    """A number of each cell, (height, n_cols), at an offset in each `pitch` bytes of each row."""
    dtype = np.dtype((">" if found.is_bigendian else "<") + code)
    step, size = found.step if hasattr(found, "step") else found.row_step, len(found.data)
    if step < n_cols * pitch or size != step * found.height or offset + dtype.itemsize > pitch:
        shape = f"{found.height} x {n_cols} of {pitch} bytes"
        raise SourceError(f"rows of {step} bytes, {size} bytes in all, for {shape}")
    rows = np.ascontiguousarray(found.data.reshape(found.height, step)[:, : n_cols * pitch])
    cells = rows.reshape(found.height, n_cols, pitch)[..., offset : offset + dtype.itemsize]
    return np.ascontiguousarray(cells).view(dtype)[..., 0].astype(dtype.newbyteorder("="))


def _array(found: Any) -> npt.NDArray[np.generic]:
    shape = [dimension.size for dimension in found.layout.dim]
    offset, n = found.layout.data_offset, prod(shape) if shape else len(found.data)
    _check_size(1, n)
    if offset + n > len(found.data):
        raise SourceError(f"{len(found.data)} numbers, from {offset} on, for {shape}")
    values: npt.NDArray[np.generic] = found.data[offset : offset + n]
    grid = [side for side in shape if side != 1] if len(shape) > 2 else shape
    return values.reshape(grid) if len(grid) == 2 else values


def _check_size(n_rows: int, n_cols: int) -> None:
    if not 1 <= n_rows * n_cols <= MAX_ELEMENTS:
        raise SourceError(f"{n_rows} x {n_cols} taxels; allowed are 1..{MAX_ELEMENTS}")
