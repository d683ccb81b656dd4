"""Recordings .bag of ROS 1, whose index is not used for messages: a killed recorder leaves none."""

import io
import struct
from collections.abc import Iterable, Iterator
from typing import IO, NamedTuple

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.recorder.bag.records import Break, decompressed
from sparseskin.nodes.sensor.layout.checks import reading
from sparseskin.plugins.bridges.messages.definitions import full_name

from .chunks import ChunkedStorage
from .storage import Topic

MAGIC = b"#ROSBAG V2.0\n"
OP_MESSAGE = 2
OP_HEADER = 3
OP_CHUNK = 5
OP_CONNECTION = 7
MAX_CHUNK_BYTES = 1 << 28
"""Largest chunk of a bag after decompression; chosen: a hundred times the usual."""
MAX_HEAD_BYTES = 1 << 20
MAX_TOPICS = 1 << 16
LENGTH = struct.Struct("<I")
TIME = struct.Struct("<II")
INDEX = struct.Struct("<Q")


class Record(NamedTuple):
    """A record that begins at a byte: the fields of its head, and its content."""

    offset: int
    head: dict[bytes, bytes]
    data: bytes

    @property
    def opcode(self) -> int:
        """Kind of the record."""
        return int.from_bytes(self.head.get(b"op", b""), "little")

    def text(self, name: bytes) -> str:
        """A text of the head, "" where there is none."""
        return self.head.get(name, b"").decode("utf-8", "replace")

    def number(self, name: bytes) -> int:
        """A number of the head. Raises Break if there is none."""
        return self.unpacked(LENGTH, name)[0]

    def unpacked(self, form: struct.Struct, name: bytes) -> tuple[int, ...]:
        """Numbers of the head."""
        value = self.head.get(name, b"")
        if len(value) != form.size:
            raise Break(self.offset, "a record there is malformed")
        return form.unpack(value)


class BagStorage(ChunkedStorage):
    """A .bag of version 2.0."""

    MAGIC = MAGIC

    def __init__(self, path: str, name: str) -> None:
        super().__init__(path, name)
        begin = 0
        with reading(path) as file:
            size = file.seek(0, 2)
            try:
                # The first record states where the index begins.
                header = next(self.records(file, len(MAGIC), size), None)
                if header is not None and header.opcode == OP_HEADER:
                    (begin,) = header.unpacked(INDEX, b"index_pos")
            except Break as fault:
                raise SourceError(f"{name}: cannot be read ({fault.why})") from fault

        # A recorder that was killed has stated no index.
        self.is_closed = 0 < begin < size
        if self.is_closed:
            self.index = (begin, size)

    def records(self, file: IO[bytes], begin: int, stop: int) -> Iterator[Record]:
        file.seek(begin)
        while file.tell() < stop:
            offset = file.tell()
            head = _bytes(file, offset, stop, MAX_HEAD_BYTES)
            data = _bytes(file, offset, stop, MAX_CHUNK_BYTES)
            yield Record(offset, _fields(head, offset), data)

    def in_chunk(self, record: Record) -> Iterable[Record]:
        if record.opcode != OP_CHUNK:
            return (record,)
        plain = _plain(record)
        # A chunk has no checksum: its size is all that can be compared.
        if len(plain) != record.number(b"size"):
            raise Break(record.offset, "its size is wrong")
        return self.records(io.BytesIO(plain), 0, len(plain))

    def in_begin_of_chunk(self, file: IO[bytes], stop: int) -> Iterable[Record]:
        offset = file.tell()
        head = _bytes(file, offset, stop, MAX_HEAD_BYTES)
        # Its length is beyond the end of the file.
        file.read(LENGTH.size)
        data = file.read(MAX_CHUNK_BYTES)
        record = Record(offset, _fields(head, offset), data)
        if record.opcode != OP_CHUNK:
            return ()
        plain = _plain(record)
        return self.records(io.BytesIO(plain), 0, len(plain))

    def payload(self, record: Record) -> tuple[int, int, bytes] | None:
        if record.opcode != OP_MESSAGE:
            return None
        seconds, nanoseconds = record.unpacked(TIME, b"time")
        stamp_ns = seconds * 10**9 + nanoseconds
        return record.number(b"conn"), stamp_ns, record.data

    def note(self, record: Record) -> None:
        if record.opcode != OP_CONNECTION or len(self.connections) >= MAX_TOPICS:
            return
        # Its content is a head of its own: the type of its messages, and the definition of that.
        head = _fields(record.data, record.offset)
        about = Record(record.offset, head, b"")
        kind = full_name(about.text(b"type"))
        described = Topic(kind, about.text(b"message_definition"), ros=1)
        number = record.number(b"conn")
        self.connections[number] = (record.text(b"topic"), described)


def _bytes(file: IO[bytes], offset: int, stop: int, most: int) -> bytes:
    """The bytes behind their length, which stands at the place of a file; of a record that begins
    at a byte. Raises Break if they are not whole.
    """
    raw = file.read(LENGTH.size)
    if len(raw) < LENGTH.size:
        raise Break(offset, "the file ends in the middle of a record")
    (n_bytes,) = LENGTH.unpack(raw)
    # A length is compared with what there is before anything is read.
    if n_bytes > stop - file.tell():
        raise Break(
            offset, "the file ends in the middle of a record, or its length is wrong"
        )
    if n_bytes > most:
        raise Break(offset, f"a record of {n_bytes} bytes, at most {most}")
    return file.read(n_bytes)


def _fields(raw: bytes, offset: int) -> dict[bytes, bytes]:
    """Fields NAME=VALUE, each behind its length, of a record that begins at a byte."""
    file = io.BytesIO(raw)
    fields = {}
    while file.tell() < len(raw):
        field = _bytes(file, offset, len(raw), MAX_HEAD_BYTES)
        name, mark, value = field.partition(b"=")
        if not mark:
            raise Break(offset, "a record there is malformed")
        fields[name] = value
    return fields


def _plain(record: Record) -> bytes:
    """The records of a chunk, or what can be decompressed of them."""
    form = record.text(b"compression")
    n_bytes = record.number(b"size")
    return decompressed(form, record.data, n_bytes, record.offset, MAX_CHUNK_BYTES)
