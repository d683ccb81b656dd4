"""Messages of ROS 2 in CDR, the form in which DDS and bags hold them: definitions and bytes by
rosbags, which needs no ROS.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats

from .base import ROW

IMAGE, CLOUD = "sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2"
ARRAY = "std_msgs/msg/Float32MultiArray"
MAX_SIDE = 4096
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


@functools.cache
def types() -> Any:
    """Messages of ROS 2 Humble, a `Typestore` of rosbags. Raises ImportError without rosbags."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def encoded(kind: str, **fields: object) -> bytes:
    """CDR, little endian, of a message such as "std_msgs/msg/Bool" with the stated fields."""
    store = types()
    return bytes(store.serialize_cdr(store.types[kind](**fields), kind))


def _header(stamp: tuple[int, int], frame_id: str) -> Any:
    made = types().types
    time = made["builtin_interfaces/msg/Time"](*stamp)
    return made["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def _bytes_of(values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    return np.ascontiguousarray(values, "<f4").reshape(-1).view(np.uint8)


def image(stamp: tuple[int, int], frame_id: str, forces: Floats) -> bytes:
    """A sensor_msgs/Image in 32FC1 of forces (n_rows, n_cols), with its stamp in s and ns."""
    return encoded(
        IMAGE,
        header=_header(stamp, frame_id),
        height=forces.shape[0],
        width=forces.shape[1],
        encoding="32FC1",
        is_bigendian=0,
        step=4 * forces.shape[1],
        data=_bytes_of(forces),
    )


def cloud(stamp: tuple[int, int], frame_id: str, columns: Mapping[str, Floats]) -> bytes:
    """A sensor_msgs/PointCloud2 of `point_columns`."""
    field = types().types["sensor_msgs/msg/PointField"]
    points = np.stack(list(columns.values()), axis=1)
    n, n_fields = points.shape
    kinds = {name: UINT32 if name == ROW else FLOAT32 for name in columns}
    return encoded(
        CLOUD,
        header=_header(stamp, frame_id),
        height=1,
        width=n,
        fields=[field(name, 4 * k, kind, 1) for k, (name, kind) in enumerate(kinds.items())],
        is_bigendian=False,
        point_step=4 * n_fields,
        row_step=4 * n_fields * n,
        data=_bytes_of(points),
        is_dense=True,
    )


def array(forces: Floats) -> bytes:
    """A std_msgs/Float32MultiArray of forces (n_rows, n_cols), row after row."""
    made, (n_rows, n_cols) = types().types, forces.shape
    dimension = made["std_msgs/msg/MultiArrayDimension"]
    sides = [dimension("rows", n_rows, n_rows * n_cols), dimension("cols", n_cols, n_cols)]
    layout = made["std_msgs/msg/MultiArrayLayout"](dim=sides, data_offset=0)
    return encoded(ARRAY, layout=layout, data=np.ascontiguousarray(forces, "<f4").reshape(-1))


class Received(NamedTuple):
    """A message that was read: its stamp in nanoseconds, None where it has none, and its values of
    shape (n_rows, n_cols).
    """

    stamp_ns: int | None
    values: npt.NDArray[np.generic]


def _decoded(data: bytes, kind: str) -> Any:
    from rosbags.serde import SerdeError

    try:
        return types().deserialize_cdr(data, kind)
    except (SerdeError, ValueError) as error:  # of texts that are no UTF-8, too
        raise SourceError(f"no {kind}: {' '.join(str(error).split())[:200]}") from error


def _check_grid(n_rows: int, n_cols: int) -> None:
    if not (1 <= n_rows <= MAX_SIDE and 1 <= n_cols <= MAX_SIDE):
        raise SourceError(f"{n_rows} x {n_cols} taxels; allowed are 1..{MAX_SIDE} each")


def read_image(data: bytes) -> Received:
    """Read a sensor_msgs/Image of one number a pixel.
    Raises SourceError if it is none, or states sizes that do not fit together.
    """
    found = _decoded(data, IMAGE)
    n_rows, n_cols, encoding = found.height, found.width, found.encoding
    _check_grid(n_rows, n_cols)
    if encoding not in FORMATS:
        raise SourceError(f"encoding {encoding[:32]!r}; allowed are {', '.join(FORMATS)}")
    dtype = np.dtype((">" if found.is_bigendian else "<") + FORMATS[encoding])
    used, size = n_cols * dtype.itemsize, len(found.data)
    if found.step < used or size != found.step * n_rows:
        raise SourceError(f"step {found.step}, {size} bytes for {n_rows} x {n_cols} of {encoding}")
    values = np.ascontiguousarray(found.data.reshape(n_rows, -1)[:, :used]).view(dtype)
    stamp_ns = found.header.stamp.sec * 1_000_000_000 + found.header.stamp.nanosec
    return Received(stamp_ns or None, values)


def read_array(data: bytes) -> Received:
    """Read a std_msgs/Float32MultiArray of two dimensions.
    Raises SourceError if it is none, or states sizes that do not fit together.
    """
    found = _decoded(data, ARRAY)
    shape = [dimension.size for dimension in found.layout.dim]
    if len(shape) != 2:
        raise SourceError(f"{len(shape)} dimensions; expected 2: rows, columns")
    _check_grid(*shape)
    offset, n = found.layout.data_offset, shape[0] * shape[1]
    if offset + n > len(found.data):
        raise SourceError(
            f"{len(found.data)} numbers, from {offset} on, for {shape[0]} x {shape[1]}"
        )
    return Received(None, found.data[offset : offset + n].reshape(shape))
