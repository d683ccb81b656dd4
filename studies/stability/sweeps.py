"""Settings of the solvers, swept one at a time far beyond both ends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from sparseskin.nodes.compressor.node import MIN_BITS, MIN_BLOCK
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import solver_class, solver_fact
from sparseskin.studies.evaluate import SUM_SOLVERS, settings_of
from sparseskin.studies.frames import SceneFrames
from sparseskin.studies.harness import LARGER, Candidate, Experiment, Measurement
from sparseskin.studies.report import Chart, Page, draw_lines, markdown

EXCERPTS = (
    SceneFrames("lift_box_40", -4, 36),
    SceneFrames("drag_wrench_40", 2180, 2580, 10),
    SceneFrames("path_40", 1180, 1580, 10),
)
"""An impact frame by frame, and at 100 Hz a wrench dragged and a light peg on its way."""
READINGS = {"readings": Candidate(of="reading")}
METHODS = (*SUM_SOLVERS, *LARGER)
"""Order of the curves."""
FAILS_DB = 3.0
"""Loss from the best of a sweep that counts as failing, in PSNR or over the touched taxels."""
SHOWN = {
    "mean_db": ("PSNR, dB", 10, 70),
    "touched_db": ("1 N / error where touched, dB", 0, 60),
}
"""Label of each score, and where its curves are cut off."""
GREY: dict[str, Any] = {
    "color": "#555555",
    "lw": 2.2,
    "alpha": 0.6,
    "zorder": 1,
}
"""Style of the readings."""


@dataclass(frozen=True)
class Sweep:
    """Label of the axis of what is swept; its values in a full and in a quick run; scale; True if
    a solver fails where it is worse than the readings, which change with it.
    """

    label: str
    values: Sequence[float] = ()
    quick: Sequence[float] = ()
    scale: str = "log"
    against_readings: bool = False


LAMBDAS = np.geomspace(1e-4, 1.0, 17).tolist()
SETTINGS = {
    "lambda_n": Sweep("λ, N", LAMBDAS, LAMBDAS[::4]),
    "iterations": Sweep(
        "iterations a frame", (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 100), (1, 5, 20)
    ),
    "noise": Sweep(
        "noise, times the paper's",
        (0, 0.25, 0.5, 1, 2, 3, 5, 7, 10),
        (0, 1, 10),
        "linear",
        True,
    ),
    "block": Sweep("block size B", [2**k for k in range(1, 9)], (2, 32, 256)),
    "bits": Sweep(
        "bits of a measurement", (4, 5, 6, 7, 8, 10, 12, 16), (4, 8), "linear"
    ),
}


def own(solver: str) -> dict[str, Any]:
    """Settings of a solver, by its name for `make_solver`: those of its preset, or its defaults."""
    settings: dict[str, Any] = {"solver": solver, "basis": "haar"}
    for preset in PRESETS.values():
        if preset["solver"] == solver:
            return settings | preset
    return settings


def experiments(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every solver over each quantity that it has, all else as it is in the project; labelled by
    the quantity. Names of candidates are "SOLVER" or "SOLVER: value".
    """
    for key, sweep in SETTINGS.items():
        values = sweep.quick if quick else sweep.values
        factors = values if key == "noise" else (1.0,)
        frames = [
            replace(excerpt, noise=factor) for excerpt in EXCERPTS for factor in factors
        ]
        of_rows: list[dict[str, Any]] = [{}]
        if key in ("block", "bits"):
            of_rows = [{key: value} for value in values]
        ratios = (3,) if quick else (3, 8)
        measurements = [
            Measurement(ratio, **changes) for ratio in ratios for changes in of_rows
        ]
        candidates = _candidates(key, values) | READINGS
        scores = ("mean_db", "touched_mn")
        yield Experiment(key, frames, measurements, candidates, scores, (seed,))


def _candidates(key: str, values: Sequence[float]) -> dict[str, Candidate]:
    """Every solver, one a value where the key is a setting of solvers."""
    if key not in ("lambda_n", "iterations"):
        candidates = {
            label: Candidate(own(name)) for label, name in SUM_SOLVERS.items()
        }
        # Larger taxels have neither blocks nor bits.
        return candidates | LARGER if key == "noise" else candidates
    candidates = {}
    for label, name in SUM_SOLVERS.items():
        if key not in settings_of(name):
            continue
        for value in values:
            candidates[f"{label}: {value}"] = Candidate({**own(name), key: value})
    return candidates


