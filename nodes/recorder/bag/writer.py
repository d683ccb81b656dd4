"""Writer of bags: NAME.mcap.part while it grows, NAME.mcap once it is complete."""

import contextlib
import dataclasses
import io
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from sparseskin.messages import Message, encode
from sparseskin.messages.base import omitted_fields, wire_fields
from sparseskin.messages.fields import (
    Each,
    FieldKind,
    Flag,
    Integer,
    Names,
    Real,
    Text,
    Words,
)
from sparseskin.messages.wire import MAX_MESSAGE_BYTES, SCHEMAS
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import place
from sparseskin.nodes.lookup import did_you_mean

from .format import (
    COUNTS_RECORD,
    ENCODING,
    GRAPH_RECORD,
    JSON_KEY,
    LIBRARY_PREFIX,
    PART_SUFFIX,
    SCHEMA_PREFIX,
    TOPICS_RECORD,
    VERSION_KEY,
    BagError,
    BagMessage,
    TopicInfo,
    check_new_bag,
)

CHUNK_BYTES = 1 << 20
"""A chunk is ended and compressed when its records exceed this many bytes."""
KEPT = "recording ended, what it holds can be read"
NOT_KEPT = "nothing was written"
_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_TYPES: dict[type[FieldKind], str] = {
    Integer: "integer",
    Real: "number",
    Flag: "boolean",
    Text: "string",
    Names: "string",
    Each: "array",
    Words: "string",
}
"""JSON types of fields; an array is a map of dtype, shape, order, data and step, an object."""


@contextlib.contextmanager
def removing(draft: Path, out: Path) -> Iterator[None]:
    """Let an error of the writer of `draft`, which is removed then, name `out` in its place."""
    try:
        yield
    except SparseskinError as error:
        _, part, fault = str(error).partition(f"{draft}{PART_SUFFIX}")
        if not part:
            raise
        raise BagError(f"{out}{fault.replace(KEPT, NOT_KEPT)}") from error


class _WholeWrites:
    """A new file to which all bytes that wait in `pending` are written by `flush`, or none.

    `flush` raises OSError if the disk refuses: the pending bytes are then dropped, and the file is
    cut to what was flushed before.
    """

    def __init__(self, path: Path) -> None:
        self._file = io.FileIO(path, "xb")
        self.pending = bytearray()

    def write(self, data: bytes) -> None:
        self.pending += data

    def tell(self) -> int:
        return self._file.tell() + len(self.pending)

    def flush(self) -> None:
        # The operating system may take a part of the bytes only.
        begin = self._file.tell()
        unwritten = memoryview(bytes(self.pending))
        self.pending.clear()
        try:
            while unwritten:
                n_written = self._file.write(unwritten)
                unwritten = unwritten[n_written:]
        except OSError:
            with contextlib.suppress(OSError):
                # A part of a chunk would break the file there.
                self._file.truncate(begin)
            raise

    def close(self, sync: bool) -> None:
        """Close the file without the pending bytes; with `sync`, once the disk holds it."""
        # A bag that has its name is on the disk.
        if sync:
            os.fsync(self._file.fileno())
        self._file.close()


