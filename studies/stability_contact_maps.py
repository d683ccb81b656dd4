"""The maps of the contact integrators, drawn and explained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sparseskin.studies.points import compute
from sparseskin.studies.report import (
    MARKERS,
    chart_style,
    legend_outside,
    markdown_table,
    save_figure,
    write_csv,
)
from sparseskin.studies.stability_charts import label_outer, panels
from sparseskin.studies.stability_contact import HIGH, LOW, measure, points
from sparseskin.studies.stability_integrators import INTEGRATORS, growth, stability_margin

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Grid = npt.NDArray[np.float64]
Maps = dict[str, dict[str, Grid]]
#: More than this is counted as growth, or as energy that was made: beyond rounding.
NOTHING = 1e-6
CHATTER = 0.25

_TEXT = """## Contact: time integrators

A mass on a spring-damper, over ω·dt (ω² = Σk/m) and c·dt/m. What is stable depends on these two
alone. `growth`: factor by which a small swing on a bed that it never leaves grows in a step,
measured, and from the eigenvalues of the method; the black line is the boundary of theory.
`chatter`: share of the first 40 steps at which the speed reverses while a hundredth of the swing
is left, less that of the exact motion; beyond ω·dt = π no steps can show the swing.
`rebound`: a mass dropped on a bed that pushes and never pulls, its largest energy after touching
over that before. Numbered markers: the largest ω·dt and c·dt/m that each scene reaches, with its
ground and its tilt."""

_REASONS = {
    "explicit Euler": "forces of the past push a body that has moved on: each step turns "
    "(ω·dt)²/2 of the swing into energy, which only damping between (ω·dt)² and 2 takes away",
    "semi-implicit Euler": "beyond (ω·dt)² + 2c·dt/m = 4 one step overshoots by more than it "
    "corrects; on a bed that it leaves it makes energy earlier, as contact begins and ends within "
    "a step",
    "implicit Euler": "never unstable, but at ω·dt near 1 the method itself damps: an undamped "
    "body does not bounce",
    "SDIRK2 (the scenes)": "never unstable: L-stable on a linear bed, and where cells come into "
    "contact or leave it the step is divided, at last into implicit Euler, which makes no energy",
    "exact": "the yardstick of the linear bed: a damped swing never grows; on a bed that the body "
    "leaves, there is no closed form",
}


def section(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute, draw and explain."""
    asked = points(quick, seed)
    figures = compute(measure, asked, out, executor, "contact")
    axis = np.array(asked[0]["omega_dts"])
    pairs = list(zip(asked, figures, strict=True))
    scenes = {point["scene"]: figure for point, figure in pairs if "scene" in point}
    maps: Maps = {}
    for method in INTEGRATORS:
        mine = [figure for point, figure in pairs if point.get("method") == method]
        for name in mine[0]:
            maps.setdefault(name, {})[method] = np.array([figure[name] for figure in mine])
    # Beyond half a swing a step, what the steps of the exact motion show is not its swing.
    seen = np.where(axis < np.pi, 1.0, np.nan)
    excess = {m: (maps["reversals"][m] - maps["reversals"]["exact"]) * seen for m in INTEGRATORS}
    with chart_style():
        charts = [
            _chart(out, "contact_growth", "growth a step", maps["growth"], axis, scenes, log=True),
            _chart(out, "contact_chatter", "chatter", excess, axis, scenes, log=False),
            _chart(out, "contact_rebound", "rebound", maps["rebound"], axis, scenes, log=True),
        ]
    rows = [
        {
            "method": method,
            "omega_dt": float(axis[j]),
            "c_dt_over_m": float(axis[i]),
            **{name: float(maps[name][method][i, j]) for name in maps if method in maps[name]},
        }
        for method in INTEGRATORS
        for i in range(len(axis))
        for j in range(len(axis))
    ]
    for row in rows:
        row.setdefault("rebound", "")
    return [
        _TEXT,
        *charts,
        _table(maps, excess, axis),
        "Where the scenes lie, and whether an explicit method would hold there:",
        _places_table(scenes),
        "No setting reaches the contact: every scene brings its own, and `RigidBody` holds at any "
        "step, so there is nothing to refuse. All figures: "
        + write_csv(out, "contact", rows)
        + ".",
    ]


