"""Recordings .mcap of ROS."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import mcap.records
import zstandard
from mcap.opcode import Opcode

from sparseskin.nodes.recorder.bag.records import (
    HEAD_BYTES,
    MAGIC,
    MAX_CHUNK_BYTES,
    Break,
    Record,
    chunk_records,
    message_of,
    open_chunk,
    records,
)
from sparseskin.nodes.sensor.layout.checks import reading
from sparseskin.plugins.bridges.messages.definitions import full_name

from .storage import Recorded, Storage, Topic

FOOTER = struct.Struct("<BQQQI")
"""The last record: opcode, length, begin of the summary and of its offsets, checksum."""
CHUNK_HEAD = struct.Struct("<QQQII")
"""Begin of a chunk: times, size and checksum of its records, length of the name of its form."""
FORMS = {"ros1msg": "msg", "ros2msg": "msg", "ros2idl": "idl"}
VERSIONS = {"ros1": 1, "cdr": 2}
"""Version of ROS by the encoding of its messages."""


class McapStorage(Storage):
    """An .mcap, whose messages stand in chunks or outside of them."""

    def __init__(self, path: str, name: str) -> None:
        super().__init__(path, name)
        self._schemas: dict[int, Topic] = {}
        with reading(path) as file:
            self._summary = self._begin_of_summary(file)
        self.is_closed = self._summary is not None

    def read_index(self) -> None:
        if not self._summary:
            return
        with reading(self.path) as file:
            size = file.seek(0, 2)
            try:
                for record in records(
                    file, self._summary, size - len(MAGIC) - FOOTER.size
                ):
                    self._note(record)
            except Break:
                self.connections.clear()

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        self.losses.clear()
        with reading(self.path) as file:
            size = file.seek(0, 2)
            place = len(MAGIC)
            try:
                for record in records(file, place, size):
                    place = record.stop
                    if record.opcode == Opcode.DATA_END:
                        return
                    yield from self._messages(record, topics)
            except Break as fault:
                self.losses.append(
                    f"behind byte {fault.offset} of {size} ({fault.why})"
                )
                yield from self._rest(file, place, size, topics)

    def _messages(self, record: Record, topics: Collection[str]) -> Iterator[Recorded]:
        """The messages of a record; a damaged chunk costs itself."""
        try:
            if record.opcode != Opcode.CHUNK:
                yield from self._message(record, topics)
                return
            for opcode, content in chunk_records(open_chunk(record), record.offset):
                yield from self._message(
                    Record(opcode, record.offset, bytes(content)), topics
                )
        except Break as fault:
            self.losses.append(f"in the record at byte {fault.offset} ({fault.why})")

    def _message(self, record: Record, topics: Collection[str]) -> Iterator[Recorded]:
        if record.opcode != Opcode.MESSAGE:
            self._note(record)
            return
        number, log_ns, _, payload = message_of(memoryview(record.data), record.offset)
        if number not in self.connections:
            raise Break(record.offset, "a message there has no channel")
        topic, described = self.connections[number]
        if topic in topics:
            yield Recorded(topic, described.kind, log_ns, bytes(payload))

    def _note(self, record: Record) -> None:
        """Note a schema or a channel."""
        if record.opcode == Opcode.SCHEMA:
            schema = record.parsed(mcap.records.Schema.read)
            form = FORMS.get(schema.encoding, "")
            text = ""
            if form:
                text = schema.data.decode("utf-8", "replace")
            self._schemas[schema.id] = Topic(full_name(schema.name), text, form)
        elif record.opcode == Opcode.CHANNEL:
            channel = record.parsed(mcap.records.Channel.read)
            encoding = channel.message_encoding
            described = Topic(encoding)
            if encoding in VERSIONS:
                schema = self._schemas.get(channel.schema_id, Topic(""))
                described = schema._replace(ros=VERSIONS[encoding])
            self.connections[channel.id] = (channel.topic, described)

    def _begin_of_summary(self, file: IO[bytes]) -> int | None:
        """Begin of the summary, 0 where there is none; None if the file has no end."""
        size = file.seek(0, 2)
        end = len(MAGIC) + FOOTER.size
        if size < end + len(MAGIC):
            return None
        file.seek(size - end)
        tail = file.read(end)
        begin: int
        opcode, length, begin, _, _ = FOOTER.unpack_from(tail)
        is_footer = opcode == Opcode.FOOTER and length == FOOTER.size - HEAD_BYTES
        if not tail.endswith(MAGIC) or not is_footer or begin >= size:
            return None
        return begin

    def _rest(
        self, file: IO[bytes], place: int, size: int, topics: Collection[str]
    ) -> Iterator[Recorded]:
        """The messages of a chunk whose end is missing."""
        file.seek(place)
        heading = file.read(HEAD_BYTES + CHUNK_HEAD.size)
        if len(heading) < HEAD_BYTES + CHUNK_HEAD.size or heading[0] != Opcode.CHUNK:
            return
        _, _, n_plain, _, n_name = CHUNK_HEAD.unpack_from(heading, HEAD_BYTES)
        if n_name > HEAD_BYTES or n_plain > MAX_CHUNK_BYTES:
            return
        form = file.read(n_name).decode("latin-1")
        file.read(8)
        plain = _begin(form, file.read(min(size - place, MAX_CHUNK_BYTES)), n_plain)
        try:
            for opcode, content in chunk_records(plain, place):
                yield from self._message(Record(opcode, place, bytes(content)), topics)
        except Break:
            return  # its end, which is named already


def _begin(form: str, data: bytes, n_plain: int) -> bytes:
    """What can be decompressed of the begin of a chunk."""
    decompressor: Any
    try:
        if form == "lz4":
            decompressor = lz4.frame.LZ4FrameDecompressor()
            return bytes(decompressor.decompress(data, max_length=n_plain))
        if form == "zstd":
            decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
            return bytes(decompressor.stream_reader(data).read(n_plain))
    except (RuntimeError, zstandard.ZstdError):
        return b""
    if form:
        return b""
    return data[:n_plain]
