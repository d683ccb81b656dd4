"""Export of a bag to .npz: arrays for NumPy, and for the sensor's `file:` source."""

import json
import math
import tempfile
import zipfile
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Contacts, Measurements, Message
from sparseskin.messages.fields import Array, FieldKind, Flag, Integer, Real
from sparseskin.messages.frames import kinds_alone, values_alone
from sparseskin.messages.state import described
from sparseskin.nodes.files import os_errors, whole_file
from sparseskin.nodes.numerics.arrays import AnyArray, Floats
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    array_names,
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
_CODES: dict[type[FieldKind], tuple[str, Any]] = {
    Integer: ("q", np.int64),
    Real: ("d", np.float64),
    Flag: ("b", np.bool_),
}
"""Type codes of numbers in memory, of which there may be millions, and their dtypes in the file."""


def export_npz(
    bag: BagReader, out: Path, topics: Iterable[str] | None = None
) -> list[Path]:
    """Write one .npz a patch, `out` or OUT_PATCH.npz each for several patches; their paths.

    Its arrays: `forces` (the taxels' readings), `truth`, `reconstruction`, float32 of shape
    (n_frames, n_rows, n_cols), NaN where a reading is missing; `measurements`, float32 of shape
    (n_frames, M), padded with NaN where M changes; a stamp a frame in `stamp_ns` (of `forces`),
    `truth_stamp_ns`, `reconstruction_stamp_ns`, `measurements_stamp_ns`, int64; and the skin's
    `f_max`, `unit`, `mask`, `points`, `point_rows`, `pitch_m`, `rate_hz` as of `Skin`, where known.

    All other numbers and texts of all messages are arrays SCHEMA_FIELD with one entry a message,
    e.g. `reconstruction_sd` (NaN in frames without one), `reconstruction_trusted`,
    `phi_seed`; None is NaN. Other arrays (mask, calibration, tree) are those of
    the last states, in `states`, as the comment of `export_csv` has them. `states`, `patch`,
    `metadata` and `counts` are texts, JSON but for the patch.

    Contacts are arrays `contacts_COLUMN` with an entry for each contact of each frame, by the
    columns of `Contacts`; their events `contacts_event_stamp_ns`, `contacts_event_id` and
    `contacts_event`.

    Raises BagError if the bag has no such frames or their shape changes, OutputError if a file
    exists or cannot be written.
    """
    by_patch: dict[str, list[str]] = {}
    for topic in stream_topics(bag, topics):
        by_patch.setdefault(patch_of(topic), []).append(topic)
    written = []
    for patch in sorted(by_patch):
        # A reader of such files expects one skin in each.
        path = out
        if len(by_patch) > 1:
            path = out.with_name(f"{out.stem}_{patch}{out.suffix}")
        _export_patch(bag, patch, by_patch[patch], path)
        written.append(path)
    return written


def _export_patch(bag: BagReader, patch: str, topics: list[str], path: Path) -> None:
    """Write one patch. Its arrays lie in files beside `path` until all messages are read."""
    with (
        whole_file(path) as draft,
        os_errors(path),
        tempfile.TemporaryDirectory(
            dir=path.parent, prefix=f".{path.name}."
        ) as scratch,
        zipfile.ZipFile(draft, "x", allowZip64=True) as archive,
    ):
        arrays = _described(bag, patch)
        for topic_arrays in _recorded(bag, with_states(bag, topics), Path(scratch)):
            arrays |= topic_arrays
        # Not by np.savez, which would copy the arrays of files into memory.
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(values))


def _recorded(
    bag: BagReader, topics: list[str], folder: Path
) -> Iterator[dict[str, Any]]:
    """Arrays of the messages on each topic, by name."""
    columns: dict[str, _Columns | _Contacts] = {}
    for message, log_time_ns in streams(bag, topics, "export"):
        topic = message.topic
        if topic not in columns and isinstance(message, Contacts):
            columns[topic] = _Contacts()
        elif topic not in columns:
            columns[topic] = _Columns(f"{bag.path}: {topic}", message, folder)
        columns[topic].add(message, log_time_ns)
    for topic in topics:
        if topic not in columns:
            raise BagError(f"{bag.path}: {topic}: states messages, but holds none")
        yield columns[topic].arrays()


