"""Export of a bag to .npz: arrays for NumPy, for the sensor's `file:` source, and back to a bag."""

from __future__ import annotations

import heapq
import json
import math
import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np

from sparseskin.messages import End, Measurements, Message, Taxels
from sparseskin.messages.topics import topic_of
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.files import os_errors, whole_file
from sparseskin.nodes.numerics.array_files import ArrayFileError, npz_shapes, read_npz
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    described,
    patch_of,
    skin_of,
    stream_topics,
    streams,
    with_states,
)
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter

from .columns import ColumnWriter, Layout, column_name, rebuilt

MAX_PADDING = 8
"""Most numbers with padding, in those recorded, where M changes; up to `MAX_PADDED`, any."""
MAX_PADDED = 1 << 20
FORMAT = "sparseskin_format"
"""Array with the version of the layout: a file that has it is an export of a bag."""
VERSION = 1


def export_npz(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write one .npz a patch, `out` or OUT_PATCH.npz each for several patches; their paths.

    Its arrays: `forces` (the taxels' readings), `truth`, `reconstruction`, float32 of shape
    (n_frames, n_rows, n_cols); `measurements`, float32 of shape (n_frames, M), padded with NaN
    where M changes; a stamp a frame in `stamp_ns` (of `forces`), `truth_stamp_ns`,
    `reconstruction_stamp_ns`, `measurements_stamp_ns`, int64; and the skin's `f_max`, `unit`,
    `mask`, `points` (float32, (n_taxels, 6): place in metres and normal of each taxel of a skin
    that is no flat grid), `point_rows` (int32, (n_taxels,): the row of each among those of the file
    of points), `pitch_m`, `rate_hz`, where known.

    All other fields of all messages are arrays SCHEMA_FIELD with one entry a message, e.g.
    `reconstruction_sd` (NaN in frames without one), `reconstruction_trusted`, `resultant_total`,
    `phi_seed`; None is NaN. Arrays of any length (`skin_mask`, `measurements_places`) stand one
    behind the other; SCHEMA_FIELD_end and SCHEMA_FIELD_shape have the end and shape of each.
    `patch`, `metadata` and `counts` (JSON) are those of the bag. So `NpzExport` makes the same
    messages of it again.

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
            folder = Path(scratch)
            members = [*_arrays(bag, ours, folder), *_described(bag, patch, folder)]
            with zipfile.ZipFile(draft, "x", allowZip64=True) as archive:
                for member in members:
                    archive.write(member, member.name)
        written.append(path)
    return written


def _arrays(bag: BagReader, topics: list[str], folder: Path) -> list[Path]:
    layouts = _layouts(bag, topics)
    writers = {topic: ColumnWriter(layout, folder) for topic, layout in layouts.items()}
    for message, log_time_ns in streams(bag, topics, "export"):
        writers[message.topic].add(message, log_time_ns)
    return [file for writer in writers.values() for file in writer.files]


def _layouts(bag: BagReader, topics: list[str]) -> dict[str, Layout]:
    """Sizes of the messages of each topic, as they are; the file may state others."""
    layouts = {topic: Layout(bag.topics[topic].schema) for topic in topics}
    for message, _ in streams(bag, topics, "measure"):
        layout = layouts[message.topic]
        before = layout.shape
        layout.add(message)
        if before and len(before) == 2 and layout.shape != before:
            raise BagError(
                f"{bag.path}: {message.topic}, stamp {message.stamp_ns}: a frame of "
                f"{layout.shape[0]} x {layout.shape[1]} after some of {before[0]} x {before[1]}"
            )
    for topic, layout in layouts.items():
        if not layout.n:
            raise BagError(f"{bag.path}: {topic}: states messages, but holds none")
        padded = layout.n * math.prod(layout.shape)
        is_padded = layout.schema == Measurements.schema
        if is_padded and padded > max(MAX_PADDED, MAX_PADDING * layout.n_elements):
            raise BagError(
                f"{bag.path}: {topic}: {layout.n_elements} numbers would be padded to {padded}; at "
                f"most {MAX_PADDING} times as many are allowed; export to csv"
            )
    return layouts


def _described(bag: BagReader, patch: str, folder: Path) -> list[Path]:
    skin = skin_of(bag, patch)
    of_skin = {} if skin is None else described(skin, skin.rate_hz)
    of_bag = {
        FORMAT: VERSION,
        "patch": patch,
        "metadata": json.dumps(bag.metadata),
        "counts": json.dumps(bag.counts),
    }
    files = []
    for name, value in {**of_skin, **of_bag}.items():
        np.save(folder / f"{name}.npy", np.asarray(value))
        files.append(folder / f"{name}.npy")
    return files


class NpzExport:
    """An export of a bag, read back.

    Attributes
    ----------
    patch : str
        Name of the patch.
    metadata : dict of str to str
        Metadata of the bag.
    counts : dict or None
        Counters of its recorder.

    Raises
    ------
    SourceError
        If the file is malformed, or of a newer version.
    """

    def __init__(self, path: Path, raw: bytes) -> None:
        self._path = path
        try:
            self._arrays = read_npz(raw, list)
            version = self._arrays[FORMAT]
            if version.shape != () or version != VERSION:
                raise ValueError(f"array {FORMAT!r}: version {version}; {VERSION} can be read")
            self.patch = self._text("patch")
            metadata = json.loads(self._text("metadata"))
            self.counts = json.loads(self._text("counts"))
            texts = isinstance(metadata, dict) and all(
                isinstance(text, str) for text in metadata.values()
            )
            if not texts or not isinstance(self.counts, dict | None):
                raise ValueError("arrays 'metadata' and 'counts': expected JSON of a bag")
            self.metadata: dict[str, str] = metadata
        except (KeyError, ArrayFileError, ValueError, RecursionError) as error:
            missing = f"holds no array {error}" if isinstance(error, KeyError) else str(error)
            raise SourceError(f"{path}: {missing}") from error

    def _text(self, name: str) -> str:
        """Return an array that holds one text; raise KeyError or ValueError."""
        array = self._arrays[name]
        if array.shape != () or array.dtype.kind != "U":
            raise ValueError(f"array {name!r}: {array.dtype} {array.shape}; expected one text")
        return str(array)

    def write(self, bag: BagWriter) -> int:
        """Record its messages in the order of their times of recording; the number of taxels'
        frames. Raises SourceError if a message cannot be made of its arrays.
        """
        n_frames = 0
        schemas = [
            one
            for one in SCHEMAS
            if one != End.schema and column_name(one, "stamp_ns") in self._arrays
        ]
        # States first: of equal times theirs is the first.
        schemas.sort(key=lambda schema: not SCHEMAS[schema].latched)
        sources = [self._messages(schema) for schema in schemas]
        for log_time_ns, message in heapq.merge(*sources, key=itemgetter(0)):
            bag.record(message, log_time_ns)
            n_frames += isinstance(message, Taxels)
        return n_frames

    def _messages(self, schema: str) -> Iterator[tuple[int, Message]]:
        try:
            yield from rebuilt(schema, self.patch, self._arrays)
        except (ValueError, TypeError, IndexError, OverflowError) as error:
            topic = topic_of(self.patch, schema)
            raise SourceError(f"{self._path}: {topic}: {error}") from error


def is_export(path: Path) -> bool:
    """True if a file is an .npz of a bag; False too where it cannot be read."""
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    try:
        with open(path, "rb") as file:
            return bool(npz_shapes(file, lambda held: [FORMAT] if FORMAT in held else []))
    except (ArrayFileError, OSError):
        return False
