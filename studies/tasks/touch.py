"""Time to the first touch: measurements beside single taxels at equal conversions per second.

A converter makes one number after the other. A frame of M measurements is looked at once its last
one is there, by the statistic of the reconstructor. A raster is looked at after each conversion.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.ticker import FuncFormatter

from sparseskin.nodes.compressor.departures import CLIPPED_MEAN, Departures, Windows
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import m_of, row_subsets
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask
from sparseskin.nodes.reconstructor.first_touch import FALSE_TOUCHES, TouchTest
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.points import compute_rows
from sparseskin.studies.presses import noisy_skin
from sparseskin.studies.report import Chart, Page, markdown, series_style

from .shapes import SIDE, draw_forces

CONVERSION_US = 0.5
"""Time of a conversion: 2 million a second, as of small converters. Chosen."""
FORCES_N = (0.05, 0.08, 0.12, 0.2, 0.5, 1.0)
QUICK_FORCES_N = (0.12, 1.0)
RATIOS = (3, 8, 16)
N_PRESSES = 240
QUICK_PRESSES = 12
PIN_RADII = (0.6, 2.5)
"""Radius of a pin, taxels, drawn evenly: one taxel to a fingertip of 5 across."""
LIMIT = 8 * SIDE * SIDE
"""Conversions after which a press is missed: 8 scans of all taxels, 4 ms."""
RASTER = "single taxels, row by row"
SHUFFLED = "single taxels, in random order"
WITH_SQUARES = "row by row, and their squares"
MEASURED = {f"measurements y, N/{ratio}": ratio for ratio in RATIOS}
WAYS = (*MEASURED, RASTER, SHUFFLED, WITH_SQUARES)
SETS = {"pins": "pins of 1 to 5 taxels across", "shapes": "twelve shapes"}
PER_CONVERSION = FALSE_TOUCHES / m_of(SIDE * SIDE, 3)
"""False touches a conversion, the same for all ways: 1 in 10 million frames of N/3."""

CHANCES = (1e-3, 1e-5, FALSE_TOUCHES)
"""Stated false touches a frame that are counted."""
COUNTED_SIDE = 16
N_COUNTED = 1_000_000
QUICK_COUNTED = 20_000
BATCH = 1000
CAPTION = (
    "Median time from a press to the first touch over its largest force: lower is better. A "
    "line ends where more than half of the presses are missed within 4 ms"
)


def add(page: Page, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the section, add it to the page of the study; return its conclusion."""
    forces = QUICK_FORCES_N if quick else FORCES_N
    n_presses = QUICK_PRESSES if quick else N_PRESSES
    points = [
        {
            "set": name,
            "force": force,
            "way": way,
            "n": n_presses,
            "seed": seed,
        }
        for name in SETS
        for force in forces
        for way in WAYS
    ]
    times = compute_rows(time_to_touch, points, page.out, executor, "touch")
    rows = pd.DataFrame(times)
    n_counted = QUICK_COUNTED if quick else N_COUNTED
    counts = [
        {
            "ratio": 3,
            "n_frames": n_counted,
            "seed": seed,
        }
    ]
    counted = compute_rows(false_touches, counts, page.out, executor, "false touches")
    false = pd.DataFrame(counted)

    # Two tables a set: how fast, and how often not at all.
    tables = []
    for name, title in SETS.items():
        of_set = rows[rows["set"] == name]
        tables.append(_table(of_set, "median_us", f"{title}: median, us", ".0f"))
        tables.append(_table(of_set, "missed", f"{title}: missed, %", ".0f"))
    values = {
        "side": SIDE,
        "n_presses": n_presses,
        "conversion_us": CONVERSION_US,
        "n_counted": n_counted,
        "counted_side": COUNTED_SIDE,
    }
    texts = []
    for chance in CHANCES:
        n_false = false[f"{chance:g}"].iloc[0]
        n_allowed = chance * n_counted
        texts.append(f"{n_false:.0f} where {n_allowed:g} are allowed")
    line = f"False touches in {n_counted} untouched frames: {'; '.join(texts)}."
    page.section("First touch", _draw(page.out, rows), *tables, line, **values)
    page.csv("first_touch", rows)
    page.csv("false_touches", false)
    return [_conclusion(rows), line]


def _table(rows: pd.DataFrame, column: str, title: str, digits: str) -> str:
    """A row a way, a column a force; empty where more than half are missed."""
    by_force = rows.pivot(
        index="way",
        columns="force",
        values=column,
    )
    by_force = by_force.reindex(WAYS)
    by_force.columns = [f"{force:g} N" for force in by_force]
    by_force.insert(0, title, by_force.index)
    return markdown(by_force, dict.fromkeys(by_force.columns[1:], digits))


