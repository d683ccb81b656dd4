"""Export of a bag to an .mcap of Foxglove's schemas, for viewers."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Contacts, Measurements, Message, SkinState
from sparseskin.messages.fields import Flag, Integer, Real
from sparseskin.messages.frames import kinds_alone, values_alone
from sparseskin.nodes.files import OutputError, whole_file
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.recorder.bag.format import GRAPH_RECORD, JSON_KEY, BagError
from sparseskin.nodes.recorder.bag.frames import (
    STATES,
    patch_of,
    skin_of,
    state_json,
    stream_topics,
    streams,
    with_states,
)
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.bridges.base import (
    ROW,
    UNKNOWN_PITCH_M,
    check_installed,
    point_columns,
)
from sparseskin.plugins.bridges.contacts import (
    COLOURS,
    Shape,
    as_json,
    json_schema,
    shapes,
)

FLOAT32_BYTES = 4
Schema = str | Mapping[str, Any]
"""Schema of a channel: a name of Foxglove's, "json", or a JSON Schema."""


def export_foxglove(
    bag: BagReader, out: Path, topics: Iterable[str] | None = None
) -> list[Path]:
    """Write one .mcap with the schemas of Foxglove; its path.

    It has the `contents` of all messages, skin, calibration, Phi and solver as JSON on /PATCH/skin,
    /PATCH/phi ..., and the bag's metadata. Stamps are those of the acquisition, log times those of
    the recording.

    Raises BagError if foxglove-sdk is not installed or the bag has no such frames, OutputError if
    the file exists or cannot be written.
    """
    check_installed("writing for Foxglove", "foxglove", "foxglove", error=BagError)
    import foxglove

    # What is wrong with the bag is reported before a file is begun.
    frame_topics = stream_topics(bag, topics)
    if out.suffix != ".mcap":
        raise OutputError(f"{out}: expected a name that ends in .mcap")
    # The skin states pitch, unit and places, which single frames do not repeat.
    patches = {patch_of(topic) for topic in frame_topics}
    skins = {patch: skin_of(bag, patch) for patch in patches}
    with whole_file(out) as draft:
        context = foxglove.Context()
        try:
            writer = foxglove.open_mcap(draft, context=context)
        except (OSError, ValueError, RuntimeError) as error:
            raise OutputError(f"{out}: {error}") from error
        with writer:
            # The launch file and the counts stay with the data.
            if bag.metadata:
                writer.write_metadata(GRAPH_RECORD, bag.metadata)
            if bag.counts is not None:
                writer.write_metadata("counts", {JSON_KEY: json.dumps(bag.counts)})

            channels = Channels(context)
            topics_read = with_states(bag, frame_topics)
            for message, log_time_ns in streams(bag, topics_read, "export"):
                if isinstance(message, STATES):
                    channel = channels.of(message.topic, "json")
                    channel.log(state_json(message), log_time=log_time_ns)
                for topic, schema, make in contents(message, skins[message.patch]):
                    channels.of(topic, schema).log(make(), log_time=log_time_ns)
    return [out]


