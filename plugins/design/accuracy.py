"""Accuracy of each strategy on the skin of a design, by simulations that the command runs."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import t as student
from tqdm import tqdm

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.sensor.scenes.presses import BODIES, COURSES
from sparseskin.nodes.sensor.sources import forms, open_source
from sparseskin.nodes.tasks.results import computed

from .budget import Accuracy, Row
from .simulation import (
    F_MAX_N,
    FEW_SCENES,
    N_SCENES,
    contact_db,
    light_touch,
    make_reader,
    noise_model,
    presses,
)
from .spec import Design
from .strategies import Strategy

MOST_SOURCE_FRAMES = 2000
"""Most frames of a stated scene that are simulated. Chosen: some seconds for each strategy."""
WITHIN = 0.9
"""Part of the scenes that lie within the band."""


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


def simulated(
    rows: Sequence[Row],
    design: Design,
    seed: int,
    *,
    scene: str | None = None,
    n_scenes: int = FEW_SCENES,
) -> list[Row]:
    """Return rows with the accuracy of their strategies, each at the rate that it reaches.

    The strategies are simulated side by side, in a process each core. Progress is written to stderr
    where that is a terminal. Parameters as those of `simulate`. Raises SparseskinError as
    `simulate` does.
    """
    mask = grid_of(design)
    tasks = {
        k: {
            "strategy": row.strategy,
            "mask": mask,
            "noise": design.noise,
            "bits": design.adc.bits if row.strategy.reads_single else design.bits,
            "rate_hz": row.reached_hz,
            "seed": seed,
            "scene": scene,
            "n_scenes": n_scenes,
        }
        for k, row in enumerate(rows)
    }
    # A scene that a module of the user's own makes is imported here, and its faults are shown here.
    n_workers = 1 if scene and ":" in scene else min(len(os.sched_getaffinity(0)), len(tasks))
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
    seed: int,
    scene: str | None = None,
    n_scenes: int = FEW_SCENES,
) -> Accuracy:
    """Simulate a strategy on a skin. Raises SettingsError if the scene's skin is another one, or
    nothing touches it; SparseskinError if the strategy is not possible on the skin, or the scene
    cannot be read.

    Parameters
    ----------
    strategy, mask, noise, bits
        As of `make_reader`.
    rate_hz : float
    seed : int
        Of scenes, noise and Phi.
    scene : str, optional
        A body of `presses.BODIES`, pressed in each course; or a source of frames as a sensor node
        takes it (scene:NAME, file:PATH, module:callable), whose frames are the true forces. Of
        its frames those next to the ticks of the rate are read, 2000 at most. None: the first
        scenes of `simulation`.
    n_scenes : int
        Number of scenes, 2..15.

    Returns
    -------
    Accuracy
        Band: `band` of the scenes; of one source, percentiles 5 and 95 of its contact frames.
    """

    def score(frames: Iterator[tuple[Floats, Floats]], k: int) -> list[float]:
        reader = make_reader(strategy, mask, noise, bits, seed * N_SCENES + k)
        return contact_db(reader, frames)

    note = ""
    if scene is None or scene in BODIES:
        numbers = range(n_scenes if scene is None else len(COURSES))
        dbs = [
            float(np.mean(score(presses(k, mask, noise, rate_hz, seed, scene), k))) for k in numbers
        ]
        low, high = band(np.array(dbs))
    else:
        frames, note = _of_source(scene, mask, noise, rate_hz, seed)
        dbs = score(frames, 0)
        low, high = np.percentile(dbs, [5, 95])
    touch = light_touch(make_reader(strategy, mask, noise, bits, seed), mask, noise, seed)
    light = math.nan if touch is None else touch
    return Accuracy(float(np.mean(dbs)), float(low), float(high), light, note)


def band(db: Doubles) -> tuple[float, float]:
    """Ends of the interval in which the PSNR of a further scene lies in 90 % of cases.

    Mean -/+ t s sqrt(1 + 1 / n) of n scenes, 2 or more; t is of Student's distribution with n - 1
    degrees of freedom.

    Notes
    -----
    Source: prediction interval of a normal distribution; Hahn, Meeker, "Statistical Intervals",
    Wiley, 1991, section 4.7.
    """
    n = len(db)
    factor = float(student.ppf((1 + WITHIN) / 2, n - 1)) * math.sqrt(1 + 1 / n)
    mean, half = float(db.mean()), factor * float(db.std(ddof=1))
    return mean - half, mean + half


def _of_source(
    name: str, exists: Mask, noise: float, rate_hz: float, seed: int
) -> tuple[Iterator[tuple[Floats, Floats]], str]:
    """Frames (truth, readings) of a source in the range of the simulation, and a note."""
    if ":" not in name:
        raise SettingsError(
            f"scene: {name!r} is not known; allowed: {', '.join(BODIES)}, {forms()}"
        )
    source = open_source(name, seed=seed)
    skin: Skin = source.skin
    if not np.array_equal(skin.exists, exists):
        raise SettingsError(
            f"scene {name}: its skin has {skin.n_taxels} taxels on {skin.n_rows} x {skin.n_cols}; "
            f"expected {np.count_nonzero(exists)} on {exists.shape[0]} x {exists.shape[1]}"
        )
    note = ""
    if source.rate_hz is not None and source.rate_hz < rate_hz * 0.99:
        note = f"the scene has {source.rate_hz:.4g} Hz: its frames are read once each"

    def frames() -> Iterator[tuple[Floats, Floats]]:
        model, rng = noise_model(noise), np.random.default_rng([seed, 6])
        scale, n_read = np.float32(F_MAX_N / skin.f_max), 0
        # Half of the shortest time between frames: the frame next to the tick.
        early_s = 0.5 / source.rate_hz if source.rate_hz else 0.0
        first_ns = None
        for stamp_ns, forces in source:
            first_ns = stamp_ns if first_ns is None else first_ns
            if (stamp_ns - first_ns) * 1e-9 + early_s < n_read / rate_hz:
                continue
            n_read += 1
            truth = np.clip(forces * scale, 0, np.float32(F_MAX_N))
            taxels = model.apply(truth, rng)
            taxels[~exists] = 0
            yield truth, taxels
            if n_read >= MOST_SOURCE_FRAMES:
                return

    return frames(), note
