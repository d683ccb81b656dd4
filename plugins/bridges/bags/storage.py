"""A file of recorded messages: the interface, and files that are compressed or not closed."""

import os
import shutil
import tempfile
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import IO, NamedTuple

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
    file has none. `ros`: the version of ROS whose bytes they are; 0: none, the form "json" or "".
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
        self._copies: dict[str, str] = {}
        self._folder = ""

    def copy(self, path: str, n_bytes: int, write: Callable[[str], None]) -> str:
        """The path of the copy of a file, which is written where there is none yet: of about so
        many bytes. Raises SourceError if the disk is full.
        """
        if path in self._copies:
            return self._copies[path]
        if not self._folder:
            self._folder = tempfile.mkdtemp(prefix="sparseskin-")
            # Removed with the last reader, or at the end of the program.
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        # Checked before anything is written: a full disk would stop other programs.
        if n_bytes > self.free_bytes:
            raise SourceError(
                f"{path}: needs {n_bytes / 1e6:.0f} MB in {self._folder}, which has "
                f"{self.free_bytes / 1e6:.0f} MB"
            )

        name = Path(path).name.removesuffix(".zstd")
        copy = str(Path(self._folder) / f"{len(self._copies)}_{name}")
        write(copy)
        self._copies[path] = copy
        return copy

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
    # Their contents are not compared: that would read all of them.
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
    with reading(path) as file:
        if file.read(len(ZSTD_MAGIC)) != ZSTD_MAGIC:
            return path

    def decompress(copy: str) -> None:
        with reading(path) as file:
            fault = _decompress(file, Path(copy), path, work.free_bytes)
        if not Path(copy).stat().st_size:
            raise SourceError(f"{path}: cannot be decompressed ({fault}); {CONVERT}")

    return work.copy(path, 2 * Path(path).stat().st_size, decompress)


def _decompress(file: IO[bytes], out: Path, path: str, free_bytes: int) -> str:
    """Decompress a file as far as it can be, into another; why it ends there."""
    size = file.seek(0, 2)
    file.seek(0)
    # A small file may decompress to a disk full of zeros.
    room_bytes = min(free_bytes, max(MAX_GROWN_BYTES, MAX_GROWTH * size))
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
    try:
        with out.open("wb") as copy, decompressor.stream_reader(file) as stream:
            for part in iter(partial(stream.read, COPY_BYTES), b""):
                room_bytes -= len(part)
                if room_bytes < 0:
                    raise SourceError(f"{path}: is far larger than its file; {CONVERT}")
                copy.write(part)
    except zstandard.ZstdError as error:
        # What came before the damage is read as a file that is cut off.
        return str(error)
    return "it is empty"


def with_log(path: str, work: Workspace) -> str:
    """The path of a database, or of a copy of it with what a killed recorder left beside it."""
    logs = [ending for ending in LOGS if _size(path + ending)]
    if not logs:
        return path

    def copy_all(copy: str) -> None:
        for ending in ("", *logs):
            shutil.copyfile(path + ending, copy + ending)

    n_bytes = sum(_size(path + ending) for ending in ("", *logs))
    return work.copy(path, 2 * n_bytes, copy_all)


def _size(path: str) -> int:
    """Size of a file, bytes; 0 where there is none."""
    return os.path.getsize(path) if os.path.isfile(path) else 0


def of_whole_pages(path: str, work: Workspace) -> str:
    """The path of a database; where it is cut off within a page, of a copy of the pages before.

    SQLite reads the missing end of a page as zeros, which would become forces.
    """
    with reading(path) as file:
        file.seek(PAGE_BYTES_AT)
        page_bytes = int.from_bytes(file.read(2), "big")
    # 65536 does not fit into the two bytes: it is stored as 1.
    if page_bytes == 1:
        page_bytes = 1 << 16
    n_bytes = _size(path)
    if not page_bytes or n_bytes % page_bytes == 0:
        return path

    def copy_pages(copy: str) -> None:
        shutil.copyfile(path, copy)
        os.truncate(copy, n_bytes // page_bytes * page_bytes)

    return work.copy(path, n_bytes, copy_pages)


def plain_message(data: bytes) -> bytes:
    """A message, decompressed if it is compressed by zstd. Raises SourceError if it cannot be."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    try:
        # The size is stated by the message itself, and read before memory is used.
        if zstandard.frame_content_size(data) > MAX_MESSAGE_BYTES:
            raise SourceError(f"a message is larger than {MAX_MESSAGE_BYTES} bytes")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        with decompressor.stream_reader(data) as stream:
            return bytes(stream.read(MAX_MESSAGE_BYTES))
    except zstandard.ZstdError as error:
        raise SourceError(
            f"a message cannot be decompressed ({error}); {CONVERT}"
        ) from error
