"""Ways to read a frame that a classifier is given: the numbers of each, and their bytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sparseskin.nodes.compressor.phi.rotation import m_of
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.baselines.larger import LargerTaxels
from sparseskin.studies.baselines.sampling import classes
from sparseskin.studies.evaluate import VALUE_BYTES, Method, make_method

ALL = "all taxels"
FORCES = "reconstructed forces"
SUMS = "measurements y"
SINGLE = "single taxels"
LARGER = "sums of neighbours"


def _method(frames: Floats, ratio: int, seed: int) -> Method:
    """Fixed scrambled sums and the default solver; the range is the largest reading."""
    shape = (frames.shape[1], frames.shape[2])
    f_max = float(frames.max())
    return make_method(PRESETS["skin"], shape, ratio, seed, f_max_n=f_max)


def _all(frames: Floats, ratio: int, seed: int) -> Floats:
    return frames.reshape(len(frames), -1)


def _forces(frames: Floats, ratio: int, seed: int) -> Floats:
    """Each frame by itself, without those before it."""
    method = _method(frames, ratio, seed)
    forces = np.empty((len(frames), frames[0].size), dtype=np.float32)
    for k, frame in enumerate(frames):
        # A classifier gets frames in any order: nothing is carried between them.
        method.reset()
        solved = method.reconstruct(frame)
        forces[k] = solved.forces.reshape(-1)
    return forces


def _sums(frames: Floats, ratio: int, seed: int) -> Floats:
    method = _method(frames, ratio, seed)
    return np.stack([method.measure(frame) for frame in frames])


def _single(frames: Floats, ratio: int, seed: int) -> Floats:
    """An even lattice of taxels, of N / ratio at most."""
    mask = np.ones(frames.shape[1:], dtype=np.bool_)
    m = m_of(mask.size, ratio)
    lattices = [cells for cells in classes(mask, ratio) if cells.size <= m]
    read = max(lattices, key=np.size)
    return frames.reshape(len(frames), -1)[:, read]


def _larger(frames: Floats, ratio: int, seed: int) -> Floats:
    mask = np.ones(frames.shape[1:], dtype=np.bool_)
    larger = LargerTaxels(mask, m_of(mask.size, ratio))
    return np.stack([larger.sums(frame) for frame in frames])


WAYS: dict[str, Callable[[Floats, int, int], Floats]] = {
    ALL: _all,
    FORCES: _forces,
    SUMS: _sums,
    LARGER: _larger,
    SINGLE: _single,
}
"""Ways to read, by name: numbers (n, d) of frames, float32 (n, n_rows, n_cols), at N / `ratio` with
Phi of `seed`. Of all taxels the ratio is 1."""


def n_bytes(n_taxels: int, ratio: int) -> int:
    """Bytes of a frame that the edge sends, `VALUE_BYTES` a number."""
    return VALUE_BYTES * m_of(n_taxels, ratio)
