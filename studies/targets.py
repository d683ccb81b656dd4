"""`sparseskin study targets`: the solver "skin" against the paper's method and the full reading."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .points import Function, StudyError, compute
from .targets_ablation import ablated
from .targets_bands import banded
from .targets_page import Pairs, write
from .targets_points import RANDOM, recorded, restored, touched_lightly

SCENES = (
    *("lift_box_40", "lift_wrench_40", "drag_wrench_40", "path_40"),
    *("lift_box_64", "drag_wrench_64"),
)
#: By number; quick: one each of pressed, slid, rolled, several.
RANDOM_SCENES, QUICK_RANDOM_SCENES = range(10), (0, 3, 6, 9)
#: 1 is the reading itself; 16 is asked of 4096 taxels alone.
RATIOS = (1, 3, 4, 8, 16)
LONGEST_FRAMES, QUICK_FRAMES, ABLATION_FRAMES, BAND_FRAMES = 4000, 150, 300, 900
TRIALS, QUICK_TRIALS = 300, 40
#: Solver and ratio N / M: skin at 4 is asked to be no worse than paper at 2.
RECORDED = tuple(
    (solver, ratio) for solver in ("paper", "skin", "skin, rotating") for ratio in (2, 4)
)
SUFFIXES = (".lst", ".csv", ".asf", ".npy", ".npz")

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str, recordings: Path | None = None) -> None:
    """Compute the study and write its page.

    Parameters
    ----------
    out : Path
        Folder for the page, its tables and charts.
    quick : bool
        Fewer frames, random scenes and trials.
    seed : int
        Seed of noise and Phi.
    executor : str
        Where points are computed.
    recordings : Path, optional
        Folder of recordings of real skins; without it they are left out, which the page says.

    Raises
    ------
    StudyError
        If a point fails, or the folder of recordings cannot be read.
    """
    files = recordings_in(recordings)
    numbers = QUICK_RANDOM_SCENES if quick else RANDOM_SCENES
    scenes = (*SCENES, *(f"{RANDOM}{k}" for k in numbers))
    n_frames = QUICK_FRAMES if quick else LONGEST_FRAMES
    restoring = [
        {"scene": scene, "ratio": ratio, "n_frames": n_frames, "seed": seed}
        for scene in scenes
        for ratio in RATIOS
        if ratio < 16 or is_large(scene)
    ]
    touching = [
        {
            "side": side,
            "ratio": 4,
            "solver": solver,
            "n_trials": QUICK_TRIALS if quick else TRIALS,
            "seed": seed,
        }
        for side in (40, 64)
        for solver in ("paper", "skin", "skin, rotating")
    ]
    banding = of_skin(
        scenes,
        [(ratio, rows) for rows in ("fixed", "rotating") for ratio in (3, 4, 8)],
        QUICK_FRAMES if quick else BAND_FRAMES,
        seed,
    )
    recording = [
        {"path": str(path), "ratio": ratio, "solver": solver, "seed": seed}
        for path in files
        for solver, ratio in RECORDED
    ]
    ablating = of_skin(
        scenes,
        [(3, "fixed"), (8, "fixed"), (8, "rotating")],
        QUICK_FRAMES if quick else ABLATION_FRAMES,
        seed,
    )

    def computed(function: Function, points: list[Point], label: str) -> Pairs:
        return list(zip(points, compute(function, points, out, executor, label), strict=True))

    write(
        out,
        restored=computed(restored, restoring, "scenes"),
        touched=computed(touched_lightly, touching, "touches"),
        banded=computed(banded, banding, "bands"),
        recorded=computed(recorded, recording, "recordings"),
        ablated=computed(ablated, ablating, "ablation"),
    )


def of_skin(
    scenes: Sequence[str], sampled: Sequence[tuple[int, str]], n_frames: int, seed: int
) -> list[Point]:
    """Points of the solver "skin" alone: each scene at each ratio N / M and kind of rows."""
    return [
        {"scene": scene, "ratio": ratio, "rows": rows, "n_frames": n_frames, "seed": seed}
        for scene in scenes
        for ratio, rows in sampled
    ]


def is_large(scene: str) -> bool:
    """Whether a scene has 64 x 64 taxels."""
    return scene.endswith("_64") or (
        scene.startswith(RANDOM) and int(scene.removeprefix(RANDOM)) % 2 == 1
    )


def recordings_in(folder: Path | None) -> list[Path]:
    """Return the recordings in a folder, said on stderr where there is none.

    Raises
    ------
    StudyError
        If the folder cannot be read.
    """
    if folder is None:
        print("targets: no recordings: state their folder with --recordings", file=sys.stderr)
        return []
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    except OSError as error:
        raise StudyError(f"--recordings {folder}: {error.strerror}") from error
    if not files:
        print(f"targets: no recording in {folder} ({', '.join(SUFFIXES)})", file=sys.stderr)
    return files
