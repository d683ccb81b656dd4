"""Variants of solvers in `speed-accuracy`, and their figures by scene and pooled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.scene_frames import scene_of

PAPER_LABEL = "fista, preset paper"
CENTRE_RATIO = 3
#: Dead zones of the full reading, newtons.
DEAD_ZONES_N = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1)
#: Best lambda of the paper's solver: a second reference.
TUNED_LAMBDA_N = 0.0125
VARIED = {
    "skin, rotating rows": {**PRESETS["skin"], "rows": ROTATING},
    "fista, tuned": {**PRESETS["paper"], "lambda_n": TUNED_LAMBDA_N},
}
COMPILED = {"skin, compiled": {**PRESETS["skin"], "fast": "on"}}
#: What a row is a setting of. panel: a scene, or "N = 1600", pooled over the scenes of that size.
#: stated: iterations that were set, missing where they are the solver's own. own: True if they are
#: the solver's or preset's own.
_KEYS = ["panel", "label", "phi", "basis", "ratio", "stated", "own"]
#: Figures of a row, and how they are pooled over scenes. iterations: done a frame, in the mean.
#: mean_db, worst_db: PSNR over the frames in contact. touched_mn: root mean square error of touched
#: taxels. median_ms: processor time of a solve. p99_ms: time of a solve by the clock. cpu_share:
#: part of the solve time in which the process had a core. n_bytes: of a frame's message.
_FIGURES = {
    **{"iterations": "mean", "mean_db": "mean", "worst_db": "min", "touched_mn": "mean"},
    **{"median_ms": "mean", "p99_ms": "mean", "cpu_share": "min", "n_bytes": "first"},
}
#: Columns of the CSV files, in their order.
COLUMNS = [*_KEYS[:5], "iterations", "stated", *list(_FIGURES)[1:], "own"]


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
class Results:
    """Figures of the study.

    Attributes
    ----------
    solvers : DataFrame
        Every solver, iterations and M swept: a row a setting, pooled panels first; see `COLUMNS`.
    parts : DataFrame
        Likewise every basis and every Phi, with the paper's solver; pooled panels alone.
    readings, parts_readings : DataFrame
        The noisy reading of all taxels with each dead zone: panel, dead_zone_n, mean_db, worst_db,
        n_bytes; on the frames of `solvers` and on those of `parts`.
    raced : DataFrame
        Points and figures of the libraries.
    refused : list of (str, str)
        Points that are not possible, and why.
    """

    solvers: pd.DataFrame
    parts: pd.DataFrame
    readings: pd.DataFrame
    parts_readings: pd.DataFrame
    raced: pd.DataFrame
    refused: list[tuple[str, str]]

    @property
    def pools(self) -> list[str]:
        """Panels that are pooled over scenes."""
        return [panel for panel in self.solvers["panel"].unique() if panel.startswith("N = ")]

    @property
    def scenes(self) -> list[str]:
        """Panels that are one scene."""
        return [panel for panel in self.solvers["panel"].unique() if panel not in self.pools]

    def of(self, panel: str) -> pd.DataFrame:
        """Rows of the solvers in one panel."""
        return self.solvers[self.solvers["panel"] == panel]


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
    rows: list[dict[str, Any]] = []
    refused: dict[str, str] = {}
    for point, figure in zip(points, figures, strict=True):
        settings = chosen[point["label"]]
        if "refused" in figure:
            what = f"{point['label']}, {point['phi']}, {point['basis']}, N/{point['ratio']}"
            refused[what] = figure["refused"]
            continue
        stated = point.get("iterations")
        own = {"stated": stated, "own": stated == settings.get("iterations")}
        named = {"panel": point["scene"], "n_bytes": figure["bytes"], "iterations": figure["done"]}
        is_own_basis = point["basis"] == settings["basis"]
        rows.append({**point, **figure, **own, **named, "is_own_basis": is_own_basis})
    extra = ["short", "is_own_basis"]
    frame = pd.DataFrame(rows, columns=[*COLUMNS, *extra]).astype({"stated": "Int64"})
    in_solvers = (frame["short"] == quick) & frame["is_own_basis"].eq(True)
    solvers = frame[in_solvers & frame["phi"].isin(["sbhe", "full"])]
    is_part = (frame["label"] == PAPER_LABEL) & frame["short"].eq(True) & frame["own"].eq(True)
    return Results(
        solvers=pd.concat([_pooled(solvers), solvers[COLUMNS]]),
        parts=_pooled(frame[is_part]),
        readings=_readings(full),
        parts_readings=_readings(full_short),
        raced=pd.DataFrame(raced),
        refused=list(refused.items()),
    )


def pool_of(scene: str) -> str:
    """The panel that a scene is pooled into."""
    rows, cols = scene_of(scene).shape
    return f"N = {rows * cols}"


def _pooled(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows pooled over the scenes of one size, as `_FIGURES` states."""
    groups = rows.assign(panel=rows["panel"].map(pool_of)).groupby(_KEYS, sort=False, dropna=False)
    return groups.agg(_FIGURES).reset_index().sort_values("panel", kind="stable")[COLUMNS]


def _readings(full: Mapping[str, dict[str, Any]]) -> pd.DataFrame:
    rows = [
        {"panel": panel, "dead_zone_n": width_n, "n_bytes": figure["bytes"], **of_zone}
        for scene, figure in full.items()
        for panel in (pool_of(scene), scene)
        for width_n, of_zone in zip(DEAD_ZONES_N, figure["by_dead_zone"], strict=True)
    ]
    columns = {"mean_db": "mean", "worst_db": "min", "n_bytes": "first"}
    frame = pd.DataFrame(rows, columns=["panel", "dead_zone_n", *columns])
    return frame.groupby(["panel", "dead_zone_n"], sort=False).agg(columns).reset_index()


def raw_and_zoned(readings: pd.DataFrame, panel: str) -> tuple[pd.Series, pd.Series]:
    """The reading of a panel as it is, and with its best dead zone."""
    of = readings[readings["panel"] == panel].set_index("dead_zone_n", drop=False)
    return of.loc[0.0], of.loc[of["mean_db"].idxmax()]


def front(rows: pd.DataFrame, x: str, y: str) -> pd.DataFrame:
    """Pareto front: the least x first, and each after it with a higher y."""
    rows = rows.sort_values([x, y], ascending=[True, False], kind="stable")
    return rows[~(rows[y] <= rows[y].cummax().shift())]


def swept_iterations(rows: pd.DataFrame, label: str) -> pd.DataFrame:
    """A solver's rows at M = N/3, fewest iterations first."""
    is_swept = (rows["label"] == label) & (rows["phi"] == "sbhe") & (rows["ratio"] == CENTRE_RATIO)
    # With its own iterations set, a solver does the same again: that is shown once.
    once = (
        rows[is_swept].sort_values("own", kind="stable").drop_duplicates("iterations", keep="last")
    )
    return once.sort_values("iterations", kind="stable")


def swept_m(rows: pd.DataFrame, label: str) -> pd.DataFrame:
    """A solver's rows at its own iterations, fewest measurements first."""
    is_swept = (rows["label"] == label) & (rows["phi"] == "sbhe") & rows["own"]
    return rows[is_swept].sort_values("ratio", ascending=False, kind="stable")
