"""Export of a bag to a dataset of LeRobot: for each video frame a window of tactile frames, and the
strongest contacts.

Source of the layout: huggingface/lerobot, `src/lerobot/datasets/`, codebase version v3.0, read in
lerobot 0.4.4 and 0.6.2.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import (
    Contacts,
    Measurements,
    Message,
    Reconstruction,
    SkinState,
    Taxels,
)
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    FRAME_SCHEMAS,
    frame_topics,
    skin_of,
    streams,
    values_of,
)
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.bridges.base import check_installed
from sparseskin.plugins.bridges.contacts import N_STATE, state, state_names

VERSION = "v3.0"
TASK = "touch"
FPS = 30
MAX_FPS, MAX_WINDOW, MAX_CONTACTS = 1000, 4096, 100
STATE_KEY = "observation.state"
BLOCK_BYTES = 1 << 26
"""Size of what is held in memory at once, bytes: a recording may be larger than the memory."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
CHUNK, TASKS = "chunk-000/file-000.parquet", "meta/tasks.parquet"
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True)
class _Stream:
    """One topic: feature, frames in a row, all frames (n_frames, N), their stamps, nanoseconds."""

    topic: str
    key: str
    size: int
    shape: tuple[int, int]
    skin: SkinState | None
    stamps_ns: npt.NDArray[np.int64]
    values: npt.NDArray[np.float32]

    def window(self, times_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Numbers of the last `size` frames at or before each time, shape (n_times, size); the
        first frame again where there were fewer.
        """
        last = np.searchsorted(self.stamps_ns, times_ns, side="right") - 1
        chosen: npt.NDArray[np.int64] = last[:, None] - np.arange(self.size - 1, -1, -1)
        return np.maximum(chosen, 0)

    def ages(self, times_ns: npt.NDArray[np.int64]) -> Floats:
        """How long before each time the frames of its window were acquired, seconds."""
        ages = (times_ns[:, None] - self.stamps_ns[self.window(times_ns)]) / 1e9
        return np.asarray(ages, np.float32)


def export_lerobot(
    bag: BagReader,
    out: Path,
    topics: Iterable[str] | None = None,
    fps: int = FPS,
    window: int | None = None,
    contacts: int = N_STATE,
) -> list[Path]:
    """Write a dataset of one episode into a new folder `out`; the paths of its files.

    Parameters
    ----------
    topics
        Topics of maps and contacts; by default the reconstructions, or else the taxels, and all
        contacts.
    fps : int
        Rows a second, the rate of the video that the dataset is for.
    window : int, optional
        Number K of tactile frames a row; by default as many as come in 1 / fps, rounded up.
    contacts : int
        Number of contacts of a patch in the state.

    Row k is that of the time t = t0 + k / fps, where t0 is the stamp from which on there are frames
    of all topics. Its feature observation.tactile.NAME, float32 (K, N), holds the last K frames at
    or before t, the newest last, each row after row; observation.tactile.NAME.age, float32 (K,),
    how long before t each was acquired, in seconds. Before K frames have come, the first stands
    in place of those that are missing. NAME is PATCH for reconstructions, PATCH_SCHEMA for others.
    Where there are contacts, observation.state, float32, holds `state` of the last of each patch at
    or before t, one patch after the other, with the names of its numbers.

    Raises BagError if pyarrow is not installed, the bag has no such frames, or a number is out of
    its range; OutputError if the folder exists or cannot be written.
    """
    check_installed("writing for LeRobot", "lerobot", "pyarrow", error=BagError)
    if not 1 <= fps <= MAX_FPS:
        raise BagError(f"--fps: {fps} is outside 1..{MAX_FPS}")
    if window is not None and not 1 <= window <= MAX_WINDOW:
        raise BagError(f"--window: {window} is outside 1..{MAX_WINDOW}")
    if not 1 <= contacts <= MAX_CONTACTS:
        raise BagError(f"--contacts: {contacts} is outside 1..{MAX_CONTACTS}")
    with whole_folder(out), tempfile.TemporaryDirectory(dir=out, prefix=".frames") as scratch:
        folder = Path(scratch)
        maps, touched = _wanted(bag, topics)
        read = [_read_map(bag, topic, folder, fps, window) for topic in maps]
        states = [_read_contacts(bag, topic, folder, contacts) for topic in touched]
        first_ns = max(int(stream.stamps_ns[0]) for stream in read + states)
        last_ns = min(int(stream.stamps_ns[-1]) for stream in read + states)
        if last_ns < first_ns:
            raise BagError(f"{bag.path}: its topics have no time in common")
        n = int((last_ns - first_ns) * fps // 1_000_000_000) + 1
        times_ns = first_ns + (np.arange(n, dtype=np.int64) * 1_000_000_000) // fps
        return _write(out, bag, read, states, times_ns, fps)


def _wanted(bag: BagReader, topics: Iterable[str] | None) -> tuple[list[str], list[str]]:
    """Topics requested; or else the reconstruction of each patch, or its taxels, and contacts."""
    found = frame_topics(bag, topics, (*FRAME_SCHEMAS, Contacts.schema))
    touched = [topic for topic in found if split_topic(topic)[1] == Contacts.schema]
    if topics is not None:
        for topic in found:
            if split_topic(topic)[1] == Measurements.schema:
                raise BagError(f"{topic}: measurements are no map; allowed are topics of forces")
        return [topic for topic in found if topic not in touched], touched
    best: dict[str, str] = {}
    for schema in (Taxels.schema, Reconstruction.schema):
        for topic in found:
            if split_topic(topic)[1] == schema:
                best[split_topic(topic)[0]] = topic
    if not best:
        raise BagError(f"{bag.path}: holds neither reconstructions nor taxels")
    return list(best.values()), touched


def _read(
    bag: BagReader, topic: str, folder: Path, values_in: Callable[[Message], Floats | None]
) -> tuple[tuple[int, ...], npt.NDArray[np.int64], Floats]:
    """Shape of the values of a message, stamps, and all values, each flat."""
    stamps: list[int] = []
    shape: tuple[int, ...] = ()
    path = folder / topic.strip("/").replace("/", "_")
    with path.open("wb") as file:
        for message, _ in streams(bag, [topic], "read"):
            if (values := values_in(message)) is None:
                continue
            shape = shape or values.shape
            if values.shape != shape:
                raise BagError(f"{bag.path}: {topic}: the shape of its frames changes")
            if stamps and message.stamp_ns <= stamps[-1]:
                continue  # played again, or late
            file.write(np.ascontiguousarray(values, "<f4").tobytes())
            stamps.append(message.stamp_ns)
    if not stamps:
        raise BagError(f"{bag.path}: {topic}: states messages, but holds none")
    held = np.memmap(path, "<f4", "r", shape=(len(stamps), math.prod(shape)))
    return shape, np.array(stamps, np.int64), held


def _read_map(bag: BagReader, topic: str, folder: Path, fps: int, size: int | None) -> _Stream:
    patch, schema = split_topic(topic)
    name = patch if schema == Reconstruction.schema else f"{patch}_{schema}"
    shape, stamps_ns, values = _read(bag, topic, folder, values_of)
    if size is None:
        rate_hz = (len(stamps_ns) - 1) * 1e9 / max(1, int(stamps_ns[-1] - stamps_ns[0]))
        size = min(max(1, math.ceil(rate_hz / fps - 1e-6)), MAX_WINDOW)
    key, sides = f"observation.tactile.{name}", (shape[0], shape[1])
    return _Stream(topic, key, size, sides, skin_of(bag, patch), stamps_ns, values)


def _read_contacts(bag: BagReader, topic: str, folder: Path, k: int) -> _Stream:
    def values_in(message: Message) -> Floats | None:
        return state(message, k) if isinstance(message, Contacts) else None

    shape, stamps_ns, values = _read(bag, topic, folder, values_in)
    skin = skin_of(bag, split_topic(topic)[0])
    return _Stream(topic, STATE_KEY, 1, (k, shape[0]), skin, stamps_ns, values)


def _state(states: list[_Stream], times_ns: npt.NDArray[np.int64]) -> Floats:
    """The state at each time, of all patches: shape (n_times, n_numbers)."""
    parts = [stream.values[stream.window(times_ns)[:, 0]] for stream in states]
    return np.concatenate(parts, axis=1)


def _write(
    out: Path,
    bag: BagReader,
    streams: list[_Stream],
    states: list[_Stream],
    times_ns: npt.NDArray[np.int64],
    fps: int,
) -> list[Path]:
    features: dict[str, dict[str, Any]] = {}
    stats: dict[str, dict[str, Any]] = {}
    for stream in streams:
        key, shape = stream.key, [stream.size, stream.values.shape[1]]
        features[key] = {"dtype": "float32", "shape": shape, "names": None}
        features[f"{key}.age"] = {"dtype": "float32", "shape": shape[:1], "names": None}
        stats[key] = _window_stats(stream, stream.window(times_ns))
        stats[f"{key}.age"] = _stats(stream.ages(times_ns))
    if states:
        names = [n for s in states for n in state_names(split_topic(s.topic)[0], s.shape[0])]
        features[STATE_KEY] = {"dtype": "float32", "shape": [len(names)], "names": names}
        stats[STATE_KEY] = _stats(_state(states, times_ns))
    n = len(times_ns)
    for name in INDICES:
        dtype = "float32" if name == "timestamp" else "int64"
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
        stats[name] = _stats(_index(name, 0, n, fps)[:, None])
    texts = {
        "meta/info.json": json.dumps(_info(features, n, fps), indent=4),
        "meta/stats.json": json.dumps(stats, default=np.ndarray.tolist),
        "README.md": _readme(bag, streams, states, int(times_ns[0]), fps),
    }
    paths = [out / name for name in (*texts, f"data/{CHUNK}", TASKS, f"meta/episodes/{CHUNK}")]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
    _write_rows(paths[3], streams, states, features, times_ns, fps)
    _write_tasks(paths[4])
    _write_episode(paths[5], stats, n)
    return paths


def _info(features: dict[str, Any], n: int, fps: int) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": 1,
        "total_frames": n,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }


def _index(name: str, begin: int, end: int, fps: int) -> npt.NDArray[Any]:
    """A column that every dataset has, of rows begin to end - 1 of the only episode."""
    if name == "timestamp":
        return (np.arange(begin, end) / fps).astype(np.float32)
    if name in ("frame_index", "index"):
        return np.arange(begin, end, dtype=np.int64)
    return np.zeros(end - begin, np.int64)


def _stats(values: npt.NDArray[Any]) -> dict[str, Any]:
    """Statistics over the rows (axis 0): arrays of the shape of a row, and the number of rows."""
    wide = values.astype(np.float64)
    levels = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        **{name: getattr(wide, name)(axis=0) for name in ("min", "max", "mean", "std")},
        **dict(zip(QUANTILES, levels, strict=True)),
        "count": np.array([len(values)]),
    }


def _window_stats(stream: _Stream, chosen: npt.NDArray[np.int64]) -> dict[str, Any]:
    """Statistics of the windows of a stream, (K, N) each; a block of taxels at a time."""
    n, size = chosen.shape
    block = max(1, BLOCK_BYTES // (8 * n))
    found: dict[str, Any] = {}
    for begin in range(0, stream.values.shape[1], block):
        of_block = [_stats(stream.values[chosen[:, k], begin : begin + block]) for k in range(size)]
        for name in of_block[0]:
            found.setdefault(name, []).append(np.stack([one[name] for one in of_block]))
    return {name: np.concatenate(parts, axis=1) for name, parts in found.items()} | {
        "count": np.array([n])
    }


def _write_rows(
    path: Path,
    streams: list[_Stream],
    states: list[_Stream],
    features: dict[str, dict[str, Any]],
    times_ns: npt.NDArray[np.int64],
    fps: int,
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields: dict[str, Any] = {}
    for name, feature in features.items():
        fields[name] = getattr(pa, feature["dtype"])()
        for _ in () if name in INDICES else feature["shape"]:
            fields[name] = pa.list_(fields[name])
    schema = pa.schema(fields)
    widest = sum(4 * s.size * s.values.shape[1] for s in streams + states)
    with pq.ParquetWriter(path, schema, compression="snappy") as writer:
        block = max(1, BLOCK_BYTES // widest)
        for begin in range(0, len(times_ns), block):
            times = times_ns[begin : begin + block]
            columns = []
            for stream in streams:
                columns.append(_nested(stream.values[stream.window(times)]))
                columns.append(_nested(stream.ages(times)))
            if states:
                columns.append(_nested(_state(states, times)))
            columns += [pa.array(_index(name, begin, begin + len(times), fps)) for name in INDICES]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


def _nested(values: Floats) -> Any:
    """An array of Arrow, of lists for each dimension after the first."""
    import pyarrow as pa

    made = pa.array(np.ascontiguousarray(values).ravel())
    for k in range(values.ndim - 1, 0, -1):
        n = int(np.prod(values.shape[:k]))
        offsets = np.arange(n + 1, dtype=np.int32) * values.shape[k]
        made = pa.ListArray.from_arrays(pa.array(offsets), made)
    return made


def _write_tasks(path: Path) -> None:
    """The task by its number; pandas reads the text as the index."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def column(name: str, kind: str, numpy_type: str) -> dict[str, Any]:
        types = {"pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        return {"name": name, "field_name": name, **types}

    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([TASK])})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(described)}), path)


