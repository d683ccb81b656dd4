"""A file of recorded messages: the interface, and files that are compressed or not closed."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import zstandard

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES, MAX_GROWTH
from sparseskin.nodes.sensor.layout.checks import reading

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAX_MESSAGE_BYTES = 1 << 28
"""Largest message after decompression; chosen: more numbers than a frame has."""
MAX_WINDOW_BYTES = 1 << 27
"""Largest window of a decompressor of zstd, its own default."""
COPY_BYTES = 1 << 20
LOGS = ("-wal", "-journal")
"""Endings of the files of SQLite with what is not in the database yet."""
PAGE_BYTES_AT = 16
"""Place of the size of a page in the header of a database of SQLite."""
SPARE_DISK_BYTES = 1 << 26
CONVERT = "compressed: ros2 bag convert writes it plain"


class Topic(NamedTuple):
    """Type of the messages on a topic, and its definition, in the form "msg" or "idl"; "" where the
    file has none. `ros`: the version of ROS whose bytes they are.
    """

    kind: str
    text: str = ""
    form: str = "msg"
    ros: int = 2


class Recorded(NamedTuple):
    """A message as it was recorded, and the time at which it was."""

    topic: str
    kind: str
    log_ns: int
    data: bytes


class Storage(ABC):
    """One file of recorded messages, which is opened each time that it is read."""

    def __init__(self, path: str, name: str) -> None:
        self.path = path
        self.name = name
        #: Topics by the numbers that messages state.
        self.connections: dict[int, tuple[str, Topic]] = {}
        #: What the last `messages` could not read, a text each.
        self.losses: list[str] = []
        #: False if the recorder did not close the file.
        self.is_closed = True

    def topics(self) -> dict[str, Topic]:
        """The topics of the file. Raises SourceError if it cannot be read."""
        if not self.connections:
            self.read_index()
        if not self.connections:
            # No index: the topics stand among the messages.
            for _ in self.messages(()):
                continue
        return dict(self.connections.values())

    @abstractmethod
    def read_index(self) -> None:
        """Note the connections of the index, as far as there is one that can be read."""

    @abstractmethod
    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """The messages on some topics, as they stand in the file: about in the order of their
        times. A damaged part is named in `losses`. Raises SourceError if nothing can be read.
        """


class Workspace:
    """A folder for copies of files that are compressed or not closed. It lasts as long as a
    recording that reads them, and until those of other files are read.
    """

    def __init__(self) -> None:
        #: Paths of the copies, by those of the files.
        self.copies: dict[str, str] = {}
        self._folder = ""

    def path(self, name: str, n_bytes: int, of: str) -> str:
        """The path of a new file of about that size. Raises SourceError if the disk is full."""
        if not self._folder:
            self._folder = tempfile.mkdtemp(prefix="sparseskin-")
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        if n_bytes > self.free_bytes:
            needed = f"needs {n_bytes / 1e6:.0f} MB in {self._folder}, which has"
            raise SourceError(f"{of}: {needed} {self.free_bytes / 1e6:.0f} MB")
        return str(Path(self._folder) / f"{len(self.copies)}_{name}")

    @property
    def free_bytes(self) -> int:
        """Bytes that may be written."""
        return shutil.disk_usage(self._folder).free - SPARE_DISK_BYTES


_LAST: dict[tuple[object, ...], Workspace] = {}
"""The copies of the files that were read last: a launch opens them several times."""


def workspace_of(paths: Sequence[str]) -> Workspace:
    """The copies of some files, as long as these are not changed."""
    files = [Path(path + ending) for path in paths for ending in ("", *LOGS)]
    states = [file.stat() for file in files if file.is_file()]
    versions = [(state.st_mtime_ns, state.st_size) for state in states]
    key = (*paths, *versions)
    # A file that was written again has other copies.
    if key not in _LAST:
        _LAST.clear()
        _LAST[key] = Workspace()
    return _LAST[key]


def decompressed(path: str, work: Workspace) -> str:
    """The path of a file, or of its decompressed copy, if it is compressed by zstd. Raises
    SourceError if it cannot be decompressed, or grows far more than recordings do.
    """
    if path in work.copies:
        return work.copies[path]
    with reading(path) as file:
        is_compressed = file.read(len(ZSTD_MAGIC)) == ZSTD_MAGIC
        if not is_compressed:
            return path

        size = file.seek(0, 2)
        file.seek(0)
        copy = work.path(Path(path).stem, 2 * size, path)
        # A small file may decompress to a disk full of zeros.
        room_bytes = max(MAX_GROWN_BYTES, MAX_GROWTH * size)
        free_bytes = work.free_bytes
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        try:
            with (
                Path(copy).open("wb") as out,
                decompressor.stream_reader(file) as stream,
            ):
                part = stream.read(COPY_BYTES)
                while part:
                    room_bytes -= len(part)
                    free_bytes -= len(part)
                    if min(room_bytes, free_bytes) < 0:
                        raise SourceError(
                            f"{path}: is far larger than its file; {CONVERT}"
                        )
                    out.write(part)
                    part = stream.read(COPY_BYTES)
        except zstandard.ZstdError as error:
            # What came before the damage is read as a file that is cut off.
            fault = str(error)
        else:
            fault = "it is empty"
        if not Path(copy).stat().st_size:
            raise SourceError(f"{path}: cannot be decompressed ({fault}); {CONVERT}")
    work.copies[path] = copy
    return copy


def with_log(path: str, work: Workspace) -> str:
    """The path of a database, or of a copy of it with what a killed recorder left beside it."""
    if path in work.copies:
        return work.copies[path]
    logs = []
    for ending in LOGS:
        log = Path(path + ending)
        if log.is_file() and log.stat().st_size:
            logs.append(log)
    if not logs:
        return path

    n_bytes = sum(file.stat().st_size for file in (Path(path), *logs))
    copy = work.path(Path(path).name, 2 * n_bytes, path)
    shutil.copyfile(path, copy)
    for log in logs:
        shutil.copyfile(log, copy + log.name.removeprefix(Path(path).name))
    work.copies[path] = copy
    return copy


def of_whole_pages(path: str, work: Workspace) -> str:
    """The path of a database; where it is cut off within a page, of a copy of the pages before.

    SQLite reads the missing end of a page as zeros, which would become forces.
    """
    key = f"{path} in whole pages"
    if key in work.copies:
        return work.copies[key]
    with reading(path) as file:
        file.seek(PAGE_BYTES_AT)
        page_bytes = int.from_bytes(file.read(2), "big")
    # 65536 does not fit into the two bytes: it is stored as 1.
    if page_bytes == 1:
        page_bytes = 1 << 16
    n_bytes = Path(path).stat().st_size
    if not page_bytes or n_bytes % page_bytes == 0:
        return path

    copy = work.path(Path(path).name, n_bytes, path)
    shutil.copyfile(path, copy)
    os.truncate(copy, n_bytes // page_bytes * page_bytes)
    work.copies[key] = copy
    return copy


def plain_message(data: bytes) -> bytes:
    """A message, decompressed if it is compressed by zstd. Raises SourceError if it cannot be."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        if zstandard.frame_content_size(data) > MAX_MESSAGE_BYTES:
            raise SourceError(f"a message is larger than {MAX_MESSAGE_BYTES} bytes")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        with decompressor.stream_reader(data) as stream:
            return bytes(stream.read(MAX_MESSAGE_BYTES))
    except zstandard.ZstdError as error:
        raise SourceError(
            f"a message cannot be decompressed ({error}); {CONVERT}"
        ) from error
