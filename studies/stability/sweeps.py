"""Sweeps over one quantity at a time, drawn and tabulated: one line for each solver."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes

from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.report import Chart, draw_lines

FLOOR_DB, CEILING_DB = 10.0, 70.0
"""Where curves are cut off, dB: below, all has failed; above, all is good."""
FAILS_DB = 3.0
"""Loss from the best of a sweep that counts as failing, in PSNR or over the touched taxels."""
#: Labels of the scores on the axes, and where they are cut off below.
_SCORES = {"psnr_db": ("PSNR, dB", FLOOR_DB), "touched_db": ("SNR where touched, dB", 0.0)}
#: Style of the name of an edge.
_EDGE: dict[str, Any] = {
    **{"xycoords": ("data", "axes fraction"), "rotation": 90, "fontsize": 7},
    **{"ha": "right", "va": "bottom"},
    "bbox": {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
}


@dataclass(frozen=True)
class Sweep:
    """One quantity that is swept.

    Attributes
    ----------
    label : str
        Label of the axis.
    values, quick : sequence of float
        In a full and in a quick run.
    scale : str
        "linear" or "log".
    edges : mapping of str to float
        Edges by theory, by name.
    against_readings : bool
        True if a solver fails where it is worse than the readings, which change with the quantity.
    """

    label: str
    values: Sequence[float] = ()
    quick: Sequence[float] = ()
    scale: str = "linear"
    edges: Mapping[str, float] = field(default_factory=dict)
    against_readings: bool = False


def sweep_points(sweeps: Mapping[str, Sweep], quick: bool) -> list[dict[str, Any]]:
    """Every solver over each quantity."""
    return [
        {"sweep": key, "value": value, "solver": solver}
        for solver in SUM_SOLVERS
        for key, sweep in sweeps.items()
        for value in (sweep.quick if quick else sweep.values)
    ]


def draw_solvers(
    axes: Axes, frame: pd.DataFrame, x: str, y: str, noisy: str, floor_db: float = FLOOR_DB
) -> None:
    """Draw decibels within the limits: one line for each solver, and one for the readings."""
    frame = frame.assign(**{one: frame[one].clip(floor_db, CEILING_DB) for one in (y, noisy)})
    readings = frame[frame["solver"] == frame["solver"].iloc[0]]
    label = "readings of all taxels"
    axes.plot(
        readings[x], readings[noisy], label=label, color="#555555", lw=2.2, alpha=0.6, zorder=1
    )
    draw_lines(axes, frame, x, y, "solver", SUM_SOLVERS, markersize=3.5)


def draw_sweeps(
    out: Path, name: str, caption: str, frame: pd.DataFrame, sweeps: Mapping[str, Sweep]
) -> str:
    """Chart of sweeps, three in a row: PSNR, and below it SNR over the touched taxels."""
    n_panels = 2 * len(sweeps)
    size_in = (3 * 2.9, -(-n_panels // 3) * 2.3 + 0.6)
    chart = Chart(out, name, caption, n_panels, 3, size_in=size_in, legend_columns=5)
    with chart:
        for k, (key, sweep) in enumerate(sweeps.items()):
            for below, (score, (title, floor_db)) in enumerate(_SCORES.items()):
                axes = chart.panels[6 * (k // 3) + 3 * below + k % 3]
                some = frame[frame["sweep"] == key]
                draw_solvers(axes, some, "value", score, f"noisy_{score}", floor_db)
                axes.set(xscale=sweep.scale, xlabel=sweep.label if below else "")
                axes.set_ylabel("" if k % 3 else title)
                for edge, at in sweep.edges.items():
                    axes.axvline(at, color="black", lw=1.0, ls=":")
                    axes.annotate(edge, (at, 0.03), **_EDGE)
    return chart.markdown


def sweep_table(frame: pd.DataFrame, sweeps: Mapping[str, Sweep]) -> pd.DataFrame:
    """Best and worst of each sweep and solver, and where the solver fails."""

    def both(row: pd.Series) -> str:
        return f"{row['psnr_db']:.1f} ({row['touched_db']:.1f}) at {row['value']:.3g}"

    lines = []
    for key, sweep in sweeps.items():
        for solver, some in frame[frame["sweep"] == key].groupby("solver", sort=False):
            best, worst = some["psnr_db"].idxmax(), some["psnr_db"].idxmin()
            lines.append(
                {
                    "swept": key,
                    "solver": solver,
                    "best, dB (where touched)": both(some.loc[best]),
                    "worst": both(some.loc[worst]),
                    "fails": failing(some, sweep),
                }
            )
            key = ""
    return pd.DataFrame(lines)


def failing(frame: pd.DataFrame, sweep: Sweep) -> str:
    """Values at which one solver fails in a sweep, as text: below and above its best value."""
    loss = pd.Series(-math.inf, frame.index)
    for score in _SCORES:
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