def _write_episode(path: Path, stats: dict[str, dict[str, Any]], n: int) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    row: dict[str, Any] = {
        "episode_index": 0,
        "tasks": [TASK],
        "length": n,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": 0,
        "dataset_to_index": n,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for feature, found in stats.items():
        row |= {f"stats/{feature}/{name}": value.tolist() for name, value in found.items()}
    pq.write_table(pa.table({name: [value] for name, value in row.items()}), path)


def _readme(
    bag: BagReader, streams: list[_Stream], states: list[_Stream], first_ns: int, fps: int
) -> str:
    lines = [
        "---", "task_categories:", "- robotics", "tags:", "- LeRobot", "- tactile", "---", "",
        f"# {bag.path.name}", "",
        f"LeRobot dataset, codebase version {VERSION}, {fps} rows a second, one episode. Row 0 is "
        f"that of the stamp {first_ns} ns. Of each row the last frames at or before its time, the "
        "newest last; `.age` is the time since each was acquired, in seconds.", "",
        "| feature | frames a row | taxels (rows x columns) | unit | range | pitch, m | topic |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for stream in streams:
        skin, (n_rows, n_cols) = stream.skin, stream.shape
        known = (skin.unit, f"0..{skin.f_max:g}", skin.pitch_m or "-") if skin else ("-",) * 3
        cells = (stream.key, stream.size, f"{n_rows} x {n_cols}", *known, stream.topic)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    if states:
        of = [f"{s.topic} ({s.shape[0]}, {s.skin.unit if s.skin else '-'})" for s in states]
        lines += [
            "",
            f"`{STATE_KEY}` has the contacts of the largest forces, the largest first, of "
            f"{', '.join(of)}: 1 where their frame is trusted, then of each contact total force "
            "and its standard deviation in that unit, centre and velocity in mm, area in mm2 "
            "(taxels where no pitch is known), and age in seconds; zeros where there are fewer.",
        ]
    return "\n".join([*lines, ""])
