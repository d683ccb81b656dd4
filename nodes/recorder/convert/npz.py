"""Export of a bag to .npz: arrays for NumPy and for the sensor's `file:` source."""

from __future__ import annotations

import math
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sparseskin.messages import SkinState
from sparseskin.nodes.files import os_errors, whole_file
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    array_names,
    described,
    frame_topics,
    frames,
    patch_of,
    skin_of,
)
from sparseskin.nodes.recorder.bag.reader import BagReader

MAX_PADDING = 8
"""Most numbers with padding, in those recorded, where M changes; up to `MAX_PADDED`, any."""
MAX_PADDED = 1 << 20


def export_npz(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write one .npz a patch, `out` or OUT_PATCH.npz each for several patches; their paths.

    Its arrays: `forces` (the taxels' readings), `truth`, `reconstruction`, float32 of shape
    (n_frames, n_rows, n_cols); `measurements`, float32 of shape (n_frames, M), padded with NaN
    where M changes; a stamp a frame in `stamp_ns` (of `forces`), `truth_stamp_ns`,
    `reconstruction_stamp_ns`, `measurements_stamp_ns`, int64; and the skin's `f_max`, `unit`,
    `mask`, `pitch_m`, `rate_hz`, where known.

    Raises BagError if the bag has no such frames or their shape changes, OutputError if a file
    exists or cannot be written.
    """
    wanted = frame_topics(bag, topics)
    patches = sorted({patch_of(topic) for topic in wanted})
    written = []
    for patch in patches:
        path = out if len(patches) == 1 else out.with_name(f"{out.stem}_{patch}{out.suffix}")
        ours = [topic for topic in wanted if patch_of(topic) == patch]
        with (
            whole_file(path) as draft,
            os_errors(path),
            tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as scratch,
        ):
            folder = Path(scratch)
            members = [*_arrays(bag, ours, folder), *_described(skin_of(bag, patch), folder)]
            with zipfile.ZipFile(draft, "x", allowZip64=True) as archive:
                for member in members:
                    archive.write(member, member.name)
        written.append(path)
    return written


def _arrays(bag: BagReader, topics: list[str], folder: Path) -> list[Path]:
    """Write the frames to .npy files: a recording may be larger than the memory."""
    shapes, counts = _measured(bag, topics)
    arrays: dict[str, npt.NDArray[np.float32]] = {}
    stamps: dict[str, npt.NDArray[np.int64]] = {}
    files = []
    for topic in topics:
        name, stamps_name = array_names(bag.topics[topic].schema)
        paths = [folder / f"{name}.npy", folder / f"{stamps_name}.npy"]
        arrays[topic] = np.lib.format.open_memmap(
            paths[0], mode="w+", dtype=np.float32, shape=(counts[topic], *shapes[topic])
        )
        stamps[topic] = np.lib.format.open_memmap(
            paths[1], mode="w+", dtype=np.int64, shape=(counts[topic],)
        )
        files += paths
    filled = dict.fromkeys(topics, 0)
    for frame in frames(bag, topics, "export"):
        topic, k = frame.message.topic, filled[frame.message.topic]
        if frame.array.ndim == 1:
            arrays[topic][k] = np.nan
        arrays[topic][k, : len(frame.array)] = frame.array
        stamps[topic][k] = frame.message.stamp_ns
        filled[topic] += 1
    return files


def _measured(bag: BagReader, topics: list[str]) -> tuple[dict[str, tuple[int, ...]], Counter[str]]:
    """Shape and number of the frames of each topic, as they are; the file may state others."""
    shapes: dict[str, tuple[int, ...]] = {}
    counts: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    for frame in frames(bag, topics, "measure"):
        topic, shape = frame.message.topic, frame.array.shape
        counts[topic] += 1
        sizes[topic] += frame.array.size
        known = shapes.setdefault(topic, shape)
        if len(shape) == 1:
            shapes[topic] = max(known, shape)
        elif shape != known:
            raise BagError(
                f"{bag.path}: {topic}, stamp {frame.message.stamp_ns}: a frame of "
                f"{shape[0]} x {shape[1]} after some of {known[0]} x {known[1]}"
            )
    for topic in topics:
        if topic not in shapes:
            raise BagError(f"{bag.path}: {topic}: states messages, but holds none")
        padded = counts[topic] * math.prod(shapes[topic])
        if padded > max(MAX_PADDED, MAX_PADDING * sizes[topic]):
            raise BagError(
                f"{bag.path}: {topic}: {sizes[topic]} numbers would be padded to {padded}; at most "
                f"{MAX_PADDING} times as many are allowed; export to csv"
            )
    return shapes, counts


def _described(skin: SkinState | None, folder: Path) -> list[Path]:
    if skin is None:
        return []
    files = []
    for name, value in described(skin, skin.rate_hz).items():
        np.save(folder / f"{name}.npy", np.asarray(value))
        files.append(folder / f"{name}.npy")
    return files