def _places_table(scenes: Mapping[str, Mapping[str, float]]) -> str:
    explicit = ("explicit Euler", "semi-implicit Euler")
    lines = []
    for k, (name, place) in enumerate(scenes.items()):
        at = (place["omega_dt"], place["c_dt_over_m"])
        holds = ["holds" if growth(method, *at) <= 1.0 else "blows up" for method in explicit]
        lines.append([k + 1, name, *(f"{value:.3f}" for value in at), *holds])
    return markdown_table(["", "scene", "ω·dt", "c·dt/m", *explicit], lines)


def _table(maps: Maps, excess: Mapping[str, Grid], axis: Grid) -> str:
    lines = []
    for method in INTEGRATORS:
        grown = maps["growth"][method] > 1 + NOTHING
        theory = maps["theory"][method] > 1 + NOTHING
        rebound = maps["rebound"].get(method)
        off = axis[np.any(grown, axis=0)]
        lines.append(
            [
                method,
                f"{100 * np.mean(grown):.0f} %",
                f"{100 * np.mean(grown == theory):.1f} %",
                f"{off.min():.2f}" if off.size else "-",
                f"{100 * np.mean(excess[method][:, axis < np.pi] > CHATTER):.0f} %",
                "-" if rebound is None else f"{100 * np.mean(rebound > 1 + NOTHING):.0f} %",
                _REASONS[method],
            ]
        )
    header = [
        "integrator",
        "unstable",
        "as theory says",
        "from ω·dt",
        "chatters (ω·dt < π)",
        "makes energy",
    ]
    return markdown_table([*header, "why"], lines)


def _chart(
    out: Path,
    name: str,
    what: str,
    maps: Mapping[str, Grid],
    axis: Grid,
    scenes: Mapping[str, Mapping[str, float]],
    log: bool,
) -> str:
    from matplotlib.colors import LogNorm, Normalize

    figure, axes = panels(len(maps), 3 if len(maps) > 4 else 2, 3.3, 3.0)
    norm = LogNorm(0.01, 100.0) if log else Normalize(-1.0, 1.0)
    half = np.sqrt(axis[1] / axis[0])
    edges = np.append(axis / half, axis[-1] * half)
    mesh = None
    for one, (method, values) in zip(axes, maps.items(), strict=True):
        one.set(xscale="log", yscale="log", title=method, xlim=edges[[0, -1]], ylim=edges[[0, -1]])
        one.grid(False)
        one.minorticks_off()
        shown = np.clip(values, 0.01, 100.0) if log else values
        mesh = one.pcolormesh(edges, edges, shown, norm=norm, cmap="RdBu_r", rasterized=True)
        _draw_boundary(one, method)
        _draw_scenes(one, scenes)
    label_outer(axes, 3 if len(maps) > 4 else 2, "ω·dt", "c·dt/m")
    if mesh is not None:
        figure.colorbar(mesh, ax=axes, label=what + (" (white: 1)" if log else ""), shrink=0.8)
    legend_outside(figure, n_columns=3)
    caption = f"Contact: {what} over ω·dt and c·dt/m; black: where theory puts the boundary."
    return save_figure(figure, out, name, caption)


def _draw_boundary(axes: Axes, method: str) -> None:
    fine = np.geomspace(LOW, HIGH, 400)
    margin = stability_margin(method, *np.meshgrid(fine, fine))
    if margin is not None:
        axes.contour(fine, fine, margin, levels=[0.0], colors="black", linewidths=1.6)
        axes.plot([], [], color="black", linewidth=1.6, label="edge of stability, in theory")


def _draw_scenes(axes: Axes, scenes: Mapping[str, Mapping[str, float]]) -> None:
    for k, (name, place) in enumerate(scenes.items()):
        axes.plot(
            [place["omega_dt"]],
            [place["c_dt_over_m"]],
            MARKERS[k],
            color="white",
            markeredgecolor="black",
            markersize=6,
            label=f"{k + 1} {name}",
        )