def _conclusion(rows: pd.DataFrame) -> str:
    """The fastest of the measurements beside single taxels in both orders, by force, on pins."""
    of_pins = rows[rows["set"] == "pins"]
    median_us = of_pins.set_index(["way", "force"])["median_us"]
    texts = []
    for force in dict.fromkeys(rows["force"]):
        measured_us = [median_us[way, force] for way in MEASURED]
        fastest_us = min(measured_us, key=_or_last)
        times_us = [fastest_us]
        times_us += [median_us[way, force] for way in (RASTER, SHUFFLED)]
        columns = " / ".join(map(_time_text, times_us))
        texts.append(f"{force:g} N {columns}")
    times_text = ", ".join(texts)
    return (
        f"First touch of a pin, the fastest y / {RASTER} / in random order, median us: "
        f"{times_text}."
    )


def _or_last(time_us: float | None) -> float:
    """A time, infinite where there is none: None, or NaN in a table."""
    if time_us is None or math.isnan(time_us):
        return math.inf
    return time_us


def _time_text(time_us: float | None) -> str:
    if math.isinf(_or_last(time_us)):
        return "missed"
    return f"{time_us:.0f}"


def _draw(out: Path, rows: pd.DataFrame) -> str:
    """Chart of the median time over force: a panel a set, a line a way."""
    layout: dict[str, Any] = {"size_in": (10.5, 4.8), "legend_columns": 3}
    with Chart(out, "first_touch", CAPTION, 2, 2, sharey=True, **layout) as chart:
        for axes, (name, title) in zip(chart.panels, SETS.items(), strict=True):
            of_set = rows[rows["set"] == name]
            for k, way in enumerate(WAYS):
                along = of_set[of_set["way"] == way].sort_values("force")
                times = along["median_us"].astype(float)
                axes.plot(along["force"], times, label=way, **series_style(k))
            axes.set(
                xscale="log",
                yscale="log",
                title=title,
            )
            forces = sorted(set(rows["force"]))
            axes.set_xticks(forces, [f"{force:g}" for force in forces])
            axes.minorticks_off()
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        chart.label("largest force of the press, N", "median time to first touch, us")
    return chart.markdown


def _presses(point: dict[str, Any], rng: np.random.Generator) -> Floats:
    """True forces of the presses, float32 (n, SIDE * SIDE)."""
    n = point["n"]
    if point["set"] == "shapes":
        forces = draw_forces(n, rng)
    else:
        rows, cols = np.indices((SIDE, SIDE))
        centre_rows, centre_cols = rng.uniform(2, SIDE - 3, (2, n, 1, 1))
        radii = rng.uniform(*PIN_RADII, (n, 1, 1))
        distances = np.hypot(rows - centre_rows, cols - centre_cols)
        # A round tip, which half of a taxel more feels.
        caps = np.clip(1 - np.square(distances / (radii + 0.5)), 0, 1)
        peaks = caps.max(axis=(1, 2), keepdims=True)
        forces = (caps / peaks).astype(np.float32)
    return np.float32(point["force"]) * forces.reshape(n, -1)


def time_to_touch(point: dict[str, Any]) -> dict[str, Any]:
    """Time from a press to the first touch, and the share that is missed within `LIMIT`.

    `point`: set, of `SETS`; force, newtons; way, of `WAYS`; n presses; seed. Returns median_us,
    None where half or more are missed, and missed, %.
    """
    rng = np.random.default_rng([point["seed"], 565])
    truth = _presses(point, rng)
    if point["way"] in MEASURED:
        times = _by_measurements(truth, MEASURED[point["way"]], rng)
    else:
        times = _by_taxels(truth, point["way"], rng)
    missed = times > LIMIT
    median = float(np.median(times))
    median_us = None
    if median <= LIMIT:
        median_us = CONVERSION_US * median
    return {"median_us": median_us, "missed": 100 * float(missed.mean())}


@lru_cache(maxsize=len(RATIOS))
def _test(ratio: int) -> tuple[list[Phi], TouchTest]:
    """Row subsets, and the test of their measurements."""
    n = SIDE * SIDE
    m = m_of(n, ratio, "rotating")
    phi = make_phi("sbhe", n, m, seed=0)
    phis = row_subsets(phi, "rotating")
    test = TouchTest(noisy_skin(SIDE), phis, PER_CONVERSION * m)
    return phis, test


