"""Names and types common to the writer and the reader of bags, the recordings of a graph's topics.

A bag is one MCAP file: unchanged wire payloads in LZ4 chunks that each carry a checksum, and an
index at the end, which is missing if the recorder was killed.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from sparseskin.messages import End
from sparseskin.messages.ranges import INT64_MAX
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import NO_FOLDER, NO_WRITING, TAKEN

FILE_SUFFIX = ".mcap"
PART_SUFFIX = ".part"
"""Suffix of an incomplete bag, after FILE_SUFFIX."""
ENCODING = "msgpack"
SCHEMA_PREFIX = "sparseskin/"
VERSION_KEY = "schema_version"
LIBRARY_PREFIX = "sparseskin "

GRAPH_RECORD = "sparseskin"
"""Name of the metadata record with the scene, seed, launch file, Phi and versions."""
ROS2_HINT = (
    "; it is for ROS 2: a sensor reads it as file:PATH, ros2 bag play its folder"
)
"""What an error appends of a bag of ROS 2."""
COUNTS_RECORD = "counts"
TOPICS_RECORD = "topics"
JSON_KEY = "json"
"""The one key of the metadata records `counts` and `topics`; its value is JSON."""


class BagError(SparseskinError):
    """A bag that cannot be written or read: one line with the file, the fault and the remedy."""


def check_new_bag(path: Path) -> Path:
    """Path of a new bag while it is incomplete.

    Raises BagError if the name does not end in .mcap, the bag exists, complete or not, or its
    folder does not or cannot be written to.
    """
    if path.suffix != FILE_SUFFIX:
        raise BagError(f"{path}: expected a name that ends in {FILE_SUFFIX}")
    part = path.with_name(path.name + PART_SUFFIX)
    for taken in (path, part):
        if os.path.lexists(taken):
            raise BagError(f"{taken}: {TAKEN}")
    if not path.parent.is_dir():
        raise BagError(f"{path}: {NO_FOLDER}")
    if not os.access(path.parent, os.W_OK):
        raise BagError(f"{path}: {NO_WRITING}")
    return part


class BagMessage(NamedTuple):
    """One recorded message."""

    topic: str  # "/PATCH/SCHEMA"
    schema: str  # of the message: the end of a stream has a schema of its own
    log_time_ns: int  # time of recording
    stamp_ns: int  # of the acquisition, as in the message itself
    payload: bytes  # wire form of the message


@dataclass
class TopicInfo:
    """Content of one topic of a bag; the message that ends its stream is not counted."""

    schema: str  # e.g. "taxels"
    version: int  # of the schema
    n_messages: int = 0
    first_ns: int = 0  # smallest and largest stamp; 0 without a message
    last_ns: int = 0
    #: Range of log time - stamp, of all messages: with it, an index of log times finds a range of
    #: stamps. Without a message the range is empty.
    min_lag_ns: int = INT64_MAX
    max_lag_ns: int = -INT64_MAX

    @property
    def rate_hz(self) -> float:
        """Messages a second by their stamps; 0 if all have the same stamp."""
        span_ns = self.last_ns - self.first_ns
        if span_ns <= 0:
            return 0.0
        return (self.n_messages - 1) * 1e9 / span_ns

    def add(self, schema: str, stamp_ns: int, log_time_ns: int) -> None:
        """Count one message."""
        # The end of a stream counts for the lags alone.
        lag_ns = log_time_ns - stamp_ns
        self.min_lag_ns = min(self.min_lag_ns, lag_ns)
        self.max_lag_ns = max(self.max_lag_ns, lag_ns)
        if schema == End.schema:
            return

        self.schema = schema
        self.version = SCHEMAS[schema].version
        # Not in the order of stamps: results come later than the frames that follow them.
        if not self.n_messages:
            self.first_ns = stamp_ns
            self.last_ns = stamp_ns
        self.first_ns = min(self.first_ns, stamp_ns)
        self.last_ns = max(self.last_ns, stamp_ns)
        self.n_messages += 1


def span_ns(infos: Iterable[TopicInfo]) -> tuple[int, int] | None:
    """First and last stamp of streams, None without a message; a latched topic may be older than
    the recording, and is left out.
    """
    streams = [
        info for info in infos if info.n_messages and not SCHEMAS[info.schema].latched
    ]
    if not streams:
        return None
    return min(info.first_ns for info in streams), max(info.last_ns for info in streams)
