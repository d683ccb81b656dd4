"""A bag as a folder that ROS 2 tools read: CDR messages alone, and metadata.yaml."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Reconstruction

from .bag import BagError
from .bag_file import BagFile
from .bag_frames import Frame, frame_topics, frames
from .bag_reader import BagReader
from .output import new_folder, os_errors
from .ros2_definitions import FLOAT, IMAGE, MSGDEFS

INSTALL = 'writing for ROS 2 needs mcap-ros2-support; pip install "sparseskin[ros2]"'
_MAX_SECONDS = (1 << 31) - 1
_FLUSH_BYTES = 1 << 20


def export_ros2(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder with NAME_0.mcap and metadata.yaml (rosbag2, version 5).

    /PATCH/SCHEMA becomes sensor_msgs/msg/Image, encoding 32FC1: n_rows x n_cols, measurements
    1 x M; its header has the stamp, and the patch as frame_id. Beside it stand, each a
    std_msgs/msg/Float32, /PATCH/SCHEMA/total_force (the sum over the taxels, in the skin's unit;
    not of measurements) and /PATCH/reconstruction/residual.

    Parameters
    ----------
    out : Path
        The folder; it must not exist.
    topics : iterable of str, optional
        Only these topics, named as in the bag.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    BagError
        If mcap-ros2-support is not installed, the bag has no such frames, a stamp does not fit
        into ROS's 31 bits of seconds, or the folder exists or cannot be written.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise BagError(INSTALL) from error
    wanted = frame_topics(bag, topics)
    count = _Count()
    with new_folder(out), os_errors(out):
        path = out / f"{out.name}_0.mcap"
        file = BagFile(path)
        try:
            writer: Any = Writer(cast("IO[bytes]", file))
            schemas = {name: writer.register_msgdef(name, text) for name, text in MSGDEFS.items()}
            for frame in frames(bag, wanted, "export"):
                for topic, kind, message in _messages(frame, bag.path):
                    writer.write_message(
                        topic,
                        schemas[kind],
                        message,
                        log_time=frame.log_time_ns,
                        publish_time=frame.message.stamp_ns,
                    )
                    count.add(topic, kind, frame.log_time_ns)
                if file.n_pending > _FLUSH_BYTES:
                    file.flush()
            writer.finish()
            file.flush()
        finally:
            file.close()
        described = out / "metadata.yaml"
        described.write_text(count.yaml(path.name), encoding="utf-8")
    return [path, described]


def _messages(frame: Frame, path: Path) -> Iterator[tuple[str, str, dict[str, Any]]]:
    message, array = frame.message, frame.array
    topic = message.topic
    yield topic, IMAGE, _image(message.patch, message.stamp_ns, np.atleast_2d(array), path)
    if array.ndim == 2:
        yield f"{topic}/total_force", FLOAT, {"data": float(array.sum(dtype=np.float64))}
    if isinstance(message, Reconstruction):
        yield f"{topic}/residual", FLOAT, {"data": message.residual}


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


class _Count:
    """Counts what metadata.yaml has to state."""

    def __init__(self) -> None:
        self._topics: dict[str, tuple[str, int]] = {}
        self._first_ns: int | None = None
        self._last_ns = 0

    def add(self, topic: str, kind: str, log_time_ns: int) -> None:
        self._topics[topic] = (kind, self._topics.get(topic, (kind, 0))[1] + 1)
        self._first_ns = log_time_ns if self._first_ns is None else min(self._first_ns, log_time_ns)
        self._last_ns = max(self._last_ns, log_time_ns)

    def yaml(self, file_name: str) -> str:
        """The text of metadata.yaml; it is JSON, which YAML contains."""
        first_ns = self._first_ns or 0
        n_messages = sum(n for _, n in self._topics.values())
        times = {
            "starting_time": {"nanoseconds_since_epoch": first_ns},
            "duration": {"nanoseconds": self._last_ns - first_ns},
            "message_count": n_messages,
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
            for topic, (kind, n) in self._topics.items()
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
