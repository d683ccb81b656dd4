"""Measurements that a frame needs: the phase transition over M/N and K/M."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import Chart, Page

from .excerpts import (
    SHAPE,
    N,
    contacts,
    count_coefficients,
    mean_psnr,
    measured,
    read,
    reconstruct,
    solver_for,
)

N_STATIC, N_JUDGED = 24, 8
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


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver on pads at random places, with the skin's noise."""
    ratios = (16, 8, 4, 2) if quick else (32, 16, 12, 8, 6, 4, 3, 2, 1.5)
    rhos = (0.1, 0.3, 0.6) if quick else (0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.75)
    n_trials = 1 if quick else 3
    return [
        {"solver": solver, "delta": 1 / ratio, "rho": rho, "n_trials": n_trials, "seed": seed}
        for solver in SUM_SOLVERS
        for ratio in ratios
        for rho in rhos
        if rho * N / ratio >= LEAST_K
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """PSNR of the settled reconstruction minus that of the readings, over static frames."""
    m = round(point["delta"] * N)
    gains, counts = [], []
    for trial in range(point["n_trials"]):
        rng = np.random.default_rng((point["seed"], trial, m, round(1000 * point["rho"])))
        frame = contacts(SHAPE, round(point["rho"] * m), rng)
        counts.append(count_coefficients(make_basis("haar", *SHAPE).analysis(frame)))
        truth = np.broadcast_to(frame, (N_STATIC, *SHAPE))
        readings = read(truth, rng)
        phi = make_phi("sbhe", N, m, seed=trial)
        solved = reconstruct(solver_for(point["solver"], phi, SHAPE), measured(phi, readings))
        judged = slice(-N_JUDGED, None)
        ours, theirs = (mean_psnr(of[judged], truth[judged]) for of in (solved, readings))
        gains.append(ours - theirs)
    return {"k_over_m": float(np.mean(counts)) / m, "gain_db": float(np.mean(gains))}


def section(page: Page, quick: bool, seed: int, executor: str) -> None:
    """Compute, draw and add the section."""
    found = compute_rows(measure, points(quick, seed), page.out, executor, "phase, each solver")
    rows = pd.DataFrame(found)
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
            some = rows[rows["solver"] == solver]
            spots = axes.scatter(some["delta"], some["k_over_m"], c=some["gain_db"], **style)
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
