"""Messages of ROS 2 in CDR, the form in which DDS and bags hold them: definitions and bytes by
rosbags, which needs no ROS.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Contacts, SkinState
from sparseskin.nodes.numerics.arrays import Doubles, Floats

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

    store = Stores.ROS2_JAZZY if ros == 2 else Stores.ROS1_NOETIC
    return get_typestore(store)


def encoded(kind: str, **fields: object) -> bytes:
    """CDR, little endian, of a message such as "std_msgs/msg/Bool" with the stated fields."""
    store = types()
    return bytes(store.serialize_cdr(store.types[kind](**fields), kind))


def _header(stamp: tuple[int, int], frame_id: str) -> Any:
    message_types = types().types
    time = message_types["builtin_interfaces/msg/Time"](*stamp)
    return message_types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


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


def cloud(
    stamp: tuple[int, int], frame_id: str, columns: Mapping[str, Floats]
) -> bytes:
    """A sensor_msgs/PointCloud2 of `point_columns`."""
    field = types().types["sensor_msgs/msg/PointField"]
    points = np.stack(list(columns.values()), axis=1)
    n, n_fields = points.shape
    fields = []
    for k, name in enumerate(columns):
        kind = UINT32 if name == ROW else FLOAT32
        fields.append(field(name, 4 * k, kind, 1))
    return encoded(
        CLOUD,
        header=_header(stamp, frame_id),
        height=1,
        width=n,
        fields=fields,
        is_bigendian=False,
        point_step=4 * n_fields,
        row_step=4 * n_fields * n,
        data=_bytes_of(points),
        is_dense=True,
    )


def array(values: Floats, labels: tuple[str, str] = ("rows", "cols")) -> bytes:
    """A std_msgs/Float32MultiArray of values (n_rows, n_cols), row after row."""
    message_types = types().types
    n_rows, n_cols = values.shape
    row_label, col_label = labels
    dimension = message_types["std_msgs/msg/MultiArrayDimension"]
    sides = [
        dimension(row_label, n_rows, n_rows * n_cols),
        dimension(col_label, n_cols, n_cols),
    ]
    layout = message_types["std_msgs/msg/MultiArrayLayout"](dim=sides, data_offset=0)
    return encoded(
        ARRAY, layout=layout, data=np.ascontiguousarray(values, "<f4").reshape(-1)
    )


def contact_array(contacts: Contacts) -> bytes:
    """A std_msgs/Float32MultiArray with a row for each contact; the second label names the columns,
    separated by commas.
    """
    columns = numbers(contacts)
    table = np.column_stack(list(columns.values()))
    return array(table, ("contacts", ",".join(columns)))


def contact_wrench(stamp: tuple[int, int], contacts: Contacts) -> bytes:
    """A geometry_msgs/WrenchStamped of all contacts together, in the frame of the patch."""
    message_types = types().types
    vector = message_types["geometry_msgs/msg/Vector3"]
    parts = [vector(*part.tolist()) for part in wrench(contacts)]
    return encoded(
        WRENCH,
        header=_header(stamp, contacts.patch),
        wrench=message_types["geometry_msgs/msg/Wrench"](*parts),
    )


def contact_markers(
    stamp: tuple[int, int], contacts: Contacts, skin: SkinState
) -> bytes:
    """A visualization_msgs/MarkerArray, which replaces the one before: of each contact a sphere, an
    arrow and a text, in the namespaces of these names, with its id.
    """
    colour = types().types["std_msgs/msg/ColorRGBA"](*COLOURS[contacts.trusted[0]])
    marker = _marker_maker(_header(stamp, contacts.patch), colour)

    # The first one deletes those of the frame before.
    markers = [marker("", SPHERE, 0, (0.0, 0.0, 0.0), ORIGIN, action=DELETE_ALL)]
    for shape in shapes(contacts, skin):
        number = shape.id
        d = shape.diameter
        tail = shape.tail
        tip = shape.centre
        markers += [
            marker("sphere", SPHERE, number, (d, d, d / 4), tip),
            marker(
                "arrow", ARROW, number, (d / 4, d / 2, 0.0), ORIGIN, ends=(tail, tip)
            ),
            marker("text", TEXT, number, (0.0, 0.0, d), tail, text=shape.text),
        ]
    return encoded(MARKERS, markers=markers)


def _marker_maker(header: Any, colour: Any) -> Callable[..., Any]:
    """A function that makes markers of one header and colour."""
    message_types = types().types
    point = message_types["geometry_msgs/msg/Point"]
    vector = message_types["geometry_msgs/msg/Vector3"]

    # What all markers share; members that none uses are empty.
    upright = message_types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    never = message_types["builtin_interfaces/msg/Duration"](0, 0)
    none = np.zeros(0, np.uint8)
    texture = message_types["sensor_msgs/msg/CompressedImage"](header, "", none)
    mesh = message_types["visualization_msgs/msg/MeshFile"]("", none)

    def marker(
        name: str,
        kind: int,
        number: int,
        scale: tuple[float, float, float],
        place: Doubles,
        action: int = ADD,
        ends: Sequence[Doubles] = (),
        text: str = "",
    ) -> Any:
        pose = message_types["geometry_msgs/msg/Pose"](point(*place.tolist()), upright)
        return message_types["visualization_msgs/msg/Marker"](
            header=header,
            ns=name,
            id=number,
            type=kind,
            action=action,
            pose=pose,
            scale=vector(*scale),
            color=colour,
            lifetime=never,
            frame_locked=False,
            points=[point(*end.tolist()) for end in ends],
            colors=[],
            texture_resource="",
            texture=texture,
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=mesh,
            mesh_use_embedded_materials=False,
        )

    return marker
