"""Records of an MCAP file, read safely whatever its bytes are.

Every length is checked against the file before anything is read, and every chunk against its
checksum. The functions raise `Break` with the byte from which on the file cannot be read.
"""

import bz2
import io
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import IO, BinaryIO, NamedTuple, TypeVar

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
    """A record of a file, which begins at byte `offset`, or the chunk that holds it, and its
    content.
    """

    opcode: int
    offset: int
    data: bytes

    @property
    def stop(self) -> int:
        """Byte behind the record."""
        return self.offset + HEAD_BYTES + len(self.data)

    def parsed(self, read: Callable[[ReadDataStream], T]) -> T:
        """The content, parsed by the reader of its class."""
        stream = ReadDataStream(io.BytesIO(self.data))
        try:
            content = read(stream)
        # EndOfFile, struct.error, UnicodeDecodeError, ValueError, ...
        except Exception as error:
            raise Break(self.offset, "a record there is malformed") from error
        if stream.count != len(self.data):
            raise Break(self.offset, "a record there is malformed")
        return content


def records(file: IO[bytes], start: int, stop: int) -> Iterator[Record]:
    """Yield the records from byte `start` up to `stop`."""
    offset = start
    while offset < stop:
        # Who iterates may have read elsewhere in the file.
        file.seek(offset)
        head = file.read(min(HEAD_BYTES, stop - offset))
        if len(head) < HEAD_BYTES:
            raise Break(offset, "the file ends in the middle of a record")

        # The length is not to be believed before it is checked.
        opcode, length = _HEAD.unpack(head)
        if opcode not in _KNOWN:
            raise Break(offset, "no record begins there")
        if length > stop - offset - HEAD_BYTES:
            raise Break(
                offset,
                "the file ends in the middle of a record, or its length is wrong",
            )
        if length > _MAX_RECORD_BYTES:
            raise Break(
                offset, f"a record of {length} bytes, at most {_MAX_RECORD_BYTES}"
            )

        record = Record(opcode, offset, file.read(length))
        yield record
        offset = record.stop


def record_at(file: BinaryIO, offset: int, stop: int, opcode: int) -> Record:
    """The record of one kind that begins at a byte and ends before another."""
    record = next(records(file, offset, stop), None)
    if record is None or record.opcode != opcode:
        raise Break(offset, "another record stands there")
    return record


def open_chunk(record: Record) -> bytes:
    """Decompress the records of a chunk."""
    chunk = record.parsed(Chunk.read)
    offset = record.offset
    n_bytes = chunk.uncompressed_size
    plain = decompressed(chunk.compression, chunk.data, n_bytes, offset)

    # 0 stands for a checksum that was not computed.
    checksum = chunk.uncompressed_crc
    if len(plain) != n_bytes or (checksum and zlib.crc32(plain) != checksum):
        raise Break(offset, "the checksum of a chunk there does not match")
    return plain


def decompressed(
    form: str, data: bytes, n_bytes: int, offset: int, max_bytes: int = MAX_CHUNK_BYTES
) -> bytes:
    """The records of the chunk at byte `offset`, as far as they can be decompressed, at most
    `n_bytes`. Raises Break if it states more than `max_bytes`, or they are malformed.
    """
    # A small chunk can claim to become any size.
    if n_bytes > max_bytes:
        raise Break(offset, f"a chunk of {n_bytes} bytes, at most {max_bytes}")
    try:
        # Each stops at the stated size, whatever the compressed bytes would become.
        match form:
            case "" | "none":
                plain = data[:n_bytes]
            case "zstd":
                reader = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
                plain = reader.stream_reader(data).read(n_bytes)
            case "lz4":
                plain = lz4.frame.LZ4FrameDecompressor().decompress(data, n_bytes)
            case "bz2":
                plain = bz2.BZ2Decompressor().decompress(data, n_bytes)
            case _:
                raise Break(offset, "a chunk of an unknown compression")
    except Break:
        raise
    # lz4 and zstandard have families of errors of their own.
    except Exception as error:
        raise Break(offset, "a chunk there cannot be decompressed") from error
    return bytes(plain)


def chunk_records(plain: bytes, offset: int) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of each record in a decompressed chunk."""
    view = memoryview(plain)
    at = 0
    while at < len(view):
        start = at + HEAD_BYTES
        if start > len(view):
            raise Break(offset, "a chunk there is malformed")
        opcode, length = _HEAD.unpack_from(view, at)
        at = start + length
        if at > len(view):
            raise Break(offset, "a chunk there is malformed")
        yield opcode, view[start:at]


def message_of(content: memoryview, offset: int) -> tuple[int, int, int, memoryview]:
    """Number of the channel, log time, stamp and payload of the message whose record in the chunk
    at `offset` has that content.
    """
    if len(content) < _MESSAGE.size:
        raise Break(offset, "a message there is malformed")
    channel, _, log_time_ns, stamp_ns = _MESSAGE.unpack_from(content)
    return channel, log_time_ns, stamp_ns, content[_MESSAGE.size :]


def crc_of(file: BinaryIO, start: int, stop: int) -> int:
    """CRC-32 of a part of a file, read in blocks."""
    file.seek(start)
    crc = 0
    n_remaining = stop - start
    while n_remaining > 0:
        block = file.read(min(_CRC_BLOCK_BYTES, n_remaining))
        if not block:
            break
        crc = zlib.crc32(block, crc)
        n_remaining -= len(block)
    return crc
