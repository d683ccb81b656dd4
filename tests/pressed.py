"""Frames of a skin under a moving contact, with the noise of a real one: what the tests restore."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Mask
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


def with_errors(
    truths: Iterable[Floats], mask: Mask, seed: int, offset: float, gain: float, dead: float
) -> Iterator[Floats]:
    """Readings with offsets |N(0, offset)|, gains N(1, gain), dead taxels and the paper's noise."""
    n, noise = int(np.count_nonzero(mask)), NoiseModel()
    draws = [np.random.default_rng([seed, 1, k]) for k in range(4)]
    offsets = np.abs(offset * draws[0].standard_normal(n))
    gains = np.maximum(0, 1 + gain * draws[1].standard_normal(n))
    is_dead = draws[3].permutation(n)[: round(dead * n)]
    rng = np.random.default_rng([seed, 2])
    for truth in truths:
        values = np.clip(gains * truth[mask] + offsets, 0, noise.f_max)
        values[is_dead] = 0
        reading = np.zeros_like(truth)
        reading[mask] = noise.apply(values.astype(np.float32), rng)
        yield reading


def psnr_db(estimate: Floats, truth: Floats, f_max: float = 2.5) -> float:
    """PSNR of one frame or of many together."""
    error = estimate.astype(np.float64) - truth
    return 10 * math.log10(f_max**2 / float(np.mean(error**2)))
