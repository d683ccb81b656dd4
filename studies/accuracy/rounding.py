"""How far the default solver amplifies a change of the measurements at their last digit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.numerics.arrays import TINY
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.frames import Frames, UntouchedFrames, opened, stated
from sparseskin.studies.harness import Candidate, Measurement, method_rows
from sparseskin.studies.points import compute
from sparseskin.studies.report import Page

CHANGE = 1e-7
"""Change of a measurement, of either sign, in the largest one: its resolution in float32."""
WITHIN = 1e-4
CHANGED = "measurements + 1e-7"
READABLE = "readable form"


def amplified(point: Mapping[str, Any]) -> dict[str, Any]:
    """Largest change of a force over the frames of a point, in the largest force: by a change of
    the measurements, and by the readable form in place of the compiled one.
    """
    take = opened(point)
    of_rows = Measurement(point["N /"], point["rows"])
    if take.n < point["N /"]:
        return {"methods": {}}
    settings: dict[str, dict[str, str]] = {
        "as it is": {},
        CHANGED: {},
        READABLE: {"fast": "off"},
    }
    methods: dict[str, Any] = {
        name: Candidate({**PRESETS["skin"], **changed_settings}).make(
            of_rows, take, point["seed"]
        )
        for name, changed_settings in settings.items()
    }
    rng = np.random.default_rng(point["seed"])
    largest = 0.0
    changes = dict.fromkeys(settings, 0.0)
    for part in take.parts():
        for method in methods.values():
            method.reset()
        for _, taxels in part:
            y = methods["as it is"].measure(taxels)
            change = CHANGE * np.abs(y).max() * rng.choice([-1.0, 1.0], y.size)
            of = dict.fromkeys(methods, y) | {CHANGED: (y + change).astype(np.float32)}
            forces = {
                name: method.solve(of[name]).forces for name, method in methods.items()
            }
            largest = max(largest, float(forces["as it is"].max()))
            for name, of_method in forces.items():
                changes[name] = max(
                    changes[name], float(np.abs(of_method - forces["as it is"]).max())
                )
    largest = max(largest, TINY)
    return {
        "methods": {
            name: {"change": changes[name] / largest} for name in (CHANGED, READABLE)
        }
    }


def section(page: Page, executor: str, frames: Sequence[Frames], seed: int) -> str:
    """Compute and add the section: `amplified` by source, ratio and rows; return its line."""
    kinds = product(map(stated, frames), (3, 8), (ROTATING, FIXED))
    points = [
        {
            "frames": of,
            "N /": ratio,
            "rows": rows,
            "seed": seed,
        }
        for of, ratio, rows in kinds
    ]
    points = [
        point for point in points if point["frames"]["kind"] != UntouchedFrames.__name__
    ]
    results = compute(amplified, points, page.out, executor, "rounding")
    kind_names = {"RecordedFrames": "recordings", "SceneFrames": "scenes"}
    keys = [
        {**p, "frames": kind_names.get(p["frames"]["kind"], "presses")} for p in points
    ]
    every = method_rows(keys, results, "by")
    page.csv("rounding", every)
    by = every.groupby(["frames", "N /", "rows", "by"], sort=False)["change"]
    table = by.agg(
        lambda of_kind: f"{of_kind.median():.0e}, {of_kind.max():.0e}"
    ).unstack("by")
    page.section("Rounding", table.reset_index(), change=CHANGE)
    parts = [
        f"{name}: {np.count_nonzero(of_kind < WITHIN)} of {len(of_kind)} streams change by less "
        f"than {WITHIN:g} of the largest force, at most {of_kind.max():.0e}, "
        f"median {of_kind.median():.0e}"
        for name, of_kind in every.groupby("by", sort=False)["change"]
    ]
    return f"Rounding: {'; '.join(parts)}."
