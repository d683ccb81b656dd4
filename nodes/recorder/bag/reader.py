"""Reader of bags: complete ones, and those that a killed recorder or a damaged disk left."""

import json
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode

from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.control import is_shallow

from .format import (
    COUNTS_RECORD,
    GRAPH_RECORD,
    JSON_KEY,
    PART_SUFFIX,
    ROS2_HINT,
    BagError,
    BagMessage,
    TopicInfo,
)
from .index import ChunkSpan, load_index
from .records import Break, chunk_records, message_of, open_chunk, record_at


class BagReader(AbstractContextManager["BagReader"]):
    """An open bag.

    Opening it checks the whole file: by its one checksum, at the speed of the disk, or chunk by
    chunk where the file has no index. Memory holds one chunk at a time.

    With `whole` False, where the checksum of the index matches, the rest of the file is not read; a
    chunk that is damaged is then found when it is read. Raises BagError if the file is missing, no
    bag, of a newer version, or broken before the first record.

    Attributes
    ----------
    path : Path
        NAME.mcap or NAME.mcap.part.
    metadata : dict of str to str
        Scene, seed, launch file, Phi, versions, as recorded.
    counts : dict or None
        Counters of the recorder, e.g. lost messages; None if it was killed before it wrote them.
    topics : dict of str to TopicInfo
        Readable topics, by name.
    recovered : str
        "" for a whole file; else a line with the number of readable messages, and where it breaks.
    """

    def __init__(self, path: str | os.PathLike[str], whole: bool = True) -> None:
        self.path = Path(path)
        # A file that is no bag is closed again.
        with ExitStack() as opened:
            self._file = opened.enter_context(_open(self.path))
            name = str(self.path)
            try:
                self._index, self.recovered = load_index(self._file, name, whole)
            except OSError as error:
                raise BagError(f"{name}: {error.strerror}") from error
            opened.pop_all()
        self.metadata = self._index.metadata.get(GRAPH_RECORD, {})
        self.counts = _counts(self._index.metadata.get(COUNTS_RECORD, {}))
        self.topics: dict[str, TopicInfo] = dict(sorted(self._index.topics.items()))

    def messages(
        self,
        topics: Iterable[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """The messages of some topics, with stamps in [start_ns, stop_ns), in recorded order.

        Raises BagError at once if the bag has no such topic; later if the file is changed.
        """
        names = frozenset(self.topics if topics is None else topics)
        missing = sorted(names - self.topics.keys())
        if missing:
            hint = did_you_mean(missing[0], self.topics)
            raise BagError(f"{self.path}: holds no topic {missing[0][:80]!r}{hint}")
        return self._messages(names, start_ns, stop_ns)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _messages(
        self, wanted: frozenset[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[BagMessage]:
        # The end of a stream has a channel of its own.
        channels = {}
        for id, channel in self._index.channels.items():
            if channel.topic in wanted:
                channels[id] = channel

        for chunk in self._index.chunks_with(wanted, start_ns, stop_ns):
            # A chunk holds messages of any topics and times.
            for opcode, content in chunk_records(self._chunk(chunk), chunk.offset):
                if opcode != Opcode.MESSAGE:
                    continue
                id, log_ns, stamp_ns, data = message_of(content, chunk.offset)
                if id not in channels:
                    continue
                if start_ns is not None and stamp_ns < start_ns:
                    continue
                if stop_ns is not None and stamp_ns >= stop_ns:
                    continue
                # A copy: the buffer of the chunk would stay in memory with each message.
                yield BagMessage(*channels[id], log_ns, stamp_ns, bytes(data))

    def _chunk(self, chunk: ChunkSpan) -> bytes:
        """A chunk, checked once more: time has passed since the file was opened."""
        if self._file.closed:
            raise BagError(f"{self.path}: the recording is closed")
        try:
            record = record_at(self._file, chunk.offset, chunk.stop, Opcode.CHUNK)
            return open_chunk(record)
        except Break as broken:
            raise BagError(
                f"{self.path}: is damaged, or was changed while it was read, at byte "
                f"{chunk.offset}: {broken.why}"
            ) from broken
        except OSError as error:
            raise BagError(f"{self.path}: {error.strerror}") from error


def _open(path: Path) -> BinaryIO:
    try:
        mode = os.stat(path).st_mode
        # Opening a pipe would wait for its writer.
        if not stat.S_ISREG(mode):
            kind = "is a folder" if stat.S_ISDIR(mode) else "is no regular file"
            hint = ""
            # A bag of ROS 2 is a folder with that file.
            if (path / "metadata.yaml").is_file():
                hint = ROS2_HINT
            raise BagError(f"{path}: {kind}; expected a recording, NAME.mcap{hint}")
        return open(path, "rb")
    except FileNotFoundError as error:
        # A recorder that was killed leaves the file under that name.
        part = f"{path}{PART_SUFFIX}"
        hint = ""
        if os.path.exists(part):
            hint = f" ({part} is there: not complete, but can be read)"
        raise BagError(f"{path}: no such file{hint}") from error
    except OSError as error:
        raise BagError(f"{path}: {error.strerror}") from error
    except ValueError as error:  # a null character in the name
        raise BagError(f"{path}: {error}") from error


def _counts(record: dict[str, str]) -> dict[str, Any] | None:
    # What cannot be read, or is nested too deep for who prints it, is as none.
    counts = None
    with suppress(ValueError, RecursionError):
        counts = json.loads(record.get(JSON_KEY, ""))
    if isinstance(counts, dict) and is_shallow(counts):
        return counts
    return None
