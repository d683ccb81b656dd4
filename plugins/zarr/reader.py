"""Folders of Zarr, version 2: arrays in groups, of which those of tactile datasets are known."""

import bz2
import itertools
import json
import lzma
import math
import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lz4.block
import numpy as np
import zstandard

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError, not_installed
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES, MAX_GROWTH
from sparseskin.nodes.numerics.arrays import AnyArray
from sparseskin.nodes.sensor.files.dataset_recording import DatasetRecording
from sparseskin.nodes.sensor.files.datasets import MAX_ARRAYS, ArrayFile, Dataset
from sparseskin.nodes.sensor.files.recording import File
from sparseskin.nodes.sensor.layout.checks import shown
from sparseskin.nodes.sensor.layout.layout import UnstatedError

# Format: Zarr storage specification, version 2.
GROUP = ".zgroup"
ARRAY = ".zarray"
ATTRIBUTES = ".zattrs"
NEW = "zarr.json"
MARKERS = (GROUP, ARRAY, NEW)
EPISODES = "meta/episode_ends"
"""Array of the numbers of frames up to the end of each episode, as replay buffers have it."""
LABELS = "_ARRAY_DIMENSIONS"
"""Attribute of an array with the names of its axes, as xarray writes it."""
SENSORS = re.compile(r"(?:^|/)[a-z]+_tactile_data_\w+$")
"""Arrays (frames, sensors, *sides of a frame) of the tactile datasets."""
EPISODE_TOPIC = re.compile(r"(.*):(\d{1,6})")
MAX_JSON_BYTES = 1 << 20
MAX_CHUNK_BYTES = 1 << 29
"""Memory of the chunks that hold some frames together, chosen."""
MAX_CHUNKS = 1 << 16
"""Chunks that hold some frames together, chosen."""
MAX_DEPTH = 8
"""Groups within groups, chosen."""
MAX_AXES = 32


class ZarrRecording(DatasetRecording):
    """The frames of an array in a folder of Zarr, of one of its episodes. The topic is the path of
    the array; where there are several episodes, it has the number of one behind it, from 0, as
    data/right_tactile_data_palm:3.
    """

    def __init__(self, file: File) -> None:
        arrays = ZarrFolder(Path(file.name).parent)
        match = EPISODE_TOPIC.fullmatch(file.layout.topic)
        topic = file.layout.topic
        episode = None
        if match:
            topic = match[1]
            episode = int(match[2])
        # Before the layout is read: the number of frames is that of the episode.
        arrays.choose_episode(episode, topic)
        layout = file.layout.stating({"topic": topic})
        super().__init__(replace(file, layout=layout), arrays)


@dataclass(frozen=True)
class _Stored:
    """What is stated of the chunks of an array."""

    folder: Path
    dtype: np.dtype[Any]
    sides: tuple[int, ...]
    chunks: tuple[int, ...]
    codec: dict[str, Any] | None
    fill: Any
    order: str
    separator: str

    @property
    def chunk_bytes(self) -> int:
        return math.prod(self.chunks) * self.dtype.itemsize