class Channels(dict[str, Any]):
    """Channels of a context by topic, each made when it is first used."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def of(self, topic: str, schema: Schema) -> Any:
        """The channel of a topic."""
        import foxglove
        from foxglove import channels

        if topic not in self:
            channel_of: Any = foxglove.Channel
            # A mapping is a JSON Schema; a name is that of one of the SDK's own channels.
            options: dict[str, Any] = {"schema": schema}
            if schema == "json":
                options = {"message_encoding": "json"}
            elif isinstance(schema, str):
                channel_of = getattr(channels, f"{schema}Channel")
                options = {}
            self[topic] = channel_of(topic, context=self._context, **options)
        return self[topic]


def contents(
    message: Message, skin: SkinState | None, more: Mapping[str, float] | None = None
) -> Iterator[tuple[str, Schema, Callable[[], Any]]]:
    """Topic, schema and a function that makes the content of all that is sent of one message:

    - a frame as RawImage on its own topic, measurements as 1 x M, standard deviations on .../sd;
    - taxels, truth and reconstruction as Grid on .../grid, metres, with the middle of the skin as
      origin of the frame PATCH; of a skin of points also as PointCloud on .../points, with normals
      and, where known, the row of each point in its file; layers `force`, and `sd` where known;
    - numbers of the message, the sum of the frame and `more` as JSON on .../figures;
    - contacts as JSON on their own topic, and as SceneUpdate on .../scene.
    """
    topic = message.topic
    cls = type(message)
    values = values_alone(message)
    forces = values.get("forces")
    sd = values.get("sd")
    if isinstance(message, Contacts):
        yield topic, json_schema(message), lambda: as_json(message)
        if skin is not None:
            yield f"{topic}/scene", "SceneUpdate", lambda: contact_scene(message, skin)
    elif isinstance(message, Measurements):
        yield topic, "RawImage", lambda: raw_image(message, np.asarray(message.y))
    elif forces is not None:
        # Both layers are fields of one grid, so that a viewer switches between them.
        layers = {"force": forces}
        yield topic, "RawImage", lambda: raw_image(message, forces)
        if sd is not None:
            layers["sd"] = sd
            yield f"{topic}/sd", "RawImage", lambda: raw_image(message, sd)
        yield f"{topic}/grid", "Grid", lambda: grid(message, layers, skin)
        if skin is not None and skin.points is not None:
            yield (
                f"{topic}/points",
                "PointCloud",
                lambda: point_cloud(message, layers, skin),
            )
    if "forces" in values:
        # A bridge adds what only a live graph has, as the latency.
        further = dict(more or {})
        schema = figures_schema(cls, further)
        yield f"{topic}/figures", schema, lambda: figures_of(message) | further


def figure_names(cls: type[Message]) -> list[str]:
    """Names of the numbers of a message class; of frames the sum first."""
    fields = kinds_alone(cls)
    names = ["total_force"] if "forces" in fields else []
    for name, kind in fields.items():
        if isinstance(kind, Real | Integer | Flag) and name not in ("run_id", "seq"):
            names.append(name)
    return names


def figures_of(message: Message) -> dict[str, float]:
    """Numbers of a message by name, without those that it does not have."""
    values = values_alone(message)
    forces = values.get("forces")
    if forces is not None:
        values["total_force"] = float(forces.sum(dtype="f8"))
    names = figure_names(type(message))
    return {name: values[name] for name in names if values[name] is not None}


def figures_schema(cls: type[Message], more: Iterable[str] = ()) -> dict[str, Any]:
    """JSON Schema of the numbers of a message class and of those that `more` names."""
    properties = {name: {"type": "number"} for name in (*figure_names(cls), *more)}
    # All others are numbers.
    properties["trusted"] = {"type": "boolean"}
    return {
        "type": "object",
        "title": "sparseskin.Figures",
        "properties": properties,
    }


def raw_image(message: Message, array: Floats) -> Any:
    """foxglove.RawImage of a frame, float32 (n_rows, n_cols)."""
    from foxglove.messages import RawImage

    return RawImage(
        timestamp=_timestamp(message.stamp_ns),
        frame_id=message.patch,
        width=array.shape[1],
        height=array.shape[0],
        encoding="32FC1",
        step=FLOAT32_BYTES * array.shape[1],
        data=array.astype("<f4").tobytes(),
    )


def grid(message: Message, layers: dict[str, Floats], skin: SkinState | None) -> Any:
    """foxglove.Grid of the layers of a frame, each float32 (n_rows, n_cols)."""
    from foxglove.messages import Grid, Vector2

    n_rows, n_cols = next(iter(layers.values())).shape
    side = UNKNOWN_PITCH_M
    if skin is not None and skin.pitch_m:
        side = skin.pitch_m
    # Layers of one cell stand beside each other.
    data = np.stack([layer.astype("<f4") for layer in layers.values()], axis=-1)
    return Grid(
        timestamp=_timestamp(message.stamp_ns),
        frame_id=message.patch,
        pose=_pose(-n_cols * side / 2, -n_rows * side / 2),
        column_count=n_cols,
        cell_size=Vector2(x=side, y=side),
        row_stride=FLOAT32_BYTES * len(layers) * n_cols,
        cell_stride=FLOAT32_BYTES * len(layers),
        fields=_fields(layers),
        data=data.tobytes(),
    )


def point_cloud(message: Message, layers: dict[str, Floats], skin: SkinState) -> Any:
    """foxglove.PointCloud of the layers of a frame on a skin of points; see `point_columns`."""
    from foxglove.messages import PointCloud

    columns = point_columns(skin, layers, normals=True)
    return PointCloud(
        timestamp=_timestamp(message.stamp_ns),
        frame_id=message.patch,
        pose=_pose(0.0, 0.0),
        point_stride=FLOAT32_BYTES * len(columns),
        fields=_fields(columns),
        data=np.stack(list(columns.values()), axis=1).astype("<f4").tobytes(),
    )


def contact_scene(message: Contacts, skin: SkinState) -> Any:
    """foxglove.SceneUpdate of the contacts of a frame, which replaces the one before."""
    from foxglove import messages as primitives

    at = _timestamp(message.stamp_ns)
    # The middle of a flat skin is the origin of its frame.
    middle = np.zeros(3)
    if skin.points is None:
        side = skin.pitch_m or UNKNOWN_PITCH_M
        middle[0] = side * (skin.n_cols - 1) / 2
        middle[1] = side * (skin.n_rows - 1) / 2

    red, green, blue, opacity = COLOURS[message.trusted[0]]
    colour = primitives.Color(
        r=red,
        g=green,
        b=blue,
        a=opacity,
    )

    entities = []
    for shape in shapes(message, skin):
        entity = primitives.SceneEntity(
            timestamp=at,
            frame_id=message.patch,
            id=str(shape.id),
            **_contact_primitives(shape, middle, colour),
        )
        entities.append(entity)
    # Contacts that have ended would stay otherwise.
    everything = primitives.SceneEntityDeletion(
        timestamp=at, type=primitives.SceneEntityDeletionType.All
    )
    return primitives.SceneUpdate(deletions=[everything], entities=entities)


def _contact_primitives(shape: Shape, middle: Doubles, colour: Any) -> dict[str, Any]:
    """Primitives of a SceneEntity: arrow, sphere and text of a contact."""
    from foxglove import messages as primitives

    d = shape.diameter
    centre = shape.centre - middle
    tail = shape.tail - middle

    # An arrow of a viewer is given by its tail and a turn of the x axis.
    length = float(np.linalg.norm(centre - tail))
    head = min(d / 2, length)
    turn = _turn_from_x((centre - tail) / (length or 1.0))
    arrow = primitives.ArrowPrimitive(
        pose=_pose(*tail, *turn),
        shaft_length=length - head,
        shaft_diameter=d / 4,
        head_length=head,
        head_diameter=d / 2,
        color=colour,
    )
    sphere = primitives.SpherePrimitive(
        pose=_pose(*centre),
        size=primitives.Vector3(
            x=d,
            y=d,
            z=d / 4,
        ),
        color=colour,
    )
    text = primitives.TextPrimitive(
        pose=_pose(*tail),
        billboard=True,
        font_size=d,
        color=colour,
        text=shape.text,
    )
    return {
        "arrows": [arrow],
        "spheres": [sphere],
        "texts": [text],
    }


def _turn_from_x(direction: Doubles) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of the shortest turn of the x axis into a unit vector."""
    x, y, z = direction.tolist()
    # From x to -x every turn is as short: one about z is taken.
    if x < -0.999999:
        return (0.0, 0.0, 1.0, 0.0)
    # From the double-angle formulas: w = cos(a/2), with cos(a) = x.
    half = float(np.sqrt(2 + 2 * x))
    return (0.0, -z / half, y / half, half / 2)


