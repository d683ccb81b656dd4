"""Shrinkage of Haar coefficients in groups: the denoiser of tiles without learned weights."""

from __future__ import annotations

from functools import cache

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats

from .gates import QUIET
from .standing_out import standing_out
from .tiles import TILE, inner

STRICT = 2.5
"""Energy of a group, in its expectation of noise, at which half of it is kept. Chosen on moving
presses and five recordings."""
LEAST = 1e-9
"""Energy that is nothing, in noise variances."""


def shrink(windows: Floats, part: Floats | None = None) -> tuple[Floats, Floats]:
    """Return the denoised tiles of windows of unit noise, and their error, as `Gates.denoise`.

    The orthonormal Haar coefficients of a tile of 8 x 8 form 22 groups: the mean, and the three
    details of each place and level. A group of k coefficients of energy e = |a|^2 is multiplied by

        g(e) = 1 / (1 + (2.5 k / e)^2),

    which has no threshold that could amplify rounding. Its divergence is k g + 4 g (1 - g), and
    Stein's unbiased estimate gives the expected squared error. Groups: Cai, "Adaptive wavelet
    estimation: a block thresholding and oracle inequality approach", Annals of Statistics 27(3),
    1999.
    """
    analysis, groups = _haar()
    count = groups.sum(axis=-1)
    coefficients = inner(windows) @ analysis.T
    energy = coefficients**2 @ groups.T
    noise_share = STRICT * count / (energy + LEAST)
    gain = 1 / (1 + noise_share**2)

    # Stein: the error of a coefficient is what was removed, plus twice its divergence, less 1.
    loss = 1 - gain
    divergence = (gain * (count + 4 * loss)).sum(axis=-1)
    removed = (loss**2 * energy).sum(axis=-1)
    error = (removed + 2 * divergence) / TILE**2 - 1
    error = error.clip(QUIET, 1)

    shrunk = coefficients * (gain @ groups)
    tiles = (shrunk @ analysis).clip(0, None)
    if part is None:
        part = standing_out(windows)
    return part[:, None] * tiles, QUIET + part * (error - QUIET)


@cache
def _haar() -> tuple[Floats, Floats]:
    """The Haar transform of a tile, float32 (64, 64), and its groups, 0 and 1, float32 (22, 64)."""
    rows = [np.full((TILE, TILE), 1 / TILE)]
    groups = [[0]]
    for size in (8, 4, 2):
        flat = np.full(size, size**-0.5)
        sign = np.where(np.arange(size) < size // 2, flat, -flat)
        for row, col in np.ndindex(TILE // size, TILE // size):
            groups.append([len(rows), len(rows) + 1, len(rows) + 2])
            for down, across in ((sign, flat), (flat, sign), (sign, sign)):
                detail = np.zeros((TILE, TILE))
                corner = detail[row * size :, col * size :]
                corner[:size, :size] = np.outer(down, across)
                rows.append(detail)

    analysis = np.array(rows, dtype=np.float32).reshape(-1, TILE**2)
    is_member = np.zeros((len(groups), TILE**2), dtype=np.float32)
    for group, places in enumerate(groups):
        is_member[group, places] = 1
    return analysis, is_member
