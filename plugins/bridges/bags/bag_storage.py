"""Recordings .bag of ROS 1, whose index is not used: a killed recorder leaves none."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Collection, Iterator
from typing import IO, Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped, unused-ignore]

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.checks import reading
from sparseskin.plugins.bridges.messages.definitions import full_name

from .storage import Recorded, Storage, Topic

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


class Break(Exception):  # noqa: N818 - a place in a file, not an error of this program
    """The place from which on a file cannot be read, and the reason."""


class Record(NamedTuple):
    """Fields of the head of a record, its bytes, and the byte behind it."""

    head: dict[bytes, bytes]
    data: bytes
    stop: int

    @property
    def opcode(self) -> int:
        """Kind of the record."""
        return int.from_bytes(self.head.get(b"op", b""), "little")

    def number(self, name: bytes) -> int:
        """A number of the head. Raises Break if there is none."""
        return int(self.unpacked(LENGTH, name)[0])

    def unpacked(self, form: struct.Struct, name: bytes) -> tuple[int, ...]:
        """Numbers of the head."""
        value = self.head.get(name, b"")
        if len(value) != form.size:
            raise Break("a record there is malformed")
        return form.unpack(value)


class BagStorage(Storage):
    """A .bag of version 2.0."""

    def __init__(self, path: str, name: str) -> None:
        super().__init__(path, name)
        self._index = 0
        with reading(path) as file:
            size = file.seek(0, 2)
            try:
                first_record = next(_records(file, len(MAGIC), size), None)
                if first_record is not None and first_record.opcode == OP_HEADER:
                    self._index = first_record.unpacked(INDEX, b"index_pos")[0]
            except Break as fault:
                raise SourceError(f"{name}: cannot be read ({fault})") from fault
        # A recorder that was killed has stated no index.
        self.is_closed = 0 < self._index < size

    def read_index(self) -> None:
        if not self.is_closed:
            return
        with reading(self.path) as file:
            size = file.seek(0, 2)
            try:
                for record in _records(file, self._index, size):
                    if record.opcode == OP_CONNECTION:
                        self._connect(record)
            # Without an index the connections are read beside the messages.
            except Break:
                self.connections.clear()

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        self.losses.clear()
        with reading(self.path) as file:
            size = file.seek(0, 2)
            place = len(MAGIC)
            try:
                for record in _records(file, place, size):
                    yield from self._messages(record, place, topics)
                    place = record.stop
            except Break as fault:
                self.losses.append(f"behind byte {place} of {size} ({fault})")
                yield from self._rest(file, place, size, topics)

    def _messages(
        self, record: Record, place: int, topics: Collection[str]
    ) -> Iterator[Recorded]:
        """The messages of a record; a damaged chunk costs itself."""
        try:
            if record.opcode != OP_CHUNK:
                yield from self._message(record, topics)
                return
            plain = _plain(record, record.data)
            if len(plain) != record.number(b"size"):
                raise Break("its size is wrong")
            for inner in _inner(plain):
                yield from self._message(inner, topics)
        except Break as fault:
            self.losses.append(f"in the record at byte {place} ({fault})")

    def _rest(
        self, file: IO[bytes], place: int, size: int, topics: Collection[str]
    ) -> Iterator[Recorded]:
        """The messages of a chunk whose end is missing."""
        try:
            head = _head(file, place, size)
            record = Record(head, b"", size)
            if record.opcode != OP_CHUNK:
                return
            file.read(LENGTH.size)
            for inner in _inner(_plain(record, file.read(MAX_CHUNK_BYTES))):
                yield from self._message(inner, topics)
        except Break:
            return  # its end, which is named already

    def _message(self, record: Record, topics: Collection[str]) -> Iterator[Recorded]:
        if record.opcode == OP_CONNECTION:
            self._connect(record)
        if record.opcode != OP_MESSAGE:
            return
        number = record.number(b"conn")
        if number not in self.connections:
            raise Break("a message there has no connection")
        topic, described = self.connections[number]
        if topic in topics:
            sec, nanosec = record.unpacked(TIME, b"time")
            yield Recorded(topic, described.kind, sec * 10**9 + nanosec, record.data)

    def _connect(self, record: Record) -> None:
        """Note a connection: a topic, its type and the definition of that."""
        fields = _fields(record.data)
        topic = record.head.get(b"topic", b"").decode("utf-8", "replace")
        kind = full_name(fields.get(b"type", b"").decode("utf-8", "replace"))
        text = fields.get(b"message_definition", b"").decode("utf-8", "replace")
        if len(self.connections) < MAX_TOPICS:
            number = record.number(b"conn")
            self.connections[number] = (topic, Topic(kind, text, ros=1))


def _records(file: IO[bytes], place: int, size: int) -> Iterator[Record]:
    """The records from a byte on. Raises Break at the first one that is not whole."""
    while place < size:
        head = _head(file, place, size)
        raw = file.read(LENGTH.size)
        if len(raw) < LENGTH.size:
            raise Break("the file ends in the middle of a record")
        (n_bytes,) = LENGTH.unpack(raw)
        stop = file.tell() + n_bytes
        if stop > size:
            raise Break(
                "the file ends in the middle of a record, or its length is wrong"
            )
        if n_bytes > MAX_CHUNK_BYTES:
            raise Break(f"a record of {n_bytes} bytes, at most {MAX_CHUNK_BYTES}")
        yield Record(head, file.read(n_bytes), stop)
        place = stop


def _head(file: IO[bytes], place: int, size: int) -> dict[bytes, bytes]:
    """The fields of the head of a record."""
    file.seek(place)
    raw = file.read(LENGTH.size)
    if len(raw) < LENGTH.size:
        raise Break("the file ends in the middle of a record")
    (n_bytes,) = LENGTH.unpack(raw)
    if n_bytes > min(MAX_HEAD_BYTES, size - file.tell()):
        raise Break("the file ends in the middle of a record, or its length is wrong")
    return _fields(file.read(n_bytes))


def _fields(raw: bytes) -> dict[bytes, bytes]:
    """Fields NAME=VALUE, each behind its length."""
    fields = {}
    at = 0
    while at < len(raw):
        if at + LENGTH.size > len(raw):
            raise Break("a record there is malformed")
        (n_bytes,) = LENGTH.unpack_from(raw, at)
        begin = at + LENGTH.size
        at = begin + n_bytes
        name, mark, value = raw[begin:at].partition(b"=")
        if at > len(raw) or not mark:
            raise Break("a record there is malformed")
        fields[name] = value
    return fields


def _inner(plain: bytes) -> Iterator[Record]:
    """The records of a chunk. Raises Break at the first one that is not whole."""
    at = 0
    while at < len(plain):
        head, at = _part(plain, at)
        data, at = _part(plain, at)
        yield Record(_fields(head), data, at)


def _part(plain: bytes, at: int) -> tuple[bytes, int]:
    """The bytes behind the length that stands at a byte of a chunk, and the byte behind them."""
    begin = at + LENGTH.size
    if begin > len(plain):
        raise Break("a chunk there is malformed")
    (n_bytes,) = LENGTH.unpack_from(plain, at)
    stop = begin + n_bytes
    if stop > len(plain):
        raise Break("a chunk there is malformed")
    return plain[begin:stop], stop


def _plain(record: Record, data: bytes) -> bytes:
    """The records of a chunk, or what can be decompressed of them."""
    form = record.head.get(b"compression", b"none")
    n_bytes = record.number(b"size")
    if n_bytes > MAX_CHUNK_BYTES:
        raise Break(f"a chunk of {n_bytes} bytes, at most {MAX_CHUNK_BYTES}")
    if form == b"none":
        return data

    decompressor: Any
    if form == b"bz2":
        decompressor = bz2.BZ2Decompressor()
    elif form == b"lz4":
        decompressor = lz4.frame.LZ4FrameDecompressor()
    else:
        raise Break("a chunk of an unknown compression")
    try:
        return bytes(decompressor.decompress(data, max_length=n_bytes))
    except (OSError, RuntimeError, ValueError) as error:
        raise Break("a chunk there cannot be decompressed") from error