def _pose(x: float, y: float, z: float = 0.0, *turn: float) -> Any:
    """A pose turned by a quaternion, x, y, z, w; none: not turned."""
    from foxglove.messages import Pose, Quaternion, Vector3

    qx, qy, qz, qw = turn or (0.0, 0.0, 0.0, 1.0)
    orientation = Quaternion(
        x=qx,
        y=qy,
        z=qz,
        w=qw,
    )
    return Pose(
        position=Vector3(
            x=x,
            y=y,
            z=z,
        ),
        orientation=orientation,
    )


def _fields(names: Iterable[str]) -> list[Any]:
    """Fields of four bytes each, one after the other: `ROW` uint32, others float32."""
    from foxglove.messages import PackedElementField, PackedElementFieldNumericType

    types = PackedElementFieldNumericType
    fields = []
    for k, name in enumerate(names):
        kind = types.Uint32 if name == ROW else types.Float32
        # All columns have four bytes, whatever their type is.
        offset = FLOAT32_BYTES * k
        fields.append(
            PackedElementField(
                name=name,
                offset=offset,
                type=kind,
            )
        )
    return fields


def _timestamp(stamp_ns: int) -> Any:
    from foxglove.messages import Timestamp

    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    try:
        return Timestamp(sec=seconds, nsec=nanoseconds)
    except (ValueError, OverflowError) as error:
        raise BagError(
            f"stamp {stamp_ns} is beyond what Foxglove can hold, 2**32 seconds"
        ) from error
