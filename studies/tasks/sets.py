"""Public sets of tactile frames with labels, which the user has: STEMNIST, and frames in .npz."""

from __future__ import annotations

import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sparseskin.nodes.errors import not_installed
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.studies.points import StudyError

STEMNIST_SHAPE = (16, 16)
MOST_STEPS = 10_000
"""Readings of a recording of STEMNIST (it has 240) beyond which it is refused."""
MOST_VALUES = 256_000_000
"""Numbers of a set in .npz, 1 GB in float32, beyond which it is refused."""
SET_FILE = "*.npz"
TEST_PART = 4
"""One in so many examples, or groups, is for the test."""


class LabelledFrames(NamedTuple):
    """A set: frames, float32 (n, n_rows, n_cols), at least 0, any unit; n labels; n names of the
    groups (such as the participant), of which no one is both in training and in test; its name.
    """

    frames: Floats
    labels: np.ndarray[Any, Any]
    groups: np.ndarray[Any, Any]
    name: str

    def is_test(self, seed: int) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Marks of the examples for the test: those of a fourth of the groups, drawn by `seed`."""
        groups, of_example = np.unique(self.groups, return_inverse=True)
        order = np.random.default_rng([seed, 35]).permutation(groups.size)
        return np.asarray((order < max(1, groups.size // TEST_PART))[of_example])


def read_set(folder: str) -> LabelledFrames:
    """Read the set in a folder: STEMNIST (`RawCharacters/PERSON_LABEL_NUMBER.h5`), or one .npz.

    Raises StudyError, one line, if the folder holds neither, or a file is not as described.
    """
    path = Path(folder)
    if not path.is_dir():
        raise StudyError(f"--data {folder}: no such folder")
    characters = sorted(path.rglob("RawCharacters/*.h5"))
    if characters:
        return _stemnist(characters)
    arrays = sorted(path.glob(SET_FILE))
    if len(arrays) != 1:
        allowed = "RawCharacters/*.h5 (STEMNIST), or one .npz of frames and labels"
        text = f"{len(arrays)} files .npz; allowed: {allowed}"
        raise StudyError(f"--data {folder}: {text}")
    return _arrays(arrays[0])


def _stemnist(paths: list[Path]) -> LabelledFrames:
    """STEMNIST: characters that people write on 16 x 16 taxels, 240 frames of 8 bits each.

    A character is one frame: the largest reading of each taxel above its median. Layout: DOI
    10.5281/zenodo.19469535; arXiv 2601.01658.
    """
    if find_spec("h5py") is None:
        raise StudyError(f"--data: {not_installed('h5py', 'hdf5')}")
    frames = np.empty((len(paths), *STEMNIST_SHAPE), dtype=np.float32)
    labels = []
    people = []
    for k, path in enumerate(paths):
        person, label, number = [*path.stem.split("_"), "", ""][:3]
        if len(label) != 1 or not number.isdecimal():
            raise StudyError(
                f"{path}: expected a name as AT_A_1.h5: person, label, number"
            )
        readings = _pressures(path).astype(np.float32)
        # At rest a taxel reads its median; the character is what is written in all of its time.
        frames[k] = np.maximum(readings - np.median(readings, axis=0), 0).max(axis=0)
        labels.append(label)
        people.append(person)
    return LabelledFrames(frames, np.array(labels), np.array(people), "STEMNIST")


def _pressures(path: Path) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Readings of a recording of STEMNIST, uint8 (n, 16, 16)."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            data = file["pressure_data"]
            shape = tuple(data.shape)
            # Checked before it is read into memory.
            is_as_expected = shape[1:] == STEMNIST_SHAPE and 0 < shape[0] <= MOST_STEPS
            if not is_as_expected or data.dtype != np.uint8:
                expected = f"uint8 (1..{MOST_STEPS}, 16, 16)"
                raise StudyError(
                    f"{path}: pressure_data is {data.dtype} {shape}, not {expected}"
                )
            return np.asarray(data[()])
    except (OSError, KeyError, AttributeError, RuntimeError) as error:
        raise StudyError(
            f"{path}: no recording of STEMNIST: pressure_data is missing"
        ) from error


def _arrays(path: Path) -> LabelledFrames:
    """A set in .npz: frames (n, n_rows, n_cols), labels (n,), and groups (n,) if there are some."""
    names = ("frames", "labels", "groups")
    try:
        # An archive may grow a thousand times: its sizes are read first.
        with zipfile.ZipFile(path) as archive:
            n_bytes = sum(member.file_size for member in archive.infolist())
        if n_bytes > 8 * MOST_VALUES:
            raise StudyError(f"{path}: more than {MOST_VALUES:,} numbers")
        with np.load(path, allow_pickle=False) as arrays:
            parts = {name: arrays[name] for name in names if name in arrays}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise StudyError(f"{path}: no .npz of numbers and texts can be read") from error

    missing = [name for name in ("frames", "labels") if name not in parts]
    if missing:
        raise StudyError(
            f"{path}: no array {missing[0]!r}; needed are frames and labels"
        )

    frames = parts["frames"]
    if frames.ndim != 3 or not frames.size or frames.dtype.kind not in "iuf":
        kind = f"{frames.dtype} {frames.shape}"
        raise StudyError(f"{path}: frames are {kind}, not numbers (n, n_rows, n_cols)")
    frames = frames.astype(np.float32)
    if not np.isfinite(frames).all() or frames.min() < 0:
        raise StudyError(f"{path}: frames hold a number that is negative or not finite")

    # Without groups, each example is one.
    groups = parts.get("groups", np.arange(len(frames)))
    for name, array in (("labels", parts["labels"]), ("groups", groups)):
        if array.shape != (len(frames),):
            raise StudyError(
                f"{path}: {name} are {array.shape}, not ({len(frames)},) as frames"
            )
    return LabelledFrames(frames, parts["labels"], groups, path.stem)
