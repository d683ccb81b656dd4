"""Export of a bag to a folder for ROS 2 tools: messages in CDR, and metadata.yaml."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt
from mcap.writer import Writer

from sparseskin.messages import (
    Contacts,
    Measurements,
    Message,
    Reconstruction,
    Resultant,
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
from sparseskin.plugins.bridges.base import RESULTANT, check_installed

_MAX_SECONDS = (1 << 31) - 1
BOOL, FLOAT, STRING = (f"std_msgs/msg/{name}" for name in ("Bool", "Float32", "String"))


def export_ros2(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder `out` with NAME_0.mcap and metadata.yaml (rosbag2, version 5); their paths.

    /PATCH/SCHEMA becomes sensor_msgs/msg/Image, encoding 32FC1: n_rows x n_cols, measurements
    1 x M; its header has the stamp, and the patch as frame_id. Beside it stand, each a
    std_msgs/msg/Float32, /PATCH/SCHEMA/total_force (the sum over the taxels, in the skin's unit;
    not of measurements) and /PATCH/reconstruction/residual; where the solver estimates its error,
    /PATCH/reconstruction/error, and /PATCH/reconstruction/trusted, a std_msgs/msg/Bool. Standard
    deviations are an Image on /PATCH/reconstruction/sd, the resultant's numbers Float32 on
    /PATCH/resultant/NAME. Contacts are, of all together, a geometry_msgs/msg/WrenchStamped on
    /PATCH/contacts/wrench, and each a part of a visualization_msgs/msg/MarkerArray on
    /PATCH/contacts/markers and a row of a std_msgs/msg/Float32MultiArray on /PATCH/contacts/array.
    Skin (with its mask), calibration, Phi and solver are JSON in a std_msgs/msg/String on
    /PATCH/skin, /PATCH/phi ...

    Raises BagError if rosbags is not installed, the bag has no such frames, or a stamp
    does not fit into ROS's 31 bits of seconds; OutputError if the folder exists or cannot be
    written.
    """
    check_installed("writing for ROS 2", "ros2", "rosbags", error=BagError)
    wanted = with_states(bag, stream_topics(bag, topics))
    skins = {patch: skin_of(bag, patch) for patch in {patch_of(topic) for topic in wanted}}
    counts: Counter[tuple[str, str]] = Counter()
    first_ns = last_ns = -1
    with whole_folder(out):
        path = out / f"{out.name}_0.mcap"
        with open(path, "xb") as file:
            channels = _Channels(file)
            for message, log_time_ns in streams(bag, wanted, "export"):
                for topic, kind, data in _messages(message, skins[message.patch], bag.path):
                    channels.write(topic, kind, data, log_time_ns, message.stamp_ns)
                    counts[topic, kind] += 1
                first_ns = log_time_ns if first_ns < 0 else min(first_ns, log_time_ns)
                last_ns = max(last_ns, log_time_ns)
            channels.finish()
        described = out / "metadata.yaml"
        described.write_text(_metadata(path.name, counts, first_ns, last_ns), encoding="utf-8")
    return [path, described]


class _Channels:
    """Channels of an .mcap by topic, each made when it is first used."""

    def __init__(self, file: IO[bytes]) -> None:
        self._writer = Writer(file)
        self._writer.start("ros2", "sparseskin")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, kind: str, data: bytes, log_time_ns: int, stamp_ns: int) -> None:
        if kind not in self._schemas:
            text = cdr.types().generate_msgdef(kind, ros_version=2)[0]
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self._channels:
            schema = self._schemas[kind]
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        self._writer.add_message(self._channels[topic], log_time_ns, data, stamp_ns)

    def finish(self) -> None:
        self._writer.finish()


def _messages(
    message: Message, skin: SkinState | None, path: Path
) -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and CDR of all that is written of one message."""
    topic, values = message.topic, values_alone(message)
    stamp = divmod(message.stamp_ns, 1_000_000_000)
    if stamp[0] > _MAX_SECONDS:
        raise BagError(
            f"{path}: stamp {message.stamp_ns} is beyond what ROS 2 can hold, 2**31 seconds"
        )

    def image(array: npt.NDArray[np.float32]) -> tuple[str, bytes]:
        return cdr.IMAGE, cdr.image(stamp, message.patch, array)

    def one(kind: str, value: object) -> tuple[str, bytes]:
        return kind, cdr.encoded(kind, data=value)

    if isinstance(message, STATES):
        yield topic, *one(STRING, json.dumps(state_json(message)))
    elif isinstance(message, Resultant):
        for name in RESULTANT:
            if (value := getattr(message, name)) is not None:
                yield f"{topic}/{name}", *one(FLOAT, value)
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


def _metadata(file_name: str, counts: Counter[tuple[str, str]], first_ns: int, last_ns: int) -> str:
    """Text of metadata.yaml; it is JSON, which YAML contains."""
    times = {
        "starting_time": {"nanoseconds_since_epoch": first_ns},
        "duration": {"nanoseconds": last_ns - first_ns},
        "message_count": counts.total(),
    }
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": "",
            },
            "message_count": n,
        }
        for (topic, kind), n in counts.items()
    ]
    bag = {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": [file_name],
        **times,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file_name, **times}],
    }
    return json.dumps({"rosbag2_bagfile_information": bag}, indent=2) + "\n"
