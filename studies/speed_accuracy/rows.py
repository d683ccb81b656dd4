"""Variants of solvers in `speed-accuracy`, and their figures by scene and pooled."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.scene_frames import shape_of

PAPER_LABEL = "fista, preset paper"
CENTRE_RATIO = 3
#: Dead zones of the full reading, newtons.
DEAD_ZONES_N = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1)
#: The paper's lambda that serves it best: a second yardstick.
TUNED_LAMBDA_N = 0.0125
VARIED = {
    "skin, rotating rows": {**PRESETS["skin"], "rows": ROTATING},
    "fista, tuned": {**PRESETS["paper"], "lambda_n": TUNED_LAMBDA_N},
}
COMPILED = {"skin, compiled": {**PRESETS["skin"], "fast": "on"}}


def variants() -> dict[str, dict[str, Any]]:
    """Solvers by the label they are shown with: solver, basis and settings.

    Each preset, `skin` with rotating rows and (with numba) in compiled loops, the tuned FISTA,
    and each solver that has no preset with its own defaults.
    """
    found = {f"{preset['solver']}, preset {name}": dict(preset) for name, preset in PRESETS.items()}
    varied = VARIED | (COMPILED if find_spec("numba") else {})
    found |= {label: dict(chosen) for label, chosen in varied.items()}
    covered = {chosen["solver"] for chosen in found.values()}
    found |= {
        name: {"solver": name, "basis": "haar"} for name in SUM_SOLVERS if name not in covered
    }
    return found


@dataclass(frozen=True)
class Row:
    """One solver with one setting, on one scene or pooled over the scenes of one size.

    Attributes
    ----------
    panel : str
        The scene, or "N = 1600": means over scenes, the worst frame of all.
    label : str
        Solver and settings as shown.
    phi, basis : str
    ratio : int
        N / M.
    iterations : float
        Done a frame, in the mean: some solvers do more where a frame needs it.
    stated : int or None
        Iterations that were set; None: the solver's own.
    mean_db, worst_db : float
        PSNR over the frames in contact.
    touched_mn : float
        Root mean square error of touched taxels, mN.
    median_ms : float
        Processor time of a frame's solve.
    p99_ms : float
        Time of a solve by the clock.
    cpu_share : float
        Part of the solve time in which the process had a core; the least of the scenes.
    n_bytes : int
        Of a frame's message.
    own : bool
        True if the iterations are the solver's or preset's own.
    """

    panel: str
    label: str
    phi: str
    basis: str
    ratio: int
    iterations: float
    stated: int | None
    mean_db: float
    worst_db: float
    touched_mn: float
    median_ms: float
    p99_ms: float
    cpu_share: float
    n_bytes: int
    own: bool


@dataclass(frozen=True)
class Reading:
    """The noisy reading of all taxels, with the dead zone that serves it best, or none."""

    mean_db: float
    worst_db: float
    dead_zone_n: float
    n_bytes: int


@dataclass(frozen=True)
class Results:
    """Figures of the study.

    Attributes
    ----------
    solvers : dict
        By panel: rows of every solver, iterations and M swept.
    parts : dict
        By panel "N = ...": rows of every basis and every Phi, with the paper's solver.
    raw, zoned : dict
        By panel: the full reading as it is, and with its best dead zone.
    raced : list of dict
        Points and figures of the libraries.
    refused : list of (str, str)
        Points that are not possible, and why.
    """

    solvers: dict[str, list[Row]]
    parts: dict[str, list[Row]]
    raw: dict[str, Reading]
    zoned: dict[str, Reading]
    parts_raw: dict[str, Reading]
    raced: list[dict[str, Any]]
    refused: list[tuple[str, str]]

    @property
    def pools(self) -> list[str]:
        """Panels that are pooled over scenes."""
        return [panel for panel in self.solvers if panel.startswith("N = ")]

    @property
    def scenes(self) -> list[str]:
        """Panels that are one scene."""
        return [panel for panel in self.solvers if panel not in self.pools]


def gather(
    points: Sequence[dict[str, Any]],
    figures: Sequence[dict[str, Any]],
    quick: bool,
    full: Mapping[str, dict[str, Any]],
    full_short: Mapping[str, dict[str, Any]],
    raced: list[dict[str, Any]],
) -> Results:
    """Sort figures into the tables and charts of the page.

    Parameters
    ----------
    points, figures : sequence of dict
        Of `timed`, in the same order.
    quick : bool
    full, full_short : mapping of str to dict
        Of `full_reading`, by scene; on all frames and on the few of `parts`.
    raced : list of dict
        Points of `race` with their figures.
    """
    chosen = variants()
    solvers: dict[str, list[Row]] = {}
    parts: dict[str, list[Row]] = {}
    refused: dict[str, str] = {}
    for point, figure in zip(points, figures, strict=True):
        if "refused" in figure:
            what = f"{point['label']}, {point['phi']}, {point['basis']}, N/{point['ratio']}"
            refused[what] = figure["refused"]
            continue
        row = _row(point, figure, chosen[point["label"]])
        in_own_basis = row.basis == chosen[row.label]["basis"]
        if point["short"] == quick and in_own_basis and row.phi in ("sbhe", "full"):
            solvers.setdefault(row.panel, []).append(row)
        if row.label == PAPER_LABEL and point["short"] and row.own:
            parts.setdefault(row.panel, []).append(row)
    raw, zoned = _readings(full)
    parts_raw, _ = _readings(full_short)
    return Results(
        solvers=_pooled(solvers) | solvers,
        parts=_pooled(parts),
        raw=raw,
        zoned=zoned,
        parts_raw=parts_raw,
        raced=raced,
        refused=list(refused.items()),
    )


def pool_of(scene: str) -> str:
    """The panel that a scene is pooled into."""
    rows, cols = shape_of(scene)
    return f"N = {rows * cols}"


def front(rows: Iterable[Row], x: str, y: str) -> list[Row]:
    """Pareto front: the least x first, and each after it with a higher y."""
    best: list[Row] = []
    for row in sorted(rows, key=lambda row: (getattr(row, x), -getattr(row, y))):
        if not best or getattr(row, y) > getattr(best[-1], y):
            best.append(row)
    return best


def swept_iterations(rows: Iterable[Row], label: str) -> list[Row]:
    """A solver's rows at M = N/3, fewest iterations first."""
    found = [r for r in rows if (r.label, r.ratio, r.phi) == (label, CENTRE_RATIO, "sbhe")]
    # With its own iterations set, a solver does the same again: that is shown once.
    once = {row.iterations: row for row in sorted(found, key=lambda row: row.own)}
    return sorted(once.values(), key=lambda row: row.iterations)


