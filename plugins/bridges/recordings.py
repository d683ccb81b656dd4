"""Recordings of ROS as files of readings: .bag of ROS 1, .db3 and .mcap of ROS 2."""

from __future__ import annotations

import bz2
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import mcap.records
import numpy as np
from mcap.opcode import Opcode

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES, MAX_GROWTH
from sparseskin.nodes.recorder.bag.records import (
    MAGIC,
    Break,
    Record,
    chunk_records,
    message_of,
    open_chunk,
    records,
)
from sparseskin.nodes.sensor.files.format import Format
from sparseskin.nodes.sensor.files.recording import (
    File,
    Parsed,
    Recording,
    choose,
    reading,
    rising,
    shape_text,
    unreadable,
)

from .base import check_installed
from .frames import KINDS, Received, read_frame

MAX_BAG_CHUNK_BYTES = 1 << 28
"""Largest chunk of a bag of ROS 1 after decompression; chosen: a hundred times the usual."""


class Recorded(NamedTuple):
    """A message of a recording, and the time at which it was recorded."""

    topic: str
    kind: str
    log_ns: int
    data: bytes


class RosRecording(Recording):
    """The messages of a topic that hold frames: the stated topic, or the only one. Times are those
    of the headers, or of the recording where a header has none or they do not rise.

    Raises
    ------
    SourceError
        If the file is damaged, no topic or several hold frames, or their shape changes.
    """

    def __init__(self, file: File) -> None:
        check_installed(file.name, "ros", "rosbags", error=SourceError)
        self._file, self._ros = file, 1 if file.name.lower().endswith(".bag") else 2

    def read(self) -> Parsed:
        name = self._file.name
        try:
            topic = self._chosen()
            messages = [one for one in self._all() if one.topic == topic]
            messages.sort(key=lambda one: one.log_ns)
            found = [self._frame(one) for one in messages]
        except SourceError:
            raise
        except Exception as error:  # of rosbags and SQLite, at malformed bytes of any kind
            raise unreadable(name, error) from error
        if len(shapes := {one.values.shape for one in found}) > 1:
            raise SourceError(f"{name}: {topic}: its shape changes: {sorted(shapes)[:4]}")
        stamps = [one.stamp_ns or 0 for one in found]
        if not all(stamps) or sorted(set(stamps)) != stamps:
            stamps = [one.log_ns for one in messages]
        return Parsed(
            np.stack([one.values for one in found]),
            stamp_ns=rising(stamps, name),
            notes=(f"topic {topic}",),
        )

    def _all(self) -> Iterator[Recorded]:
        """All messages; SourceError once they are larger than any recording of that size is."""
        names = self._file.name, *self._file.parts
        left = max(MAX_GROWN_BYTES, MAX_GROWTH * sum(Path(name).stat().st_size for name in names))
        for name in names:
            with reading(name) as opened:
                read = READERS[Path(name).suffix.lower()]
                for one in read(replace(self._file, file=opened, name=name)):
                    left -= len(one.data)
                    if left < 0:
                        raise SourceError(f"{name}: its messages are far larger than the file")
                    yield one

    def _frame(self, one: Recorded) -> Received:
        try:
            return read_frame(one.kind, one.data, self._file.columns, self._ros)
        except SourceError as error:
            raise SourceError(f"{self._file.name}: {one.topic}: {error}") from error

    def _chosen(self) -> str:
        """The topic whose first message is a frame."""
        firsts: dict[str, Recorded] = {}
        for one in self._all():
            firsts.setdefault(one.topic, one)
        fitting: dict[str, str] = {}
        more = ""
        for topic, one in firsts.items():
            if one.kind not in KINDS:
                continue
            try:
                shape = self._frame(one).values.shape
            except SourceError:
                if topic == self._file.topic or len(firsts) == 1:
                    raise
                continue
            if not fitting and len(shape) == 1 and not (self._file.n_rows or self._file.n_cols):
                more = f" {shape_text(*shape)}"
            fitting[topic] = f"{one.kind.rpartition('/')[2]}, {' x '.join(map(str, shape))}"
        if not fitting:
            held = ", ".join(f"{topic} ({one.kind})" for topic, one in [*firsts.items()][:8])
            raise SourceError(
                f"{self._file.name}: no topic holds frames; it holds {held or 'no message'}"
            )
        file = self._file
        return choose(fitting, file.topic, file.name, "topics of frames", more=more)


def _mcap(file: File) -> Iterator[Recorded]:
    """The messages of an .mcap, in or outside chunks."""
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}

    def one(record: Record) -> Iterator[Recorded]:
        if record.opcode == Opcode.SCHEMA:
            schema = record.parsed(mcap.records.Schema.read)
            schemas[schema.id] = schema.name
        elif record.opcode == Opcode.CHANNEL:
            channel = record.parsed(mcap.records.Channel.read)
            is_cdr = channel.message_encoding == "cdr"
            kind = schemas.get(channel.schema_id, "") if is_cdr else channel.message_encoding
            channels[channel.id] = channel.topic, kind
        elif record.opcode == Opcode.MESSAGE:
            id, log_ns, _, payload = message_of(memoryview(record.data), record.offset)
            if id not in channels:
                raise Break(record.offset, "a message there has no channel")
            yield Recorded(*channels[id], log_ns, bytes(payload))

    size = file.file.seek(0, 2)
    for record in records(file.file, len(MAGIC), size):
        if record.opcode == Opcode.DATA_END:
            return
        if record.opcode == Opcode.CHUNK:
            for opcode, content in chunk_records(open_chunk(record), record.offset):
                yield from one(Record(opcode, record.offset, bytes(content)))
        else:
            yield from one(record)


def _db3(file: File) -> Iterator[Recorded]:
    """The messages of an SQLite file, whose tables are no views and call nothing."""
    where = f"{Path(file.name).resolve().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(where, uri=True)) as base:
        base.execute("PRAGMA trusted_schema = OFF")
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_GROWN_BYTES)
        tables = {*base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables >= {("topics",), ("messages",)}:
            raise SourceError(f"{file.name}: holds no tables topics and messages of a bag of ROS 2")
        rows = base.execute("SELECT id, name, type, serialization_format FROM topics")
        topics = {id: (str(name), str(kind if f == "cdr" else f)) for id, name, kind, f in rows}
        rows = base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp")
        for id, log_ns, data in rows:
            if not (id in topics and isinstance(log_ns, int) and isinstance(data, bytes)):
                raise SourceError(f"{file.name}: a message has no topic, time or content")
            yield Recorded(*topics[id], log_ns, data)


def _bag(file: File) -> Iterator[Recorded]:
    """The messages of a bag of ROS 1."""
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import decompressors

    bounded = {
        decompressors["bz2"]: bz2.BZ2Decompressor,
        decompressors["lz4"]: lz4.frame.LZ4FrameDecompressor,
    }

    with Reader(Path(file.name)) as reader:
        for at, chunk in reader.chunks.items():
            if (make := bounded.get(chunk.decompressor)) is not None:
                reader.chunks[at] = chunk._replace(decompressor=partial(_plain, make))
        for connection, log_ns, data in reader.messages():
            yield Recorded(connection.topic, connection.msgtype, log_ns, data)


def _plain(make: Callable[[], Any], data: bytes) -> bytes:
    return bytes(make().decompress(data, max_length=MAX_BAG_CHUNK_BYTES))


READERS = {".bag": _bag, ".db3": _db3, ".mcap": _mcap}
ROS = Format({".bag": "ROS 1", ".db3": "ROS 2", ".mcap": "ROS 2"}, RosRecording)
