"""Each constant of the default solver halved and doubled: candidates, and what they change."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pandas as pd

from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning
from sparseskin.studies.harness import Candidate
from sparseskin.studies.points import StudyError

SWITCHES = ("most_recalled", "most_confirmed")
"""Parts that are 1, or 0 in an ablation: they are neither halved nor doubled."""
VALUES: dict[str, float] = {
    name: value for name, value in asdict(SkinTuning()).items() if name not in SWITCHES
}
PARTS = ("damping", "most_alpha", "recall_memory", "motion_memory", "silence_kept")
"""Constants that stay below 1: their distance to 1 is halved where others are doubled."""
GROWTHS = ("noise_growth", "bias_forgotten")
"""Factors per frame: their distance to 1 is halved and doubled."""
UNCHANGED = "as they are"
TIMES = (0.5, 2.0)
FORMATS = {
    "error, rotating rows, %": "+z.1f",
    "error, fixed rows, %": "+z.1f",
    "moving, dB": "+z.2f",
    "sudden, dB": "+z.2f",
    "marked, %": ".0f",
}
"""Columns of the table, and formats of their changes."""
LEAST_ERROR = 0.5
"""Least relative error that a quotient is formed with, in %. Chosen: about that of readings in 8
bits, so that below it all methods are as good as exact."""


def changed(name: str, times: float) -> float:
    """Value of a constant, halved or doubled."""
    value = VALUES[name]
    if isinstance(value, int):
        return max(1, round(times * value))
    if name in GROWTHS:
        return 1 + times * (value - 1)
    return 1 - (1 - value) / times if name in PARTS and times > 1 else times * value


def candidates() -> dict[str, Candidate]:
    """The default solver, and with each constant halved and doubled, all else as it is."""
    made = {UNCHANGED: Candidate(PRESETS["skin"])}
    for name in VALUES:
        for times in TIMES:
            tuning = {name: changed(name, times)}
            made[f"{name} x {times:g}"] = Candidate(
                {**PRESETS["skin"], "tuning": tuning}
            )
    return made


def figures(rows: pd.DataFrame) -> pd.DataFrame:
    """Figures of `FORMATS`, a line a candidate; `rows` of presses have no path.

    Raises StudyError if no recording has a loaded frame that can be reconstructed.
    """
    rows = rows.astype(
        dict.fromkeys(("median", "n_wrong", "flagged_wrong", "mean_db"), float)
    )
    recorded = rows[rows["path"].notna()]
    pressed = rows[rows["path"].isna()]
    if recorded["median"].isna().all():
        raise StudyError(
            "--constants: no recording has a loaded frame that can be reconstructed"
        )

    logs = np.log(recorded["median"].clip(LEAST_ERROR))
    errors = np.exp(
        logs.groupby([recorded["method"], recorded["rows"]]).mean()
    ).unstack()
    db = pressed.groupby(["method", "course"])["mean_db"].mean().unstack()
    n_marked = (
        (recorded["flagged_wrong"] * recorded["n_wrong"])
        .groupby(recorded["method"])
        .sum()
    )
    n_wrong = recorded.groupby("method")["n_wrong"].sum()
    columns = [
        errors.rename(columns="error, {} rows, %".format),
        db.rename(columns="{}, dB".format),
        (n_marked / n_wrong.clip(1)).rename("marked, %"),
    ]
    return pd.concat(columns, axis=1)


def changes(of_all: pd.DataFrame) -> pd.DataFrame:
    """Changes of `figures`: of errors in % of them, of PSNR in dB; the part that is marked."""
    base = of_all.loc[UNCHANGED]
    made = of_all.copy()
    for key in FORMATS:
        if key.startswith("error"):
            made[key] = 100 * (of_all[key] / base[key] - 1)
        elif key.endswith("dB"):
            made[key] = of_all[key] - base[key]
    return made


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """Scores with all constants as they are, and a line a constant: their changes with it.

    `rows`: those of `candidates`. Raises StudyError as `figures` does.
    """
    of_all = figures(rows)
    of_change = changes(of_all)
    lines = [{"constant": UNCHANGED, "halved / doubled": ""}]
    lines[0] |= {key: f"{of_all.loc[UNCHANGED, key]:.3g}" for key in FORMATS}
    for name, value in VALUES.items():
        values = " / ".join(f"{changed(name, times):g}" for times in TIMES)
        lines.append({"constant": f"{name} = {value:g}", "halved / doubled": values})
        for key, spec in FORMATS.items():
            of_both = of_change.loc[[f"{name} x {times:g}" for times in TIMES], key]
            lines[-1][key] = " / ".join(format(change, spec) for change in of_both)
    return pd.DataFrame(lines)
