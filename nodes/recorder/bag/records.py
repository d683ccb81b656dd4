"""Records of an MCAP file, read safely whatever its bytes are.

Every length is checked against the file before anything is read, and every chunk against its
checksum. The functions raise `Break` with the byte from which on the file cannot be read.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple, TypeVar

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC

MAGIC: bytes = MCAP0_MAGIC
MAX_CHUNK_BYTES = 1 << 26
"""Largest chunk that is read, before and after decompression."""
_MAX_RECORD_BYTES = MAX_CHUNK_BYTES + (1 << 20)
_HEAD = struct.Struct("<BQ")
HEAD_BYTES = _HEAD.size
_MESSAGE = struct.Struct("<HIQQ")
MESSAGE_HEAD_BYTES = _MESSAGE.size
_CRC_BLOCK_BYTES = 1 << 20
_KNOWN = frozenset(int(opcode) for opcode in Opcode)

T = TypeVar("T")


class Break(Exception):  # noqa: N818 - a place in a file, not an error of this program
    """The byte from which on a file cannot be read, and the reason."""

    def __init__(self, offset: int, why: str) -> None:
        super().__init__(why)
        self.offset = offset
        self.why = why


class Record(NamedTuple):
    """Position of a record: its opcode at `offset`, its content in `start`..`stop`."""

    opcode: int
    offset: int
    start: int
    stop: int


def walk(file: BinaryIO, start: int, stop: int) -> Iterator[Record]:
    """Yield the positions of the records from byte `start` up to `stop`."""
    offset = start
    while offset < stop:
        head = _read(file, offset, min(HEAD_BYTES, stop - offset))
        if len(head) < HEAD_BYTES:
            raise Break(offset, "the file ends in the middle of a record")
        opcode, length = _HEAD.unpack(head)
        if opcode not in _KNOWN:
            raise Break(offset, "no record begins there")
        if length > stop - offset - HEAD_BYTES:
            raise Break(offset, "the file ends in the middle of a record, or its length is wrong")
        record = Record(opcode, offset, offset + HEAD_BYTES, offset + HEAD_BYTES + length)
        yield record
        offset = record.stop


def content(file: BinaryIO, record: Record) -> bytes:
    """Read the content of a record, at most `MAX_CHUNK_BYTES` and 1 MiB."""
    length = record.stop - record.start
    if not 0 <= length <= _MAX_RECORD_BYTES:
        raise Break(record.offset, f"a record of {length} bytes, at most {_MAX_RECORD_BYTES}")
    data = _read(file, record.start, length)
    if len(data) < length:
        raise Break(record.offset, "the file ends in the middle of a record")
    return data


def parse(read: Callable[[ReadDataStream], T], data: bytes, offset: int) -> T:
    """Parse the content of the record at `offset` with the reader of its class."""
    stream = ReadDataStream(io.BytesIO(data))
    try:
        found = read(stream)
    except Exception as error:  # EndOfFile, struct.error, UnicodeDecodeError, ValueError, ...
        raise Break(offset, "a record there is malformed") from error
    if stream.count != len(data):
        raise Break(offset, "a record there is malformed")
    return found


def open_chunk(data: bytes, offset: int) -> bytes:
    """Decompress the records of a chunk from the content of the chunk's record at `offset`."""
    chunk = parse(Chunk.read, data, offset)
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise Break(
            offset, f"a chunk of {chunk.uncompressed_size} bytes, at most {MAX_CHUNK_BYTES}"
        )
    try:
        plain = _decompress(chunk)
    except Exception as error:  # lz4 and zstandard have families of their own
        raise Break(offset, "a chunk there cannot be decompressed") from error
    if len(plain) != chunk.uncompressed_size or zlib.crc32(plain) != chunk.uncompressed_crc:
        raise Break(offset, "the checksum of a chunk there does not match")
    return plain


def walk_chunk(plain: bytes, offset: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, stop) of each record in a decompressed chunk."""
    at, end = 0, len(plain)
    while at < end:
        if end - at < HEAD_BYTES:
            raise Break(offset, "a chunk there is malformed")
        opcode, length = _HEAD.unpack_from(plain, at)
        start = at + HEAD_BYTES
        at = start + length
        if at > end:
            raise Break(offset, "a chunk there is malformed")
        yield opcode, start, at


def message_times(plain: bytes, start: int, stop: int, offset: int) -> tuple[int, int, int]:
    """(channel, log time, stamp) of the message at start..stop of a decompressed chunk."""
    if stop - start < MESSAGE_HEAD_BYTES:
        raise Break(offset, "a message there is malformed")
    channel, _, log_ns, stamp_ns = _MESSAGE.unpack_from(plain, start)
    return channel, log_ns, stamp_ns


def crc_of(file: BinaryIO, start: int, stop: int) -> int:
    """CRC-32 of a part of a file, read in blocks."""
    file.seek(start)
    crc, left = 0, stop - start
    while left > 0 and (block := file.read(min(_CRC_BLOCK_BYTES, left))):
        crc = zlib.crc32(block, crc)
        left -= len(block)
    return crc


def size_of(file: BinaryIO) -> int:
    """Length of an open file in bytes."""
    return os.fstat(file.fileno()).st_size


def _decompress(chunk: Chunk) -> bytes:
    # Both stop at the size that the chunk states, whatever the compressed bytes would become.
    limit = chunk.uncompressed_size
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit))
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        return decompressor.stream_reader(chunk.data).read(limit)
    if chunk.compression == "":
        return bytes(chunk.data)
    raise ValueError(chunk.compression)


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)
