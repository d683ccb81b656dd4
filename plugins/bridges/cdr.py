"""Messages of ROS 2 in CDR, the form in which DDS and bags hold them: definitions and bytes by
rosbags, which needs no ROS.
"""

import functools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from sparseskin.messages import Contacts, SkinState
from sparseskin.nodes.numerics.arrays import Bytes, Floats

from .base import ROW
from .contacts import COLOURS, numbers, shapes, wrench

IMAGE = "sensor_msgs/msg/Image"
CLOUD = "sensor_msgs/msg/PointCloud2"
ARRAY = "std_msgs/msg/Float32MultiArray"
WRENCH = "geometry_msgs/msg/WrenchStamped"
MARKERS = "visualization_msgs/msg/MarkerArray"
MARKER = "visualization_msgs/msg/Marker"
FIELD = "sensor_msgs/msg/PointField"
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
"""A quaternion x, y, z, w that turns nothing."""
Stated = Mapping[str, Any] | Iterable[Any]
"""Members of a message by name, or the first ones in their order."""


@functools.cache
def types(ros: int = 2) -> Any:
    """Messages of ROS 2 Jazzy, or of ROS 1 Noetic, a `Typestore` of rosbags.
    Raises ImportError without rosbags.
    """
    from rosbags.typesys import Stores, get_typestore

    store = Stores.ROS2_JAZZY if ros == 2 else Stores.ROS1_NOETIC
    return get_typestore(store)


def message(kind: str, stated: Stated = ()) -> Any:
    """A message such as "std_msgs/msg/Header" with the stated members, and zeros for the others.
    Messages within it are stated likewise.
    """
    store = types()
    _, members = store.fielddefs[kind]
    # Short messages, as times and points, are stated by position.
    if not isinstance(stated, Mapping):
        names = [name for name, _ in members]
        stated = dict(zip(names, stated, strict=False))
    values = [_member(form, stated.get(name)) for name, form in members]
    return store.types[kind](*values)


def _member(form: Any, value: Any) -> Any:
    """The value of a member, by its form in a definition of rosbags; None: zeros."""
    _, detail = form
    # The name of a type; a base type and its length; or the form of the entries of a list.
    if isinstance(detail, str):
        return _zeros(detail) if value is None else message(detail, value)
    if not isinstance(detail[0], str):
        _, entry = detail[0]
        if isinstance(entry, str):
            return [message(entry, part) for part in value or ()]
        return np.zeros(0, np.uint8) if value is None else value
    if value is None:
        return "" if detail[0] == "string" else 0
    return value


@functools.cache
def _zeros(kind: str) -> Any:
    """A message of zeros, which is in many others."""
    return message(kind)


def encoded(kind: str, **stated: Any) -> bytes:
    """CDR, little endian, of a `message`."""
    return bytes(types().serialize_cdr(message(kind, stated), kind))


def _bytes_of(values: Floats) -> Bytes:
    # Bytes are viewed, not copied, where the values are in this form already.
    return np.ascontiguousarray(values, "<f4").reshape(-1).view(np.uint8)


def image(stamp: tuple[int, int], frame_id: str, forces: Floats) -> bytes:
    """A sensor_msgs/Image in 32FC1 of forces (n_rows, n_cols), with its stamp in s and ns."""
    return encoded(
        IMAGE,
        header=(stamp, frame_id),
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
    number_of = types().types[FIELD]
    # A point is a record of its columns, four bytes each.
    points = np.stack(list(columns.values()), axis=1)
    n, n_fields = points.shape
    fields = []
    for k, name in enumerate(columns):
        kind = number_of.UINT32 if name == ROW else number_of.FLOAT32
        fields.append((name, 4 * k, kind, 1))
    return encoded(
        CLOUD,
        header=(stamp, frame_id),
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
    n_rows, n_cols = values.shape
    row_label, col_label = labels
    # The stride of a dimension counts the numbers within it, itself included.
    sides = [(row_label, n_rows, n_rows * n_cols), (col_label, n_cols, n_cols)]
    data = np.ascontiguousarray(values, "<f4").reshape(-1)
    return encoded(ARRAY, layout=(sides,), data=data)


def contact_array(contacts: Contacts) -> bytes:
    """A std_msgs/Float32MultiArray with a row for each contact; the second label names the columns,
    separated by commas.
    """
    columns = numbers(contacts)
    table = np.column_stack(list(columns.values()))
    return array(table, ("contacts", ",".join(columns)))


def contact_wrench(stamp: tuple[int, int], contacts: Contacts) -> bytes:
    """A geometry_msgs/WrenchStamped of all contacts together, in the frame of the patch."""
    parts = [part.tolist() for part in wrench(contacts)]
    return encoded(WRENCH, header=(stamp, contacts.patch), wrench=parts)


def contact_markers(
    stamp: tuple[int, int], contacts: Contacts, skin: SkinState
) -> bytes:
    """A visualization_msgs/MarkerArray, which replaces the one before: of each contact a sphere, an
    arrow and a text, in the namespaces of these names, with its id.
    """
    # Numbers of the types and actions.
    number_of = types().types[MARKER]
    # Markers of one frame differ in shape and place alone.
    shared = {
        "header": (stamp, contacts.patch),
        "color": COLOURS[contacts.trusted[0]],
        "pose": ((), UPRIGHT),
    }

    # The first one deletes those of the frame before.
    markers = [shared | {"action": number_of.DELETEALL}]
    for shape in shapes(contacts, skin):
        d = shape.diameter
        sphere = {
            "ns": "sphere",
            "type": number_of.SPHERE,
            "pose": (shape.centre, UPRIGHT),
            "scale": (d, d, d / 4),
        }
        arrow = {
            "ns": "arrow",
            "type": number_of.ARROW,
            "scale": (d / 4, d / 2),
            "points": (shape.tail, shape.centre),
        }
        text = {
            "ns": "text",
            "type": number_of.TEXT_VIEW_FACING,
            "pose": (shape.tail, UPRIGHT),
            "scale": (0, 0, d),
            "text": shape.text,
        }
        markers += [shared | {"id": shape.id} | it for it in (sphere, arrow, text)]
    return encoded(MARKERS, markers=markers)