def swept(experiment: Experiment, out: Path, executor: str) -> pd.DataFrame:
    """Means over the excerpts: sweep, ratio, solver, value, scores, and those of the readings."""
    key = experiment.label
    rows = experiment.run(out, executor)
    rows = rows.astype({"mean_db": float, "touched_mn": float})
    # A setting of a solver is in the name of the candidate, all else in a column of its own.
    split = rows["method"].str.split(": ", expand=True)
    split = split.reindex(columns=[0, 1])
    value = rows[key] if key in rows else pd.to_numeric(split[1])
    rows = rows.assign(
        sweep=key,
        solver=split[0],
        value=value,
    )
    # In dB below 1 N; an error of 0 has no logarithm.
    touched_n = (1e-3 * rows["touched_mn"]).clip(1e-6)
    rows["touched_db"] = -20 * np.log10(touched_n)

    scores = list(SHOWN)
    keys = ["sweep", "ratio", "solver", "value"]
    groups = rows.groupby(keys, sort=False, dropna=False)
    means = groups[scores].mean().reset_index()
    is_reading = means["solver"].isin(READINGS)
    noisy_names = {score: f"noisy_{score}" for score in scores}
    noisy = means[is_reading].rename(columns=noisy_names)
    # Readings have no value where it is a setting of the solver: they are the same for all.
    on = ["ratio"]
    if noisy["value"].notna().all():
        on.append("value")
    noisy = noisy[[*on, *noisy_names.values()]]
    return means[~is_reading].merge(noisy, on=on)


def section(page: Page, quick: bool, seed: int, executor: str) -> None:
    """Compute, draw and add the section."""
    rows = pd.concat(
        swept(experiment, page.out, executor) for experiment in experiments(quick, seed)
    )
    charts = []
    for ratio, of_ratio in rows.groupby("ratio", sort=False):
        charts.append(_draw(page.out, int(ratio), of_ratio))
        charts.append(markdown(sweep_table(of_ratio)))
    page.csv("settings", rows)
    # The limits that solvers state: a value beyond them is refused.
    lambdas = []
    iterations = []
    for label, name in SUM_SOLVERS.items():
        cls = solver_class(name)
        bounds = solver_fact(cls, "lambdas_n")
        if bounds:
            lambdas.append(f"{bounds[0]:g} to {bounds[1]:g} ({label})")
        iterations.append(f"{solver_fact(cls, 'least_iterations')} ({label})")
    page.section(
        "Solvers: settings and surroundings",
        *charts,
        lambdas=", ".join(lambdas),
        iterations=", ".join(iterations),
        min_block=MIN_BLOCK,
        min_bits=MIN_BITS,
    )


def _draw(out: Path, ratio: int, frame: pd.DataFrame) -> str:
    """Chart of the sweeps, a column each: PSNR, and below it the error where touched."""
    n = len(SETTINGS)
    caption = f"Settings, M = N/{ratio}."
    size_in = (n * 2.9, 5.2)
    with Chart(out, f"settings_n{ratio}", caption, 2 * n, n, size_in=size_in) as chart:
        for k, (key, sweep) in enumerate(SETTINGS.items()):
            of_sweep = frame[frame["sweep"] == key]
            _draw_sweep(chart.panels[k::n], of_sweep, sweep)
        first_column = chart.panels[::n]
        for axes, (title, *_) in zip(first_column, SHOWN.values(), strict=True):
            axes.set_ylabel(title)
    return chart.markdown


def _draw_sweep(panels: Sequence[Axes], rows: pd.DataFrame, sweep: Sweep) -> None:
    """Lines of one sweep, a panel a score."""
    for axes, (score, (_, low, high)) in zip(panels, SHOWN.items(), strict=True):
        noisy = f"noisy_{score}"
        cut = rows.copy()
        cut[[score, noisy]] = cut[[score, noisy]].clip(low, high)
        readings = cut.drop_duplicates("value").sort_values("value")
        label = "readings of all taxels"
        axes.plot(readings["value"], readings[noisy], label=label, **GREY)
        draw_lines(axes, cut, "value", score, "solver", METHODS, markersize=3.5)
        axes.set_xscale(sweep.scale)
    panels[-1].set_xlabel(sweep.label)


def sweep_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Best and worst of each sweep and solver, and where the solver fails."""
    curves = frame.reset_index().groupby(["sweep", "solver"], sort=False)
    lines = []
    for (key, solver), rows in curves:
        best = rows.loc[rows["mean_db"].idxmax()]
        worst = rows.loc[rows["mean_db"].idxmin()]
        line = {
            "swept": key,
            "solver": solver,
            "best, dB (where touched)": _both(best),
            "worst": _both(worst),
            "fails": failing(rows, SETTINGS[str(key)]),
        }
        lines.append(line)
    return pd.DataFrame(lines)


def _both(row: pd.Series) -> str:
    """Both scores at a value."""
    return f"{row['mean_db']:.1f} ({row['touched_db']:.1f}) at {row['value']:.3g}"


def failing(frame: pd.DataFrame, sweep: Sweep) -> str:
    """Values at which one solver fails in a sweep, as text: below and above its best value."""
    loss = pd.Series(-math.inf, frame.index)
    for score in SHOWN:
        needed = frame[f"noisy_{score}"]
        if not sweep.against_readings:
            needed = frame[score].max() - FAILS_DB
        # The worse of both scores counts: a PSNR may be good where nothing is touched alone.
        loss = loss.combine(needed - frame[score], max)
    best = frame["value"].loc[loss.idxmin()]
    failed = frame["value"][loss > 0.0]
    if len(failed) == len(frame):
        return "everywhere"
    # Values ascend: the last of those below, and the first of those above.
    limits = [f"≤ {value:.3g}" for value in failed[failed < best]][-1:]
    limits += [f"≥ {value:.3g}" for value in failed[failed > best]][:1]
    return " and ".join(limits) or "nowhere"
