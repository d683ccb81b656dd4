"""Settings of the solvers, swept one at a time far beyond both ends."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from sparseskin.nodes.compressor.limits import MIN_BITS, MIN_BLOCK
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.limits import LAMBDAS_N, MIN_ITERATIONS
from sparseskin.studies.evaluate import SUM_SOLVERS, settings_of
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import Chart, Page, draw_lines, markdown

from .excerpts import SCORES, SHAPE, N, measured, read_excerpts, reconstruct, scores, solver_for

FLOOR_DB, CEILING_DB = 10.0, 70.0
"""Where curves are cut off, dB: below, all has failed; above, all is good."""
FAILS_DB = 3.0
"""Loss from the best of a sweep that counts as failing, in PSNR or over the touched taxels."""
#: Labels of the scores on the axes, and where they are cut off below.
_SHOWN = {"psnr_db": ("PSNR, dB", FLOOR_DB), "touched_db": ("SNR where touched, dB", 0.0)}
#: Style of the name of an edge.
_EDGE: dict[str, Any] = {
    **{"xycoords": ("data", "axes fraction"), "rotation": 90, "fontsize": 7},
    **{"ha": "right", "va": "bottom"},
    "bbox": {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5},
}


@dataclass(frozen=True)
class Sweep:
    """One quantity that is swept.

    Label of its axis; its values in a full and in a quick run; "linear" or "log"; edges by theory,
    by name; True if a solver fails where it is worse than the readings, which change with it.
    """

    label: str
    values: Sequence[float] = ()
    quick: Sequence[float] = ()
    scale: str = "linear"
    edges: Mapping[str, float] = field(default_factory=dict)
    against_readings: bool = False


SETTINGS = {
    "step": Sweep(
        "step, in 1/L",
        np.linspace(0.5, 2.5, 17).tolist(),
        np.linspace(0.5, 2.5, 5).tolist(),
        edges={"4/3: momentum": 4 / 3, "2: none": 2.0},
    ),
    "lambda_n": Sweep(
        "λ, N", np.geomspace(1e-4, 1.0, 17).tolist(), np.geomspace(1e-4, 1.0, 5).tolist(), "log"
    ),
    "iterations": Sweep(
        "iterations a frame", (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 100), (1, 5, 20), "log"
    ),
    "noise": Sweep(
        "noise, times the paper's",
        (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0),
        (0.0, 1.0, 10.0),
        against_readings=True,
    ),
    "block": Sweep("block size B", [2**k for k in range(1, 9)], (2, 32, 256), "log"),
    "bits": Sweep("bits of a measurement", (4, 5, 6, 7, 8, 10, 12, 16), (4, 8)),
}


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Every solver over each quantity that it has, all else as it is in the project."""
    return [
        {"sweep": key, "value": value, "solver": solver, "ratio": ratio, "seed": seed}
        for solver in SUM_SOLVERS
        for key, sweep in SETTINGS.items()
        if key not in ("lambda_n", "iterations") or key in settings_of(solver)
        for value in (sweep.quick if quick else sweep.values)
        for ratio in ((3,) if quick else (3, 8))
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """`SCORES` of a solver, means over the excerpts, dB: of reconstructed frames, and of readings;
    and the share of frames that blew up.

    `point`: sweep, value, solver, ratio, seed.
    """
    sweep, level, name, ratio = (point[key] for key in ("sweep", "value", "solver", "ratio"))
    changed = {sweep: level} if sweep in ("lambda_n", "iterations") else {}
    found, blown_up = [], []
    for truth, readings in read_excerpts(point["seed"], level if sweep == "noise" else 1.0):
        phi = _phi(sweep, level, N, int(N / ratio), point["seed"])
        ys = measured(phi, readings)
        if sweep == "bits":
            ys = np.stack([np.asarray(quantised(y, level)) for y in ys])
        frames = reconstruct(solver_for(name, phi, SHAPE, **changed), ys)
        blown_up += [not np.isfinite(frame).all() for frame in frames]
        found.append(scores(frames, readings, truth))
    means = dict(zip(SCORES, np.mean(found, axis=0).tolist(), strict=True))
    return {**means, "blown_up": float(np.mean(blown_up))}


def _phi(sweep: str, value: float, n: int, m: int, seed: int) -> Phi:
    if sweep == "step":
        return LongRows(n, m, seed, value)
    return make_phi("sbhe", n, m, seed, **({"block": int(value)} if sweep == "block" else {}))


class LongRows(Phi):
    """Scrambled block Hadamard with rows longer than the length 1 that it states.

    A solver then takes steps of `times` / L, L being the true largest eigenvalue.
    """

    kind = "long rows"

    def __init__(self, n: int, m: int, seed: int, times: float) -> None:
        super().__init__(n, m, seed)
        self._honest = SbhePhi(n, m, seed)
        self._length = np.float32(math.sqrt(times))
        self.fingerprint = self._honest.fingerprint

    def dense(self) -> npt.NDArray[np.float64]:
        return self._honest.dense() * float(self._length)

    def _forward(self, x: Floats, out: Floats) -> None:
        np.multiply(self._honest.forward(x), self._length, out=out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.multiply(self._honest.adjoint(y), self._length, out=out)


def section(page: Page, quick: bool, seed: int, executor: str) -> None:
    """Compute, draw and add the section."""
    asked = points(quick, seed)
    rows = pd.DataFrame(compute_rows(measure, asked, page.out, executor, "settings"))
    charts = []
    for ratio, some in rows.groupby("ratio", sort=False):
        chart = draw_sweeps(page.out, f"settings_n{ratio}", f"Settings, M = N/{ratio}.", some)
        charts += [chart, markdown(sweep_table(some))]
    page.csv("settings", rows)
    page.section(
        "Solvers: settings and surroundings",
        *charts,
        lambdas=", ".join(
            f"{low:g} to {high:g} ({name})" for name, (low, high) in LAMBDAS_N.items()
        ),
        iterations=", ".join(f"{least} ({name})" for name, least in MIN_ITERATIONS.items()),
        min_block=MIN_BLOCK,
        min_bits=MIN_BITS,
    )


def draw_sweeps(out: Path, name: str, caption: str, frame: pd.DataFrame) -> str:
    """Chart of sweeps, three in a row: PSNR, and below it SNR over the touched taxels."""
    n_panels = 6 * -(-len(SETTINGS) // 3)
    size_in = (3 * 2.9, n_panels // 3 * 2.3 + 0.6)
    with Chart(out, name, caption, n_panels, 3, size_in=size_in, legend_columns=5) as chart:
        for k, (key, sweep) in enumerate(SETTINGS.items()):
            for below, (score, (title, floor_db)) in enumerate(_SHOWN.items()):
                axes = chart.panels[6 * (k // 3) + 3 * below + k % 3]
                some = frame[frame["sweep"] == key].copy()
                noisy = f"noisy_{score}"
                some[[score, noisy]] = some[[score, noisy]].clip(floor_db, CEILING_DB)
                readings = some[some["solver"] == some["solver"].iloc[0]]
                grey: dict[str, Any] = {"color": "#555555", "lw": 2.2, "alpha": 0.6, "zorder": 1}
                axes.plot(
                    readings["value"], readings[noisy], label="readings of all taxels", **grey
                )
                draw_lines(axes, some, "value", score, "solver", SUM_SOLVERS, markersize=3.5)
                axes.set(xscale=sweep.scale, xlabel=sweep.label if below else "")
                axes.set_ylabel("" if k % 3 else title)
                for edge, at in sweep.edges.items():
                    axes.axvline(at, color="black", lw=1.0, ls=":")
                    axes.annotate(edge, (at, 0.03), **_EDGE)
        for axes in chart.panels:
            axes.set_visible(axes.has_data())
    return chart.markdown


def sweep_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Best and worst of each sweep and solver, and where the solver fails."""

    def both(row: pd.Series) -> str:
        return f"{row['psnr_db']:.1f} ({row['touched_db']:.1f}) at {row['value']:.3g}"

    lines = []
    for key, sweep in SETTINGS.items():
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
    for score in _SHOWN:
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