class _Columns:
    """Messages of one topic, field by field, frames in files; `place` names the topic in errors."""

    def __init__(self, place: str, message: Message, folder: Path) -> None:
        self._place = place
        self._schema = message.schema
        kinds = {**kinds_alone(type(message)), LOG_TIME: Integer()}
        self._kinds: dict[str, FieldKind] = {}
        for name, kind in kinds.items():
            if name != "patch" and not isinstance(kind, Array):
                self._kinds[name] = kind
        self._columns: dict[str, Any] = {}
        for name, kind in self._kinds.items():
            self._columns[name] = []
            if type(kind) in _CODES:
                code, _ = _CODES[type(kind)]
                self._columns[name] = array(code)
        frame_fields = ("y", "forces", "sd")
        self._files = {name: folder / f"{self._schema}_{name}" for name in frame_fields}
        self._with_frames: set[str] = set()
        self._shapes: list[tuple[int, ...]] = []

    def add(self, message: Message, log_time_ns: int) -> None:
        values = {**values_alone(message), LOG_TIME: log_time_ns}
        for name, column in self._columns.items():
            value = values[name]
            column.append(math.nan if value is None else value)
        frame = values_of(message)
        # Of a state or of contacts.
        if frame is None:
            return

        # Frames go to files at once: a recording may be larger than memory.
        self._check_shape(frame, message)
        self._shapes.append(frame.shape)
        for name in self._files.keys() & values.keys():
            numbers = values[name]
            if numbers is None:
                numbers = np.full_like(frame, np.nan)
            else:
                self._with_frames.add(name)
                if name != "sd":
                    numbers = frame  # NaN where a reading is missing
            with self._files[name].open("ab") as file:
                file.write(np.ascontiguousarray(numbers).data)

    def _check_shape(self, frame: AnyArray, message: Message) -> None:
        """Raise BagError if the frame has another shape than the one before; M may change."""
        if not self._shapes or isinstance(message, Measurements):
            return
        # Another skin under the same name: one array cannot hold both.
        previous = self._shapes[-1]
        if frame.shape != previous:
            n_rows, n_cols = frame.shape
            sizes = f"a frame of {n_rows} x {n_cols} after some of "
            sizes += " x ".join(map(str, previous))
            raise BagError(f"{self._place}, stamp {message.stamp_ns}: {sizes}")

    def arrays(self) -> dict[str, AnyArray]:
        """Arrays by their names in the file; a field that no message has gets none."""
        # As the sensor reads them from a file.
        frames_name, stamps_name = array_names(self._schema)
        short = {
            "forces": frames_name,
            "y": frames_name,
            "stamp_ns": stamps_name,
        }
        arrays = {
            name: self._frames(self._files[name]) for name in sorted(self._with_frames)
        }
        for name, kind in self._kinds.items():
            _, dtype = _CODES.get(type(kind), ("", None))
            values = np.array(self._columns[name], dtype)
            # A number that no message has is left out.
            if not (isinstance(kind, Real) and np.isnan(values).all()):
                arrays[name] = values
        return {
            short.get(name, f"{self._schema}_{name}"): value
            for name, value in arrays.items()
        }

    def _frames(self, path: Path) -> Floats:
        """The frames in a file, with NaN behind those of fewer measurements."""
        # The largest shape: all frames have the same one but measurements, whose M may change.
        numbers = np.memmap(path, np.float32, "r")
        shape = (len(self._shapes), *max(self._shapes))
        n_padded = math.prod(shape)
        if numbers.size == n_padded:
            return numbers.reshape(shape)
        # One long frame among many short ones would fill the disk.
        if n_padded > max(MAX_PADDED, MAX_PADDING * numbers.size):
            raise BagError(
                f"{self._place}: {numbers.size} numbers would be padded to {n_padded}; "
                f"at most {MAX_PADDING} times as many are allowed; export to csv"
            )

        # M may change between messages: the rest of a row is NaN.
        padded = np.memmap(f"{path}_padded", np.float32, "w+", shape=shape)
        at = 0
        for row, (m,) in zip(padded, self._shapes, strict=True):
            row[:m] = numbers[at : at + m]
            row[m:] = np.nan
            at += m
        return padded


class _Contacts:
    """Contacts of one topic, column by column, and their events."""

    def __init__(self) -> None:
        self._columns: dict[str, list[AnyArray]] = {}
        self._events: list[tuple[int, int, str]] = []

    def add(self, message: Message, log_time_ns: int) -> None:
        assert isinstance(message, Contacts)
        for name, column in message.columns().items():
            self._columns.setdefault(name, []).append(column)
        self._events += [(message.stamp_ns, *event) for event in message.named_events]

    def arrays(self) -> dict[str, AnyArray]:
        """Arrays by their names in the file."""
        arrays = {name: np.concatenate(parts) for name, parts in self._columns.items()}
        dtypes = {
            "event_stamp_ns": "<i8",
            "event_id": "<i4",
            "event": "<U8",
        }
        events = np.array(self._events, list(dtypes.items()))
        arrays |= {name: events[name] for name in dtypes}
        return {f"{Contacts.schema}_{name}": values for name, values in arrays.items()}


def _described(bag: BagReader, patch: str) -> dict[str, Any]:
    """Description of a patch by the names of the file."""
    skin = skin_of(bag, patch)
    topics = [topic for topic in bag.topics if patch_of(topic) == patch]
    arrays: dict[str, Any] = {
        "patch": patch,
        "states": json.dumps(last_states(bag, topics)),
        "metadata": json.dumps(bag.metadata),
        "counts": json.dumps(bag.counts),
    }
    if skin is not None:
        arrays |= described(skin, skin.rate_hz)
    return arrays
