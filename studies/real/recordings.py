"""Recordings of real skins as study `real` takes them: files of a folder, and a part of each."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sparseskin.arrays import read_recording
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX
from sparseskin.nodes.sensor.files.recorded import SUFFIXES
from sparseskin.studies.points import StudyError

from .methods import Skin

LOADED = 0.1
"""Part of the 95th percentile of the frames' norms above which a frame is loaded. Chosen: below it
a relative error is one of the sensor's offset and noise."""
UNTOUCHED, GHOST = 0.01, 0.05
"""Parts of the 95th percentile of the frames' totals: a frame below the first is untouched, and a
reconstruction of it above the second is a ghost. Chosen."""


class Recording(NamedTuple):
    """A part of a recording.

    Attributes
    ----------
    frames, truth : ndarray of float32, shape (n_frames, n_rows, n_cols)
        Readings, and what a reconstruction is compared with: true forces where the recording knows
        them, or else the readings.
    skin : Skin
    unit : str
    spacing_ms : float or None
        Time between frames, where the recording states its rate.
    first, n_recorded : int
        Number of the first of these frames, and of all that were recorded.
    norm, total : float
        95th percentiles of the frames' norms and totals, over the frames of the whole recording in
        which anything touches the skin.
    """

    frames: Floats
    truth: Floats
    skin: Skin
    unit: str
    spacing_ms: float | None
    first: int
    n_recorded: int
    norm: float
    total: float


def files_in(folder: Path) -> list[Path]:
    """Return the files of a folder whose suffix is that of a recording, by name.

    Raises
    ------
    StudyError
        If the folder cannot be read, or has none.
    """
    suffixes = (*SUFFIXES, FILE_SUFFIX)
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    except OSError as error:
        raise StudyError(f"--recordings {folder}: {error.strerror}") from error
    if not files:
        raise StudyError(f"--recordings {folder}: no recording; allowed are {', '.join(suffixes)}")
    return files


def digest_of(path: Path) -> str:
    """Return 16 hexadecimal characters that change with the content of a file."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error


@cache
def part_of(path: str, n_most: int) -> Recording:
    """Read a recording, and return its part of at most `n_most` frames with most loaded ones.

    Of several such parts it is the one next to the middle of the recording.

    Raises
    ------
    SparseskinError
        If the file cannot be read, holds no readings, or nothing touches the skin.
    """
    read = read_recording(path)
    if "forces" not in read:
        raise SparseskinError(f"{path}: holds no readings of taxels")
    frames = read["forces"]
    truth = read.get("truth", frames)
    if truth.shape != frames.shape:
        raise SparseskinError(
            f"{path}: {len(truth)} frames of true forces, but {len(frames)} of readings"
        )
    mask = read.get("mask", np.ones(frames.shape[1:], dtype=np.bool_))
    flat = truth[:, mask].astype(np.float64)
    norms, totals = np.linalg.norm(flat, axis=1), flat.sum(axis=1)
    touched = norms > 0
    if not touched.any():
        raise SparseskinError(f"{path}: nothing touches the skin, all readings are 0")
    norm, total = (float(np.percentile(of[touched], 95)) for of in (norms, totals))
    first = _busiest(norms > LOADED * norm, n_most)
    part = slice(first, first + n_most)
    skin = Skin(mask, float(read["f_max"]))
    spacing_ms = 1e3 / float(read["rate_hz"]) if "rate_hz" in read else None
    return Recording(
        *(frames[part], truth[part], skin, read["unit"], spacing_ms),
        *(first, len(frames), norm, total),
    )


def _busiest(loaded: np.ndarray[tuple[int], np.dtype[np.bool_]], n_most: int) -> int:
    """Return the first frame of the part of `n_most` frames with most loaded ones."""
    if loaded.size <= n_most:
        return 0
    counts = np.convolve(loaded, np.ones(n_most, dtype=np.intp), "valid")
    best = np.flatnonzero(counts == counts.max())
    return int(best[np.argmin(np.abs(best - (counts.size - 1) / 2))])
