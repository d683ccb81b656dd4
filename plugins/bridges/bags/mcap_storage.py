"""Recordings .mcap of ROS."""

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
    Break,
    Record,
    chunk_records,
    decompressed,
    message_of,
    open_chunk,
    records,
)
from sparseskin.nodes.sensor.layout.checks import reading
from sparseskin.plugins.bridges.messages.definitions import full_name
from sparseskin.plugins.bridges.messages.json_messages import KIND as JSON_KIND

from .chunks import ChunkedStorage
from .storage import Topic

FOOTER_BYTES = HEAD_BYTES + 20
"""Size of the last record, of two places and a checksum."""
CHUNK_HEAD = struct.Struct("<BQQQQI")
"""Begin of a chunk: opcode, length, times, size and checksum of its records."""
FORMS = {
    "ros1msg": "msg",
    "ros2msg": "msg",
    "ros2idl": "idl",
}
VERSIONS = {"ros1": 1, "cdr": 2}
"""Version of ROS by the encoding of its messages."""


class McapStorage(ChunkedStorage):
    """An .mcap, whose messages stand in chunks or outside of them."""

    MAGIC = MAGIC

    def __init__(self, path: str, name: str) -> None:
        super().__init__(path, name)
        self._schemas: dict[int, Topic] = {}
        with reading(path) as file:
            end = file.seek(0, 2) - len(MAGIC)
            begin = _begin_of_summary(file, end)
        self.is_closed = begin is not None
        if begin:
            self.index = (begin, end - FOOTER_BYTES)

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
        # The name of the compression and the size of the records follow, then these.
        content = io.BytesIO(file.read(MAX_CHUNK_BYTES))
        stream = ReadDataStream(content)
        try:
            form = stream.read_prefixed_string()
            stream.read8()
        except (EndOfFile, struct.error, UnicodeDecodeError):
            return ()
        plain = decompressed(form, content.read(), n_plain, offset)
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
            schema = self._schemas.get(channel.schema_id, Topic(""))
            # A topic of another encoding is listed by that, and never read as ROS.
            described = Topic(encoding, form="", ros=0)
            if encoding in VERSIONS:
                described = schema._replace(ros=VERSIONS[encoding])
            elif encoding == "json":
                kind = f"{JSON_KIND} {schema.kind}".strip()
                described = Topic(kind, form="json", ros=0)
            self.connections[channel.id] = (channel.topic, described)


def _begin_of_summary(file: IO[bytes], end: int) -> int | None:
    """Begin of the summary, 0 where there is none; None if no footer ends the data at a byte."""
    # From the end: the footer states where the summary begins.
    begin = end - FOOTER_BYTES
    if begin < 0:
        return None
    file.seek(end)
    if file.read() != MAGIC:
        return None
    try:
        record = next(records(file, begin, end))
        footer = record.parsed(mcap.records.Footer.read)
    except Break:
        return None
    if record.opcode != Opcode.FOOTER or footer.summary_start >= end:
        return None
    begin_of_summary: int = footer.summary_start
    return begin_of_summary


def _inner(plain: bytes, offset: int) -> Iterator[Record]:
    """The records of a chunk that begins at a byte."""
    for opcode, content in chunk_records(plain, offset):
        yield Record(opcode, offset, bytes(content))