class BagWriter(AbstractContextManager["BagWriter"]):
    """Writes messages into a bag; not for several threads at once.

    Memory holds a chunk of messages and the index of all chunks, 0.5 kB a chunk and 60 bytes for
    each topic in it: 15 MB an hour with five chunks a second of five topics.

    `path` is that of the complete bag, NAME.mcap; `metadata` state its origin: scene, seed, launch
    file, Phi, versions. A message stays in memory for `flush_every_s` seconds of the clock
    `monotonic` at most, while `write` or `tick` is called. Raises BagError if NAME.mcap or
    NAME.mcap.part exists or cannot be created, or the metadata are no valid Unicode.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str],
        *,
        flush_every_s: float = 0.2,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self.path = Path(path)
        # The name is that of a complete bag: until then the file has another.
        self.part = check_new_bag(self.path)
        self.n_messages = 0
        self._flush_every_s = flush_every_s
        self._monotonic = monotonic
        self._oldest_s: float | None = None
        self._topics: dict[str, TopicInfo] = {}
        self._failure = ""
        self._closed = False
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}

        try:
            # Found now: the library would fail in the middle of the file.
            "".join([*metadata, *metadata.values()]).encode()
        except UnicodeEncodeError as error:
            raise BagError(f"{self.path}: metadata: no valid Unicode") from error
        try:
            self._file = _WholeWrites(self.part)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise BagError(f"{self.part}: {reason}") from error
        # A reader believes the index if the checksum of the data before it is right.
        self._mcap = Writer(
            self._file,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.LZ4,
            enable_data_crcs=True,
        )

        self._mcap.start(library=LIBRARY_PREFIX + version_of("sparseskin"))
        self._mcap.add_metadata(GRAPH_RECORD, dict(metadata))
        # Now: a disk that takes nothing is reported before the first message.
        try:
            self._file.flush()
        except OSError as error:
            self.discard()
            raise BagError(f"{self.part}: {error.strerror}; {NOT_KEPT}") from error

    def write(self, message: BagMessage) -> None:
        """Record the wire payload of one message, byte for byte. Raises BagError if the schema is
        unknown or the payload is too large; if the disk refuses (each later call then raises the
        same line, and the file is not changed any more); or if the bag is closed.
        """
        self._check_open()
        topic, schema, log_time_ns, stamp_ns, payload = message
        channel = self._channel(topic, schema)
        n_bytes = len(payload)
        if n_bytes > MAX_MESSAGE_BYTES:
            raise BagError(
                f"{self.path}: a message of {n_bytes} bytes on {topic}, at most "
                f"{MAX_MESSAGE_BYTES}"
            )

        info = self._topics.get(topic)
        if info is None:
            info = TopicInfo(schema, SCHEMAS[schema].version)
            self._topics[topic] = info

        # 32 bits in the file.
        sequence = info.n_messages & 0xFFFFFFFF
        self._mcap.add_message(channel, log_time_ns, payload, stamp_ns, sequence)
        info.add(schema, stamp_ns, log_time_ns)
        self.n_messages += 1

        # The chunk was full.
        if self._file.pending:
            self.flush()
            return
        if self._oldest_s is None:
            self._oldest_s = self._monotonic()
        self.tick()

    def record(self, message: Message, log_time_ns: int) -> None:
        """Encode and record a message; raises as `write`."""
        topic, payload = encode(message)
        stamp_ns = message.stamp_ns
        self.write(
            BagMessage(topic.decode(), message.schema, log_time_ns, stamp_ns, payload)
        )

    def tick(self) -> None:
        """Flush if a message has waited for `flush_every_s`; raises as `flush`."""
        oldest_s = self._oldest_s
        if oldest_s is not None and self._monotonic() - oldest_s >= self._flush_every_s:
            self.flush()

    def flush(self) -> None:
        """Pass every message to the operating system: it survives this process.

        Raises BagError if the disk refuses, or the bag is closed.
        """
        self._check_open()
        with self._disk():
            self._mcap.flush()
        self._oldest_s = None

    def close(self, counts: Mapping[str, Any] | None = None) -> None:
        """Complete the bag and rename it to NAME.mcap; a second call does nothing.

        After a failed write it only closes the file, which stays NAME.mcap.part. `counts` are
        counters of the recording for JSON, e.g. lost and dropped messages a topic. Raises BagError
        if the disk refuses, or another file has taken the name meanwhile; the recorded messages are
        then in NAME.mcap.part.
        """
        if self._closed:
            return
        # First: whatever fails below, nothing is written any more.
        self._closed = True
        try:
            if self._failure:
                return
            with self._disk():
                self._finish(counts)
        finally:
            self._file.close(sync=False)
        self._rename()

    def __exit__(self, *_: object) -> None:
        self.close()

    def discard(self) -> None:
        """Close an incomplete bag, and remove its file."""
        self._closed = True
        self._file.close(sync=False)
        self.part.unlink(missing_ok=True)

    def _channel(self, topic: str, schema: str) -> int:
        """Number of the channel of a topic and schema, which is registered at its first use."""
        channel = self._channels.get((topic, schema))
        if channel is not None:
            return channel
        if schema not in SCHEMAS:
            hint = did_you_mean(schema, SCHEMAS)
            raise BagError(
                f"{self.path}: {topic}: schema {schema!r} is not known{hint}"
            )

        cls = SCHEMAS[schema]
        if schema not in self._schemas:
            text = json.dumps(json_schema(cls)).encode()
            name = SCHEMA_PREFIX + schema
            self._schemas[schema] = self._mcap.register_schema(name, "jsonschema", text)
        metadata = {VERSION_KEY: str(cls.version)}
        channel = self._mcap.register_channel(
            topic, ENCODING, self._schemas[schema], metadata
        )
        self._channels[topic, schema] = channel
        return channel

    def _check_open(self) -> None:
        if self._failure:
            raise BagError(self._failure)
        if self._closed:
            raise BagError(f"{self.path}: the recording is closed")

    @contextlib.contextmanager
    def _disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # Each later call raises the same line.
            self._failure = f"{self.part}: {error.strerror}; {KEPT}"
            self._file.close(sync=False)
            raise BagError(self._failure) from error

    def _finish(self, counts: Mapping[str, Any] | None) -> None:
        # Counts by topic: of a whole file, no message has to be read for them.
        self._mcap.flush()
        topics = {
            topic: dataclasses.asdict(info) for topic, info in self._topics.items()
        }
        self._mcap.add_metadata(TOPICS_RECORD, {JSON_KEY: json.dumps(topics)})
        if counts is not None:
            text = json.dumps(dict(counts), default=str)
            self._mcap.add_metadata(COUNTS_RECORD, {JSON_KEY: text})
        self._mcap.finish()
        self._file.flush()
        self._file.close(sync=True)

    def _rename(self) -> None:
        try:
            place(self.part, self.path)
        except OSError as error:
            raise BagError(
                f"{self.path}: {error.strerror}; the recording is complete in "
                f"{self.part.name}"
            ) from error
        # The name is on the disk once the folder is.
        with contextlib.suppress(OSError):
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)


def json_schema(cls: type[Message]) -> dict[str, Any]:
    """Describe the msgpack map of a message class as a JSON Schema: its fields and their types."""
    properties: dict[str, Any] = {
        "schema": {"const": cls.schema},
        "version": {"const": cls.version},
    }
    for name, kind in wire_fields(cls).items():
        json_type = _TYPES.get(type(kind), "object")
        properties[name] = {"type": json_type}
        if getattr(kind, "optional", False):
            properties[name] = {"type": [json_type, "null"]}
    return {
        "$schema": _DIALECT,
        "title": f"sparseskin/{cls.schema}",
        "description": " ".join((cls.__doc__ or "").partition("\n\n")[0].split()),
        "type": "object",
        "properties": properties,
        "required": [name for name in properties if name not in omitted_fields(cls)],
        "additionalProperties": False,
    }
