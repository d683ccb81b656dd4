"""Export of a bag to a folder for ROS 2 tools: messages in CDR, and metadata.yaml."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Reconstruction
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import Frame, frame_topics, frames
from sparseskin.nodes.recorder.bag.reader import BagReader

INSTALL = 'writing for ROS 2 needs mcap-ros2-support; pip install "sparseskin[ros2]"'
_MAX_SECONDS = (1 << 31) - 1
BOOL = "std_msgs/msg/Bool"
IMAGE = "sensor_msgs/msg/Image"
FLOAT = "std_msgs/msg/Float32"
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
}
"""Definitions of the exported messages, as in common_interfaces of ROS 2."""


def export_ros2(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder `out` with NAME_0.mcap and metadata.yaml (rosbag2, version 5); their paths.

    /PATCH/SCHEMA becomes sensor_msgs/msg/Image, encoding 32FC1: n_rows x n_cols, measurements
    1 x M; its header has the stamp, and the patch as frame_id. Beside it stand, each a
    std_msgs/msg/Float32, /PATCH/SCHEMA/total_force (the sum over the taxels, in the skin's unit;
    not of measurements) and /PATCH/reconstruction/residual; where the solver estimates its error,
    /PATCH/reconstruction/error, and /PATCH/reconstruction/trusted, a std_msgs/msg/Bool.

    Raises BagError if mcap-ros2-support is not installed, the bag has no such frames, or a stamp
    does not fit into ROS's 31 bits of seconds; OutputError if the folder exists or cannot be
    written.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise BagError(INSTALL) from error
    wanted = frame_topics(bag, topics)
    counts: Counter[tuple[str, str]] = Counter()
    first_ns = last_ns = -1
    with whole_folder(out):
        path = out / f"{out.name}_0.mcap"
        with open(path, "xb") as file:
            writer: Any = Writer(file)
            schemas = {name: writer.register_msgdef(name, text) for name, text in _MSGDEFS.items()}
            for frame in frames(bag, wanted, "export"):
                for topic, kind, message in _messages(frame, bag.path):
                    writer.write_message(
                        topic,
                        schemas[kind],
                        message,
                        log_time=frame.log_time_ns,
                        publish_time=frame.message.stamp_ns,
                    )
                    counts[topic, kind] += 1
                first_ns = frame.log_time_ns if first_ns < 0 else min(first_ns, frame.log_time_ns)
                last_ns = max(last_ns, frame.log_time_ns)
            writer.finish()
        described = out / "metadata.yaml"
        described.write_text(_metadata(path.name, counts, first_ns, last_ns), encoding="utf-8")
    return [path, described]


def _messages(frame: Frame, path: Path) -> Iterator[tuple[str, str, dict[str, Any]]]:
    message, array = frame.message, frame.array
    topic = message.topic
    yield topic, IMAGE, _image(message.patch, message.stamp_ns, np.atleast_2d(array), path)
    if array.ndim == 2:
        yield f"{topic}/total_force", FLOAT, {"data": float(array.sum(dtype=np.float64))}
    if isinstance(message, Reconstruction):
        yield f"{topic}/residual", FLOAT, {"data": message.residual}
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
