"""Study `real`: the default solver on recordings of real skins, beside what a user would try."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.nodes.errors import SparseskinError
from sparseskin.studies.points import StudyError, compute
from sparseskin.studies.report import frame_of

from .methods import Compared, judgement_of, make_methods
from .page import RATIOS, RIGHT, WRONG, show, write
from .recordings import GHOST, LOADED, UNTOUCHED, Recording, digest_of, files_in, part_of

LONGEST_FRAMES, QUICK_FRAMES = 300, 60
#: Frames at the begin of a part that are not scored: until "hold" has read all taxels once.
UNSCORED = max(RATIOS)
VANISHED = 0.9
"""Relative error from which a contact counts as vanished: 1 is that of an estimate of 0. Chosen."""

Point = dict[str, Any]


def run(
    out: Path,
    quick: bool,
    seed: int,
    executor: str,
    recordings: Path | None = None,
    seeds: int = 1,
) -> None:
    """Compute the study, print its table and write its page; see `command.Study`.

    `recordings` is the folder of recordings; `seeds`: number of seeds of Phi, from `seed` on.
    Raises StudyError also if no file of that folder can be used.
    """
    if recordings is None:
        raise StudyError("study real: states no recordings; allowed: --recordings DIR")
    n_most = QUICK_FRAMES if quick else LONGEST_FRAMES
    files = readable(files_in(recordings), n_most)
    points = [
        {
            "path": str(path),
            "digest": digest_of(path),
            "n_most": n_most,
            "ratio": ratio,
            "seed": seed + k,
        }
        for path in files
        for ratio in (1, *RATIOS)
        # Codecs know no seed.
        for k in range(1 if ratio == 1 else seeds)
        if part_of(str(path), n_most).skin.n >= ratio
    ]
    found = compute(compared, points, out, executor, "recordings")
    frame = frame_of(points, found, "method")
    stems = [path.stem for path in files]
    labels = {str(p): p.stem if stems.count(p.stem) == 1 else p.name for p in files}
    frame["recording"] = frame["path"].map(labels)
    parts = {label: part_of(path, n_most) for path, label in labels.items()}
    for line in show(frame):
        print(line)
    write(out, frame, parts, unscored=UNSCORED, vanished=VANISHED)


def readable(files: Sequence[Path], n_most: int) -> list[Path]:
    """Return the recordings that can be used; of each other one a line on stderr.

    Raises
    ------
    StudyError
        If there is none.
    """
    found: list[Path] = []
    for path in files:
        try:
            part_of(str(path), n_most)
        except SparseskinError as error:
            print(f"real: skipped: {error}", file=sys.stderr)
            continue
        found.append(path)
    if not found:
        raise StudyError(f"--recordings {files[0].parent}: none of {len(files)} files can be used")
    return found


def compared(point: Point) -> dict[str, Any]:
    """Reconstruct a recording by each method at one ratio N / M; ratio 1: by each codec.

    `point`: path, digest, n_most, ratio, seed.

    Returns
    -------
    dict
        "methods": by method the figures of `figures_of`; of a method that cannot be used on this
        skin, `failed` alone, a text.
    """
    recording = part_of(point["path"], point["n_most"])
    methods: dict[str, Any] = {}
    for name, make in make_methods(recording.skin, point["ratio"], point["seed"]).items():
        try:
            methods[name] = figures_of(make(), recording)
        except SparseskinError as error:
            methods[name] = {"failed": str(error)}
    return {"methods": methods}


def figures_of(method: Compared, recording: Recording) -> dict[str, float | int | None]:
    """Run a method over the frames of a recording.

    Returns
    -------
    dict
        median, mean: relative error ||x' - x|| / ||x|| over loaded frames, in %; vanished: part of
        them with an error of `VANISHED` or more, in %; ghosts: part of the untouched frames, in %,
        whose reconstruction has a total force; flagged: part of all frames that the solver marks
        as not to be trusted, in %; flagged_wrong, flagged_right: the same of loaded frames with an
        error above `WRONG`, and below `RIGHT`; n_wrong, n_right: numbers of these;
        estimate_low, estimate_median, estimate_high: estimated over true RMS error of loaded
        frames, 5th, 50th and 95th percentile; n_loaded, n_untouched: numbers of these frames;
        n_values, n_bytes: values and bytes a frame, in the mean; cpu_ms: processor time of a solve,
        median. None where there is no such frame, or no such mark.
    """
    errors, ghosts, sizes, spans_s = [], [], [], []
    marks: list[bool] = []
    wrong: list[bool] = []
    right: list[bool] = []
    quotients: list[float] = []
    mask = recording.skin.mask
    for k, (taxels, truth) in enumerate(zip(recording.frames, recording.truth, strict=True)):
        solved = method.estimator.reconstruct(taxels)
        if k < min(UNSCORED, len(recording.frames) - 1):
            continue
        x, estimate = truth[mask].astype(np.float64), solved.forces[mask]
        norm, total = float(np.linalg.norm(x)), float(x.sum())
        found = judgement_of(method.estimator)
        mark = [] if found.flagged is None else [found.flagged]
        marks += mark
        if norm > LOADED * recording.norm:
            off = float(np.linalg.norm(estimate - x))
            errors.append(off / norm)
            wrong += mark if errors[-1] > WRONG else []
            right += mark if errors[-1] < RIGHT else []
            if found.error is not None and off:
                quotients.append(found.error * math.sqrt(x.size) / off)
        if total <= UNTOUCHED * recording.total:
            ghosts.append(float(estimate.sum(dtype=np.float64)) > GHOST * recording.total)
        sizes.append(method.n_bytes())
        spans_s.append(solved.cpu_s)

    def percent(of: Sequence[float | bool]) -> float | None:
        return 100 * float(np.mean(of)) if of else None

    low, middle, high = np.percentile(quotients, (5, 50, 95)).tolist() if quotients else [None] * 3
    return {
        "median": 100 * float(np.median(errors)) if errors else None,
        "mean": percent(errors),
        "vanished": percent([error >= VANISHED for error in errors]),
        "ghosts": percent(ghosts),
        "flagged": percent(marks),
        "flagged_wrong": percent(wrong),
        "flagged_right": percent(right),
        "n_wrong": len(wrong),
        "n_right": len(right),
        "estimate_low": low,
        "estimate_median": middle,
        "estimate_high": high,
        "n_loaded": len(errors),
        "n_untouched": len(ghosts),
        "n_values": float(method.n_values),
        "n_bytes": float(np.mean(sizes)),
        "cpu_ms": 1e3 * float(np.median(spans_s)),
    }