def swept_m(rows: Iterable[Row], label: str) -> list[Row]:
    """A solver's rows at its own iterations, fewest measurements first."""
    found = [row for row in rows if (row.label, row.phi) == (label, "sbhe") and row.own]
    return sorted(found, key=lambda row: -row.ratio)


def labels_of(rows: Iterable[Row]) -> list[str]:
    """Labels in the order in which they first come."""
    return list(dict.fromkeys(row.label for row in rows))


def _row(point: Mapping[str, Any], figure: Mapping[str, Any], chosen: Mapping[str, Any]) -> Row:
    same = {key: figure[key] for key in ("mean_db", "worst_db", "touched_mn")}
    return Row(
        panel=point["scene"],
        **{key: point[key] for key in ("label", "phi", "basis", "ratio")},
        iterations=figure["done"],
        stated=point.get("iterations"),
        **same,
        median_ms=figure["median_ms"],
        p99_ms=figure["p99_ms"],
        cpu_share=figure["cpu_share"],
        n_bytes=figure["bytes"],
        own=point.get("iterations") == chosen.get("iterations"),
    )


def _pooled(by_scene: Mapping[str, list[Row]]) -> dict[str, list[Row]]:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for scene, rows in by_scene.items():
        for row in rows:
            key = (pool_of(scene), row.label, row.phi, row.basis, row.ratio, row.stated)
            groups.setdefault((*key, row.own), []).append(row)
    pooled: dict[str, list[Row]] = {}
    for (panel, *_), rows in groups.items():
        means: dict[str, Any] = {
            name: float(np.mean([getattr(row, name) for row in rows]))
            for name in ("mean_db", "touched_mn", "median_ms", "p99_ms", "iterations")
        }
        means["worst_db"] = min(row.worst_db for row in rows)
        means["cpu_share"] = min(row.cpu_share for row in rows)
        pooled.setdefault(panel, []).append(replace(rows[0], panel=panel, **means))
    return dict(sorted(pooled.items()))


def _readings(
    full: Mapping[str, dict[str, Any]],
) -> tuple[dict[str, Reading], dict[str, Reading]]:
    """The raw reading and the one with the best dead zone, by panel."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for scene, figure in full.items():
        groups.setdefault(pool_of(scene), []).append(figure)
        groups[scene] = [figure]
    raw, zoned = {}, {}
    for panel, figures in groups.items():
        readings = [
            Reading(
                mean_db=float(np.mean([f["by_dead_zone"][k]["mean_db"] for f in figures])),
                worst_db=min(f["by_dead_zone"][k]["worst_db"] for f in figures),
                dead_zone_n=width_n,
                n_bytes=figures[0]["bytes"],
            )
            for k, width_n in enumerate(DEAD_ZONES_N)
        ]
        raw[panel] = readings[0]
        zoned[panel] = max(readings, key=lambda reading: reading.mean_db)
    return raw, zoned
