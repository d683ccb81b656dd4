"""Study `slices`: how long the warm-up of a slice of a recording has to be."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.launch.offline.plan import LEAST_FRAMES, WARM_UP
from sparseskin.studies.points import compute
from sparseskin.studies.real.recordings import files_in
from sparseskin.studies.report import fill_page, markdown, write_csv

from .seams import WARM_UPS, seams

#: Scenes, and every how many frames of them.
SOURCES = (
    *(("drag_wrench_40", 1), ("drag_wrench_40", 3), ("path_40", 1), ("path_40", 10)),
    *(("lift_wrench_40", 2), ("drag_wrench_64", 8)),
)
QUICK_SOURCES = (("path_40", 10),)
RATIOS = (3, 8)
N_FRAMES, QUICK_N_FRAMES = 1100, 200
N_SEAMS, QUICK_N_SEAMS = 24, 4
LONGEST, QUICK_LONGEST = 512, 64
SMALL = 0.1
"""Difference that counts as none, in standard deviations of the noise. Chosen."""

Point = dict[str, Any]


def points_of(quick: bool, seed: int, recordings: Path | None) -> list[Point]:
    """Points of scenes, and of recordings that are long enough."""
    common = {
        "n_frames": QUICK_N_FRAMES if quick else N_FRAMES,
        "n_seams": QUICK_N_SEAMS if quick else N_SEAMS,
        "longest": QUICK_LONGEST if quick else LONGEST,
        "seed": seed,
    }
    sources = list(QUICK_SOURCES if quick else SOURCES)
    if recordings is not None:
        from sparseskin.studies.real.recordings import part_of

        files = (str(path) for path in files_in(recordings))
        n = common["n_frames"]
        sources += [(path, 1) for path in files if len(part_of(path, n).frames) == n]
    return [
        {"source": source, "every": every, "ratio": ratio, **common}
        for source, every in sources
        for ratio in RATIOS
    ]


def run(out: Path, quick: bool, seed: int, executor: str, recordings: Path | None = None) -> None:
    """Compute the study and write its page; see `command.Study`."""
    points = points_of(quick, seed, recordings)
    found = compute(seams, points, out, executor, "seams")
    scenes = [(p, f) for p, f in zip(points, found, strict=True) if not Path(p["source"]).suffix]
    real = [(p, f) for p, f in zip(points, found, strict=True) if Path(p["source"]).suffix]
    text = table_of(scenes)
    of_real = table_of(real) if real else "none (--recordings DIR)"
    rows = [
        {**p, "warm_up": w, "rms": value}
        for p, f in zip(points, found, strict=True)
        for w, values in (*f["rms"].items(), ("other shifts", f["other"]))
        for value in values
    ]
    fill_page(
        out,
        "slices",
        table=text,
        real=of_real,
        small=SMALL,
        warm_up=WARM_UP,
        least=LEAST_FRAMES,
        n_seams=len({p["source"] + str(p["every"]) for p, _ in scenes}) * points[0]["n_seams"],
        csv=write_csv(out, "seams", pd.DataFrame(rows)),
    )
    print(text)
    if real:
        print(f"\nrecordings, in hundredths of the RMS of their frames:\n\n{of_real}")


def table_of(found: Sequence[tuple[Point, dict[str, Any]]]) -> str:
    """Differences by warm-up, and those between two passes."""
    rows = []
    known = [str(w) for w in WARM_UPS if all(str(w) in f["rms"] for _, f in found)]
    for name in (*known, "other"):
        row: dict[str, Any] = {"warm-up, frames": "other shifts" if name == "other" else name}
        for ratio in RATIOS:
            of = [f for p, f in found if p["ratio"] == ratio]
            values = np.concatenate([f["other"] if name == "other" else f["rms"][name] for f in of])
            median, most = np.quantile(values, (0.5, 0.99))
            row |= {
                f"N/{ratio}: median": f"{median:.3f}",
                f"N/{ratio}: 99 %": f"{most:.2f}",
                f"N/{ratio}: below {SMALL:g}": f"{np.mean(values < SMALL):.0%}",
            }
        rows.append(row)
    return markdown(pd.DataFrame(rows))
