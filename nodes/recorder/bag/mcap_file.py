"""The records of an MCAP file: messages in compressed chunks, and the index at its end.

The bytes are those of the writer of the package `mcap`, which takes several times as long for each
message. Source: the MCAP specification, mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from typing import Protocol

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

COMPRESSION = "lz4"
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, stamp; the payload follows."""
_MESSAGE_BYTES = _MESSAGE.size - 9
"""Length of a message without its payload: opcode and length themselves do not count."""
_CHUNK = struct.Struct("<BQQQQII3sQ")
"""Opcode, length, first and last log time, size and checksum of the records, name of the
compression with its length, compressed size; the compressed records follow."""


class File(Protocol):
    """A file that grows."""

    def write(self, data: bytes) -> object: ...

    def tell(self) -> int: ...


class McapFile:
    """Writes an MCAP file; a chunk ends once its records exceed `chunk_bytes`.

    `add_message` is the only method that is called for each message.
    """

    def __init__(self, file: File, library: str, chunk_bytes: int) -> None:
        self._file = file
        self._chunk_bytes = chunk_bytes
        #: Records of the chunk under way.
        self._chunk = bytearray()
        #: Log time and place in it of each of its messages, alternating, by channel.
        self._index: dict[int, list[int]] = {}
        self._crc = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._n_messages: dict[int, int] = {}
        self._write(MCAP0_MAGIC)
        self._write(_bytes_of(Header(profile="", library=library)))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Append a record of texts by name."""
        begin = self._file.tell()
        record = _bytes_of(Metadata(name=name, metadata=data))
        self._write(record)
        self._metadata.append(MetadataIndex(begin, len(record), name))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Append a schema; return its number."""
        number = len(self._schemas) + 1
        schema = Schema(id=number, name=name, encoding=encoding, data=data)
        self._schemas.append(schema)
        self._describe(schema)
        return number

    def register_channel(
        self, topic: str, encoding: str, schema: int, metadata: dict[str, str]
    ) -> int:
        """Append a channel of a schema, by its number; return that of the channel."""
        number = len(self._channels) + 1
        channel = Channel(number, topic, encoding, metadata, schema)
        self._channels.append(channel)
        self._describe(channel)
        return number

    def add_message(
        self, channel: int, log_ns: int, payload: bytes, stamp_ns: int, sequence: int
    ) -> None:
        """Append a message of a channel, by its number."""
        chunk = self._chunk
        entries = self._index.get(channel)
        if entries is None:
            entries = self._index[channel] = []
        entries += (log_ns, len(chunk))
        n_bytes = _MESSAGE_BYTES + len(payload)
        chunk += _MESSAGE.pack(
            Opcode.MESSAGE, n_bytes, channel, sequence, log_ns, stamp_ns
        )
        chunk += payload
        if len(chunk) > self._chunk_bytes:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the messages so far as a chunk, if there are any."""
        if not self._index:
            return
        records = self._chunk
        log_times = [entries[::2] for entries in self._index.values()]
        first_ns = min(map(min, log_times))
        last_ns = max(map(max, log_times))
        compressed = lz4.frame.compress(records)

        begin = self._file.tell()
        n_bytes = _CHUNK.size - 9 + len(compressed)
        name = COMPRESSION.encode()
        crc = zlib.crc32(records)
        sizes = (len(records), crc, len(name), name, len(compressed))
        self._write(_CHUNK.pack(Opcode.CHUNK, n_bytes, first_ns, last_ns, *sizes))
        self._write(compressed)

        index_begin = self._file.tell()
        places: dict[int, int] = {}
        for channel, entries in self._index.items():
            places[channel] = self._file.tell()
            self._write(_message_index(channel, entries))
            n_messages = len(entries) // 2
            self._n_messages[channel] = self._n_messages.get(channel, 0) + n_messages
        self._chunks.append(
            ChunkIndex(
                chunk_length=_CHUNK.size + len(compressed),
                chunk_start_offset=begin,
                compression=COMPRESSION,
                compressed_size=len(compressed),
                message_start_time=first_ns,
                message_end_time=last_ns,
                message_index_length=self._file.tell() - index_begin,
                message_index_offsets=places,
                uncompressed_size=len(records),
            )
        )
        self._chunk = bytearray()
        self._index = {}

    def finish(self) -> None:
        """Write the index, which ends the file."""
        self.end_chunk()
        self._write(_bytes_of(DataEnd(self._crc)))
        begin = self._file.tell()
        groups: dict[Opcode, list[McapRecord]] = {
            Opcode.SCHEMA: [*self._schemas],
            Opcode.CHANNEL: [*self._channels],
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: [*self._chunks],
            Opcode.ATTACHMENT_INDEX: [],
            Opcode.METADATA_INDEX: [*self._metadata],
        }
        summary = bytearray()
        offsets = bytearray()
        for opcode, records in groups.items():
            group = b"".join(map(_bytes_of, records))
            offsets += _bytes_of(
                SummaryOffset(opcode, begin + len(summary), len(group))
            )
            summary += group

        # The checksum covers the footer up to itself.
        offsets_begin = begin + len(summary)
        summary += offsets
        footer = _bytes_of(Footer(begin, offsets_begin, summary_crc=0))
        crc = zlib.crc32(footer[:-4], zlib.crc32(summary))
        self._write(bytes(summary))
        self._write(_bytes_of(Footer(begin, offsets_begin, crc)))
        self._write(MCAP0_MAGIC)

    def _describe(self, record: Schema | Channel) -> None:
        """Add what messages need to the chunk under way: it can be read by itself."""
        self._chunk += _bytes_of(record)
        if len(self._chunk) > self._chunk_bytes:
            self.end_chunk()

    def _statistics(self) -> Statistics:
        first_ns = [chunk.message_start_time for chunk in self._chunks]
        last_ns = [chunk.message_end_time for chunk in self._chunks]
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._n_messages,
            chunk_count=len(self._chunks),
            message_count=sum(self._n_messages.values()),
            message_start_time=min(first_ns, default=0),
            message_end_time=max(last_ns, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._file.write(data)


def _message_index(channel: int, entries: list[int]) -> bytes:
    """Record of the log times and places of the messages of a channel."""
    n_bytes = 8 * len(entries)
    head = (Opcode.MESSAGE_INDEX, 6 + n_bytes, channel, n_bytes)
    return struct.pack(f"<BQHI{len(entries)}Q", *head, *entries)


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