def _by_measurements(truth: Floats, ratio: int, rng: np.random.Generator) -> Indices:
    """Conversions from each press to its touch; more than `LIMIT`: none."""
    n_presses = len(truth)
    phis, test = _test(ratio)
    m = phis[0].m
    windows = test.windows(n_presses)
    # Presses begin anywhere in a window.
    window = test.span * m
    begins: Indices = rng.integers(window, 2 * window, size=n_presses)
    times = np.full(n_presses, 2 * LIMIT)
    for frame in range(2 * test.span + LIMIT // m + 1):
        subset = frame % len(phis)
        y = _measured(phis[subset], truth, begins - frame * m, rng)
        difference = y - test.expected[subset]
        alarms = _alarms(test, windows, difference, subset)
        # A frame is looked at once its last measurement is there.
        _note(times, alarms, (frame + 1) * m - begins)
        if (times <= LIMIT).all():
            break
    return times


def _alarms(test: TouchTest, windows: Windows, difference: Floats, subset: int) -> Mask:
    """Frames that show a touch, bool (n,), by what their measurements differ from an untouched
    skin, float32 (n, m), as the reconstructor looks at them.
    """
    scores = test.departures.scores(difference, subset)
    quiet = np.zeros(len(difference))
    limits = test.bounds.scores
    alarms = windows.alarms(scores, limits, quiet, one_sided=True)
    energy = test.departures.energy(difference, test.bounds)
    alarms |= energy > test.bounds.energy
    return alarms


def _measured(
    phi: Phi, truth: Floats, begins: Indices, rng: np.random.Generator
) -> Floats:
    """Measurements of a frame in which each press begins at some conversion of it."""
    noise = NoiseModel()
    pressed = phi.forward(noise.apply(truth, rng))
    if (begins <= 0).all():
        return pressed
    untouched = phi.forward(noise.apply(np.zeros_like(truth), rng))
    is_before = np.arange(phi.m) < begins[:, np.newaxis]
    return np.where(is_before, untouched, pressed)


def _by_taxels(truth: Floats, way: str, rng: np.random.Generator) -> Indices:
    """As `_by_measurements`, of single taxels that are read in turn."""
    n_presses, n = truth.shape
    order = rng.permutation(n) if way == SHUFFLED else np.arange(n)
    chance = PER_CONVERSION
    if way == WITH_SQUARES:
        # Two tests share the false touches.
        chance = PER_CONVERSION / 2
    deviations = -NormalDist().inv_cdf(chance)
    limit = deviations * NoiseModel().sigma_end
    scans = None
    if way == WITH_SQUARES:
        scans = Departures(noisy_skin(SIDE), chance * n, n_windows=2, one_sided=True)
        untouched = np.zeros((1, SIDE, SIDE), dtype=np.float32)
        bounds = scans.bounds(untouched)
        windows = Windows(n_presses, scans.pyramid.n, 2)
        expected = np.float32(CLIPPED_MEAN * NoiseModel().sigma_end)

    begins: Indices = rng.integers(2 * n, 4 * n, size=n_presses)
    times = np.full(n_presses, 2 * LIMIT)
    place = np.arange(n)
    for scan in range(4 + LIMIT // n + 1):
        is_pressed = place >= begins[:, np.newaxis] - scan * n
        # Of the taxels in their order of reading.
        forces = np.where(is_pressed, truth[:, order], 0)
        readings = NoiseModel().apply(forces, rng)
        exceeds = is_pressed & (readings > limit)
        # The first taxel of the scan that exceeds the limit; n: none does.
        index = np.where(exceeds.any(axis=1), exceeds.argmax(axis=1), n)
        _note(times, index < n, scan * n + index + 1 - begins)
        if scans is None:
            continue

        grids = (readings - expected).reshape(-1, SIDE, SIDE)
        scores = scans.scores(grids)
        quiet = np.zeros(n_presses)
        alarms = windows.alarms(scores, bounds.scores, quiet, one_sided=True)
        _note(times, alarms, (scan + 1) * n - begins)
    return times


def _note(times: Indices, alarms: Mask, now: Indices) -> None:
    """Note the time of the first alarm of each press, after it began."""
    is_sooner = alarms & (now > 0) & (now < times)
    times[is_sooner] = now[is_sooner]


def false_touches(point: dict[str, Any]) -> dict[str, Any]:
    """Numbers of untouched frames in which the statistic alarms, by stated chance.

    `point`: ratio, n_frames, seed.
    """
    rng = np.random.default_rng([point["seed"], 566])
    n = COUNTED_SIDE**2
    skin = noisy_skin(COUNTED_SIDE)
    m = m_of(n, point["ratio"], "rotating")
    phi = make_phi("sbhe", n, m, seed=0)
    phis = row_subsets(phi, "rotating")
    tests = [TouchTest(skin, phis, chance) for chance in CHANCES]
    windows = [test.windows(BATCH) for test in tests]
    counts = np.zeros(len(CHANCES), dtype=np.int64)
    noise = NoiseModel()
    untouched = np.zeros((BATCH, n), dtype=np.float32)
    for frame in range(point["n_frames"] // BATCH):
        subset = frame % len(phis)
        readings = noise.apply(untouched, rng)
        y = phis[subset].forward(readings)
        # What is expected of an untouched skin does not depend on the chance.
        difference = y - tests[0].expected[subset]
        for k, test in enumerate(tests):
            alarms = _alarms(test, windows[k], difference, subset)
            counts[k] += np.count_nonzero(alarms)
    names = [f"{chance:g}" for chance in CHANCES]
    return dict(zip(names, counts.tolist(), strict=True))
