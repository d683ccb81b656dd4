"""Messages of ROS 2 in CDR, the form in which DDS and bags hold them: definitions and bytes by
rosbags, which needs no ROS.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Contacts, SkinState
from sparseskin.nodes.numerics.arrays import Floats

from .base import ROW
from .contacts import COLOURS, numbers, shapes, wrench

IMAGE = "sensor_msgs/msg/Image"
CLOUD = "sensor_msgs/msg/PointCloud2"
ARRAY = "std_msgs/msg/Float32MultiArray"
WRENCH = "geometry_msgs/msg/WrenchStamped"
MARKERS = "visualization_msgs/msg/MarkerArray"
UINT32 = 6
FLOAT32 = 7
"""Numbers of the types of a field in sensor_msgs/PointField."""
ARROW = 0
SPHERE = 2
TEXT = 9
ADD = 0
DELETE_ALL = 3
"""Numbers of the types and actions of a visualization_msgs/Marker."""
ORIGIN = np.zeros(3)


@functools.cache
def types(ros: int = 2) -> Any:
    """Messages of ROS 2 Jazzy, or of ROS 1 Noetic, a `Typestore` of rosbags.
    Raises ImportError without rosbags.
    """
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY if ros == 2 else Stores.ROS1_NOETIC)


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


def array(values: Floats, labels: tuple[str, str] = ("rows", "cols")) -> bytes:
    """A std_msgs/Float32MultiArray of values (n_rows, n_cols), row after row."""
    made = types().types
    (n_rows, n_cols) = values.shape
    dimension = made["std_msgs/msg/MultiArrayDimension"]
    sides = [dimension(labels[0], n_rows, n_rows * n_cols), dimension(labels[1], n_cols, n_cols)]
    layout = made["std_msgs/msg/MultiArrayLayout"](dim=sides, data_offset=0)
    return encoded(ARRAY, layout=layout, data=np.ascontiguousarray(values, "<f4").reshape(-1))


def contact_array(contacts: Contacts) -> bytes:
    """A std_msgs/Float32MultiArray with a row for each contact; the second label names the columns,
    separated by commas.
    """
    columns = numbers(contacts)
    return array(np.column_stack(list(columns.values())), ("contacts", ",".join(columns)))


def contact_wrench(stamp: tuple[int, int], contacts: Contacts) -> bytes:
    """A geometry_msgs/WrenchStamped of all contacts together, in the frame of the patch."""
    made = types().types
    vector = made["geometry_msgs/msg/Vector3"]
    parts = [vector(*part.tolist()) for part in wrench(contacts)]
    return encoded(
        WRENCH,
        header=_header(stamp, contacts.patch),
        wrench=made["geometry_msgs/msg/Wrench"](*parts),
    )


def contact_markers(stamp: tuple[int, int], contacts: Contacts, skin: SkinState) -> bytes:
    """A visualization_msgs/MarkerArray, which replaces the one before: of each contact a sphere, an
    arrow and a text, in the namespaces of these names, with its id.
    """
    made = types().types
    header = _header(stamp, contacts.patch)
    point = made["geometry_msgs/msg/Point"]
    vector = made["geometry_msgs/msg/Vector3"]
    upright = made["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    never = made["builtin_interfaces/msg/Duration"](0, 0)
    none = np.zeros(0, np.uint8)
    texture = made["sensor_msgs/msg/CompressedImage"](header, "", none)
    mesh = made["visualization_msgs/msg/MeshFile"]("", none)
    colour = made["std_msgs/msg/ColorRGBA"](*COLOURS[contacts.trusted[0]])

    rows: list[tuple[Any, ...]] = [("", SPHERE, DELETE_ALL, 0, (0.0, 0.0, 0.0), ORIGIN, (), "")]
    for one in shapes(contacts, skin):
        n = one.id
        d = one.diameter
        tail = one.tail
        tip = one.centre
        rows += [
            ("sphere", SPHERE, ADD, n, (d, d, d / 4), tip, (), ""),
            ("arrow", ARROW, ADD, n, (d / 4, d / 2, 0.0), ORIGIN, (tail, tip), ""),
            ("text", TEXT, ADD, n, (0.0, 0.0, d), tail, (), one.text),
        ]
    markers = [
        made["visualization_msgs/msg/Marker"](
            *(header, name, number, kind, action),
            made["geometry_msgs/msg/Pose"](point(*at.tolist()), upright),
            *(vector(*scale), colour, never, False, [point(*end.tolist()) for end in ends]),
            *([], "", texture, [], text, "", mesh, False),
        )
        for name, kind, action, number, scale, at, ends, text in rows
    ]
    return encoded(MARKERS, markers=markers)
