"""Frames, readings, solvers and scores that the parts of the stability study share."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import Solver, make_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.touch import in_contact
from sparseskin.studies.frames import scene_frames

#: Scene, first frame, stop and stride: an impact frame by frame, and at 100 Hz a wrench dragged
#: and a light peg on its way.
EXCERPTS = (
    ("lift_box_40", 316, 356, 1),
    ("drag_wrench_40", 2500, 2900, 10),
    ("path_40", 1500, 1900, 10),
)
SHAPE = (40, 40)
N = math.prod(SHAPE)
BLOWN_UP_DB = -100.0
"""PSNR that stands for a reconstruction that is not finite."""
MAX_PADS, MAX_SIDE = 300, 12
SCORES = ("psnr_db", "touched_db", "noisy_psnr_db", "noisy_touched_db")
"""Names of what `scores` returns: figures of reconstructed frames and of readings."""


@cache
def excerpt(k: int) -> Floats:
    """True forces of excerpt k of `EXCERPTS`, float32 of shape (40, 40, 40), N."""
    scene, first, stop, every = EXCERPTS[k]
    frames = np.stack([truth for truth, _ in scene_frames(scene, 0, first, stop, every)])
    frames.setflags(write=False)
    return frames


def read_excerpts(seed: int, factor: float = 1.0) -> Iterator[tuple[Floats, Floats]]:
    """Yield each excerpt: true forces and readings."""
    for k in range(len(EXCERPTS)):
        yield excerpt(k), read(excerpt(k), np.random.default_rng((seed, k)), factor)


def read(truth: Floats, rng: np.random.Generator, factor: float = 1.0) -> Floats:
    """Readings of true forces: the paper's noise times a factor, clipped to the range."""
    paper = NoiseModel.for_range(PAPER_F_MAX_N)
    sigmas = [min(factor * sigma, PAPER_F_MAX_N) for sigma in (paper.sigma_mid, paper.sigma_end)]
    return NoiseModel(PAPER_F_MAX_N, *sigmas).apply(truth, rng)


def solver_for(name: str, phi: Phi, shape: tuple[int, int], **changed: Any) -> Solver:
    """A solver with the settings of its preset, or its defaults, some of them changed."""
    presets = (preset for preset in PRESETS.values() if preset["solver"] == name)
    settings = {"basis": "haar", **next(presets, {}), **changed}
    settings.pop("solver", None)
    basis = make_basis(settings.pop("basis"), *shape)
    return make_solver(name, phi, basis, **settings)


def measured(phi: Phi, frames: Floats) -> Floats:
    """Measurements of frames, float32 of shape (n_frames, m)."""
    return phi.forward(frames.reshape(len(frames), -1))


def reconstruct(solver: Solver, ys: Floats) -> Floats:
    """Reconstruct frame after frame; a frame that blows up is NaN."""
    frames = []
    for y in ys:
        with np.errstate(all="ignore"):  # a solver that diverges is expected to overflow
            try:
                frames.append(solver.solve(y))
            except SolverError:
                frames.append(np.full(solver.mask.shape, np.nan, np.float32))
    return np.stack(frames)


def mean_psnr(frames: Floats, truth: Floats) -> float:
    """Mean PSNR over the frames in contact, dB; of each from `BLOWN_UP_DB` to 100."""
    contact = [in_contact(frame, PAPER_F_MAX_N) for frame in truth]
    with np.errstate(all="ignore"):
        errors = np.mean(np.square(frames - truth, dtype=np.float64), axis=(1, 2))
        db = np.nan_to_num(10 * np.log10(PAPER_F_MAX_N**2 / errors), nan=BLOWN_UP_DB)
    return float(np.mean(np.clip(db, BLOWN_UP_DB, 100.0)[contact]))


def touched_snr(frames: Floats, truth: Floats) -> float:
    """Signal over error on the taxels that are truly pressed, dB; 0 for frames of zeros.

    In PSNR, a peg that presses 14 taxels of 1600 hardly counts.
    """
    pressed = truth > 0.0
    with np.errstate(all="ignore"):
        error = float(np.sum(np.square(frames - truth, dtype=np.float64)[pressed]))
    if not math.isfinite(error):
        return BLOWN_UP_DB
    signal = float(np.sum(np.square(truth[pressed], dtype=np.float64)))
    return max(BLOWN_UP_DB, 10.0 * math.log10(signal / max(error, 1e-12)))


def scores(frames: Floats, readings: Floats, truth: Floats) -> list[float]:
    """`SCORES` of one excerpt, dB: PSNR over contact frames, SNR over touched taxels, of both."""
    both = (frames, readings)
    return [score for some in both for score in (mean_psnr(some, truth), touched_snr(some, truth))]


def contacts(shape: tuple[int, int], n_coefficients: int, rng: np.random.Generator) -> Floats:
    """Pads pressed on the skin until the frame has about so many Haar coefficients.

    `n_coefficients`, K, is met within a tenth where pads of whole taxels allow it; never more.
    Returns forces in newtons, 0.2 to 1.5 under each pad: float32, shape (n_rows, n_cols).
    """
    basis = make_basis("haar", *shape)
    frame = np.zeros(shape, np.float32)
    for _ in range(MAX_PADS):
        sides = rng.integers(1, MAX_SIDE + 1, 2)
        row, col = rng.integers(0, np.array(shape) - sides + 1)
        trial = frame.copy()
        trial[row : row + sides[0], col : col + sides[1]] = rng.uniform(0.2, 1.5)
        count = count_coefficients(basis.analysis(trial))
        if count <= n_coefficients:
            frame = trial
            if count > 0.9 * n_coefficients:
                break
    return frame


def count_coefficients(theta: Floats) -> int:
    """Number of coefficients of a noise-free frame that are not 0 beyond rounding."""
    return int(np.count_nonzero(np.abs(theta) > 1e-5 * PAPER_F_MAX_N))
