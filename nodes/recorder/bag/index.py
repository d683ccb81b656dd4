"""Index of a bag: its channels, chunks, counts and metadata.

It is read from the end of a complete bag if checksums prove the file whole. Any other file is
scanned up to its end or to the first break.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import mcap.records as mcap
from mcap.opcode import Opcode

from sparseskin.messages import version_1
from sparseskin.messages.errors import MessageError
from sparseskin.messages.ranges import INT64_MAX, is_whole
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS

from .format import (
    ENCODING,
    GRAPH_RECORD,
    JSON_KEY,
    LIBRARY_PREFIX,
    ROS2_HINT,
    SCHEMA_PREFIX,
    TOPICS_RECORD,
    VERSION_KEY,
    BagError,
    TopicInfo,
)
from .records import (
    HEAD_BYTES,
    MAGIC,
    Break,
    Record,
    content,
    crc_of,
    message_times,
    open_chunk,
    parse,
    size_of,
    walk,
    walk_chunk,
)

_MAX_CHANNELS = 4096
"""Most channels of a file: a damaged or hostile one could list any number."""
_FOOTER_BYTES = HEAD_BYTES + 20
_DATA_END_BYTES = HEAD_BYTES + 4
_SUMMARY_CRC_BYTES = 4
_NO_INDEX = "the index at its end is missing or damaged"


@dataclass(frozen=True)
class BagChannel:
    """A channel of the file: messages of one schema on one topic."""

    topic: str
    schema: str
    version: int

    @property
    def today(self) -> BagChannel:
        """The channel with topic, schema and version that it would have in a bag of today."""
        schema, version, topic = self.schema, self.version, version_1.topic_today(self.topic)
        if version == version_1.VERSION and schema in version_1.SCHEMAS:
            schema, version = (cls := version_1.SCHEMAS[schema]).schema, cls.version
        return BagChannel(topic, schema, version)


@dataclass(frozen=True)
class ChunkSpan:
    """Position of a chunk, its topics, and the range of its log times."""

    record: Record
    topics: frozenset[str]
    first_log_ns: int
    last_log_ns: int


@dataclass
class BagIndex:
    """Content of a bag apart from its messages; `name` stands for the file in errors."""

    name: str
    library: str = ""
    channels: dict[int, BagChannel] = field(default_factory=dict)
    chunks: list[ChunkSpan] = field(default_factory=list)
    topics: dict[str, TopicInfo] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    n_scanned: int = 0
    _schemas: dict[int, mcap.Schema] = field(default_factory=dict)

    @property
    def is_bag(self) -> bool:
        """True if a channel or the metadata show that this program wrote the file."""
        return bool(self.channels) or GRAPH_RECORD in self.metadata

    @property
    def of_another_program(self) -> str:
        """Error text for an MCAP file that is no bag."""
        library = " ".join(self.library[:80].split())
        return f"an MCAP file of another program (library {library!r})"

    def describe(self, opcode: int, data: bytes, offset: int) -> None:
        """Add a schema, a channel or metadata, from the content of a record.

        Raises Break if it is malformed, BagError for a channel of another program or version.
        """
        if opcode == Opcode.SCHEMA:
            schema = parse(mcap.Schema.read, data, offset)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = parse(mcap.Channel.read, data, offset)
            self.channels[channel.id] = self._checked(channel)
        elif opcode == Opcode.METADATA:
            found = parse(mcap.Metadata.read, data, offset)
            self.metadata.setdefault(found.name, found.metadata)

    def _checked(self, channel: mcap.Channel) -> BagChannel:
        if len(self.channels) >= _MAX_CHANNELS and channel.id not in self.channels:
            raise BagError(f"{self.name}: more than {_MAX_CHANNELS} channels")
        schema = self._schemas.get(channel.schema_id)
        schema_name = "" if schema is None else schema.name
        topic = channel.topic[:80]
        if channel.message_encoding != ENCODING or not schema_name.startswith(SCHEMA_PREFIX):
            found = (
                f"topic {topic!r} holds {channel.message_encoding[:40]!r} messages of schema "
                f"{schema_name[:80]!r}; expected {ENCODING!r} and {SCHEMA_PREFIX}..."
                f"{self._readers(channel.message_encoding, schema_name)}"
            )
            if GRAPH_RECORD not in self.metadata and not self.library.startswith(LIBRARY_PREFIX):
                raise BagError(f"{self.name}: {self.of_another_program}: {found}")
            raise BagError(f"{self.name}: {found}")
        kind = schema_name.removeprefix(SCHEMA_PREFIX)
        try:
            split_topic(channel.topic)
        except MessageError as error:
            raise BagError(f"{self.name}: {error}") from error
        version = channel.metadata.get(VERSION_KEY, "")
        if kind in version_1.SCHEMAS and version == str(version_1.VERSION):
            return BagChannel(channel.topic, kind, version_1.VERSION)
        if kind not in SCHEMAS:
            raise BagError(
                f"{self.name}: topic {topic} holds messages of schema {kind[:40]!r}; this program "
                f"reads {', '.join(SCHEMAS)}"
            )
        if version != str(SCHEMAS[kind].version):
            raise BagError(
                f"{self.name}: topic {topic}: recorded with {kind} version "
                f"{version[:20] or 'unknown'}; this program reads {SCHEMAS[kind].version}"
            )
        return BagChannel(channel.topic, kind, SCHEMAS[kind].version)

    def _readers(self, encoding: str, schema_name: str) -> str:
        """Hint at the programs that read an MCAP file of such a channel; "" where none is known."""
        if encoding == "cdr":
            return ROS2_HINT
        if self.library.startswith("foxglove") or schema_name.startswith("foxglove."):
            return "; it is for viewers: Foxglove and Lichtblick open it"
        return ""

    def add_chunk(self, record: Record, plain: bytes) -> None:
        """Add the channels and count the messages of a decompressed chunk.

        Raises as `describe`, and Break if a message has no channel; then it counts none.
        """
        found: list[tuple[BagChannel, int, int]] = []
        for opcode, start, stop in walk_chunk(plain, record.offset):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.describe(opcode, plain[start:stop], record.offset)
            elif opcode == Opcode.MESSAGE:
                channel_id, log_ns, stamp_ns = message_times(plain, start, stop, record.offset)
                channel = self.channels.get(channel_id)
                if channel is None or max(log_ns, stamp_ns) > INT64_MAX:
                    raise Break(record.offset, "a message there has no channel or a wrong time")
                found.append((channel, stamp_ns, log_ns))
        for channel, stamp_ns, log_ns in found:
            info = self.topics.setdefault(channel.topic, TopicInfo(channel.schema, channel.version))
            info.add(channel.schema, channel.version, stamp_ns, log_ns)
        self.n_scanned += len(found)
        if found:
            logs = [log_ns for _, _, log_ns in found]
            topics = frozenset(channel.topic for channel, _, _ in found)
            self.chunks.append(ChunkSpan(record, topics, min(logs), max(logs)))

    def chunks_with(
        self, topics: frozenset[str], start_ns: int | None, stop_ns: int | None
    ) -> list[ChunkSpan]:
        """The chunks that may hold a stamp in [start_ns, stop_ns) on one of the topics."""
        wanted = self.topics.keys() & topics

        def may_hold(chunk: ChunkSpan, info: TopicInfo) -> bool:
            if info.min_lag_ns is None or info.max_lag_ns is None:
                return True
            late_enough = start_ns is None or chunk.last_log_ns - info.min_lag_ns >= start_ns
            early_enough = stop_ns is None or chunk.first_log_ns - info.max_lag_ns < stop_ns
            return late_enough and early_enough

        return [
            chunk
            for chunk in self.chunks
            if any(may_hold(chunk, self.topics[topic]) for topic in chunk.topics & wanted)
        ]


def load_index(file: BinaryIO, name: str, whole: bool = True) -> tuple[BagIndex, str]:
    """Read the index of a bag, or scan the file; `whole` as in `BagReader`.

    Returns
    -------
    index : BagIndex
        The index; of a broken file, every complete message before the first break.
    recovered : str
        "" for a whole file; else the number of messages found and the place of the break.

    Raises
    ------
    BagError
        If the file is no bag that this program reads, or broken before the first record.
    """
    first = file.read(len(MAGIC))
    if not first:
        raise BagError(f"{name}: is empty")
    if first != MAGIC:
        if MAGIC.startswith(first):
            raise BagError(f"{name}: ends after {len(first)} bytes, before anything was recorded")
        raise BagError(f"{name}: not an MCAP file (it begins with {first!r}){_source_hint(name)}")
    index, damage = _read_summary(file, name, whole)
    return (index, "") if index is not None else _scan(file, name, damage)


def _source_hint(name: str) -> str:
    """Hint at what reads a file that a sensor can play; "" by its suffix for others."""
    from sparseskin.nodes.sensor.files.format import suffixes

    if Path(name).suffix.lower() not in suffixes():
        return ""
    return (
        "; sparseskin launch replay --set sensor.source=file:FILE reads such a file, "
        "sparseskin bag import makes a bag of it"
    )


def _read_summary(file: BinaryIO, name: str, whole: bool) -> tuple[BagIndex | None, str]:
    """The index at the end of the file, None if it must be scanned; and the damage found by
    the checksums, "" for none.
    """
    size = size_of(file)
    tail_at = size - _FOOTER_BYTES - len(MAGIC)
    file.seek(max(tail_at, 0))
    tail = file.read(_FOOTER_BYTES + len(MAGIC))
    if tail_at < len(MAGIC) or not tail.endswith(MAGIC) or tail[0] != Opcode.FOOTER:
        return None, _NO_INDEX
    footer = parse(mcap.Footer.read, tail[HEAD_BYTES:_FOOTER_BYTES], tail_at)
    data_end_at = footer.summary_start - _DATA_END_BYTES
    if not len(MAGIC) <= data_end_at <= tail_at - _DATA_END_BYTES:
        return None, "" if footer.summary_start == 0 else _NO_INDEX
    # The checksum covers the footer as well, up to the checksum itself.
    summary_crc = crc_of(file, footer.summary_start, size - len(MAGIC) - _SUMMARY_CRC_BYTES)
    if footer.summary_crc and summary_crc != footer.summary_crc:
        return None, _NO_INDEX
    try:
        data_end = next(walk(file, data_end_at, size))
        if data_end.opcode != Opcode.DATA_END or data_end.stop != footer.summary_start:
            raise Break(data_end_at, "no end of data")
        stated = parse(mcap.DataEnd.read, content(file, data_end), data_end_at).data_section_crc
    except Break:
        return None, _NO_INDEX
    if stated and whole and crc_of(file, 0, data_end_at) != stated:
        return None, "a record outside the messages is damaged"
    if not (stated and footer.summary_crc):
        return None, ""
    try:
        return _from_summary(file, name, footer.summary_start, tail_at), ""
    except BagError:
        raise
    # Checksums that match and content that does not, in any way: another program has changed it.
    except Exception:
        return None, ""


def _from_summary(file: BinaryIO, name: str, start: int, stop: int) -> BagIndex | None:
    index = BagIndex(name)
    header = _record_at(file, len(MAGIC), stop, Opcode.HEADER)
    index.library = parse(mcap.Header.read, header, len(MAGIC)).library
    if not index.library.startswith(LIBRARY_PREFIX):
        return None
    for record in walk(file, start, stop):
        data = content(file, record)
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            index.describe(record.opcode, data, record.offset)
        elif record.opcode == Opcode.CHUNK_INDEX:
            chunk = parse(mcap.ChunkIndex.read, data, record.offset)
            offset, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
            if index.chunks and offset < index.chunks[-1].record.stop:
                raise Break(record.offset, "a chunk is listed twice")
            index.chunks.append(
                ChunkSpan(
                    Record(Opcode.CHUNK, offset, offset + HEAD_BYTES, end),
                    frozenset(index.channels[id].topic for id in chunk.message_index_offsets),
                    chunk.message_start_time,
                    chunk.message_end_time,
                )
            )
        elif record.opcode == Opcode.METADATA_INDEX:
            offset = int.from_bytes(data[:8], "little")
            metadata = _record_at(file, offset, start, Opcode.METADATA)
            index.describe(Opcode.METADATA, metadata, offset)
    topics = json.loads(index.metadata[TOPICS_RECORD][JSON_KEY])
    index.topics = {topic: _topic_info(values) for topic, values in topics.items()}
    channels = set(index.channels.values())
    stated = {BagChannel(topic, i.schema, i.version) for topic, i in index.topics.items()}
    if index.topics.keys() != {channel.topic for channel in channels} or not stated <= channels:
        return None
    return index


def _record_at(file: BinaryIO, offset: int, stop: int, opcode: int) -> bytes:
    record = next(walk(file, offset, stop))
    if record.opcode != opcode:
        raise Break(offset, "another record stands there")
    return content(file, record)


def _topic_info(values: dict[str, Any]) -> TopicInfo:
    for key, value in values.items():
        low = -INT64_MAX if key.endswith("lag_ns") else 0
        if type(value) is not str if key == "schema" else not is_whole(value, low, INT64_MAX):
            raise TypeError(key)
    info = TopicInfo(**values)
    if dataclasses.asdict(info).keys() != values.keys() or info.first_ns > info.last_ns:
        raise ValueError("incomplete")
    return info


def _scan(file: BinaryIO, name: str, damage: str) -> tuple[BagIndex, str]:
    """Find every complete message before the first break, each proven by a checksum."""
    index, size = BagIndex(name), size_of(file)
    try:
        damage = _scan_records(file, index, size) or damage
    except Break as broken:
        if not index.is_bag:
            raise BagError(
                f"{name}: cannot be read from byte {broken.offset} of {size} on ({broken.why}), "
                "before anything was recorded"
            ) from broken
        where = f"byte {broken.offset} of {size}: {broken.why}"
    else:
        if not index.is_bag:
            raise BagError(f"{name}: {index.of_another_program}")
        if not damage:
            return index, ""
        where = f"the end: {damage}"
    some = "1 message" if index.n_scanned == 1 else f"{index.n_scanned} messages"
    return index, f"{some} recovered, up to {where}"


def _scan_records(file: BinaryIO, index: BagIndex, size: int) -> str:
    """Add all records up to the end of the data; the damage that costs no message."""
    damage = ""
    for record in walk(file, len(MAGIC), size):
        if record.opcode == Opcode.DATA_END:
            return damage
        try:
            _add_record(index, record, content(file, record))
        except Break:
            # These hold no force, and the next record can be found.
            if record.opcode not in (Opcode.HEADER, Opcode.METADATA) or index.chunks:
                raise
            damage = f"the record at byte {record.offset} is damaged"
    raise Break(size, "it ends there without an index; its recorder was killed or still runs")


def _add_record(index: BagIndex, record: Record, data: bytes) -> None:
    match record.opcode:
        case Opcode.CHUNK:
            index.add_chunk(record, open_chunk(data, record.offset))
        case Opcode.SCHEMA | Opcode.CHANNEL | Opcode.METADATA:
            index.describe(record.opcode, data, record.offset)
        case Opcode.HEADER if record.offset == len(MAGIC):
            index.library = parse(mcap.Header.read, data, record.offset).library
        case Opcode.MESSAGE_INDEX:
            parse(mcap.MessageIndex.read, data, record.offset)
        case Opcode.ATTACHMENT:
            parse(mcap.Attachment.read, data, record.offset)
        case Opcode.MESSAGE:
            raise Break(record.offset, "a message outside the chunks, which no checksum protects")
        case _:
            raise Break(record.offset, "no record of a recording begins there")
