"""The phase transitions, drawn and explained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sparseskin.studies.points import compute
from sparseskin.studies.report import (
    chart_style,
    legend_outside,
    markdown_table,
    save_figure,
    write_csv,
)
from sparseskin.studies.solvers import SUM_SOLVERS
from sparseskin.studies.stability_charts import label_outer, panels
from sparseskin.studies.stability_phase import (
    l1_points,
    measure_l1,
    measure_skin,
    skin_points,
    weak_threshold,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = Mapping[str, Any]

_L1_TEXT = """## Solvers: how many measurements a frame needs

K coefficients at random places of 32 x 32, exact measurements, FISTA run to its end: the share of
trials in which it finds them, over M/N and K/M. The line is the weak threshold of Donoho and
Tanner, proven for Gaussian Phi and large N. It fails above the line because l1 then prefers
another, denser set of coefficients that gives the same measurements: no solver of the same problem
does better, only one that knows more (x ≥ 0, the last frame, coefficients that come together)."""

_SKIN_TEXT = """The same over frames of a skin, with its noise: pads of 1 to 12 taxels a side, at
random places, on 40 x 40 taxels; K counts the Haar coefficients of the true frame. The settled
PSNR less that of the readings: blue is better than reading every taxel, red is worse."""


def section(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute, draw and explain."""
    asked = l1_points(quick, seed)
    found = compute(measure_l1, asked, out, executor, "phase transition")
    l1_rows = [{**p, **f} for p, f in zip(asked, found, strict=True)]
    asked = skin_points(quick, seed)
    gains = compute(measure_skin, asked, out, executor, "phase, each solver")
    skin_rows = [{**p, **f} for p, f in zip(asked, gains, strict=True)]
    with chart_style():
        charts = [_draw_l1(out, l1_rows), _draw_skin(out, skin_rows)]
    return [
        _L1_TEXT,
        charts[0],
        _l1_table(l1_rows),
        _SKIN_TEXT,
        charts[1],
        _skin_table(skin_rows),
        f"All figures: {write_csv(out, 'phase_l1', l1_rows)}, "
        f"{write_csv(out, 'phase_skin', skin_rows)}.",
    ]


def _draw_l1(out: Path, rows: Sequence[Row]) -> str:
    kinds = list(dict.fromkeys(row["phi"] for row in rows))
    figure, axes = panels(len(kinds), 2, 3.6, 3.2)
    for one, kind in zip(axes, kinds, strict=True):
        mine = [row for row in rows if row["phi"] == kind]
        spots = one.scatter(
            [row["delta"] for row in mine],
            [row["rho"] for row in mine],
            c=[row["success"] for row in mine],
            cmap="cividis",
            vmin=0.0,
            vmax=1.0,
            marker="s",
            s=45,
        )
        one.set(title=f"FISTA, Phi {kind}", xlim=(0.0, 1.0), ylim=(0.0, 0.8))
        _draw_threshold(one, "#D55E00")
    label_outer(axes, 2, "M/N", "K/M")
    figure.colorbar(spots, ax=axes, label="found, share of trials")
    legend_outside(figure)
    caption = "Phase transition of l1 against the theory."
    return save_figure(figure, out, "phase_l1", caption)


def _draw_skin(out: Path, rows: Sequence[Row]) -> str:
    n_columns = min(3, len(SUM_SOLVERS))
    figure, axes = panels(len(SUM_SOLVERS), n_columns)
    for one, solver in zip(axes, SUM_SOLVERS, strict=True):
        mine = [row for row in rows if row["solver"] == solver]
        spots = one.scatter(
            [row["delta"] for row in mine],
            [row["k_over_m"] for row in mine],
            c=[row["gain_db"] for row in mine],
            cmap="RdBu",
            vmin=-15.0,
            vmax=15.0,
            marker="s",
            s=45,
            edgecolors="#999999",
            linewidths=0.3,
        )
        one.set(title=solver, xlim=(0.025, 1.0), xscale="log", ylim=(0.0, 0.8))
        ticks = [1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2]
        one.set_xticks(ticks, [f"1/{round(1 / tick)}" for tick in ticks])
        one.minorticks_off()
        _draw_threshold(one, "#000000")
    label_outer(axes, n_columns, "M/N", "K/M")
    figure.colorbar(spots, ax=axes, label="dB above the readings of all taxels", extend="both")
    legend_outside(figure)
    caption = "PSNR above that of the readings: each solver, settled, pads at random places."
    return save_figure(figure, out, "phase_skin", caption)


def _draw_threshold(axes: Axes, color: str) -> None:
    deltas = np.linspace(0.03, 0.99, 60)
    label = "l1 finds nearly all below (Donoho, Tanner)"
    axes.plot(deltas, [weak_threshold(d) for d in deltas], color=color, lw=1.6, label=label)


def _l1_table(rows: Sequence[Row]) -> str:
    lines = []
    for phi, delta in dict.fromkeys((row["phi"], row["delta"]) for row in rows):
        mine = [row for row in rows if (row["phi"], row["delta"]) == (phi, delta)]
        half = crossing([r["rho"] for r in mine], [r["success"] for r in mine], 0.5)
        theory = weak_threshold(delta)
        lines.append([phi, f"{delta:.2f}", "-" if half is None else f"{half:.2f}", f"{theory:.2f}"])
    return markdown_table(["Phi", "M/N", "K/M at which half are found", "theory"], lines)


def _skin_table(rows: Sequence[Row]) -> str:
    """Up to which K/M each solver is at least as good as the readings."""
    deltas = list(dict.fromkeys(row["delta"] for row in rows))
    lines = []
    for solver in SUM_SOLVERS:
        cells = []
        for delta in deltas:
            mine = [r for r in rows if (r["solver"], r["delta"]) == (solver, delta)]
            best = mine[0]["gain_db"] >= 0.0
            edge = crossing([r["k_over_m"] for r in mine], [r["gain_db"] for r in mine], 0.0)
            last = mine[-1]["k_over_m"]
            cells.append(f"{edge:.2f}" if edge else (f"> {last:.2f}" if best else "-"))
        lines.append([solver, *cells])
    header = [f"N/{1 / delta:.3g}" for delta in deltas]
    return (
        "K/M up to which each solver is as good as the readings (-: nowhere that was looked at):"
        "\n\n" + markdown_table(["solver", *header], lines)
    )


def crossing(xs: Sequence[float], ys: Sequence[float], level: float) -> float | None:
    """Where a falling curve first goes below a level, between its points; None: nowhere."""
    for x0, x1, y0, y1 in zip(xs, xs[1:], ys, ys[1:], strict=False):
        if y0 >= level > y1:
            return x0 + (x1 - x0) * (y0 - level) / (y0 - y1)
    return None
