"""Export of a bag to a folder for ROS 2 tools: messages in CDR, and metadata.yaml."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Measurements, Message, Reconstruction, Resultant
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    STATES,
    state_json,
    stream_topics,
    streams,
    with_states,
)
from sparseskin.nodes.recorder.bag.reader import BagReader

INSTALL = 'writing for ROS 2 needs mcap-ros2-support; pip install "sparseskin[ros2]"'
_MAX_SECONDS = (1 << 31) - 1
BOOL = "std_msgs/msg/Bool"
IMAGE = "sensor_msgs/msg/Image"
FLOAT = "std_msgs/msg/Float32"
STRING = "std_msgs/msg/String"
_RESULTANT = ("total", "total_sd", "row", "col", "row_sd", "col_sd")
_LINE = "=" * 80

_MSGDEFS = {
    IMAGE: f"""\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
{_LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_LINE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
""",
    FLOAT: "float32 data\n",
    BOOL: "bool data\n",
    STRING: "string data\n",
}
"""Definitions of the exported messages, as in common_interfaces of ROS 2."""


def export_ros2(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder `out` with NAME_0.mcap and metadata.yaml (rosbag2, version 5); their paths.

    /PATCH/SCHEMA becomes sensor_msgs/msg/Image, encoding 32FC1: n_rows x n_cols, measurements
    1 x M; its header has the stamp, and the patch as frame_id. Beside it stand, each a
    std_msgs/msg/Float32, /PATCH/SCHEMA/total_force (the sum over the taxels, in the skin's unit;
    not of measurements) and /PATCH/reconstruction/residual; where the solver estimates its error,
    /PATCH/reconstruction/error, and /PATCH/reconstruction/trusted, a std_msgs/msg/Bool. Standard
    deviations are an Image on /PATCH/reconstruction/sd, the resultant's numbers Float32 on
    /PATCH/resultant/NAME. Skin (with its mask), calibration, Phi and solver are JSON in a
    std_msgs/msg/String on /PATCH/skin, /PATCH/phi ...

    Raises BagError if mcap-ros2-support is not installed, the bag has no such frames, or a stamp
    does not fit into ROS's 31 bits of seconds; OutputError if the folder exists or cannot be
    written.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise BagError(INSTALL) from error
    wanted = with_states(bag, stream_topics(bag, topics))
    counts: Counter[tuple[str, str]] = Counter()
    first_ns = last_ns = -1
    with whole_folder(out):
        path = out / f"{out.name}_0.mcap"
        with open(path, "xb") as file:
            writer: Any = Writer(file)
            schemas = {name: writer.register_msgdef(name, text) for name, text in _MSGDEFS.items()}
            for message, log_time_ns in streams(bag, wanted, "export"):
                for topic, kind, content in _messages(message, bag.path):
                    writer.write_message(
                        topic,
                        schemas[kind],
                        content,
                        log_time=log_time_ns,
                        publish_time=message.stamp_ns,
                    )
                    counts[topic, kind] += 1
                first_ns = log_time_ns if first_ns < 0 else min(first_ns, log_time_ns)
                last_ns = max(last_ns, log_time_ns)
            writer.finish()
        described = out / "metadata.yaml"
        described.write_text(_metadata(path.name, counts, first_ns, last_ns), encoding="utf-8")
    return [path, described]


def _messages(message: Message, path: Path) -> Iterator[tuple[str, str, dict[str, Any]]]:
    topic, patch, stamp_ns = message.topic, message.patch, message.stamp_ns
    if isinstance(message, STATES):
        yield topic, STRING, {"data": json.dumps(state_json(message))}
    elif isinstance(message, Resultant):
        for name in _RESULTANT:
            if (value := getattr(message, name)) is not None:
                yield f"{topic}/{name}", FLOAT, {"data": value}
    elif isinstance(message, Measurements):
        yield topic, IMAGE, _image(patch, stamp_ns, np.atleast_2d(np.asarray(message.y)), path)
    elif (forces := getattr(message, "forces", None)) is not None:
        yield topic, IMAGE, _image(patch, stamp_ns, forces, path)
        yield f"{topic}/total_force", FLOAT, {"data": float(forces.sum(dtype=np.float64))}
    if isinstance(message, Reconstruction):
        yield f"{topic}/residual", FLOAT, {"data": message.residual}
        if message.sd is not None:
            yield f"{topic}/sd", IMAGE, _image(patch, stamp_ns, message.sd, path)
        if message.error is not None:
            yield f"{topic}/error", FLOAT, {"data": message.error}
        if message.error is not None or not message.trusted:
            yield f"{topic}/trusted", BOOL, {"data": message.trusted}


def _image(patch: str, stamp_ns: int, array: npt.NDArray[np.float32], path: Path) -> dict[str, Any]:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    if seconds > _MAX_SECONDS:
        raise BagError(f"{path}: stamp {stamp_ns} is beyond what ROS 2 can hold, 2**31 seconds")
    return {
        "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": patch},
        "height": array.shape[0],
        "width": array.shape[1],
        "encoding": "32FC1",
        "is_bigendian": 0,
        "step": 4 * array.shape[1],
        "data": array.astype("<f4").tobytes(),
    }


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
