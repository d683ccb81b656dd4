"""Accuracy of a design's rows by simulations of the skin itself, beside the stored grid."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from sparseskin.nodes.numerics.arrays import Mask

from .accuracy import simulate
from .budget import Row
from .models.wires import reads_single
from .spec import Design
from .text import aligned


def grid_of(design: Design) -> Mask:
    """Cells on which a skin is simulated, True where a taxel exists: bool (n_rows, n_cols).

    Points are on their virtual grid; of those that are only counted, on the smallest near square
    that holds them, row by row.
    """
    if design.mask is not None:
        return design.mask
    if design.n_rows is not None and design.n_cols is not None:
        return np.ones((design.n_rows, design.n_cols), dtype=np.bool_)
    side = math.isqrt(design.n_taxels - 1) + 1
    cells = np.arange(-(-design.n_taxels // side) * side) < design.n_taxels
    return cells.reshape(-1, side)


def simulated(rows: Sequence[Row], design: Design, scene: str | None, seed: int) -> list[Row]:
    """Return rows whose accuracy is simulated, each at the rate that it reaches.

    `scene` and `seed` are those of `accuracy.simulate`. Progress is written to stderr where that is
    a terminal.

    Raises
    ------
    SparseskinError
        As `accuracy.simulate` does.
    """
    mask = grid_of(design)
    found = []
    for row in tqdm(rows, "simulated", file=sys.stderr, disable=None, leave=False):
        bits = design.adc.bits if reads_single(row.strategy) else design.bits
        made = simulate(
            row.strategy.name,
            mask.shape[0],
            mask.shape[1],
            design.noise,
            bits,
            row.reached_hz,
            seed,
            scene,
            mask=mask,
        )
        found.append(replace(row, accuracy=made))
    return found


def comparison(rows: Sequence[Row], simulations: Sequence[Row]) -> str:
    """Table of the stored grid beside simulations of the same rows: PSNR, and if it is in the band
    of the grid.
    """
    lines = []
    for row, other in zip(rows, simulations, strict=True):
        a, b = row.accuracy, other.accuracy
        within = "-" if math.isnan(a.psnr_db) else "no"
        if a.low_db <= b.psnr_db <= a.high_db:
            within = "yes"
        lines.append(
            (
                row.strategy.name,
                f"{row.reached_hz:.0f}",
                f"{a.psnr_db:.1f}",
                f"{a.low_db:.1f} .. {a.high_db:.1f}",
                f"{b.psnr_db:.1f}",
                within,
                f"{1e3 * row.light_touch_n:.3g}",
                f"{1e3 * other.light_touch_n:.3g}",
            )
        )
    columns = ("strategy", "Hz", "grid, dB", "band", "simulated, dB", "in the band")
    return aligned((*columns, "touch, mN", "simulated, mN"), lines, (0,))
