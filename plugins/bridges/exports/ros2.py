"""Export of a bag to a bag of ROS 2."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import (
    Contacts,
    Measurements,
    Message,
    Reconstruction,
    SkinState,
)
from sparseskin.messages.frames import values_alone
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.recorder.bag.format import BagError
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
from sparseskin.plugins.bridges import cdr
from sparseskin.plugins.bridges.base import check_installed

_MAX_SECONDS = (1 << 31) - 1
BOOL, FLOAT, STRING = (f"std_msgs/msg/{name}" for name in ("Bool", "Float32", "String"))


def export_ros2(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder `out` with NAME.mcap and metadata.yaml (rosbag2, version 8); their paths.

    A frame becomes a sensor_msgs/msg/Image, 32FC1, measurements 1 x M, with its stamp and the
    patch as frame_id; its numbers std_msgs/msg/Float32 and Bool on .../total_force, .../residual,
    .../error, .../trusted; contacts are WrenchStamped, MarkerArray and Float32MultiArray on
    .../wrench, .../markers, .../array; skin, calibration, Phi and solver JSON in a String.

    Raises BagError if rosbags is not installed, the bag has no such frames, or a stamp
    does not fit into ROS's 31 bits of seconds; OutputError if the folder exists or cannot be
    written.
    """
    check_installed("writing for ROS 2", "ros2", "rosbags", error=BagError)
    from rosbags.rosbag2 import StoragePlugin, Writer

    wanted = with_states(bag, stream_topics(bag, topics))
    skins = {patch: skin_of(bag, patch) for patch in {patch_of(topic) for topic in wanted}}
    connections: dict[str, Any] = {}
    with whole_folder(out):
        out.rmdir()  # the writer makes it
        with Writer(out, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            for message, log_time_ns in streams(bag, wanted, "export"):
                for topic, kind, data in _messages(message, skins[message.patch], bag.path):
                    if topic not in connections:
                        made = writer.add_connection(topic, kind, typestore=cdr.types())
                        connections[topic] = made
                    writer.write(connections[topic], log_time_ns, data)
        return sorted(out.iterdir())


def _messages(
    message: Message, skin: SkinState | None, path: Path
) -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and CDR of all that is written of one message."""
    topic = message.topic
    values = values_alone(message)
    stamp = divmod(message.stamp_ns, 1_000_000_000)
    if stamp[0] > _MAX_SECONDS:
        raise BagError(f"{path}: stamp {message.stamp_ns} is beyond what ROS 2 holds, 2**31 s")

    def image(array: npt.NDArray[np.float32]) -> tuple[str, bytes]:
        return cdr.IMAGE, cdr.image(stamp, message.patch, array)

    def one(kind: str, value: object) -> tuple[str, bytes]:
        return kind, cdr.encoded(kind, data=value)

    if isinstance(message, STATES):
        yield topic, *one(STRING, json.dumps(state_json(message)))
    elif isinstance(message, Contacts):
        yield f"{topic}/wrench", cdr.WRENCH, cdr.contact_wrench(stamp, message)
        yield f"{topic}/array", cdr.ARRAY, cdr.contact_array(message)
        if skin is not None:
            yield f"{topic}/markers", cdr.MARKERS, cdr.contact_markers(stamp, message, skin)
    elif isinstance(message, Measurements):
        yield topic, *image(np.asarray(message.y))
    elif (forces := values.get("forces")) is not None:
        yield topic, *image(forces)
        yield f"{topic}/total_force", *one(FLOAT, float(forces.sum(dtype=np.float64)))
    if isinstance(message, Reconstruction):
        yield f"{topic}/residual", *one(FLOAT, values["residual"])
        if values["sd"] is not None:
            yield f"{topic}/sd", *image(values["sd"])
        if values["error"] is not None:
            yield f"{topic}/error", *one(FLOAT, values["error"])
        if values["error"] is not None or not values["trusted"]:
            yield f"{topic}/trusted", *one(BOOL, values["trusted"])
