"""Export of a bag to a bag of ROS 2."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import (
    Contacts,
    Measurements,
    Message,
    Reconstruction,
    SkinState,
)
from sparseskin.messages.frames import values_alone
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.numerics.arrays import Floats
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
from sparseskin.plugins.bridges.ros2 import OF_CONTACTS

_MAX_SECONDS = (1 << 31) - 1
BOOL = "std_msgs/msg/Bool"
FLOAT = "std_msgs/msg/Float32"
STRING = "std_msgs/msg/String"


def export_ros2(
    bag: BagReader, out: Path, topics: Iterable[str] | None = None
) -> list[Path]:
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

    # What is wrong with the bag is reported before a folder is made.
    read_topics = with_states(bag, stream_topics(bag, topics))
    patches = {patch_of(topic) for topic in read_topics}
    skins = {patch: skin_of(bag, patch) for patch in patches}
    connections: dict[str, Any] = {}
    with whole_folder(out):
        # The writer makes it.
        out.rmdir()
        with Writer(out, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            for message, log_time_ns in streams(bag, read_topics, "export"):
                skin = skins[message.patch]
                for topic, kind, data in _messages(message, skin, bag.path):
                    # Only topics with a message are in the bag.
                    if topic not in connections:
                        connections[topic] = writer.add_connection(
                            topic, kind, typestore=cdr.types()
                        )
                    writer.write(connections[topic], log_time_ns, data)
        return sorted(out.iterdir())


def _messages(
    message: Message, skin: SkinState | None, path: Path
) -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and CDR of all that is written of one message."""
    topic = message.topic
    values = values_alone(message)
    forces = values.get("forces")
    stamp = divmod(message.stamp_ns, 1_000_000_000)
    if stamp[0] > _MAX_SECONDS:
        raise BagError(
            f"{path}: stamp {message.stamp_ns} is beyond what ROS 2 holds, 2**31 s"
        )

    def image(array: Floats) -> tuple[str, bytes]:
        return cdr.IMAGE, cdr.image(stamp, message.patch, array)

    def scalar(kind: str, value: object) -> tuple[str, bytes]:
        return kind, cdr.encoded(kind, data=value)

    # States are texts, as ROS has no messages for them.
    if isinstance(message, STATES):
        yield topic, *scalar(STRING, json.dumps(state_json(message)))
    elif isinstance(message, Contacts):
        for name, (ending, kind, make) in OF_CONTACTS.items():
            # What is drawn has the unit and the range of the skin.
            if skin is not None or name != "markers":
                yield topic + ending, kind, make(message, skin)
    elif isinstance(message, Measurements):
        yield topic, *image(np.asarray(message.y))
    elif forces is not None:
        yield topic, *image(forces)
        # A float32 would round the sum of many taxels.
        total = float(forces.sum(dtype=np.float64))
        yield f"{topic}/total_force", *scalar(FLOAT, total)

    if isinstance(message, Reconstruction):
        yield f"{topic}/residual", *scalar(FLOAT, values["residual"])
        if values["sd"] is not None:
            yield f"{topic}/sd", *image(values["sd"])
        if values["error"] is not None:
            yield f"{topic}/error", *scalar(FLOAT, values["error"])
        # A frame whose error nobody estimated is trusted by default: that says nothing.
        if values["error"] is not None or not values["trusted"]:
            yield f"{topic}/trusted", *scalar(BOOL, values["trusted"])
