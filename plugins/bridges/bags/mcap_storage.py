"""Recordings .mcap of ROS."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Iterator
from typing import IO

import mcap.records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

from sparseskin.nodes.recorder.bag.records import (
    HEAD_BYTES,
    MAGIC,
    MAX_CHUNK_BYTES,
    Record,
    chunk_records,
    message_of,
    open_chunk,
    records,
)
from sparseskin.nodes.sensor.layout.checks import reading
from sparseskin.plugins.bridges.messages.definitions import full_name

from .chunks import ChunkedStorage, begin_of_chunk
from .storage import Topic

FOOTER = struct.Struct("<BQQQI")
"""The last record: opcode, length, begin of the summary and of its offsets, checksum."""
CHUNK_HEAD = struct.Struct("<BQQQQI")
"""Begin of a chunk: opcode, length, times, size and checksum of its records."""
FORMS = {"ros1msg": "msg", "ros2msg": "msg", "ros2idl": "idl"}
VERSIONS = {"ros1": 1, "cdr": 2}
"""Version of ROS by the encoding of its messages."""


class McapStorage(ChunkedStorage):
    """An .mcap, whose messages stand in chunks or outside of them."""

    MAGIC = MAGIC

    def __init__(self, path: str, name: str) -> None:
        super().__init__(path, name)
        self._schemas: dict[int, Topic] = {}
        with reading(path) as file:
            begin = _begin_of_summary(file)
            stop = file.seek(0, 2) - len(MAGIC) - FOOTER.size
        self.is_closed = begin is not None
        if begin:
            self.index = (begin, stop)

    def records(self, file: IO[bytes], begin: int, stop: int) -> Iterator[Record]:
        for record in records(file, begin, stop):
            if record.opcode == Opcode.DATA_END:
                return
            yield record

    def in_chunk(self, record: Record) -> Iterable[Record]:
        if record.opcode != Opcode.CHUNK:
            return (record,)
        return _inner(open_chunk(record), record.offset)

    def in_begin_of_chunk(self, file: IO[bytes], stop: int) -> Iterable[Record]:
        offset = file.tell()
        heading = file.read(CHUNK_HEAD.size)
        if len(heading) < CHUNK_HEAD.size or heading[0] != Opcode.CHUNK:
            return ()
        _, _, _, _, n_plain, _ = CHUNK_HEAD.unpack(heading)
        content = io.BytesIO(file.read(MAX_CHUNK_BYTES))
        stream = ReadDataStream(content)
        try:
            form = stream.read_prefixed_string()
            stream.read8()
        except (EndOfFile, struct.error, UnicodeDecodeError):
            return ()
        plain = begin_of_chunk(form, content.read(), n_plain, offset)
        return _inner(plain, offset)

    def payload(self, record: Record) -> tuple[int, int, bytes] | None:
        if record.opcode != Opcode.MESSAGE:
            return None
        content = memoryview(record.data)
        number, log_ns, _, data = message_of(content, record.offset)
        return number, log_ns, bytes(data)

    def note(self, record: Record) -> None:
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


def _begin_of_summary(file: IO[bytes]) -> int | None:
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


def _inner(plain: bytes, offset: int) -> Iterator[Record]:
    """The records of a chunk that begins at a byte."""
    for opcode, content in chunk_records(plain, offset):
        yield Record(opcode, offset, bytes(content))
