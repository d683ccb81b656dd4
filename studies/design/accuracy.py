"""Accuracy of a strategy on a skin: from the stored grid, or by a simulation of its own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.sensor.scenes.presses import BODIES, COURSES
from sparseskin.nodes.sensor.sources import FORMS, open_source

from .grid import BEYOND, band, stored_grid
from .simulation import (
    F_MAX_N,
    MOST_TAXELS,
    N_SCENES,
    check_conditions,
    contact_db,
    light_touch,
    make_reader,
    noise_model,
    presses,
    strategy_of,
)

MOST_FRAMES = 2000
"""Most frames of a stated scene that are simulated. Chosen: some seconds for each strategy."""


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of a strategy.

    Attributes
    ----------
    psnr_db : float
        Mean PSNR of contact frames, peak f_max; NaN where it is not available.
    low_db, high_db : float
        Band of 90 % of the scenes, widened by the error of the interpolation.
    light_touch : float
        Least force a taxel, as a part of the range, at which a touch of 3 x 3 taxels is found
        within 8 frames in 90 % of cases; NaN where none is found, or it is not available.
    interpolated : bool
        True if the figures are of the grid, False if they were simulated.
    note : str
        "", or why figures are extrapolated or not available.
    """

    psnr_db: float
    low_db: float
    high_db: float
    light_touch: float
    interpolated: bool
    note: str = ""


def accuracy(
    strategy: str, n_taxels: int, noise: float, bits: int, rate_hz: float, aspect: float = 1.0
) -> Accuracy:
    """Interpolate the accuracy of a strategy in the stored grid; scenes as in `simulation`.

    Parameters
    ----------
    strategy : str
        A name of `STRATEGIES`.
    n_taxels : int
        Taxels of a patch, 1 or more.
    noise : float
        Standard deviation of a taxel's noise, as a part of the range, 1e-6..0.3.
    bits : int
        Of a value that is read or sent, 2..24.
    rate_hz : float
        Frame rate, above 0.
    aspect : float
        Columns a row of the skin, above 0.

    Returns
    -------
    Accuracy
        Its note states what lies outside the grid: up to 4 times outside it is extrapolated along
        the outermost points, and the band reaches back to the figure at the edge of the grid;
        farther it is NaN. Rates above the grid's have the figures of its highest rate, and skins
        that are more than 4 times narrower than its narrowest those of 4 times.

    Raises
    ------
    SettingsError
        If an argument is not allowed.
    """
    strategy_of(strategy)
    if not is_whole(n_taxels, 1):
        raise SettingsError(f"taxels: {n_taxels!r} is not allowed; allowed: a whole number from 1")
    if not (is_real(rate_hz, 0) and rate_hz > 0):
        raise SettingsError(f"rate: {rate_hz!r} Hz is not allowed; allowed: a number above 0")
    if not (is_real(aspect, 0) and aspect > 0):
        raise SettingsError(f"aspect: {aspect!r} is not allowed; allowed: a number above 0")
    check_conditions(noise, bits, 1.0)
    grid = stored_grid()
    axes, table = grid.axes, grid.tables[strategy]
    limits = {
        "taxels": f"{axes.n_taxels[0]}..{axes.n_taxels[-1]} taxels",
        "noise": f"noise and rounding of {axes.noise[0]:.1%}..{axes.noise[-1]:.0%} of the range",
        "rate": f"{axes.all_rates_hz[0]:g}..{axes.all_rates_hz[-1]:g} Hz",
        "shape": f"{axes.narrow} : 1..1 : {axes.narrow} rows : columns",
    }
    found = grid.at(strategy, n_taxels, noise, bits, rate_hz, aspect)
    if found is None:
        outside = f"more than {BEYOND:g} times outside {', '.join(limits.values())}"
        nan = math.nan
        return Accuracy(nan, nan, nan, nan, True, f"not available: {outside}; simulate it")
    low, high, note = found.low_db, found.high_db, ""
    if found.beyond:
        note = f"extrapolated beyond {', '.join(limits[name] for name in found.beyond)}"
        edge = grid.at(
            strategy,
            int(np.clip(n_taxels, axes.n_taxels[0], axes.n_taxels[-1])),
            float(np.clip(noise, axes.noise[0], axes.noise[-1])),
            max(bits, axes.bits) if "noise" in found.beyond else bits,
            float(np.clip(rate_hz, axes.all_rates_hz[0], axes.all_rates_hz[-1])),
            float(np.clip(aspect, axes.aspects[0], axes.aspects[-1])),
        )
        if edge is not None:
            low, high = min(low, edge.low_db), max(high, edge.high_db)
    error = table.error_db
    return Accuracy(found.db, low - error, high + error, found.touch, True, note)


