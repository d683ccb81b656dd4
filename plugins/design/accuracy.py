"""Accuracy of each strategy on the skin of a design, by simulations that the command runs."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import stdtrit
from tqdm import tqdm

from sparseskin.nodes.numerics.arrays import Doubles, Mask
from sparseskin.nodes.tasks.results import computed

from .budget import Accuracy, Row
from .simulation import contact_db, light_touch, make_reader, presses
from .spec import Design
from .strategies import FEW_SCENES, N_SCENES, Strategy

WITHIN = 0.9
"""Part of the scenes that lie within the band."""


def grid_of(design: Design) -> Mask:
    """Cells on which a skin is simulated, True where a taxel exists: bool (n_rows, n_cols). Points
    are on their virtual grid; those that are only counted on the smallest near square, row by row.
    """
    if design.mask is not None:
        return design.mask
    if design.n_rows is not None and design.n_cols is not None:
        return np.ones((design.n_rows, design.n_cols), dtype=np.bool_)
    side = math.isqrt(design.n_taxels - 1) + 1
    cells = np.arange(-(-design.n_taxels // side) * side) < design.n_taxels
    return cells.reshape(-1, side)


def simulated(rows: Sequence[Row], design: Design, n_scenes: int = FEW_SCENES) -> list[Row]:
    """Return rows with the accuracy of their strategies, each at the rate that it reaches, in the
    first `n_scenes` scenes; in a process each core, with a progress bar on stderr where that is a
    terminal. Raises SparseskinError as `simulate`.
    """
    mask = grid_of(design)
    tasks = {
        k: {
            "strategy": row.strategy,
            "mask": mask,
            "noise": design.noise,
            "bits": design.adc.bits if row.strategy.reads_single else design.bits,
            "rate_hz": row.reached_hz,
            "n_scenes": n_scenes,
        }
        for k, row in enumerate(rows)
    }
    n_workers = min(len(os.sched_getaffinity(0)), len(tasks))
    executor = f"process:{n_workers}" if n_workers > 1 else "serial"
    finished = computed(executor, _simulate, tasks)
    with closing(finished):  # it ends the workers if one of them fails
        progress = tqdm(
            finished, "simulated", len(tasks), file=sys.stderr, disable=None, leave=False
        )
        found = {k: future.result() for k, future in progress}
    return [replace(row, accuracy=found[k]) for k, row in enumerate(rows)]


def _simulate(task: Mapping[str, Any]) -> Accuracy:
    """Simulate in another process: arguments of `simulate` by name."""
    return simulate(**task)


def simulate(
    strategy: Strategy,
    mask: Mask,
    noise: float,
    bits: int,
    rate_hz: float,
    seed: int = 0,
    n_scenes: int = FEW_SCENES,
) -> Accuracy:
    """Simulate a strategy on a skin; `strategy`, `mask`, `noise`, `bits` as of `make_reader`,
    `seed` of scenes, noise and Phi, the first `n_scenes` (2..15) scenes of `simulation`. Raises
    SparseskinError if the strategy is not possible on it.
    """
    dbs = [
        np.mean(
            contact_db(
                make_reader(strategy, mask, noise, bits, seed * N_SCENES + k),
                presses(k, mask, noise, rate_hz, seed),
            )
        )
        for k in range(n_scenes)
    ]
    low, high = band(np.array(dbs))
    touch = light_touch(make_reader(strategy, mask, noise, bits, seed), mask, noise, seed)
    return Accuracy(float(np.mean(dbs)), low, high, touch)


def band(db: Doubles) -> tuple[float, float]:
    """Ends of the interval in which the PSNR of a further scene lies in 90 % of cases.

    Mean -/+ t s sqrt(1 + 1 / n) of n scenes, 2 or more; t is of Student's distribution with n - 1
    degrees of freedom. Source: prediction interval of a normal distribution; Hahn, Meeker,
    "Statistical Intervals", Wiley, 1991, section 4.7.
    """
    n = len(db)
    factor = float(stdtrit(n - 1, (1 + WITHIN) / 2)) * math.sqrt(1 + 1 / n)
    mean, half = float(db.mean()), factor * float(db.std(ddof=1))
    return mean - half, mean + half
