"""Reads a bag, also one that a killed recorder left, or that a disk has damaged."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from mcap.opcode import Opcode

from sparseskin.nodes.lookup import did_you_mean

from .bag import (
    COUNTS_RECORD,
    GRAPH_RECORD,
    JSON_KEY,
    PART_SUFFIX,
    BagError,
    BagMessage,
    TopicInfo,
)
from .bag_index import BagChannel, BagIndex, ChunkSpan
from .bag_records import (
    MAGIC,
    MESSAGE_HEAD_BYTES,
    Break,
    content,
    message_times,
    open_chunk,
    size_of,
    walk,
    walk_chunk,
)
from .bag_scan import scan
from .bag_summary import read_index


class BagReader:
    """An open bag.

    All of it is checked as it is opened: by the checksum over a whole file, at the speed of the
    disk, or chunk by chunk where a file has no index. Memory holds one chunk at a time.

    Parameters
    ----------
    path : str or path
        The bag, NAME.mcap or NAME.mcap.part.

    Attributes
    ----------
    path : Path
        As given.
    metadata : dict of str to str
        Scene, seed, launch file, Phi, versions, as recorded.
    counts : dict or None
        What the recorder counted, e.g. lost messages; None where it did not get to say so.
    topics : dict of str to TopicInfo
        What can be read, by topic.
    recovered : str
        "" for a whole file; else one sentence: how many messages survived and where the break is.

    Raises
    ------
    BagError
        If the file is missing, no bag, of a newer version, or broken before anything was recorded.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._file = _open(self.path)
        try:
            self._index, self.recovered = _index(self._file, str(self.path))
        except OSError as error:
            self._file.close()
            raise BagError(f"{self.path}: {error.strerror}") from error
        except BaseException:
            self._file.close()
            raise
        self.metadata = self._index.metadata.get(GRAPH_RECORD, {})
        self.counts = _counts(self._index.metadata.get(COUNTS_RECORD, {}))
        self.topics: dict[str, TopicInfo] = {
            topic: tally.info(topic) for topic, tally in sorted(self._index.tallies.items())
        }

    def messages(
        self,
        topics: Iterable[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """The messages in the order in which they were recorded.

        Parameters
        ----------
        topics : iterable of str, optional
            Only messages of these topics.
        start_ns, stop_ns : int, optional
            Only stamps in the half-open range [start_ns, stop_ns).

        Raises
        ------
        BagError
            At once if the bag has no such topic; later if the file is changed while it is read.
        """
        return (message for _, message in self.records(topics, start_ns, stop_ns))

    def records(
        self,
        topics: Iterable[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[tuple[BagChannel, BagMessage]]:
        """As `messages`, each with its channel: a topic's last message has a schema of its own.

        Raises
        ------
        BagError
            As `messages`.
        """
        wanted = frozenset(self.topics) if topics is None else frozenset(topics)
        for topic in sorted(wanted - self.topics.keys()):
            hint = did_you_mean(topic, self.topics)
            raise BagError(f"{self.path}: holds no topic {topic[:80]!r}{hint}")
        return self._records(wanted, start_ns, stop_ns)

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _records(
        self, wanted: frozenset[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[BagChannel, BagMessage]]:
        channels = {
            id: channel for id, channel in self._index.channels.items() if channel.topic in wanted
        }
        for chunk in self._index.chunks_with(wanted, start_ns, stop_ns):
            plain = self._chunk(chunk)
            for opcode, start, stop in walk_chunk(plain, chunk.record.offset):
                if opcode != Opcode.MESSAGE:
                    continue
                id, log_ns, stamp_ns = message_times(plain, start, stop, chunk.record.offset)
                channel = channels.get(id)
                if channel is None:
                    continue
                if start_ns is not None and stamp_ns < start_ns:
                    continue
                if stop_ns is not None and stamp_ns >= stop_ns:
                    continue
                payload = plain[start + MESSAGE_HEAD_BYTES : stop]
                yield channel, BagMessage(channel.topic, log_ns, stamp_ns, payload)

    def _chunk(self, chunk: ChunkSpan) -> bytes:
        """A chunk, checked once more: time has passed since the file was opened."""
        if self._file.closed:
            raise BagError(f"{self.path}: the bag is closed")
        offset = chunk.record.offset
        try:
            if next(walk(self._file, offset, size_of(self._file)), None) != chunk.record:
                raise Break(offset, "another record stands there")
            return open_chunk(content(self._file, chunk.record), offset)
        except Break as broken:
            raise BagError(
                f"{self.path}: was changed while it was read, at byte {offset}: {broken.why}"
            ) from broken
        except OSError as error:
            raise BagError(f"{self.path}: {error.strerror}") from error


def _open(path: Path) -> BinaryIO:
    try:
        mode = os.stat(path).st_mode
        # Opening a pipe would wait for its writer.
        if not stat.S_ISREG(mode):
            what = "is a folder" if stat.S_ISDIR(mode) else "is no regular file"
            raise BagError(f"{path}: {what}; expected a bag, NAME.mcap")
        return open(path, "rb")
    except FileNotFoundError as error:
        part = f"{path}{PART_SUFFIX}"
        begun = f" ({part} is there: not complete, but can be read)" if os.path.exists(part) else ""
        raise BagError(f"{path}: no such file{begun}") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise BagError(f"{path}: {reason}") from error


def _index(file: BinaryIO, name: str) -> tuple[BagIndex, str]:
    first = file.read(len(MAGIC))
    if not first:
        raise BagError(f"{name}: is empty")
    if first != MAGIC:
        if MAGIC.startswith(first):
            raise BagError(f"{name}: ends after {len(first)} bytes, before anything was recorded")
        raise BagError(f"{name}: not an MCAP file (it begins with {first!r})")
    index, damage = read_index(file, name)
    if index is not None:
        return index, ""
    return scan(file, name, damage)


def _counts(record: dict[str, str]) -> dict[str, Any] | None:
    try:
        found = json.loads(record.get(JSON_KEY, ""))
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
