"""Sweeps over one quantity at a time, drawn and tabulated: one line for each solver."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.studies.points import Figures, compute
from sparseskin.studies.report import chart_style, legend_outside, markdown_table, save_figure
from sparseskin.studies.stability_charts import FLOOR_DB, by_solver, draw_solvers, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = Mapping[str, Any]
#: So much below the best of its sweep, in PSNR or over the touched taxels, is called failing.
FAILS_DB = 3.0
#: What the axes call the scores, and where they are cut off below.
_SCORES = {"psnr_db": ("PSNR, dB", FLOOR_DB), "touched_db": ("SNR where touched, dB", 0.0)}


@dataclass(frozen=True)
class Sweep:
    """One quantity that is swept.

    Attributes
    ----------
    label : str
        What the axis says.
    why : str
        Why it fails, in one sentence.
    done : str
        What the program does about it.
    scale : str
        "linear" or "log".
    edges : mapping of str to float
        Where theory puts an edge, by its name.
    against_readings : bool
        Whether a solver fails where it is worse than the readings, which change with it.
    """

    label: str
    why: str
    done: str
    scale: str = "linear"
    edges: Mapping[str, float] = field(default_factory=dict)
    against_readings: bool = False


def rows_of(
    function: Callable[[dict[str, Any]], Figures],
    points: Sequence[Row],
    out: Path,
    executor: str,
    label: str,
) -> list[dict[str, Any]]:
    """Points together with their figures."""
    figures = compute(function, points, out, executor, label)
    return [{**point, **figure} for point, figure in zip(points, figures, strict=True)]


def draw_sweeps(
    out: Path,
    name: str,
    caption: str,
    rows: Sequence[Row],
    sweeps: Mapping[str, Sweep],
    n_columns: int,
) -> str:
    """One panel of PSNR, and below it one of SNR over the touched taxels, for each sweep."""
    with chart_style():
        figure, axes = panels(2 * len(sweeps), n_columns, 2.9, 2.3)
        for k, (key, sweep) in enumerate(sweeps.items()):
            mine = [row for row in rows if row["sweep"] == key]
            for below, (score, (title, floor_db)) in enumerate(_SCORES.items()):
                one = axes[2 * n_columns * (k // n_columns) + below * n_columns + k % n_columns]
                noisy = next(iter(by_solver(mine, "value", f"noisy_{score}").values()))
                draw_solvers(one, by_solver(mine, "value", score), noisy, floor_db)
                one.set(xscale=sweep.scale, xlabel=sweep.label if below else "")
                one.set_ylabel(title if k % n_columns == 0 else "")
                _draw_edges(one, sweep.edges)
        legend_outside(figure, n_columns=5)
        return save_figure(figure, out, name, caption)


def _draw_edges(axes: Axes, edges: Mapping[str, float]) -> None:
    for name, edge in edges.items():
        axes.axvline(edge, color="black", lw=1.0, ls=":")
        axes.annotate(
            name,
            (edge, 0.03),
            xycoords=("data", "axes fraction"),
            rotation=90,
            fontsize=7,
            ha="right",
            va="bottom",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
        )


def sweep_table(rows: Sequence[Row], sweeps: Mapping[str, Sweep]) -> str:
    """For each sweep and solver: its best, its worst, and where it fails."""
    lines = []
    for key, sweep in sweeps.items():
        mine = [row for row in rows if row["sweep"] == key]
        for solver in dict.fromkeys(row["solver"] for row in mine):
            some = [row for row in mine if row["solver"] == solver]
            best = max(some, key=lambda row: row["psnr_db"])
            worst = min(some, key=lambda row: row["psnr_db"])
            lines.append([key, solver, _both(best), _both(worst), failing(some, sweep)])
            key = ""
    header = ["swept", "solver", "best, dB (where touched)", "worst", "fails"]
    return markdown_table(header, lines)


def reasons_table(sweeps: Mapping[str, Sweep]) -> str:
    """Why each fails, and what the program does about it."""
    return markdown_table(
        ["swept", "why it fails", "what the program does"],
        [[key, sweep.why, sweep.done] for key, sweep in sweeps.items()],
    )


def failing(rows: Sequence[Row], sweep: Sweep) -> str:
    """Where one solver fails in a sweep, as text: below and above its best value."""
    values, losses = [row["value"] for row in rows], [-math.inf] * len(rows)
    for score in _SCORES:
        wanted = [row[f"noisy_{score}"] for row in rows]
        if not sweep.against_readings:
            wanted = [max(row[score] for row in rows) - FAILS_DB] * len(rows)
        losses = [max(a, b - row[score]) for a, b, row in zip(losses, wanted, rows, strict=True)]
    best = values[losses.index(min(losses))]
    failed = [value for value, loss in zip(values, losses, strict=True) if loss > 0.0]
    if len(failed) == len(values):
        return "everywhere"
    below = [f"≤ {value:.3g}" for value in failed if value < best]
    above = [f"≥ {value:.3g}" for value in failed if value > best]
    return " and ".join(below[-1:] + above[:1]) or "nowhere"


def _both(row: Row) -> str:
    return f"{row['psnr_db']:.1f} ({row['touched_db']:.1f}) at {row['value']:.3g}"
