"""Export of a bag to .npz: arrays for NumPy and for the sensor's `file:` source."""

from __future__ import annotations

import tempfile
import zipfile
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
    shapes = _shapes(bag, topics)
    arrays: dict[str, npt.NDArray[np.float32]] = {}
    stamps: dict[str, npt.NDArray[np.int64]] = {}
    files = []
    for topic in topics:
        info = bag.topics[topic]
        name, stamps_name = array_names(info.schema)
        paths = [folder / f"{name}.npy", folder / f"{stamps_name}.npy"]
        arrays[topic] = np.lib.format.open_memmap(
            paths[0], mode="w+", dtype=np.float32, shape=(info.n_messages, *shapes[topic])
        )
        stamps[topic] = np.lib.format.open_memmap(
            paths[1], mode="w+", dtype=np.int64, shape=(info.n_messages,)
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


def _shapes(bag: BagReader, topics: list[str]) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for frame in frames(bag, topics, "measure"):
        topic, shape = frame.message.topic, frame.array.shape
        known = shapes.setdefault(topic, shape)
        if len(shape) == 1:
            shapes[topic] = max(known, shape)
        elif shape != known:
            raise BagError(
                f"{bag.path}: {topic}, stamp {frame.message.stamp_ns}: a frame of "
                f"{shape[0]} x {shape[1]} after some of {known[0]} x {known[1]}"
            )
    return shapes


def _described(skin: SkinState | None, folder: Path) -> list[Path]:
    if skin is None:
        return []
    files = []
    for name, value in described(skin, skin.rate_hz).items():
        np.save(folder / f"{name}.npy", np.asarray(value))
        files.append(folder / f"{name}.npy")
    return files
