"""Formats of recordings: the interface, those of the core, and those of plug-ins."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.extensions import FILES, failures, loaded
from sparseskin.nodes.sensor.layout.checks import shown

from .arrays import ArrayRecording
from .recording import File, Recording
from .table.table import TableRecording
from .table.transposed import TransposedTable

HEAD_BYTES = 1 << 16
"""Bytes from the begin of a file by which its format is found, where several have its suffix."""
BAG_METADATA = "metadata.yaml"
"""File in the folder of a bag of ROS 2."""
BAG_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
BAG_LOGS = ("-wal", "-shm", "-journal")
"""Ends of the files that SQLite leaves beside a bag whose recorder was killed."""
TEXT_SUFFIXES = (".txt", ".dat", ".log", ".asc")
TABLE_SUFFIXES = (".csv", ".tsv", ".jsonl", ".ndjson", *TEXT_SUFFIXES)
SHARED_SUFFIXES = (".csv", ".txt", ".mcap")
"""Suffixes of the core that formats of plug-ins have, too."""
MAX_PARTS = 1 << 20
"""Most files of a folder that are read; chosen."""


@dataclass(frozen=True)
class Format:
    """A format of recordings."""

    #: Suffixes of its files, in small letters with the dot, and what such a file holds, in few
    #: words.
    suffixes: Mapping[str, str]
    open: Callable[[File], Recording]  # raises SourceError
    #: True if a file that begins with these bytes (at most `HEAD_BYTES`) is one of this format;
    #: None: every file with one of its suffixes that no other format recognises.
    recognises: Callable[[bytes], bool] | None = None
    #: Of a format that is a folder: names of files in it, one of which every such folder has, with
    #: no suffix of the core. That file is the one that is opened.
    markers: tuple[str, ...] = ()


def open_table(file: File) -> Recording:
    """A table, with frames along its lines, or along its columns if `axes` states that. Raises
    SourceError if `axes` is of an array.
    """
    axes = file.layout.axis_names
    if axes == ("taxels", "frames"):
        return TransposedTable(file)
    if axes not in ((), ("frames", "taxels")) and "value" not in axes:
        ways = "taxels,frames or frames,taxels or frames,rows,cols,value"
        fault = f"axes = {file.layout.axes}; allowed for a table: {ways}"
        raise SourceError(f"{file.name}: {fault}")
    return TableRecording(file)


def open_bag(file: File) -> Recording:
    """A recording of this program."""
    # What records is imported where one is read.
    from .bag import BagRecording

    return BagRecording(file)


def is_bag(begin: bytes) -> bool:
    """True if a file begins as a recording of this program does: with its name as the library."""
    profile = int.from_bytes(begin[17:21], "little")
    return profile == 0 and begin[25:].startswith(b"sparseskin ")


_NPZ = "array 'forces' with stamp_ns, rate_hz, mask, f_max, unit, pitch_m as wanted"
OWN = (
    Format(dict.fromkeys(TABLE_SUFFIXES, "table of text"), open_table),
    Format({".npy": "array (frames, rows, columns)", ".npz": _NPZ}, ArrayRecording),
    Format({".mcap": "recording of sparseskin"}, open_bag, is_bag),
)
"""Formats of the core."""


@cache
def suffixes() -> dict[str, str]:
    """The suffixes of recordings that can be read, and what files of each hold."""
    about: dict[str, list[str]] = {}
    for format_ in (*OWN, *loaded(FILES).values()):
        for suffix, words in format_.suffixes.items():
            about.setdefault(suffix, []).append(words)
    return {suffix: " or ".join(words) for suffix, words in about.items()}


def recording_of(file: File) -> Recording:
    """The recording of an open file, by its suffix, and where several formats have it, by its
    begin. Raises SourceError if no format has it.
    """
    path = Path(file.name)
    suffix = path.suffix.lower()
    fitting = [format_ for format_ in OWN if suffix in format_.suffixes]
    # Plug-ins are imported where they may have the file, too: that takes longer than to read it.
    if suffix in SHARED_SUFFIXES or not fitting:
        plugins: list[Format] = list(loaded(FILES).values())
        for format_ in plugins:
            if path.name in format_.markers:
                return format_.open(file)
        fitting += [format_ for format_ in plugins if suffix in format_.suffixes]
        fitting = _recognised(file, fitting)
    if not fitting:
        allowed = f"allowed are {', '.join(suffixes())}{failures(FILES)}"
        unknown = f"suffix {shown(path.suffix)} is not known"
        raise SourceError(f"{file.name}: {unknown}; {allowed}")
    return fitting[0].open(file)


def _recognised(file: File, fitting: list[Format]) -> list[Format]:
    """The formats that recognise the begin of a file, or else those that take every file."""
    begin = file.file.read(HEAD_BYTES)
    file.file.seek(0)
    # A table of text has no marks of its own: it is what remains.
    for_all = [format_ for format_ in fitting if format_.recognises is None]
    sure = [form for form in fitting if form.recognises and form.recognises(begin)]
    return sure or for_all or fitting


@contextmanager
def folder_files(path: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The file that is opened for a path, and those that go on with it: the files of a bag of
    ROS 2, the marker of a format that is a folder, or files of one frame each, in the order of the
    numbers in their names. Raises SourceError if a folder is none of these.
    """
    folder = Path(path)
    if not folder.is_dir():
        yield path, ()
        return
    # A marker states the format; else the names of the files have to.
    markers = [
        name for candidate in loaded(FILES).values() for name in candidate.markers
    ]
    for name in markers:
        if (folder / name).is_file():
            yield str(folder / name), ()
            return
    files = sorted(_listed(folder), key=lambda file: _natural(file.name))
    of_bag = [file for file in files if file.name.endswith(BAG_SUFFIXES)]
    beside_bag = [file for file in files if file.name.endswith(BAG_LOGS)]
    if (folder / BAG_METADATA).is_file() or len(of_bag) + len(beside_bag) == len(files):
        # The last message may stand in the log of a recorder that was killed.
        files = of_bag
        if not files:
            raise SourceError(f"{path}: holds no file of a recording")
    else:
        kinds = {file.suffix.lower() for file in files}
        if len(kinds) != 1 or not kinds <= {*TABLE_SUFFIXES}:
            expected = f"one file in it, or a folder of tables alone ({', '.join(TABLE_SUFFIXES)})"
            raise SourceError(f"{path}: is a directory; name {expected}")
    names = [str(file) for file in files]
    yield names[0], tuple(names[1:])


def _listed(folder: Path) -> Iterator[Path]:
    """The plain files of a folder, without hidden ones."""
    for n, file in enumerate(folder.iterdir()):
        if n >= MAX_PARTS:
            raise SourceError(f"{folder}: more than {MAX_PARTS} files")
        if file.is_file() and not file.name.startswith("."):
            yield file


def _natural(name: str) -> list[tuple[int, str]]:
    """Key that puts bag_2 before bag_10."""
    key: list[tuple[int, str]] = []
    for part in re.split(r"(\d+)", name):
        if part.isdecimal():
            key.append((int(part), ""))
        else:
            key.append((-1, part))
    return key
