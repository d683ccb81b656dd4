"""Export of bags to a folder of Zarr, version 2, as tactile datasets have it."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from sparseskin.messages import Reconstruction, Taxels
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.numerics.arrays import AnyArray, Floats, mask_texts
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    frame_topics,
    patch_of,
    skin_of,
    streams,
    values_of,
)
from sparseskin.nodes.recorder.bag.reader import BagReader

from .reader import ARRAY, ATTRIBUTES, GROUP

SIDES = ("left", "right")
CHUNK_BYTES = 1 << 20
"""Numbers of a chunk, about; chosen: a second of 32 x 32 taxels at 250 Hz."""
LEVEL = 3
NO_AREA = -1
"""Functional area of a skin that none is stated of."""


def export_zarr(
    bags: Sequence[BagReader],
    out: Path,
    topics: Iterable[str] | None = None,
    side: str = "right",
    area: int = NO_AREA,
) -> list[Path]:
    """Write a new folder `out`, bag k being its episode k; the paths of its files.

    Parameters
    ----------
    topics
        Topics of frames, the same in all bags; by default the reconstructions, or else the taxels.
    side : str
        "left" or "right", of the patches whose name has neither word.
    area : int
        Functional area of the hand that the skins are on, as the dataset numbers them; -1: none.

    T rows of all episodes follow each other, a row for each frame of the first topic with the
    newest frame of each other one. Arrays in `data`: `timestamps`, float64 (T,), s;
    SIDE_tactile_data_GROUP, float32 (T, 1, n_rows, n_cols), NaN where a reading is missing, with
    the attributes unit, f_max, pitch_m, mask; SIDE_tactile_area_GROUP, int32 (T, 1);
    SIDE_tactile_sensor_GROUP and SIDE_tactile_type_GROUP, texts (T,). GROUP is the patch without
    its side, and the schema where a patch has frames of several. In `meta`: `episode_ends`, int64.

    Raises BagError if the bags have no such frames or those of different shapes, or a number is
    out of its range, OutputError if the folder exists or cannot be written.
    """
    if side not in SIDES:
        raise BagError(f"--side {side}: allowed are {' and '.join(SIDES)}")
    if not NO_AREA <= area <= 10**6:
        raise BagError(f"--area: {area} is outside {NO_AREA}..{10**6}")

    topics = _topics_of(bags[0], topics)
    names = _names(topics, side)
    with whole_folder(out):
        for folder in (out, out / "data", out / "meta"):
            folder.mkdir(exist_ok=True)
            _write_json(folder / GROUP, {"zarr_format": 2})

        # Episodes follow each other in one array: readers of the dataset cut them by their ends.
        times = _Rows(out / "data/timestamps", np.dtype("<f8"), ())
        rows: dict[str, _Rows] = {}
        ends = []
        for bag in bags:
            n_earlier = times.n
            # An episode of no rows would have the end of the one before it.
            _add_episode(bag, topics, times, rows, out / "data", names)
            if times.n == n_earlier:
                raise BagError(
                    f"{bag.path}: no frame has one of each topic: {', '.join(topics)}"
                )
            ends.append(times.n)

        times.finish({"units": "s"})
        for topic, column in rows.items():
            column.finish(_attributes(bags[0], patch_of(topic)))
            _write_constants(out / "data", names[topic], times.n, topic, area)
        _write_whole(out / "meta/episode_ends", np.array(ends, "<i8"))
        return sorted(path for path in out.rglob("*") if path.is_file())


def _topics_of(bag: BagReader, topics: Iterable[str] | None) -> list[str]:
    """Topics of frames of one shape."""
    schemas = (Reconstruction.schema, Taxels.schema)
    if topics is not None:
        return frame_topics(bag, topics, schemas)
    topics_found = frame_topics(bag, None, schemas)
    reconstructed = []
    for topic in topics_found:
        _, schema = split_topic(topic)
        if schema == Reconstruction.schema:
            reconstructed.append(topic)
    # A recording of a sensor alone has none.
    return reconstructed or topics_found


def _names(topics: Sequence[str], side: str) -> dict[str, tuple[str, str]]:
    """Side and group of each topic."""
    names = {}
    patches = [patch_of(topic) for topic in topics]
    # The words of a patch, skin_left, may have its side.
    for topic, patch in zip(topics, patches, strict=True):
        words = patch.split("_")
        sides_in_name = [word for word in words if word in SIDES]
        if patches.count(patch) > 1:
            # Frames of a patch before and after reconstruction.
            _, schema = split_topic(topic)
            words.append(schema)
        group = "_".join(word for word in words if word not in SIDES) or "skin"
        # A name with both words states none.
        side_of_topic = sides_in_name[0] if len(sides_in_name) == 1 else side
        names[topic] = (side_of_topic, group)
    if len({*names.values()}) < len(names):
        raise BagError(
            f"the patches of {', '.join(topics)} would have one name; state --topics"
        )
    return names


def _add_episode(
    bag: BagReader,
    topics: Sequence[str],
    times: "_Rows",
    rows: "dict[str, _Rows]",
    folder: Path,
    names: dict[str, tuple[str, str]],
) -> None:
    """Append the rows of a bag."""
    newest: dict[str, Floats] = {}
    for message, _ in streams(bag, topics, "export"):
        frame = values_of(message)
        if frame is None:
            continue
        newest[message.topic] = frame
        if message.topic != topics[0] or len(newest) < len(topics):
            continue

        # A row: the newest frame of each topic.
        times.add(np.float64(message.stamp_ns / 1e9))
        for topic in topics:
            shape = (1, *newest[topic].shape)
            if topic not in rows:
                side, group = names[topic]
                path = folder / f"{side}_tactile_data_{group}"
                rows[topic] = _Rows(path, np.dtype("<f4"), shape)
            # An array has one shape: another skin in a later bag does not fit.
            if rows[topic].sides != shape:
                raise BagError(
                    f"{bag.path}: {topic}, stamp {message.stamp_ns}: frames of "
                    f"{shape[1:]} after some of {rows[topic].sides[1:]}"
                )
            rows[topic].add(newest[topic])


class _Rows:
    """An array that grows by rows, written chunk by chunk."""

    def __init__(
        self, folder: Path, dtype: np.dtype[Any], sides: tuple[int, ...]
    ) -> None:
        folder.mkdir()
        self.n = 0
        self.sides = sides
        self._folder = folder
        row_bytes = math.prod(sides) * dtype.itemsize
        length = max(1, CHUNK_BYTES // row_bytes)
        self._chunk = np.zeros((length, *sides), dtype)

    def add(self, row: Any) -> None:
        length = len(self._chunk)
        self._chunk[self.n % length] = row
        self.n += 1
        if self.n % length == 0:
            self._write()

    def finish(self, attributes: dict[str, Any]) -> None:
        """Write the last chunk and what states the array."""
        # All chunks have one size: what is beyond the last row is 0.
        n_in_last = self.n % len(self._chunk)
        if n_in_last:
            self._chunk[n_in_last:] = 0
            self._write()
        _write_head(self._folder, (self.n, *self.sides), self._chunk)
        _write_json(self._folder / ATTRIBUTES, attributes)

    def _write(self) -> None:
        # Chunks are cut along the first axis alone: the other numbers are 0.
        number = (self.n - 1) // len(self._chunk)
        place = (number, *[0] * len(self.sides))
        name = ".".join(map(str, place))
        _write_chunk(self._folder / name, self._chunk)


def _write_constants(
    folder: Path, name: tuple[str, str], n: int, topic: str, area: int
) -> None:
    """Write what the dataset states of each row of a group."""
    side, group = name
    sensor = f"sparseskin {patch_of(topic)}"
    _write_whole(folder / f"{side}_tactile_area_{group}", np.full((n, 1), area, "<i4"))
    _write_whole(folder / f"{side}_tactile_sensor_{group}", np.full(n, sensor))
    _write_whole(folder / f"{side}_tactile_type_{group}", np.full(n, "matrix"))


def _attributes(bag: BagReader, patch: str) -> dict[str, Any]:
    """What a bag states of a skin."""
    skin = skin_of(bag, patch)
    if skin is None:
        return {}
    attributes: dict[str, Any] = {"unit": skin.unit, "f_max": skin.f_max}
    if skin.pitch_m:
        attributes["pitch_m"] = skin.pitch_m
    if skin.mask is not None:
        attributes["mask"] = mask_texts(skin.mask)
    return attributes


def _write_whole(folder: Path, array: AnyArray) -> None:
    folder.mkdir()
    _write_chunk(folder / ".".join("0" * array.ndim), array)
    _write_head(folder, array.shape, array)


def _write_head(folder: Path, sides: tuple[int, ...], chunk: AnyArray) -> None:
    fill_value: int | str = ""
    if chunk.dtype.kind in "if":
        fill_value = 0
    head = {
        "zarr_format": 2,
        "shape": sides,
        "chunks": chunk.shape,
        "dtype": chunk.dtype.newbyteorder("<").str,
        "compressor": {"id": "zstd", "level": LEVEL},
        "fill_value": fill_value,
        "order": "C",
        "filters": None,
    }
    _write_json(folder / ARRAY, head)


def _write_chunk(path: Path, chunk: AnyArray) -> None:
    path.write_bytes(zstandard.ZstdCompressor(LEVEL).compress(chunk.tobytes()))


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n")
