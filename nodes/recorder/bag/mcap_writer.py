"""Writer of MCAP files: whole records reach the disk or none, in bounded memory."""

from __future__ import annotations

import contextlib
import os
import tempfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import mcap.records as mcap
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from .records import MAGIC

CHUNK_BYTES = 1 << 20
"""A chunk is ended and compressed when its records exceed this many bytes."""
BLOCK_BYTES = 1 << 16
"""Largest part of the chunk index that is kept in memory."""
_CRC_BYTES = 4


class McapWriter:
    """Writes an MCAP file: LZ4 chunks with checksums, and their index at the end.

    All bytes wait in memory until `flush`. Memory holds the current chunk and at most
    `BLOCK_BYTES` of the index, however long the recording: the library's own writer keeps an
    object for each chunk, 36 MB an hour.

    `path` must not exist; `library` is the name and version of the writing program. `pending`
    holds the bytes of complete records that are not flushed.

    Raises OSError if the file cannot be created, FileExistsError if it exists; and from `flush`
    and `finish` if the disk refuses. The pending bytes are then dropped, and the file is cut to
    its last complete record.
    """

    def __init__(self, path: Path, library: str) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self.pending = bytearray()
        self._n_written = 0
        self._data_crc = 0
        self._schemas: list[mcap.Schema] = []
        self._channels: list[mcap.Channel] = []
        self._metadata: list[mcap.MetadataIndex] = []
        self._chunk = RecordBuilder()
        self._message_indices: dict[int, mcap.MessageIndex] = {}
        self._chunk_index = _Spool(path.parent)
        self._statistics = mcap.Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._put(MAGIC + _packed(mcap.Header(profile="", library=library)))

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        offset = self._tell()
        self._put(_packed(mcap.Metadata(name, values)))
        self._metadata.append(mcap.MetadataIndex(offset, self._tell() - offset, name))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a schema; its number, from 1."""
        schema = mcap.Schema(len(self._schemas) + 1, data, encoding, name)
        self._schemas.append(schema)
        schema.write(self._chunk)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema_id: int, values: dict[str, str]) -> int:
        """Register a channel with its metadata; its number, from 1."""
        channel = mcap.Channel(len(self._channels) + 1, topic, encoding, values, schema_id)
        self._channels.append(channel)
        channel.write(self._chunk)
        return channel.id

    def add_message(
        self, channel_id: int, sequence: int, log_time_ns: int, stamp_ns: int, data: bytes
    ) -> None:
        """Append a message to the current chunk, which is ended if it is full."""
        index = self._message_indices.get(channel_id)
        if index is None:
            index = self._message_indices[channel_id] = mcap.MessageIndex(channel_id, [])
        index.records.append((log_time_ns, self._chunk.count))
        mcap.Message(channel_id, log_time_ns, data, stamp_ns, sequence).write(self._chunk)
        if self._chunk.count > CHUNK_BYTES:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Compress the messages of the current chunk, and begin another."""
        if not self._message_indices:
            return
        indices, self._message_indices = self._message_indices, {}
        plain: bytes = self._chunk.end()  # type: ignore[no-untyped-call]
        times_ns = [time_ns for index in indices.values() for time_ns, _ in index.records]
        chunk = mcap.Chunk(
            compression="lz4",
            data=lz4.frame.compress(plain),
            message_end_time=max(times_ns),
            message_start_time=min(times_ns),
            uncompressed_crc=zlib.crc32(plain),
            uncompressed_size=len(plain),
        )
        chunk_start = self._tell()
        self._put(_packed(chunk))
        index_start, offsets = self._tell(), {}
        for channel_id, index in indices.items():
            offsets[channel_id] = self._tell()
            self._put(_packed(index))
        entry = mcap.ChunkIndex(
            chunk_length=index_start - chunk_start,
            chunk_start_offset=chunk_start,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=self._tell() - index_start,
            message_index_offsets=offsets,
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
        self._chunk_index.append(_packed(entry))
        self._count(indices, chunk)

    def flush(self) -> None:
        """Pass all pending bytes to the operating system."""
        data, self.pending = bytes(self.pending), bytearray()
        done = 0
        try:
            while done < len(data):
                done += os.write(self._fd, memoryview(data)[done:])
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._n_written)
            raise
        self._n_written += done

    def finish(self) -> None:
        """Write the index, and wait until the disk holds the file."""
        self.end_chunk()
        self._put(_packed(mcap.DataEnd(self._data_crc)))
        statistics = self._statistics
        statistics.schema_count = len(self._schemas)
        statistics.channel_count = len(self._channels)
        statistics.metadata_count = len(self._metadata)
        groups: list[tuple[Opcode, Iterable[bytes]]] = [
            (Opcode.SCHEMA, [_packed(*self._schemas)]),
            (Opcode.CHANNEL, [_packed(*self._channels)]),
            (Opcode.STATISTICS, [_packed(statistics)]),
            (Opcode.CHUNK_INDEX, self._chunk_index.blocks()),
            (Opcode.ATTACHMENT_INDEX, []),
            (Opcode.METADATA_INDEX, [_packed(*self._metadata)]),
        ]
        start, crc, offsets = self._tell(), 0, []
        for opcode, blocks in groups:
            group_start = self._tell()
            for block in blocks:
                crc = zlib.crc32(block, crc)
                self.pending += block
            offsets.append(mcap.SummaryOffset(opcode, group_start, self._tell() - group_start))
        offset_start, packed = self._tell(), _packed(*offsets)
        # The checksum covers the footer as well, up to the checksum itself.
        footer = _packed(mcap.Footer(start, offset_start, 0))[:-_CRC_BYTES]
        crc = zlib.crc32(footer, zlib.crc32(packed, crc))
        self.pending += packed + footer + crc.to_bytes(_CRC_BYTES, "little") + MAGIC
        self.flush()
        os.fsync(self._fd)

    def close(self) -> None:
        """Close the file; pending bytes are dropped."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)

    def _tell(self) -> int:
        return self._n_written + len(self.pending)

    def _put(self, data: bytes) -> None:
        self._data_crc = zlib.crc32(data, self._data_crc)
        self.pending += data

    def _count(self, indices: dict[int, mcap.MessageIndex], chunk: mcap.Chunk) -> None:
        counts = self._statistics
        first_ns = chunk.message_start_time
        if counts.chunk_count:
            first_ns = min(first_ns, counts.message_start_time)
        counts.message_start_time = first_ns
        counts.message_end_time = max(counts.message_end_time, chunk.message_end_time)
        counts.chunk_count += 1
        for channel_id, index in indices.items():
            n_messages, of_channel = len(index.records), counts.channel_message_counts
            of_channel[channel_id] = of_channel.get(channel_id, 0) + n_messages
            counts.message_count += n_messages


class _Spool:
    """Bytes in memory up to `BLOCK_BYTES`, earlier ones in a nameless file in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pending = bytearray()
        self._file: IO[bytes] | None = None
        self._n_stored = 0

    def append(self, data: bytes) -> None:
        self._pending += data
        if len(self._pending) < BLOCK_BYTES:
            return
        done = 0
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
            while done < len(self._pending):
                where = self._n_stored + done
                done += os.pwrite(self._file.fileno(), self._pending[done:], where)
        except OSError:
            return  # they stay in memory until the next attempt
        self._n_stored += done
        self._pending.clear()

    def blocks(self) -> Iterator[bytes]:
        """All bytes in order, in blocks of at most `BLOCK_BYTES` from the file."""
        if self._file is not None:
            with self._file as file:
                file.seek(0)
                while block := file.read(min(BLOCK_BYTES, self._n_stored - file.tell())):
                    yield block
        yield bytes(self._pending)


def _packed(*records: mcap.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
