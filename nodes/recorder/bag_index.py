"""What is known of a bag before its messages are read, and which chunk holds what."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from sparseskin.messages.errors import MessageError
from sparseskin.messages.fields import INT64_MAX
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS

from .bag import (
    ENCODING,
    GRAPH_RECORD,
    LIBRARY_PREFIX,
    SCHEMA_PREFIX,
    VERSION_KEY,
    BagError,
    Tally,
)
from .bag_records import Break, Record, message_times, walk_chunk

_MAX_CHANNELS = 4096


@dataclass(frozen=True)
class BagChannel:
    """A channel of the file: messages of one schema on one topic."""

    topic: str
    schema: str
    version: int


@dataclass(frozen=True)
class ChunkSpan:
    """Where a chunk stands, and which topics and log times are in it."""

    record: Record
    topics: frozenset[str]
    first_log_ns: int
    last_log_ns: int


@dataclass
class BagIndex:
    """What is known of a bag before its messages are read."""

    library: str = ""
    channels: dict[int, BagChannel] = field(default_factory=dict)
    chunks: list[ChunkSpan] = field(default_factory=list)
    tallies: dict[str, Tally] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    n_scanned: int = 0

    @property
    def is_bag(self) -> bool:
        """Whether anything shows that this program wrote the file."""
        return bool(self.channels) or GRAPH_RECORD in self.metadata

    def add_channel(self, name: str, channel: Channel, schemas: dict[int, Schema]) -> None:
        """Take in a channel of the file.

        Raises
        ------
        BagError
            If it is not one that this program can have recorded, or of a newer version.
        """
        if len(self.channels) >= _MAX_CHANNELS and channel.id not in self.channels:
            raise BagError(f"{name}: more than {_MAX_CHANNELS} channels")
        schema = schemas.get(channel.schema_id)
        schema_name = "" if schema is None else schema.name
        topic = channel.topic[:80]
        if channel.message_encoding != ENCODING or not schema_name.startswith(SCHEMA_PREFIX):
            found = (
                f"topic {topic!r} holds {channel.message_encoding[:40]!r} messages of schema "
                f"{schema_name[:80]!r}; expected {ENCODING!r} and {SCHEMA_PREFIX}..."
            )
            if GRAPH_RECORD not in self.metadata and not self.library.startswith(LIBRARY_PREFIX):
                raise BagError(f"{name}: {self.of_another_program()}: {found}")
            raise BagError(f"{name}: {found}")
        kind = schema_name.removeprefix(SCHEMA_PREFIX)
        try:
            split_topic(channel.topic)
        except MessageError as error:
            raise BagError(f"{name}: {error}") from error
        if kind not in SCHEMAS:
            raise BagError(
                f"{name}: topic {topic} holds messages of schema {kind[:40]!r}; this program "
                f"reads {', '.join(SCHEMAS)}"
            )
        version = channel.metadata.get(VERSION_KEY, "")
        if version != str(SCHEMAS[kind].version):
            raise BagError(
                f"{name}: topic {topic}: recorded with {kind} version {version[:20] or 'unknown'}; "
                f"this program reads {SCHEMAS[kind].version}"
            )
        self.channels[channel.id] = BagChannel(channel.topic, kind, SCHEMAS[kind].version)

    def add_chunk(self, record: Record, plain: bytes) -> None:
        """Count the messages of an opened chunk.

        Raises
        ------
        Break
            If a message has no channel; nothing of the chunk is counted then.
        """
        found: list[tuple[BagChannel, int, int]] = []
        for opcode, start, stop in walk_chunk(plain, record.offset):
            if opcode == Opcode.MESSAGE:
                channel_id, log_ns, stamp_ns = message_times(plain, start, stop, record.offset)
                channel = self.channels.get(channel_id)
                if channel is None or max(log_ns, stamp_ns) > INT64_MAX:
                    raise Break(record.offset, "a message there has no channel or a wrong time")
                found.append((channel, stamp_ns, log_ns))
        for channel, stamp_ns, log_ns in found:
            tally = self.tallies.setdefault(channel.topic, Tally(channel.schema, channel.version))
            tally.add(channel.schema, channel.version, stamp_ns, log_ns)
        self.n_scanned += len(found)
        if found:
            logs = [log_ns for _, _, log_ns in found]
            topics = frozenset(channel.topic for channel, _, _ in found)
            self.chunks.append(ChunkSpan(record, topics, min(logs), max(logs)))

    def chunks_with(
        self, topics: Iterable[str], start_ns: int | None, stop_ns: int | None
    ) -> list[ChunkSpan]:
        """The chunks that may hold a stamp in [start_ns, stop_ns) on one of the topics."""
        bounds = {topic: self.tallies[topic] for topic in topics if topic in self.tallies}

        def may_hold(chunk: ChunkSpan, topic: str) -> bool:
            tally = bounds[topic]
            if tally.min_lag_ns is None or tally.max_lag_ns is None:
                return True
            late_enough = start_ns is None or chunk.last_log_ns - tally.min_lag_ns >= start_ns
            early_enough = stop_ns is None or chunk.first_log_ns - tally.max_lag_ns < stop_ns
            return late_enough and early_enough

        return [
            chunk
            for chunk in self.chunks
            if any(may_hold(chunk, topic) for topic in chunk.topics & bounds.keys())
        ]

    def of_another_program(self) -> str:
        """That the file is an MCAP, but no bag."""
        library = " ".join(self.library[:80].split())
        return f"an MCAP file of another program (library {library!r})"
