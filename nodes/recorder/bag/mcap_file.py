"""Writer of an MCAP file: messages in compressed chunks, each with its index, and a summary.

`mcap.writer` writes the same bytes, but packs each number of a message by itself, and copies each
chunk four times: half of the processor time of a recording.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import mcap.records as mcap
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from .records import HEAD_BYTES, MAGIC

CHUNK_BYTES = 1 << 20
"""A chunk is ended and compressed when its records exceed this many bytes."""
COMPRESSION = "lz4"
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct(f"<BQQQQII{len(COMPRESSION)}sQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_FOOTER = struct.Struct("<BQQQ")
"""Heads of records: opcode, length, and the fields before the last one; of a footer, that is its
checksum."""
_FOOTER_BYTES = 20


class Sink(Protocol):
    """What the bytes of a file are written to."""

    def write(self, data: bytes) -> None:
        """Append bytes."""

    def tell(self) -> int:
        """Number of bytes so far."""


class Message(NamedTuple):
    """A message of a channel; its times are in nanoseconds."""

    channel: int
    log_ns: int
    data: bytes
    publish_ns: int
    sequence: int  # below 2**32


class _Chunk:
    """Records that wait to be compressed."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.n_bytes = 0
        self.first_ns = 0
        self.last_ns = 0
        #: By channel: log time and place of each message, one after the other.
        self.places: dict[int, list[int]] = {}

    def add(self, record: bytes) -> None:
        """Append a record of another kind than a message."""
        self.parts.append(record)
        self.n_bytes += len(record)

    def add_message(self, message: Message) -> None:
        """Append a message."""
        channel, log_ns, data, publish_ns, sequence = message
        if not self.places or log_ns < self.first_ns:
            self.first_ns = log_ns
        if log_ns > self.last_ns:
            self.last_ns = log_ns
        places = self.places.get(channel)
        if places is None:
            places = self.places[channel] = []
        places.append(log_ns)
        places.append(self.n_bytes)

        length = _MESSAGE.size - HEAD_BYTES + len(data)
        head = _MESSAGE.pack(
            Opcode.MESSAGE, length, channel, sequence, log_ns, publish_ns
        )
        self.parts.append(head)
        self.parts.append(data)
        self.n_bytes += HEAD_BYTES + length


class McapFile:
    """Writes the records of an MCAP file; `library` names the program that does.

    A chunk is written once its records exceed `CHUNK_BYTES`, or by `end_chunk`.
    """

    def __init__(self, sink: Sink, library: str) -> None:
        self._sink = sink
        #: Checksum of all bytes so far.
        self._crc = 0
        self._chunk = _Chunk()
        self._schemas: list[mcap.Schema] = []
        self._channels: list[mcap.Channel] = []
        self._chunks: list[mcap.ChunkIndex] = []
        self._metadata: list[mcap.MetadataIndex] = []
        self._n_messages: dict[int, int] = {}
        self._put(MAGIC)
        self._put(_packed([mcap.Header(profile="", library=library)]))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write texts by their keys, before the chunk in progress."""
        record = _packed([mcap.Metadata(name=name, metadata=dict(values))])
        self._metadata.append(
            mcap.MetadataIndex(offset=self._sink.tell(), length=len(record), name=name)
        )
        self._put(record)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its number."""
        number = len(self._schemas) + 1
        schema = mcap.Schema(id=number, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._add_to_chunk(schema)
        return number

    def add_channel(
        self, topic: str, encoding: str, schema: int, metadata: dict[str, str]
    ) -> int:
        """Add a channel whose messages are of a schema; return its number."""
        number = len(self._channels) + 1
        channel = mcap.Channel(
            id=number,
            topic=topic,
            message_encoding=encoding,
            metadata=metadata,
            schema_id=schema,
        )
        self._channels.append(channel)
        self._add_to_chunk(channel)
        return number

    def add_message(self, message: Message) -> None:
        """Add a message to the chunk in progress."""
        self._chunk.add_message(message)
        if self._chunk.n_bytes > CHUNK_BYTES:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the chunk in progress and its index, if it holds a message."""
        chunk = self._chunk
        if not chunk.places:
            return
        plain = b"".join(chunk.parts)
        data = lz4.frame.compress(plain)
        head = _CHUNK.pack(
            Opcode.CHUNK,
            _CHUNK.size - HEAD_BYTES + len(data),
            chunk.first_ns,
            chunk.last_ns,
            len(plain),
            zlib.crc32(plain),
            len(COMPRESSION),
            COMPRESSION.encode(),
            len(data),
        )
        start = self._sink.tell()
        self._put(head)
        self._put(data)

        index_start = self._sink.tell()
        offsets = {}
        for channel, places in chunk.places.items():
            offsets[channel] = self._sink.tell()
            self._put(_message_index(channel, places))
            n_messages = self._n_messages.get(channel, 0)
            self._n_messages[channel] = n_messages + len(places) // 2
        self._chunks.append(
            mcap.ChunkIndex(
                message_start_time=chunk.first_ns,
                message_end_time=chunk.last_ns,
                chunk_start_offset=start,
                chunk_length=index_start - start,
                message_index_offsets=offsets,
                message_index_length=self._sink.tell() - index_start,
                compression=COMPRESSION,
                compressed_size=len(data),
                uncompressed_size=len(plain),
            )
        )
        self._chunk = _Chunk()

    def finish(self) -> None:
        """Write the chunk in progress, and the summary of the file."""
        self.end_chunk()
        self._put(_packed([mcap.DataEnd(self._crc)]))

        start = self._sink.tell()
        summary = bytearray()
        offsets = []
        for opcode, group in self._groups().items():
            records = _packed(group)
            place = start + len(summary)
            offsets.append(mcap.SummaryOffset(opcode, place, len(records)))
            summary += records
        offsets_start = start + len(summary)
        summary += _packed(offsets)

        # The checksum covers the footer, too, up to the checksum itself.
        head = _FOOTER.pack(Opcode.FOOTER, _FOOTER_BYTES, start, offsets_start)
        crc = zlib.crc32(head, zlib.crc32(summary))
        self._sink.write(bytes(summary))
        self._sink.write(_packed([mcap.Footer(start, offsets_start, crc)]))
        self._sink.write(MAGIC)

    def _groups(self) -> dict[Opcode, Sequence[mcap.McapRecord]]:
        """Records of the summary by their kind."""
        starts = [chunk.message_start_time for chunk in self._chunks]
        ends = [chunk.message_end_time for chunk in self._chunks]
        statistics = mcap.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._n_messages,
            chunk_count=len(self._chunks),
            message_count=sum(self._n_messages.values()),
            message_start_time=min(starts, default=0),
            message_end_time=max(ends, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return {
            Opcode.SCHEMA: self._schemas,
            Opcode.CHANNEL: self._channels,
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: self._chunks,
            Opcode.METADATA_INDEX: self._metadata,
        }

    def _add_to_chunk(self, record: mcap.McapRecord) -> None:
        self._chunk.add(_packed([record]))
        if self._chunk.n_bytes > CHUNK_BYTES:
            self.end_chunk()

    def _put(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._sink.write(data)


def _packed(records: Sequence[mcap.McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def _message_index(channel: int, places: Sequence[int]) -> bytes:
    """Index of the messages of a channel in a chunk, by log times and places."""
    n_bytes = 8 * len(places)
    length = _MESSAGE_INDEX.size - HEAD_BYTES + n_bytes
    head = _MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, length, channel, n_bytes)
    return head + struct.pack(f"<{len(places)}Q", *places)
