"""Measurements that a frame needs: the phase transition over M/N and K/M."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import Chart, write_csv

from .frames import (
    SHAPE,
    N,
    contacts,
    count_coefficients,
    frame_errors,
    mean_psnr,
    measured,
    read,
    reconstruct,
    solver_for,
)

L1_SHAPE = (32, 32)
L1_ERROR = 0.03
"""Relative error of the coefficients that counts as success: the small lambda alone makes 0.01."""
L1_LAMBDA, L1_ITERATIONS, L1_CALLS = 1e-3, 300, 4
N_STATIC, N_JUDGED = 24, 8
LEAST_K = 13
"""Fewest coefficients that a pad of whole taxels has at a place of its own."""


def l1_points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """FISTA run to its end, on coefficients at random places, over M/N and K/M.

    The dense Gaussian matrix, for which the theory is proven, has a coarser grid: it is slow.
    """
    grids = {
        "sbhe": (6, 9, 3) if quick else (12, 19, 10),
        "gaussian": (2, 4, 1) if quick else (5, 10, 4),
    }
    return [
        {"phi": phi, "delta": delta, "rho": rho, "n_trials": n_trials, "seed": seed}
        for phi, (n_deltas, n_rhos, n_trials) in grids.items()
        for delta in np.linspace(0.08, 0.96, n_deltas).round(4).tolist()
        for rho in np.linspace(0.04, 0.76, n_rhos).round(4).tolist()
    ]


def measure_l1(point: dict[str, Any]) -> dict[str, Any]:
    """Share of K-sparse sets of coefficients that FISTA finds from M exact measurements."""
    n = math.prod(L1_SHAPE)
    m = round(point["delta"] * n)
    k = max(1, round(point["rho"] * m))
    basis = make_basis("haar", *L1_SHAPE)
    found = 0
    for trial in range(point["n_trials"]):
        rng = np.random.default_rng((point["seed"], trial, m, k))
        theta = np.zeros(n, np.float32)
        theta[rng.choice(n, k, replace=False)] = rng.standard_normal(k)
        phi = make_phi(point["phi"], n, m, seed=trial)
        solver = FistaSolver(phi, basis, iterations=L1_ITERATIONS, lambda_n=L1_LAMBDA)
        y = phi.forward(basis.synthesis(theta.reshape(L1_SHAPE)).ravel())
        # Momentum starts anew with each call, which makes the last steps faster. The forces
        # are cut at 0, so the coefficients themselves are compared.
        for _ in range(L1_CALLS):
            solver.solve(y)
        error = np.linalg.norm(solver.theta.ravel() - theta) / np.linalg.norm(theta)
        found += bool(error < L1_ERROR)
    return {"k": k, "m": m, "success": found / point["n_trials"]}


def weak_threshold(delta: float) -> float:
    """K/M up to which l1 finds nearly all K-sparse signals from a share delta = M/N.

    Source: Donoho, Tanner, J. AMS 22 (2009), the weak threshold of the cross-polytope, in the
    parametric form of Donoho, Maleki, Montanari, PNAS 106 (2009), eq. 4 and 5.
    """

    def negative_rho(z: float) -> float:
        tail = (1.0 + z * z) * norm.cdf(-z) - z * norm.pdf(z)
        return -float((1.0 - 2.0 / delta * tail) / (1.0 + z * z - 2.0 * tail))

    found = minimize_scalar(negative_rho, bounds=(0.0, 8.0), method="bounded")
    return -float(found.fun)


def skin_points(quick: bool, seed: int) -> list[dict[str, Any]]:
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


def measure_skin(point: dict[str, Any]) -> dict[str, Any]:
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
        errors = [frame_errors(frames[judged], truth[judged]) for frames in (solved, readings)]
        gains.append(mean_psnr(errors[0], truth[judged]) - mean_psnr(errors[1], truth[judged]))
    return {"k_over_m": float(np.mean(counts)) / m, "gain_db": float(np.mean(gains))}


def section(out: Path, quick: bool, seed: int, executor: str) -> dict[str, Any]:
    """Compute and draw; the values for the page."""
    l1_rows = compute_rows(measure_l1, l1_points(quick, seed), out, executor, "phase transition")
    asked = skin_points(quick, seed)
    skin_rows = compute_rows(measure_skin, asked, out, executor, "phase, each solver")
    l1, skin = pd.DataFrame(l1_rows), pd.DataFrame(skin_rows)
    return {
        "l1_chart": _chart(
            out,
            "phase_l1",
            "Phase transition of l1 against the theory.",
            {f"FISTA, Phi {phi}": some for phi, some in l1.groupby("phi", sort=False)},
            ("rho", "success"),
            {"cmap": "cividis", "vmin": 0.0, "vmax": 1.0},
            {"label": "found, share of trials"},
        ),
        "l1_table": _l1_table(l1),
        "l1_csv": write_csv(out, "phase_l1", l1_rows),
        "skin_chart": _chart(
            out,
            "phase_skin",
            "PSNR above that of the readings: each solver, settled, pads at random places.",
            {solver: skin[skin["solver"] == solver] for solver in SUM_SOLVERS},
            ("k_over_m", "gain_db"),
            {"cmap": "RdBu", "vmin": -15.0, "vmax": 15.0, "edgecolors": "#999999", "lw": 0.3},
            {"label": "dB above the readings of all taxels", "extend": "both"},
        ),
        "skin_table": _skin_table(skin),
        "skin_csv": write_csv(out, "phase_skin", skin_rows),
    }


def _chart(
    out: Path,
    name: str,
    caption: str,
    frames: dict[str, pd.DataFrame],
    columns: tuple[str, str],
    style: dict[str, Any],
    bar: dict[str, Any],
) -> str:
    """Map of one figure over M/N and K/M in a panel each, with the threshold of theory."""
    is_l1 = name == "phase_l1"
    n_columns = 2 if is_l1 else 3
    width_in, height_in = (3.6, 3.2) if is_l1 else (3.1, 2.6)
    n_rows = -(-len(frames) // n_columns)
    size_in = (width_in * n_columns, height_in * n_rows + 0.6)
    deltas = np.linspace(0.03, 0.99, 60)
    threshold = [weak_threshold(delta) for delta in deltas]
    with Chart(out, name, caption, len(frames), n_columns, size_in=size_in) as chart:
        for axes, (title, frame) in zip(chart.panels, frames.items(), strict=True):
            y, colour = (frame[column] for column in columns)
            spots = axes.scatter(frame["delta"], y, c=colour, marker="s", s=45, **style)
            axes.set(title=title, xlim=(0.0, 1.0), ylim=(0.0, 0.8))
            if not is_l1:
                axes.set(xlim=(0.025, 1.0), xscale="log")
                ticks = (32, 16, 8, 4, 2)
                axes.set_xticks([1 / k for k in ticks], [f"1/{k}" for k in ticks])
                axes.minorticks_off()
            label = "l1 finds nearly all below (Donoho, Tanner)"
            colour_of_line = "#D55E00" if is_l1 else "#000000"
            axes.plot(deltas, threshold, color=colour_of_line, lw=1.6, label=label)
        chart.label("M/N", "K/M")
        chart.figure.colorbar(spots, ax=chart.panels, **bar)
    return chart.markdown


def _l1_table(frame: pd.DataFrame) -> pd.DataFrame:
    lines = []
    for (phi, delta), some in frame.groupby(["phi", "delta"], sort=False):
        half = crossing(some["rho"], some["success"], 0.5)
        found = "-" if half is None else f"{half:.2f}"
        lines.append((phi, f"{delta:.2f}", found, f"{weak_threshold(delta):.2f}"))
    columns = ["Phi", "M/N", "K/M at which half are found", "theory"]
    return pd.DataFrame(lines, columns=columns)


def _skin_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Largest K/M at which each solver is at least as good as the readings."""
    lines = []
    for solver, of_solver in frame.groupby("solver", sort=False):
        line = {"solver": solver}
        for delta, some in of_solver.groupby("delta", sort=False):
            gains, ratios = some["gain_db"].tolist(), some["k_over_m"].tolist()
            edge = crossing(ratios, gains, 0.0)
            never_fails = f"> {ratios[-1]:.2f}" if gains[0] >= 0.0 else "-"
            line[f"N/{1 / delta:.3g}"] = f"{edge:.2f}" if edge else never_fails
        lines.append(line)
    return pd.DataFrame(lines)


def crossing(xs: Sequence[float], ys: Sequence[float], level: float) -> float | None:
    """Place where a falling curve first passes below a level, between its points; None: nowhere."""
    for x0, x1, y0, y1 in zip(xs, xs[1:], ys, ys[1:], strict=False):
        if y0 >= level > y1:
            return x0 + (x1 - x0) * (y0 - level) / (y0 - y1)
    return None
