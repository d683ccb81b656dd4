"""Frames of a skin under a moving contact, with the noise of a real one: what the tests restore."""

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel


def sliding_disc(
    shape: tuple[int, int],
    n_frames: int,
    *,
    touch_at: int = 5,
    peak_n: float = 0.6,
    f_max: float = 2.5,
) -> Floats:
    """A disc that comes down at a frame, stays, and slides along a row; newtons, no noise."""
    rows, cols = np.indices(shape)
    radius = min(shape) / 5
    frames = np.zeros((n_frames, *shape), dtype=np.float32)
    for t in range(touch_at, n_frames):
        centre = shape[1] / 3 + 0.02 * (t - touch_at)
        distance = np.hypot(rows - shape[0] / 2, cols - centre)
        rise = min(1.0, (t - touch_at + 1) / 5)
        frames[t] = peak_n * rise * np.clip(radius + 0.5 - distance, 0, 1)
    return np.minimum(frames, f_max)


def noisy(frames: Floats, seed: int = 0, f_max: float = 2.5) -> Floats:
    """The readings of a skin with the paper's noise."""
    return NoiseModel.for_range(f_max).apply(frames, np.random.default_rng(seed))


def psnr_db(estimate: Floats, truth: Floats, f_max: float = 2.5) -> float:
    """PSNR of one frame or of many together."""
    error = estimate.astype(np.float64) - truth
    return 10 * math.log10(f_max**2 / float(np.mean(error**2)))
