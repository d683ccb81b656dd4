"""How far the default solver amplifies a change of the measurements at their last digit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.frames import Frames, UntouchedFrames, opened, stated
from sparseskin.studies.harness import Candidate, Measurement, method_rows
from sparseskin.studies.points import compute
from sparseskin.studies.report import Page

CHANGE = 1e-7
"""Change of a measurement, of either sign, in the largest one: its resolution in float32."""
WITHIN = 1e-4
CHANGED, READABLE = "measurements + 1e-7", "readable form"


def rows(out: Path, executor: str, frames: Sequence[Frames], seed: int) -> pd.DataFrame:
    """A row a source, ratio, kind of rows and figure of `amplified`."""
    points = [
        {"frames": of, "ratio": ratio, "rows": kind, "seed": seed}
        for of, ratio, kind in product(map(stated, frames), (3, 8), (ROTATING, FIXED))
        if of["kind"] != UntouchedFrames.__name__
    ]
    keys = [{**p["frames"], "ratio": p["ratio"], "rows": p["rows"]} for p in points]
    return method_rows(keys, compute(amplified, points, out, executor, "rounding"), "cause")


def amplified(point: Mapping[str, Any]) -> dict[str, Any]:
    """Largest change of a force over the frames of a point, in the largest force: by a change of
    the measurements, and by the readable form in place of the compiled one.
    """
    take, of_rows = opened(point), Measurement(point["ratio"], point["rows"])
    settings: dict[str, dict[str, str]] = {"as it is": {}, CHANGED: {}, READABLE: {"fast": "off"}}
    made: dict[str, Any] = {
        name: Candidate({**PRESETS["skin"], **more}).make(of_rows, take, point["seed"])
        for name, more in settings.items()
    }
    rng, largest, changes = np.random.default_rng(point["seed"]), 0.0, dict.fromkeys(settings, 0.0)
    for part in take.parts():
        for method in made.values():
            method.reset()
        for _, taxels in part:
            y = made["as it is"].measure(taxels)
            change = CHANGE * np.abs(y).max() * rng.choice([-1.0, 1.0], y.size)
            of = dict.fromkeys(made, y) | {CHANGED: (y + change).astype(np.float32)}
            forces = {name: method.solve(of[name]).forces for name, method in made.items()}
            largest = max(largest, float(forces["as it is"].max()))
            for name, found in forces.items():
                changes[name] = max(changes[name], float(np.abs(found - forces["as it is"]).max()))
    of_force = {name: change / largest for name, change in changes.items() if largest}
    return {"methods": {name: {"change": of_force[name]} for name in (CHANGED, READABLE)}}


def section(page: Page, rows: pd.DataFrame) -> str:
    """Add the section; return its line of the conclusion."""
    names = {"RecordedFrames": "recordings", "SceneFrames": "scenes"}
    rows["frames"] = rows["kind"].map(names).fillna("presses")
    page.csv("rounding", rows.drop(columns=["path"], errors="ignore"))
    rows["N /"] = rows["ratio"].map("{:g}".format)
    by = rows.groupby(["frames", "N /", "rows", "cause"], sort=False)["change"]
    shown = by.agg(lambda some: f"{some.median():.0e}, {some.max():.0e}").unstack("cause")
    page.section("Rounding", shown.reset_index(), change=CHANGE)
    parts = [
        f"{cause}: {np.count_nonzero(some < WITHIN)} of {len(some)} streams within {WITHIN:g} of "
        f"the largest force, median {some.median():.0e}, largest {some.max():.0e}"
        for cause, some in rows.groupby("cause", sort=False)["change"]
    ]
    return f"Rounding: {'; '.join(parts)}."
