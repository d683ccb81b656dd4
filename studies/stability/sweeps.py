"""Settings of the solvers, swept one at a time far beyond both ends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

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
    presets = (preset for preset in PRESETS.values() if preset["solver"] == solver)
    return {"solver": solver, "basis": "haar", **next(presets, {})}


def experiments(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every solver over each quantity that it has, all else as it is in the project; labelled by
    the quantity. Names of candidates are "SOLVER" or "SOLVER: value".
    """
    for key, sweep in SETTINGS.items():
        values = sweep.quick if quick else sweep.values
        factors = values if key == "noise" else (1.0,)
        frames = [replace(one, noise=factor) for one in EXCERPTS for factor in factors]
        of_rows = (
            [{key: value} for value in values] if key in ("block", "bits") else [{}]
        )
        ratios = (3,) if quick else (3, 8)
        measurements = [Measurement(r, **one) for r in ratios for one in of_rows]  # type: ignore[arg-type]
        candidates = {
            label: Candidate(own(name)) for label, name in SUM_SOLVERS.items()
        }
        if key in ("lambda_n", "iterations"):
            candidates = {
                f"{label}: {value}": Candidate({**own(name), key: value})
                for label, name in SUM_SOLVERS.items()
                if key in settings_of(name)
                for value in values
            }
        if key == "noise":
            # Nothing else is a setting of them.
            candidates |= LARGER
        scores = ("mean_db", "touched_mn")
        yield Experiment(
            key, frames, measurements, candidates | READINGS, scores, (seed,)
        )


def swept(one: Experiment, out: Path, executor: str) -> pd.DataFrame:
    """Means over the excerpts: sweep, ratio, solver, value, scores, and those of the readings."""
    rows = one.run(out, executor).astype({"mean_db": float, "touched_mn": float})
    split = rows["method"].str.split(": ", expand=True).reindex(columns=[0, 1])
    value = rows[one.label] if one.label in rows else pd.to_numeric(split[1])
    rows = rows.assign(sweep=one.label, solver=split[0], value=value)
    rows["touched_db"] = -20 * np.log10((1e-3 * rows["touched_mn"]).clip(1e-6))
    keys = ["sweep", "ratio", "solver", "value"]
    names = list(SHOWN)
    means = rows.groupby(keys, sort=False, dropna=False)[names].mean().reset_index()
    noisy = means[means["solver"].isin(READINGS)].rename(
        columns={s: f"noisy_{s}" for s in names}
    )
    on = ["ratio", *(["value"] if noisy["value"].notna().all() else [])]
    noisy = noisy[[*on, *(f"noisy_{s}" for s in names)]]
    return means[~means["solver"].isin(READINGS)].merge(noisy, on=on)


def section(page: Page, quick: bool, seed: int, executor: str) -> None:
    """Compute, draw and add the section."""
    rows = pd.concat(swept(one, page.out, executor) for one in experiments(quick, seed))
    charts = []
    for ratio, some in rows.groupby("ratio", sort=False):
        charts += [_draw(page.out, int(ratio), some), markdown(sweep_table(some))]
    page.csv("settings", rows)
    classes = {label: solver_class(name) for label, name in SUM_SOLVERS.items()}
    ranges = {label: solver_fact(cls, "lambdas_n") for label, cls in classes.items()}
    least = {
        label: solver_fact(cls, "least_iterations") for label, cls in classes.items()
    }
    known = {
        "lambdas": ", ".join(
            f"{r[0]:g} to {r[1]:g} ({label})" for label, r in ranges.items() if r
        ),
        "iterations": ", ".join(
            f"{number} ({label})" for label, number in least.items()
        ),
    }
    limits = {"min_block": MIN_BLOCK, "min_bits": MIN_BITS}
    page.section("Solvers: settings and surroundings", *charts, **known, **limits)


def _draw(out: Path, ratio: int, frame: pd.DataFrame) -> str:
    """Chart of the sweeps, a column each: PSNR, and below it the error where touched."""
    n = len(SETTINGS)
    caption = f"Settings, M = N/{ratio}."
    size_in = (n * 2.9, 5.2)
    with Chart(out, f"settings_n{ratio}", caption, 2 * n, n, size_in=size_in) as chart:
        for k, (key, sweep) in enumerate(SETTINGS.items()):
            some = frame[frame["sweep"] == key].copy()
            for below, (score, (title, low, high)) in enumerate(SHOWN.items()):
                axes = chart.panels[n * below + k]
                noisy = f"noisy_{score}"
                some[[score, noisy]] = some[[score, noisy]].clip(low, high)
                readings = some.drop_duplicates("value").sort_values("value")
                grey: dict[str, Any] = {
                    "color": "#555555",
                    "lw": 2.2,
                    "alpha": 0.6,
                    "zorder": 1,
                }
                label = "readings of all taxels"
                axes.plot(readings["value"], readings[noisy], label=label, **grey)
                draw_lines(
                    axes, some, "value", score, "solver", METHODS, markersize=3.5
                )
                axes.set(xscale=sweep.scale, xlabel=sweep.label if below else "")
                axes.set_ylabel("" if k else title)
    return chart.markdown


def sweep_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Best and worst of each sweep and solver, and where the solver fails."""

    def both(row: pd.Series) -> str:
        return f"{row['mean_db']:.1f} ({row['touched_db']:.1f}) at {row['value']:.3g}"

    lines = []
    for (key, solver), some in frame.reset_index().groupby(
        ["sweep", "solver"], sort=False
    ):
        best = some["mean_db"].idxmax()
        worst = some["mean_db"].idxmin()
        ends = {
            "best, dB (where touched)": both(some.loc[best]),
            "worst": both(some.loc[worst]),
        }
        fails = failing(some, SETTINGS[str(key)])
        lines.append({"swept": key, "solver": solver, **ends, "fails": fails})
    return pd.DataFrame(lines)


def failing(frame: pd.DataFrame, sweep: Sweep) -> str:
    """Values at which one solver fails in a sweep, as text: below and above its best value."""
    loss = pd.Series(-math.inf, frame.index)
    for score in SHOWN:
        wanted = frame[f"noisy_{score}"]
        if not sweep.against_readings:
            wanted = frame[score].max() - FAILS_DB
        loss = loss.combine(wanted - frame[score], max)
    best = frame["value"].loc[loss.idxmin()]
    failed = frame["value"][loss > 0.0]
    if len(failed) == len(frame):
        return "everywhere"
    below = [f"≤ {value:.3g}" for value in failed[failed < best]]
    above = [f"≥ {value:.3g}" for value in failed[failed > best]]
    return " and ".join(below[-1:] + above[:1]) or "nowhere"
