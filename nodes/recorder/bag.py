"""What a bag, the recording of a graph's topics, consists of; its writer and reader are apart.

A bag is one MCAP file: the wire payloads as they were, LZ4 chunks that each carry a checksum,
and an index at the end that a recorder which was killed has not written.
"""

from __future__ import annotations

from dataclasses import dataclass

from sparseskin.messages import End
from sparseskin.nodes.errors import SparseskinError

FILE_SUFFIX = ".mcap"
PART_SUFFIX = ".part"
"""What a bag's name ends in, after FILE_SUFFIX, until it is complete."""
ENCODING = "msgpack"
SCHEMA_PREFIX = "sparseskin/"
VERSION_KEY = "schema_version"
LIBRARY_PREFIX = "sparseskin "

GRAPH_RECORD = "sparseskin"
"""Name of the metadata record with the scene, seed, launch file, Phi and versions."""
COUNTS_RECORD = "counts"
TOPICS_RECORD = "topics"
JSON_KEY = "json"
"""The one key of the metadata records `counts` and `topics`; its value is JSON."""


class BagError(SparseskinError):
    """A bag that cannot be written or read: one line with the file, what is wrong, and what
    is allowed.
    """


@dataclass(frozen=True)
class BagMessage:
    """One recorded message.

    Attributes
    ----------
    topic : str
        "/PATCH/SCHEMA".
    log_time_ns : int
        When it was recorded.
    stamp_ns : int
        Stamp of the acquisition, as in the message itself.
    payload : bytes
        The wire payload, byte for byte.
    """

    topic: str
    log_time_ns: int
    stamp_ns: int
    payload: bytes


@dataclass(frozen=True)
class TopicInfo:
    """What a bag holds of one topic; the message that ends its stream is not counted.

    Attributes
    ----------
    topic, schema : str
        "/PATCH/SCHEMA", and the schema's name, e.g. "taxels".
    version : int
        Version of the schema.
    n_messages : int
        How many messages.
    first_ns, last_ns : int
        Smallest and largest stamp; 0 where there is no message.
    """

    topic: str
    schema: str
    version: int
    n_messages: int
    first_ns: int
    last_ns: int

    @property
    def rate_hz(self) -> float:
        """Messages a second by their stamps; 0 where that says nothing."""
        span_ns = self.last_ns - self.first_ns
        return (self.n_messages - 1) * 1e9 / span_ns if span_ns > 0 else 0.0


@dataclass
class Tally:
    """What is counted of a topic while a bag is written or scanned.

    The lags are the bounds of log time - stamp: with them, a range of stamps is found in an
    index that knows log times alone.
    """

    schema: str
    version: int
    n_messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    min_lag_ns: int | None = None
    max_lag_ns: int | None = None

    def add(self, schema: str, version: int, stamp_ns: int, log_time_ns: int) -> None:
        """Count one message."""
        lag_ns = log_time_ns - stamp_ns
        self.min_lag_ns = lag_ns if self.min_lag_ns is None else min(self.min_lag_ns, lag_ns)
        self.max_lag_ns = lag_ns if self.max_lag_ns is None else max(self.max_lag_ns, lag_ns)
        if schema == End.schema:
            return
        self.schema, self.version = schema, version
        self.first_ns = min(self.first_ns, stamp_ns) if self.n_messages else stamp_ns
        self.last_ns = max(self.last_ns, stamp_ns) if self.n_messages else stamp_ns
        self.n_messages += 1

    def info(self, topic: str) -> TopicInfo:
        """The same for readers."""
        return TopicInfo(
            topic, self.schema, self.version, self.n_messages, self.first_ns, self.last_ns
        )
