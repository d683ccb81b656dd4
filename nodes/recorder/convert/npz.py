"""Export of a bag to .npz: arrays for NumPy, and for the sensor's `file:` source."""

from __future__ import annotations

import json
import math
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Measurements, Message
from sparseskin.messages.fields import Array, FieldKind, Flag, Integer, Real, Samples, Text
from sparseskin.messages.frames import kinds_alone, values_alone
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.files import os_errors, whole_file
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    array_names,
    described,
    last_states,
    patch_of,
    skin_of,
    stream_topics,
    streams,
    values_of,
    with_states,
)
from sparseskin.nodes.recorder.bag.reader import BagReader

MAX_PADDING = 8
"""Most numbers with padding, in those recorded, where M changes; up to `MAX_PADDED`, any."""
MAX_PADDED = 1 << 20
LOG_TIME = "log_time_ns"
_DTYPES: dict[type[FieldKind], Any] = {Integer: np.int64, Real: np.float64, Flag: np.bool_}
_FRAMES = ("forces", "sd")
"""Arrays of the shape of the skin."""


def export_npz(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write one .npz a patch, `out` or OUT_PATCH.npz each for several patches; their paths.

    Its arrays: `forces` (the taxels' readings), `truth`, `reconstruction`, float32 of shape
    (n_frames, n_rows, n_cols); `measurements`, float32 of shape (n_frames, M), padded with NaN
    where M changes; a stamp a frame in `stamp_ns` (of `forces`), `truth_stamp_ns`,
    `reconstruction_stamp_ns`, `measurements_stamp_ns`, int64; and the skin's `f_max`, `unit`,
    `mask`, `points` (float32, (n_taxels, 6): place in metres and normal of each taxel of a skin
    that is no flat grid), `point_rows` (int32, (n_taxels,): the row of each among those of the file
    of points), `pitch_m`, `rate_hz`, where known.

    All other numbers and texts of all messages are arrays SCHEMA_FIELD with one entry a message,
    e.g. `reconstruction_sd` (NaN in frames without one), `reconstruction_trusted`,
    `resultant_total`, `phi_seed`; None is NaN. Other arrays (mask, calibration, tree) are those of
    the last states, in `states`, as the comment of `export_csv` has them. `states`, `patch`,
    `metadata` and `counts` are texts, JSON but for the patch.

    Raises BagError if the bag has no such frames or their shape changes, OutputError if a file
    exists or cannot be written.
    """
    wanted = stream_topics(bag, topics)
    patches = sorted({patch_of(topic) for topic in wanted})
    written = []
    for patch in patches:
        path = out if len(patches) == 1 else out.with_name(f"{out.stem}_{patch}{out.suffix}")
        ours = with_states(bag, [topic for topic in wanted if patch_of(topic) == patch])
        with (
            whole_file(path) as draft,
            os_errors(path),
            tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as scratch,
        ):
            members = [*_arrays(bag, ours, Path(scratch)), *_described(bag, patch, Path(scratch))]
            with zipfile.ZipFile(draft, "x", allowZip64=True) as archive:
                for member in members:
                    archive.write(member, member.name)
        written.append(path)
    return written


def _arrays(bag: BagReader, topics: list[str], folder: Path) -> list[Path]:
    """Write the messages of topics in two passes; the file may state other sizes than it has."""
    columns = {topic: _Columns(bag.topics[topic].schema) for topic in topics}
    for message, _ in streams(bag, topics, "measure"):
        of_topic = columns[message.topic]
        before = of_topic.shape
        of_topic.measure(message)
        if len(before) == 2 and of_topic.shape != before:
            raise BagError(
                f"{bag.path}: {message.topic}, stamp {message.stamp_ns}: a frame of "
                f"{of_topic.shape[0]} x {of_topic.shape[1]} after some of {before[0]} x {before[1]}"
            )
    for topic, of_topic in columns.items():
        if not of_topic.n:
            raise BagError(f"{bag.path}: {topic}: states messages, but holds none")
        padded = of_topic.n * math.prod(of_topic.shape)
        if padded > max(MAX_PADDED, MAX_PADDING * of_topic.n_elements):
            raise BagError(
                f"{bag.path}: {topic}: {of_topic.n_elements} numbers would be padded to {padded}; "
                f"at most {MAX_PADDING} times as many are allowed; export to csv"
            )
        of_topic.open(folder)
    for message, log_time_ns in streams(bag, topics, "export"):
        columns[message.topic].add(message, log_time_ns)
    return [path for of_topic in columns.values() for path in of_topic.paths]


class _Columns:
    """Messages of one topic as .npy files: a recording may be larger than the memory.

    All messages are measured, then added. `shape` is that of the frames, with the largest M of
    measurements. A field that no message has gets no file.
    """

    def __init__(self, schema: str) -> None:
        self.n = self.n_elements = 0
        self.shape: tuple[int, ...] = ()
        self.paths: list[Path] = []
        self._schema = schema
        self._lengths: dict[str, int] = {}
        self._columns: dict[str, npt.NDArray[Any]] = {}
        self._n_added = 0

    def measure(self, message: Message) -> None:
        self.n += 1
        for name, value in values_alone(message).items():
            if value is not None:
                length = len(value) if isinstance(value, str) else 1
                self._lengths[name] = max(self._lengths.get(name, 1), length)
        if (values := values_of(message)) is not None:
            self.n_elements += values.size
            is_padded = isinstance(message, Measurements)
            self.shape = max(self.shape, values.shape) if is_padded else values.shape

    def open(self, folder: Path) -> None:
        kinds = {**kinds_alone(SCHEMAS[self._schema]), LOG_TIME: Integer()}
        self._lengths[LOG_TIME] = 1
        frames, stamps = array_names(self._schema)
        short = {"forces": frames, "y": frames, "stamp_ns": stamps}
        for name, kind in kinds.items():
            if name not in self._lengths or name == "patch":
                continue
            dtype: Any = np.float32
            shape: tuple[int, ...] = (self.n,)
            if isinstance(kind, Samples) or name in _FRAMES:
                shape = (self.n, *self.shape)
            elif isinstance(kind, Array):
                continue
            else:
                is_text = isinstance(kind, Text)
                dtype = f"<U{self._lengths[name]}" if is_text else _DTYPES[type(kind)]
            path = folder / f"{short.get(name, f'{self._schema}_{name}')}.npy"
            self.paths.append(path)
            self._columns[name] = np.lib.format.open_memmap(path, "w+", dtype=dtype, shape=shape)

    def add(self, message: Message, log_time_ns: int) -> None:
        k, self._n_added = self._n_added, self._n_added + 1
        values = {**values_alone(message), LOG_TIME: log_time_ns}
        for name, column in self._columns.items():
            value = values[name]
            if name == "y":
                column[k] = np.nan
                column[k, : len(value)] = value
            else:
                column[k] = np.nan if value is None else value


def _described(bag: BagReader, patch: str, folder: Path) -> list[Path]:
    skin = skin_of(bag, patch)
    topics = [topic for topic in bag.topics if patch_of(topic) == patch]
    texts = {"states": last_states(bag, topics), "metadata": bag.metadata, "counts": bag.counts}
    arrays = {"patch": patch, **{name: json.dumps(value) for name, value in texts.items()}}
    arrays |= {} if skin is None else described(skin, skin.rate_hz)
    paths = []
    for name, value in arrays.items():
        paths.append(folder / f"{name}.npy")
        np.save(paths[-1], np.asarray(value))
    return paths