class ZarrFolder(ArrayFile):
    """The arrays of a folder. Links are not followed, and no chunk is unpickled. Raises SourceError
    if a file of it is malformed.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(str(folder))
        self._stored: dict[str, _Stored] = {}
        self._frames = range(0)  # those of the chosen episode; empty: all
        for path, attributes in _arrays_of(folder, "", {}, self.name):
            self._add(folder, path, attributes)

    def choose_episode(self, number: int | None, topic: str) -> None:
        """Read the frames of one episode alone. Raises SourceError if there is none of this number,
        or none is stated of several.
        """
        if EPISODES not in self.datasets:
            # A folder of arrays that is no dataset of episodes.
            if number is not None:
                raise SourceError(
                    f"{self.name}: topic: states episode {number}, but there are none"
                )
            return

        numbers = self.property_array(EPISODES)
        if numbers.dtype.kind not in "iu":
            raise SourceError(f"{self.where(EPISODES)}: expected whole numbers")
        ends = [0, *map(int, numbers.reshape(-1))]
        n = len(ends) - 1
        if number is None and n > 1:
            name = topic or "NAME"
            ways = f"state topic={name}:0 .. topic={name}:{n - 1}"
            keys = [printable(key) for key in self._tactile()]
            names = ", ".join(keys) or "none of tactile data"
            raise UnstatedError(
                f"{self.name}: holds {n} episodes, which is not stated: {ways}; "
                f"arrays: {names}"
            )
        # One episode need not be stated.
        number = number or 0
        if number >= n or ends[number] >= ends[number + 1]:
            raise SourceError(f"{self.name}: topic: no episode {number}; it holds {n}")

        # Arrays of another length are not cut: nothing states their part of the episode.
        self._frames = range(ends[number], ends[number + 1])
        self.notes = (f"episode {number} of {n}",)
        for key, dataset in [*self.datasets.items()]:
            # Those describe all episodes.
            if key.startswith("meta/"):
                continue
            if dataset.sides[:1] != (ends[-1],):
                del self.datasets[key]
                continue
            sides = (len(self._frames), *dataset.sides[1:])
            self.datasets[key] = replace(dataset, sides=sides)

    def whole(self, key: str) -> AnyArray:
        stored = self._stored[key]
        if not stored.sides:
            return self._part(key, ())
        # In one block, whose size is checked before it is read.
        blocks = list(self.blocks(key, 0, max(1, stored.sides[0])))
        if not blocks:
            return np.empty(stored.sides, stored.dtype)
        return np.concatenate(blocks)

    def blocks(self, key: str, axis: int, size: int) -> Iterator[AnyArray]:
        stored = self._stored[key]
        entries = range(stored.sides[axis])
        is_cut = self.datasets[key].sides != stored.sides and axis == 0
        if is_cut:
            entries = self._frames
        self._check_sizes(key, axis)

        # Begins of parts are those of chunks, so that each chunk is read once.
        length = stored.chunks[axis]
        step = max(1, size // length) * length
        for begin in range(entries.start // length * length, entries.stop, step):
            entries_read = range(
                max(begin, entries.start), min(begin + step, entries.stop)
            )
            ranges = [range(side) for side in stored.sides]
            ranges[axis] = entries_read
            yield np.moveaxis(self._part(key, tuple(ranges)), axis, 0)

    def _check_sizes(self, key: str, axis: int) -> None:
        """Raise SourceError if parts along an axis need too much memory, or the array is far larger
        than its files.
        """
        stored = self._stored[key]
        length = stored.chunks[axis]
        n_entries = max(1, stored.sides[axis])
        n_bytes = math.prod(stored.sides) * stored.dtype.itemsize

        # Of the chunks that are read together.
        row_bytes = n_bytes // n_entries * length
        sides = zip(stored.sides, stored.chunks, strict=True)
        n_all_chunks = math.prod(-(-side // chunk) for side, chunk in sides)
        n_chunks = n_all_chunks // -(-n_entries // length)
        if (
            max(row_bytes, stored.chunk_bytes) > MAX_CHUNK_BYTES
            or n_chunks > MAX_CHUNKS
        ):
            raise SourceError(
                f"{self.where(key)}: {n_chunks} chunks of {length} entries of axis "
                f"{axis + 1} need {row_bytes} bytes; at most {MAX_CHUNKS} of "
                f"{MAX_CHUNK_BYTES} bytes together"
            )

        # Chunks that are not there cost nothing: a file of some bytes may state any shape.
        n_files_bytes = 0
        for folder, _, names in os.walk(stored.folder):
            for name in names:
                n_files_bytes += os.lstat(os.path.join(folder, name)).st_size
        limit = max(MAX_GROWN_BYTES, MAX_GROWTH * n_files_bytes)
        if n_bytes > limit:
            raise SourceError(
                f"{self.where(key)}: would have {n_bytes} bytes, of files of "
                f"{n_files_bytes}; at most {limit}"
            )

    def _part(self, key: str, ranges: tuple[range, ...]) -> AnyArray:
        """The numbers of an array in a range of each axis."""
        stored = self._stored[key]
        part = np.full([len(span) for span in ranges], stored.fill, stored.dtype)
        # Numbers of the chunks along each axis.
        numbers = []
        for span, side in zip(ranges, stored.chunks, strict=True):
            of_axis = range(0)
            if span:
                of_axis = range(span.start // side, -(-span.stop // side))
            numbers.append(of_axis)

        for place in itertools.product(*numbers):
            chunk = self._chunk(key, place)
            # The part is filled already.
            if chunk is None:
                continue

            # What the chunk and the part have in common.
            places_in_part: list[slice] = []
            places_in_chunk: list[slice] = []
            for at, span, side in zip(place, ranges, stored.chunks, strict=True):
                begin = at * side
                start = max(span.start, begin)
                stop = min(span.stop, begin + side)
                places_in_part.append(slice(start - span.start, stop - span.start))
                places_in_chunk.append(slice(start - begin, stop - begin))
            part[tuple(places_in_part)] = chunk[tuple(places_in_chunk)]
        return part

    def _chunk(self, key: str, place: tuple[int, ...]) -> AnyArray | None:
        """One chunk; None where its numbers are those that fill the array."""
        stored = self._stored[key]
        # A number without axes is in chunk 0.
        name = stored.separator.join(map(str, place)) or "0"
        limit = stored.chunk_bytes + MAX_JSON_BYTES
        raw = _file_bytes(stored.folder / name, limit, self.where(key))
        if raw is None:
            return None
        try:
            plain = _decoded(stored.codec, raw, stored.chunk_bytes)
        except Exception as error:  # of five libraries, at malformed bytes
            fault = f"chunk {name} cannot be decoded ({error})"
            raise SourceError(
                f"{self.where(key)}: {' '.join(fault.split())[:200]}"
            ) from error
        if len(plain) != stored.chunk_bytes:
            raise SourceError(
                f"{self.where(key)}: chunk {name} has {len(plain)} bytes in place of "
                f"{stored.chunk_bytes}"
            )

        # Read-only: what is read of it is copied.
        flat = np.frombuffer(plain, stored.dtype)
        if stored.order == "F":
            return flat.reshape(stored.chunks, order="F")
        return flat.reshape(stored.chunks)

    def _tactile(self) -> list[str]:
        return [key for key in self.datasets if SENSORS.search(key)]

    def _add(self, folder: Path, path: str, attributes: dict[str, Any]) -> None:
        """Add an array; one of objects, or with filters, is listed and cannot be read."""
        where = self.where(path)
        head = _json(folder / path / ARRAY, where) or {}
        # An array of objects is listed too, as one that cannot be read.
        try:
            sides = tuple(map(int, head["shape"]))
            chunks = tuple(map(int, head["chunks"]))
            text = head["dtype"]
            dtype = np.dtype(object)
            if isinstance(text, str) and not head.get("filters"):
                dtype = np.dtype(text)
            codec = head.get("compressor")
            fill = head.get("fill_value")
            order = str(head.get("order", "C"))
            separator = str(head.get("dimension_separator", "."))
        except (KeyError, TypeError, ValueError) as error:
            raise SourceError(f"{where}: {ARRAY} is malformed ({error!r})") from error
        is_sound = (
            len(sides) == len(chunks) <= MAX_AXES
            and all(0 <= side < 1 << 48 for side in sides)
            and min(chunks, default=1) >= 1
            and separator in (".", "/")
        )
        if not is_sound:
            raise SourceError(f"{where}: {ARRAY} is malformed")
        # Texts and objects have no number to fill with.
        is_number = dtype.kind in "iufb"
        fill = _fill(fill, where) if is_number and fill is not None else 0
        self._stored[path] = _Stored(
            folder / path, dtype, sides, chunks, codec, fill, order, separator
        )

        labels: tuple[str, ...] = ()
        names: dict[int, tuple[str, ...]] = {}
        axis_names = attributes.get(LABELS)
        if isinstance(axis_names, list) and len(axis_names) == len(sides):
            labels = tuple(map(str, axis_names))
        # Those datasets state no labels, but have one layout.
        if SENSORS.search(path) and len(sides) > 1 and not labels:
            labels, names = _tactile_axes(sides)
        self.datasets[path] = Dataset(sides, dtype, labels, attributes, names)


def _tactile_axes(
    sides: tuple[int, ...],
) -> tuple[tuple[str, ...], dict[int, tuple[str, ...]]]:
    """Labels of the axes of an array of the tactile datasets, which state none, and names of the
    entries of some.
    """
    if len(sides) <= 3:
        return ("frames", *[""] * (len(sides) - 1)), {}

    # One of several sensors is read, as a channel is.
    labels = ("frames", "channel", *[""] * (len(sides) - 2))
    n_sensors = min(sides[1], MAX_ARRAYS)
    return labels, {1: tuple(f"sensor{k}" for k in range(n_sensors))}


def _arrays_of(
    folder: Path, path: str, outer: dict[str, Any], where: str
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Paths of the arrays in a folder, and attributes of themselves and the groups around them."""
    group = folder / path
    attributes_here = _json(group / ATTRIBUTES, where) or {}
    in_small_letters = {
        str(name).lower(): value for name, value in attributes_here.items()
    }
    attributes = {
        **outer,
        **in_small_letters,
        **attributes_here,
    }
    if (group / ARRAY).is_file():
        yield path, attributes
        return
    if path.count("/") >= MAX_DEPTH:
        return
    if (group / NEW).is_file():
        raise SourceError(
            f"{where}: is of Zarr format 3; allowed is format 2, as zarr_format=2 "
            "writes it"
        )

    # A folder may hold any number of entries: no more are listed than are read.
    with os.scandir(group) as entries:
        few = itertools.islice(entries, MAX_ARRAYS)
        names = sorted(entry.name for entry in few if _is_folder(entry))
    for name in names:
        inner = f"{path}/{name}" if path else name
        yield from _arrays_of(folder, inner, attributes, where)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    return entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")


