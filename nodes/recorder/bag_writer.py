"""Writes a bag: NAME.mcap.part while it grows, NAME.mcap once it is complete."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version as version_of
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, cast

from mcap.writer import CompressionType, Writer

from sparseskin.messages.fields import INT64_MAX
from sparseskin.messages.wire import MAX_MESSAGE_BYTES

from .bag import (
    COUNTS_RECORD,
    FILE_SUFFIX,
    GRAPH_RECORD,
    JSON_KEY,
    LIBRARY_PREFIX,
    PART_SUFFIX,
    TOPICS_RECORD,
    BagError,
    Tally,
)
from .bag_channels import Channels
from .bag_file import BagFile, give_name
from .chunk_index import store_chunk_index
from .output import check_free

CHUNK_BYTES = 1 << 20


class BagWriter:
    """Writes messages into a bag; not for several threads at once.

    Parameters
    ----------
    path : Path
        Where the complete bag shall be, NAME.mcap; neither it nor NAME.mcap.part may exist.
    metadata : mapping of str to str
        What the recording is of: scene, seed, launch file, Phi, versions.
    flush_every_s : float
        No message waits longer in memory, provided that `write` or `tick` is called.
    monotonic : callable
        The clock of `flush_every_s`, in seconds.

    Attributes
    ----------
    n_messages : int
        How many messages were taken.

    Raises
    ------
    BagError
        If the file exists, cannot be created, or the metadata are not texts.
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
        self.part = self.path.with_name(self.path.name + PART_SUFFIX)
        self.n_messages = 0
        self._flush_every_s = flush_every_s
        self._monotonic = monotonic
        self._oldest_s: float | None = None
        self._tallies: dict[str, Tally] = {}
        self._failure = ""
        self._closed = False
        self._check_metadata(metadata)
        self._file = self._create()
        self._writer = Writer(
            cast("IO[bytes]", self._file),
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.LZ4,
            enable_data_crcs=True,
        )
        store_chunk_index(self._writer, self.path.parent)
        self._channels = Channels(self._writer, self.path)
        self._writer.start(profile="", library=LIBRARY_PREFIX + version_of("sparseskin"))
        self._writer.add_metadata(GRAPH_RECORD, dict(metadata))
        try:
            self._file.flush()
        except OSError as error:
            self._file.close()
            self.part.unlink(missing_ok=True)
            raise BagError(f"{self.part}: {error.strerror}") from error

    def write(
        self,
        topic: str,
        payload: bytes,
        *,
        schema: str,
        version: int,
        log_time_ns: int,
        stamp_ns: int,
    ) -> None:
        """Record one message.

        Parameters
        ----------
        topic : str
            "/PATCH/SCHEMA".
        payload : bytes
            The wire payload, kept byte for byte.
        schema, version
            Of the message.
        log_time_ns, stamp_ns : int
            When it is recorded, and its stamp: 0 .. 2**63 - 1.

        Raises
        ------
        BagError
            If the message cannot be recorded, the disk refuses (then each later call is refused
            with the same line, and the file is left alone), or the bag is closed.
        """
        self._check_open()
        channel = self._channels.id_of(topic, schema, version)
        if len(payload) > MAX_MESSAGE_BYTES:
            raise BagError(
                f"{self.path}: a message of {len(payload)} bytes on {topic}, "
                f"at most {MAX_MESSAGE_BYTES}"
            )
        for what, time_ns in (("log time", log_time_ns), ("stamp", stamp_ns)):
            if not 0 <= time_ns <= INT64_MAX:
                raise BagError(f"{self.path}: {topic}: {what} {time_ns} is outside 0..2**63 - 1")
        tally = self._tallies.setdefault(topic, Tally(schema, version))
        self._writer.add_message(
            channel,
            log_time=log_time_ns,
            data=payload,
            publish_time=stamp_ns,
            sequence=tally.n_messages & 0xFFFFFFFF,
        )
        tally.add(schema, version, stamp_ns, log_time_ns)
        self.n_messages += 1
        if self._file.n_pending:  # the chunk was full
            self._to_disk(self._file.flush)
            self._oldest_s = None
            return
        if self._oldest_s is None:
            self._oldest_s = self._monotonic()
        self.tick()

    def tick(self) -> None:
        """Flush if a message has waited for `flush_every_s`; to be called when idle.

        Raises
        ------
        BagError
            As `flush`.
        """
        oldest_s = self._oldest_s
        if oldest_s is not None and self._monotonic() - oldest_s >= self._flush_every_s:
            self.flush()

    def flush(self) -> None:
        """Hand every message to the operating system: it survives this process.

        Raises
        ------
        BagError
            If the disk refuses, or the bag is closed.
        """
        self._check_open()
        self._to_disk(self._writer.flush)
        self._oldest_s = None

    def close(self, counts: Mapping[str, Any] | None = None) -> None:
        """Complete the bag and give it its name; a second call does nothing.

        After a failed write it only lets go of the file, which stays NAME.mcap.part.

        Parameters
        ----------
        counts : mapping, optional
            What was counted beside the messages, e.g. lost and dropped ones a topic; JSON.

        Raises
        ------
        BagError
            If the disk refuses, or another file has taken the name meanwhile; what was recorded
            is then in NAME.mcap.part.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if not self._failure:
                self._to_disk(self._writer.flush)
                self._to_disk(lambda: self._finish(counts))
        finally:
            self._file.close()
        if not self._failure:
            give_name(self.part, self.path)

    def discard(self) -> None:
        """Let go of a bag that is not complete, and remove it."""
        if not self._closed:
            self._closed = True
            self._file.close()
        self.part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _check_metadata(self, metadata: Mapping[str, str]) -> None:
        for key, value in metadata.items():
            if not isinstance(key, str) or not isinstance(value, str):
                raise BagError(f"{self.path}: metadata {key!r}: expected texts")
            try:
                (key + value).encode()
            except UnicodeEncodeError as error:
                raise BagError(f"{self.path}: metadata {key!r}: no valid Unicode") from error

    def _create(self) -> BagFile:
        if self.path.suffix != FILE_SUFFIX:
            raise BagError(f"{self.path}: expected a name that ends in {FILE_SUFFIX}")
        try:
            check_free(self.path, self.part)
            return BagFile(self.part)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise BagError(f"{self.part}: {reason}") from error

    def _check_open(self) -> None:
        if self._failure:
            raise BagError(self._failure)
        if self._closed:
            raise BagError(f"{self.path}: the bag is closed")

    def _to_disk(self, action: Callable[[], None]) -> None:
        try:
            action()
        except OSError as error:
            self._failure = (
                f"{self.part}: {error.strerror}; recording ended, what it holds can be read"
            )
            raise BagError(self._failure) from error

    def _finish(self, counts: Mapping[str, Any] | None) -> None:
        topics = {topic: dataclasses.asdict(tally) for topic, tally in self._tallies.items()}
        self._writer.add_metadata(TOPICS_RECORD, {JSON_KEY: json.dumps(topics)})
        if counts is not None:
            text = json.dumps(dict(counts), default=str)
            self._writer.add_metadata(COUNTS_RECORD, {JSON_KEY: text})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        self._file.sync()