def simulate(
    strategy: str,
    n_rows: int,
    n_cols: int,
    noise: float,
    bits: int,
    rate_hz: float,
    seed: int,
    scene: str | None = None,
    *,
    mask: Mask | None = None,
) -> Accuracy:
    """Simulate a strategy on a skin.

    Parameters
    ----------
    strategy, noise, bits, rate_hz
        As in `accuracy`; rates 1..10000 Hz.
    n_rows, n_cols : int
        Grid of the taxels, at most 65536 cells.
    seed : int
        Of scenes, noise and Phi.
    scene : str, optional
        A body of `presses.BODIES`, pressed in each course; or a source of frames as a sensor node
        takes it (scene:NAME, file:PATH, module:callable), whose frames are the true forces. Of
        its frames those next to the ticks of the rate are read, 2000 at most. None: all scenes
        of the grid.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists. None: everywhere.

    Returns
    -------
    Accuracy
        Band: as that of the grid, of the scenes; of one source, percentiles 5 and 95 of its contact
        frames.

    Raises
    ------
    SettingsError
        If an argument is not allowed, the scene's skin is another one, or nothing touches it.
    SparseskinError
        If the strategy is not possible on the skin, or the scene cannot be read.
    """
    one = strategy_of(strategy)
    check_conditions(noise, bits, rate_hz)
    if not (is_whole(n_rows, 1) and is_whole(n_cols, 1) and n_rows * n_cols <= MOST_TAXELS):
        raise SettingsError(
            f"taxels: {n_rows!r} x {n_cols!r} is not allowed; allowed: 1..{MOST_TAXELS} taxels"
        )
    if not is_whole(seed, 0, 2**31):
        raise SettingsError(f"seed: {seed!r} is not allowed; allowed: a whole number from 0")
    exists = np.ones((n_rows, n_cols), dtype=np.bool_) if mask is None else mask
    if exists.shape != (n_rows, n_cols) or exists.dtype != np.bool_ or not exists.any():
        raise SettingsError(f"mask: expected bool, {n_rows} x {n_cols}, and a taxel at least")

    def score(frames: Iterator[tuple[Floats, Floats]], k: int) -> list[float]:
        reader = make_reader(one, exists, noise, bits, seed * N_SCENES + k)
        return contact_db(reader, frames)[0]

    note = ""
    if scene is None or scene in BODIES:
        numbers = range(N_SCENES) if scene is None else range(len(COURSES))
        dbs = [
            float(np.mean(score(presses(k, exists, noise, rate_hz, seed, scene), k)))
            for k in numbers
        ]
        low, high = band(np.array(dbs))
    else:
        frames, note = _of_source(scene, exists, noise, rate_hz, seed)
        dbs = score(frames, 0)
        low, high = np.percentile(dbs, [5, 95])
    touch = light_touch(make_reader(one, exists, noise, bits, seed), exists, noise, seed)
    light = math.nan if touch is None else touch
    return Accuracy(float(np.mean(dbs)), float(low), float(high), light, False, note)


def _of_source(
    name: str, exists: Mask, noise: float, rate_hz: float, seed: int
) -> tuple[Iterator[tuple[Floats, Floats]], str]:
    """Frames (truth, readings) of a source in the range of the simulation, and a note."""
    if ":" not in name:
        raise SettingsError(f"scene: {name!r} is not known; allowed: {', '.join(BODIES)}, {FORMS}")
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
            if n_read >= MOST_FRAMES:
                return

    return frames(), note