def _file_bytes(path: Path, limit: int, where: str) -> bytes | None:
    """The bytes of a file, None if there is none. Raises SourceError if it is a link, or larger
    than `limit`.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SourceError(
            f"{where}: {shown(path.name)}: cannot be read ({error.strerror})"
        ) from error

    # One byte more than allowed shows that there are too many.
    with open(descriptor, "rb") as file:
        raw = file.read(limit + 1)
    if len(raw) > limit:
        raise SourceError(f"{where}: {shown(path.name)} is larger than {limit} bytes")
    return raw


def _json(path: Path, where: str) -> dict[str, Any] | None:
    raw = _file_bytes(path, MAX_JSON_BYTES, where)
    if raw is None:
        return None
    try:
        content = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{where}: {path.name} is no JSON") from error
    if not isinstance(content, dict):
        raise SourceError(f"{where}: {path.name} is malformed")
    return content


def _fill(value: Any, where: str) -> float | int | bool:
    """The number of places that are not stored."""
    values = {
        "NaN": math.nan,
        "Infinity": math.inf,
        "-Infinity": -math.inf,
    }
    if isinstance(value, str) and value in values:
        return values[value]
    if isinstance(value, int | float):
        return value
    raise SourceError(f"{where}: fill_value {shown(value)} is no number")


def _decoded(codec: dict[str, Any] | None, raw: bytes, n_bytes: int) -> bytes:
    """The bytes of a chunk, of which there should be `n_bytes`, and no more are made. Raises any
    error at malformed ones.
    """
    kind = codec.get("id") if isinstance(codec, dict) else codec
    # One byte more than expected shows that there are too many.
    if kind is None:
        return raw
    if kind in ("zlib", "gzip"):
        return zlib.decompressobj(zlib.MAX_WBITS | 32).decompress(raw, n_bytes + 1)
    if kind == "zstd":
        n_stated = zstandard.frame_content_size(raw)
        if n_stated not in (-1, n_bytes):
            return b""
        return zstandard.ZstdDecompressor().decompress(raw, max_output_size=n_bytes)
    if kind == "lz4":
        (n_stated,) = struct.unpack_from(
            "<I", raw
        )  # before the block, as numcodecs writes it
        if n_stated != n_bytes:
            return b""
        plain: bytes = lz4.block.decompress(raw)
        return plain
    if kind == "bz2":
        return bz2.BZ2Decompressor().decompress(raw, n_bytes + 1)
    if kind == "lzma":
        return lzma.LZMADecompressor(memlimit=MAX_CHUNK_BYTES).decompress(
            raw, n_bytes + 1
        )
    if kind == "blosc":
        # In its header: the bytes of the numbers, of a block, and of all that follows.
        n_stated, _, n_packed = struct.unpack_from("<III", raw, 4)
        if n_stated != n_bytes or n_packed != len(raw):
            return b""
        return _blosc(raw)
    raise ValueError(
        f"codec {str(kind)[:40]!r}; allowed: blosc, zstd, lz4, zlib, gzip, bz2, lzma"
    )


def _blosc(raw: bytes) -> bytes:
    try:
        from numcodecs.blosc import decompress
    except ImportError as error:
        raise ValueError(f"blosc: {not_installed('numcodecs', 'zarr')}") from error
    plain: bytes = decompress(raw)
    return plain
