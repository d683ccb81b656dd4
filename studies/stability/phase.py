"""Measurements that a frame needs: the phase transition over M/N and K/M."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.frames import PadFrames
from sparseskin.studies.harness import Candidate, Experiment, Measurement
from sparseskin.studies.report import Chart, Page

from .sweeps import READINGS, own

SIDE, N_STATIC, N_JUDGED = 40, 24, 8
LEAST_K = 13
"""Fewest coefficients that a pad of whole taxels has at a place of its own."""


def weak_threshold(delta: float) -> float:
    """K/M up to which l1 finds nearly all K-sparse signals from a share delta = M/N.

    Source: Donoho, Tanner, J. AMS 22 (2009), the weak threshold of the cross-polytope, in the
    parametric form of Donoho, Maleki, Montanari, PNAS 106 (2009), eq. 4 and 5.
    """

    def negative_rho(z: float) -> float:
        tail = (1.0 + z * z) * ndtr(-z) - z * np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
        return -float((1.0 - 2.0 / delta * tail) / (1.0 + z * z - 2.0 * tail))

    found = minimize_scalar(negative_rho, bounds=(0.0, 8.0), method="bounded")
    return -float(found.fun)


def experiments(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every solver and the readings, on pads at random places, by the ratio."""
    rhos = (0.1, 0.3, 0.6) if quick else (0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.75)
    candidates = {name: Candidate(own(name)) for name in SUM_SOLVERS} | READINGS
    seeds = range(seed, seed + (1 if quick else 3))
    for ratio in (16, 8, 4, 2) if quick else (32, 16, 12, 8, 6, 4, 3, 2, 1.5):
        counts = [k for rho in rhos if (k := round(rho * SIDE**2 / ratio)) >= LEAST_K]
        frames = [PadFrames(SIDE, k, N_STATIC, N_STATIC - N_JUDGED) for k in counts]
        yield Experiment("phase", frames, [Measurement(ratio)], candidates, ("mean_db",), seeds)


def section(page: Page, quick: bool, seed: int, executor: str) -> None:
    """Compute, draw and add the section."""
    every = pd.concat(one.run(page.out, executor) for one in experiments(quick, seed))
    every = every.astype({"mean_db": float})
    means = every.groupby(["n_coefficients", "ratio", "method"], sort=False)["mean_db"].mean()
    gains = means.unstack("method")
    gains = gains.drop(columns=list(READINGS)).sub(gains[next(iter(READINGS))], axis=0)
    rows = gains.stack().rename("gain_db").reset_index()
    rows["k_over_m"] = rows["n_coefficients"] * rows["ratio"] / SIDE**2
    page.csv("phase_skin", rows)
    page.section("Solvers: measurements that a frame needs", _draw(page.out, rows))


def _draw(out: Path, rows: pd.DataFrame) -> str:
    """Maps of the gain over M/N and K/M, a panel a solver, with the threshold of theory."""
    caption = "PSNR above that of the readings: each solver, settled, pads at random places."
    n, n_columns = len(SUM_SOLVERS), 3
    size_in = (3.1 * n_columns, 2.6 * -(-n // n_columns) + 0.6)
    deltas = np.linspace(0.03, 0.99, 60)
    threshold = [weak_threshold(delta) for delta in deltas]
    style: dict[str, Any] = {"cmap": "RdBu", "vmin": -15.0, "vmax": 15.0, "marker": "s", "s": 45}
    style |= {"edgecolors": "#999999", "lw": 0.3}
    with Chart(out, "phase_skin", caption, n, n_columns, size_in=size_in) as chart:
        for axes, solver in zip(chart.panels, SUM_SOLVERS, strict=True):
            some = rows[rows["method"] == solver]
            spots = axes.scatter(1 / some["ratio"], some["k_over_m"], c=some["gain_db"], **style)
            axes.set(title=solver, xlim=(0.025, 1.0), ylim=(0.0, 0.8), xscale="log")
            ticks = (32, 16, 8, 4, 2)
            axes.set_xticks([1 / k for k in ticks], [f"1/{k}" for k in ticks])
            axes.minorticks_off()
            label = "l1 finds nearly all below (Donoho, Tanner)"
            axes.plot(deltas, threshold, color="black", lw=1.6, label=label)
        chart.label("M/N", "K/M")
        label = "dB above the readings of all taxels"
        chart.figure.colorbar(spots, ax=chart.panels, label=label, extend="both")
    return chart.markdown
