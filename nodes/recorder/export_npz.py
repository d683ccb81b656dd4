"""A bag as .npz: arrays for NumPy, and a recording that the sensor's `file:` source reads."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sparseskin.messages import SkinState

from .bag import BagError
from .bag_frames import FRAME_SCHEMAS, frame_topics, frames, patch_of, skin_of
from .bag_reader import BagReader
from .output import new_file, os_errors

NAMES = dict(zip(FRAME_SCHEMAS, FRAME_SCHEMAS, strict=True)) | {"taxels": "forces"}
"""Name of the array that holds a schema's frames."""


def export_npz(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write one .npz a patch.

    Its arrays: `forces` (what the taxels read), `truth`, `reconstruction`, float32 of shape
    (n_frames, n_rows, n_cols); `measurements`, float32 of shape (n_frames, M), NaN behind the
    last one where M changes; a stamp a frame in `stamp_ns` (of `forces`), `truth_stamp_ns`,
    `reconstruction_stamp_ns`, `measurements_stamp_ns`, int64; and of the skin `f_max`, `unit`,
    `mask`, `pitch_m`, `rate_hz`, where known.

    Parameters
    ----------
    out : Path
        OUT.npz; OUT_PATCH.npz each where there are several patches.
    topics : iterable of str, optional
        Only these topics.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    BagError
        If the bag has no such frames, their shape changes, or a file exists or cannot be written.
    """
    wanted = frame_topics(bag, topics)
    patches = sorted({patch_of(topic) for topic in wanted})
    written = []
    for patch in patches:
        path = out if len(patches) == 1 else out.with_name(f"{out.stem}_{patch}{out.suffix}")
        ours = [topic for topic in wanted if patch_of(topic) == patch]
        with new_file(path) as part, os_errors(part), _scratch(path) as folder:
            members = [*_arrays(bag, ours, folder), *_described(skin_of(bag, patch), folder)]
            with zipfile.ZipFile(part, "x", allowZip64=True) as archive:
                for member in members:
                    archive.write(member, member.name)
        written.append(path)
    return written


@contextmanager
def _scratch(path: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        yield Path(folder)


def _arrays(bag: BagReader, topics: list[str], folder: Path) -> list[Path]:
    """Lay the frames down in .npy files: a recording may be larger than the memory."""
    shapes = _shapes(bag, topics)
    arrays: dict[str, npt.NDArray[np.float32]] = {}
    stamps: dict[str, npt.NDArray[np.int64]] = {}
    files = []
    for topic in topics:
        info = bag.topics[topic]
        name = NAMES[info.schema]
        stamps_name = "stamp_ns" if name == "forces" else f"{name}_stamp_ns"
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
    known: dict[str, object] = {"f_max": skin.f_max, "unit": skin.unit}
    if skin.mask is not None:
        known["mask"] = skin.mask
    if skin.pitch_m:
        known["pitch_m"] = skin.pitch_m
    if skin.rate_hz:
        known["rate_hz"] = skin.rate_hz
    files = []
    for name, value in known.items():
        np.save(folder / f"{name}.npy", np.asarray(value))
        files.append(folder / f"{name}.npy")
    return files
