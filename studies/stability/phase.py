"""Measurements that a frame needs: the phase transition over M/N and K/M."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.frames import PadFrames
from sparseskin.studies.harness import LARGER, Candidate, Experiment, Measurement
from sparseskin.studies.report import Chart, Page

from .sweeps import READINGS, own

SIDE = 40
N_STATIC = 24
N_JUDGED = 8
RHOS = (0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.75)
QUICK_RHOS = (0.1, 0.3, 0.6)
RATIOS = (32, 16, 12, 8, 6, 4, 3, 2, 1.5)
QUICK_RATIOS = (16, 8, 4, 2)
"""K/M and N/M of the pads."""
TITLES = {"skin": "skin, the default", "fista": "fista, the paper's solver"}
LEAST_K = 13
"""Fewest coefficients that a pad of whole taxels has at a place of its own."""


def weak_threshold(delta: float) -> float:
    """K/M up to which l1 finds nearly all K-sparse signals from a share delta = M/N.

    Source: Donoho, Tanner, J. AMS 22 (2009), the weak threshold of the cross-polytope, in the
    parametric form of Donoho, Maleki, Montanari, PNAS 106 (2009), eq. 4 and 5.
    """

    # The threshold is the largest rho over z; scipy only minimises.
    def negative_rho(z: float) -> float:
        bell = z * np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
        tail = (1.0 + z * z) * ndtr(-z) - bell
        numerator = 1.0 - 2.0 / delta * tail
        denominator = 1.0 + z * z - 2.0 * tail
        return -float(numerator / denominator)

    lowest = minimize_scalar(negative_rho, bounds=(0.0, 8.0), method="bounded")
    return -float(lowest.fun)


def _ratios(quick: bool) -> Sequence[float]:
    return QUICK_RATIOS if quick else RATIOS


def _rhos(quick: bool) -> Sequence[float]:
    return QUICK_RHOS if quick else RHOS


def coefficients(ratio: float, quick: bool) -> dict[float, int]:
    """Numbers of coefficients of the pads at a ratio, by K/M."""
    return {rho: round(rho * SIDE**2 / ratio) for rho in _rhos(quick)}


def experiments(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every solver, larger taxels and the readings, on pads at random places, by the ratio."""
    candidates = {label: Candidate(own(name)) for label, name in SUM_SOLVERS.items()}
    candidates |= LARGER | READINGS
    seeds = range(seed, seed + (1 if quick else 3))
    for ratio in _ratios(quick):
        frames = []
        for k in coefficients(ratio, quick).values():
            if k >= LEAST_K:
                frames.append(PadFrames(SIDE, k, N_STATIC, N_STATIC - N_JUDGED))
        measurements = [Measurement(ratio)]
        yield Experiment("phase", frames, measurements, candidates, ("mean_db",), seeds)


def section(page: Page, quick: bool, seed: int, executor: str) -> None:
    """Compute, draw and add the section."""
    parts = [
        experiment.run(page.out, executor) for experiment in experiments(quick, seed)
    ]
    rows_of_frames = pd.concat(parts).astype({"mean_db": float})
    keys = ["n_coefficients", "ratio", "method"]
    # The mean over the seeds.
    of_pads = rows_of_frames.groupby(keys, sort=False)
    psnr_db = of_pads["mean_db"].mean().unstack("method")
    # What compressing gains over reading all taxels of the same frames.
    (name,) = READINGS
    gains = psnr_db.drop(columns=name).sub(psnr_db[name], axis=0)
    rows = gains.stack().rename("gain_db").reset_index()
    rows["k_over_m"] = rows["n_coefficients"] * rows["ratio"] / SIDE**2
    page.csv("phase_skin", rows)
    title = "Solvers: measurements that a frame needs"
    page.section(title, _draw(page.out, rows, quick))


def _edges(centres: Sequence[float]) -> list[float]:
    """Edges of the cells about ascending centres: half way between them."""
    values = np.asarray(centres)
    inner = (values[1:] + values[:-1]) / 2
    begin = 1.5 * values[0] - values[1] / 2
    end = 1.5 * values[-1] - values[-2] / 2
    return [float(begin), *inner, float(end)]


def _gains(rows: pd.DataFrame, quick: bool) -> Floats:
    """Gain by K/M and M/N, both ascending, dB: NaN where there is no pad."""
    gain_db = rows.set_index(["n_coefficients", "ratio"])["gain_db"]
    rhos = _rhos(quick)
    ratios = _ratios(quick)
    gains = np.full((len(rhos), len(ratios)), np.nan, dtype=np.float32)
    for column, ratio in enumerate(ratios):
        counts = coefficients(ratio, quick)
        for row, rho in enumerate(rhos):
            pad = (counts[rho], ratio)
            gains[row, column] = gain_db.get(pad, np.nan)
    return gains


def _draw(out: Path, rows: pd.DataFrame, quick: bool) -> str:
    """Maps of the gain over M/N and K/M, a panel a method, with the threshold of theory."""
    caption = (
        "Where compressing beats reading all taxels, frames that stand still, pads at random "
        "places. Blue: the reconstruction has a higher PSNR than the readings; grey: not computed"
    )
    methods = (*SUM_SOLVERS, *LARGER)
    n = len(methods)
    # One row: every panel has the same axes.
    size_in = (2.4 * n + 1.0, 3.2)
    deltas = np.linspace(0.02, 0.85, 80)
    threshold = [weak_threshold(delta) for delta in deltas]
    with Chart(out, "phase_skin", caption, n, n, size_in=size_in, sharey=True) as chart:
        for axes, method in zip(chart.panels, methods, strict=True):
            of_method = rows[rows["method"] == method]
            cells = _draw_gains(axes, _gains(of_method, quick), quick)
            axes.set_title(TITLES.get(method, method))
            label = "l1 finds nearly all below (Donoho, Tanner)"
            axes.plot(
                deltas,
                threshold,
                color="black",
                lw=1.6,
                label=label,
            )
        chart.label("M/N: measurements per taxel", "K/M: coefficients per measurement")
        label = "dB above reading all taxels"
        chart.figure.colorbar(
            cells,
            ax=chart.panels,
            label=label,
            extend="both",
        )
    return chart.markdown


def _draw_gains(axes: Axes, gains: Floats, quick: bool) -> Any:
    """Draw one map; return its cells, for a scale of their colours."""
    # Columns are as wide as the logarithm of M/N has them.
    logarithms = [-math.log(ratio) for ratio in _ratios(quick)]
    x_edges = np.exp(_edges(logarithms))
    y_edges = _edges(_rhos(quick))
    style: dict[str, Any] = {
        "cmap": "RdBu",
        "vmin": -15.0,
        "vmax": 15.0,
    }
    axes.set_facecolor("0.85")
    axes.grid(False)
    # What was not computed lets the grey through.
    known_gains = np.ma.masked_invalid(gains)
    cells = axes.pcolormesh(x_edges, y_edges, known_gains, **style)
    axes.set(
        xscale="log",
        xlim=(x_edges[0], x_edges[-1]),
        ylim=(y_edges[0], y_edges[-1]),
    )
    ticks = (32, 16, 8, 4, 2)
    axes.set_xticks([1 / k for k in ticks], [f"1/{k}" for k in ticks])
    axes.minorticks_off()
    return cells
