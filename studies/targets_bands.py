"""How often 90 % bands hold the truth in study `targets`: forces, their sum, its centre."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import mean
from typing import Any

import numpy as np

from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.presets import PRESETS
from sparseskin.nodes.reconstructor.resultant import Estimate, ResultantEstimator
from sparseskin.nodes.reconstructor.rotating import make_rotating_solver
from sparseskin.nodes.reconstructor.uncertainty import Uncertainty

from .report import markdown_table
from .scene_frames import in_contact
from .targets_points import TOUCHED, Floats, Point, frames_of, phases_at
from .targets_scenes import F_MAX_N

#: A band of so many standard deviations to each side is to hold 90 % of the truth.
DEVIATIONS = 1.645
HELD = ("touched", "untouched", "total", "row", "col")


def banded(point: Point) -> dict[str, Any]:
    """Restore a scene by "skin" with its standard deviations: how often their bands hold.

    Parameters
    ----------
    point : dict
        scene, ratio, rows ("fixed" or "rotating"), n_frames, seed.

    Returns
    -------
    dict
        By name in `HELD`, the part of all contact frames' bands that hold the truth, 0..1; NaN
        where there was none.
    """
    chosen = dict(PRESETS["skin"])
    held: dict[str, list[float]] = {name: [] for name in HELD}
    for k, (truth, taxels) in enumerate(
        frames_of(point["scene"], point["seed"], point["n_frames"])
    ):
        if not k:
            everywhere = np.ones(truth.shape, dtype=np.bool_)
            phases = phases_at(truth.size, point["ratio"], point["rows"], point["seed"])
            basis = make_basis(chosen.pop("basis"), *truth.shape)
            solver = make_rotating_solver(chosen.pop("solver"), phases, basis, everywhere, **chosen)
            uncertainty = Uncertainty(everywhere, phases[0].ratio, "skin", point["rows"])
            resultant = ResultantEstimator(phases[0], solver.taxels, truth.shape)
        phi = phases[k % len(phases)]
        y = phi.forward(taxels.reshape(-1))
        told = resultant.estimate(phi, y)
        solver.use(phi)
        forces = solver.solve(y)
        fitted = phi.forward(forces.reshape(-1))
        residual = math.sqrt(float(np.mean(np.square(fitted - y, dtype=np.float64))))
        sd = uncertainty.update(forces, residual)
        resultant.learn(phi, y, forces.reshape(-1), fitted)
        resultant.prepare(phases[(k + 1) % len(phases)])
        if in_contact(truth, F_MAX_N):
            _count(held, truth, np.abs(forces - truth) <= DEVIATIONS * sd, told)
    return {name: mean(values) if values else math.nan for name, values in held.items()}


def _count(held: dict[str, list[float]], truth: Floats, inside: Any, told: Estimate) -> None:
    touched = truth > TOUCHED * F_MAX_N
    held["touched"].append(float(inside[touched].mean()))
    held["untouched"].append(float(inside[truth == 0].mean()))
    total = float(truth.sum(dtype=np.float64))
    held["total"].append(abs(told.total - total) <= DEVIATIONS * told.total_sd)
    if told.centre is None or told.centre_sd is None:
        return
    places = np.indices(truth.shape, dtype=np.float64)
    for name, place, middle, deviation in zip(
        ("row", "col"), places, told.centre, told.centre_sd, strict=True
    ):
        centre = float((place * truth).sum()) / total
        held[name].append(abs(middle - centre) <= DEVIATIONS * deviation)


def bands_table(found: Sequence[tuple[Point, dict[str, Any]]]) -> str:
    """Coverage by scene, rows and ratio, and the mean over all scenes, as Markdown."""
    ratios = sorted({point["ratio"] for point, _ in found})
    of = {(p["scene"], p["rows"], p["ratio"]): figures for p, figures in found}
    kinds = list(dict.fromkeys((p["scene"], p["rows"]) for p, _ in found))
    rows = [
        [scene, how, *(_cell([of[scene, how, ratio]]) for ratio in ratios)] for scene, how in kinds
    ]
    for how in dict.fromkeys(how for _, how in kinds):
        cells = [
            _cell([figures for key, figures in of.items() if key[1:] == (how, ratio)])
            for ratio in ratios
        ]
        rows.append(["**mean**", how, *cells])
    text = (
        f"Of the bands of {DEVIATIONS} standard deviations to each side so many hold the truth in "
        "contact frames, % (wanted: 85 to 95): of touched taxels / of untouched ones / total "
        "force / row / column of its centre. The deviations' constants are fitted on these scenes' "
        "first 500 frames (not on N/4). Where a body lies still, what is off stays off: all frames "
        "are held then, or none.\n\n"
    )
    return text + markdown_table(["scene", "rows", *(f"N/{ratio}" for ratio in ratios)], rows)


def _cell(figures: Sequence[dict[str, float]]) -> str:
    shown = []
    for name in HELD:
        known = [f[name] for f in figures if not math.isnan(f[name])]
        shown.append(f"{100 * mean(known):.0f}" if known else "-")
    return " / ".join(shown)
