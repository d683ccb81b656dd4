"""Experiments of study `speed-accuracy`: not all combinations, but each part swept by itself.

- Every solver, with its own settings and with those of each preset: iterations swept at M = N/3,
  and M swept at its own iterations; Haar, SBHE. Every solver on Phi "full": all taxels denoised.
- Every basis and every Phi, with the paper's solver and M swept: on fewer frames, as a dense Phi
  is slow.
- Other libraries on the problem that FISTA solves.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages import Measurements, Taxels
from sparseskin.messages.wire import size_bytes
from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.compressor.phi.rotation import ROTATING, m_of
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import BASES
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.nodes.touch import in_contact
from sparseskin.studies.baselines.libraries import PEERS, Bpdn, Solve
from sparseskin.studies.evaluate import SUM_SOLVERS, settings_of
from sparseskin.studies.frames import SceneFrames, scene_of
from sparseskin.studies.harness import PAPER_ROWS, Candidate, Experiment, Measurement

QUICK_SCENES = ("drag_wrench_40", "lift_box_64")
ITERATIONS, QUICK_ITERATIONS = (3, 5, 10, 20, 30), (5, 20)
RATIOS, QUICK_RATIOS = (2, 3, 4, 8, 16), (3, 8)
PARTS_RATIOS, CENTRE_RATIO = (3, 4, 8), 3
#: Every Phi but those that no solver of sums inverts.
SUM_KINDS = tuple(kind for kind in KINDS if kind not in ("acts", "adaptive", "row_local"))
PAPER_LABEL = "fista, preset paper"
PRESET_SKIN, ROTATED = "skin, preset skin", "skin, rotating rows"
#: Best lambda of the paper's solver: a second reference.
TUNED_LAMBDA_N = 0.0125
#: Dead zones of the full reading, newtons.
DEAD_ZONES_N = (0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1)
#: Frames are 1 ms apart in all scenes, whatever their own step.
PERIOD_S = 1e-3
#: Figures of a row, and how they are pooled over scenes.
FIGURES = {
    **{"iterations": "mean", "mean_db": "mean", "min_db": "min", "touched_mn": "mean"},
    **{"median_ms": "mean", "p99_ms": "mean", "cpu_share": "min"},
}
#: Ratio to the minimum at which an objective counts as reached, and iterations that are tried.
WITHIN = 1.01
STEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 18, 22, 27, 33, 40, 50, 60, 75, 90, 120, 160, 220, 300)


_timed: Callable[..., Experiment] = partial(Experiment, timed=True)


def variants() -> dict[str, Candidate]:
    """Solvers by the label they are shown with.

    Each preset, `skin` with rotating rows, (with numba) in compiled loops and without learned
    weights, the tuned FISTA, and each solver that has no preset with its own defaults.
    """
    paper = {"rows": PAPER_ROWS}
    found = {
        PAPER_LABEL: Candidate(PRESETS["paper"], changes=paper),
        PRESET_SKIN: Candidate(PRESETS["skin"]),
        ROTATED: Candidate(PRESETS["skin"], changes={"rows": ROTATING}),
        "fista, tuned": Candidate({**PRESETS["paper"], "lambda_n": TUNED_LAMBDA_N}, changes=paper),
    }
    if find_spec("numba"):
        found["skin, compiled"] = Candidate({**PRESETS["skin"], "fast": "on"})
    found["skin, formula"] = Candidate({**PRESETS["skin"], "gates": "formula"})
    covered = {one.settings["solver"] for one in found.values()}
    others = [name for name in SUM_SOLVERS if name not in covered]
    return found | {name: Candidate({"solver": name, "basis": "haar"}) for name in others}


def frames_of(scenes: Sequence[str], short: bool) -> list[SceneFrames]:
    """Two parts of each scene: from 20 frames before its first contact, and half way on."""
    found = []
    for scene in scenes:
        every = max(1, round(PERIOD_S / (scene_of(scene).dt_ns * 1e-9)))
        after, later = (40, 40) if short else (180, 200)
        found.append(SceneFrames(scene, -20 * every, after * every, every, later))
    return found


def solvers(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every solver, iterations and M swept; names of candidates are "LABEL" or "LABEL: k"."""
    known, ratios = variants(), QUICK_RATIOS if quick else RATIOS
    swept = {
        f"{label}: {k}": Candidate({**of.settings, "iterations": k}, changes=of.changes)
        for label, of in known.items()
        if "iterations" in settings_of(of.settings["solver"])
        for k in (QUICK_ITERATIONS if quick else ITERATIONS)
    }
    fixed = {label: of for label, of in known.items() if of.changes.get("rows") != ROTATING}
    frames = frames_of(QUICK_SCENES if quick else tuple(SCENES), quick)
    for candidates, measurements in (
        (swept, [Measurement(CENTRE_RATIO)]),
        (known, [*map(Measurement, ratios)]),
        (fixed, [Measurement(1, phi="full")]),
    ):
        yield _timed("solvers", frames, measurements, candidates, tuple(FIGURES), (seed,))


def parts(quick: bool, seed: int) -> Iterator[Experiment]:
    """Every basis, and every Phi, with the paper's solver; the candidate is named by the basis."""
    frames = frames_of(QUICK_SCENES if quick else tuple(SCENES), True)
    ratios = QUICK_RATIOS if quick else PARTS_RATIOS
    changes = {"rows": PAPER_ROWS}
    bases = {
        basis: Candidate({**PRESETS["paper"], "basis": basis}, changes=changes) for basis in BASES
    }
    others = [kind for kind in SUM_KINDS if kind not in ("sbhe", "full")]
    kinds = [Measurement(ratio, phi=kind) for kind in others for ratio in ratios]
    haar = {"haar": bases["haar"]}
    for candidates, measurements in (
        (bases, [*map(Measurement, ratios)]),
        (haar, [*kinds, Measurement(1, phi="full")]),
    ):
        yield _timed("bases and Phi", frames, measurements, candidates, tuple(FIGURES), (seed,))


def readings(quick: bool, seed: int) -> Experiment:
    """The noisy taxels themselves, with dead zones of several widths, which name the candidates."""
    frames = frames_of(QUICK_SCENES if quick else tuple(SCENES), quick)
    zones = {
        f"{width:g}": Candidate({"dead_zone_n": width}, of="reading") for width in DEAD_ZONES_N
    }
    scores = ("mean_db", "min_db", "touched_mn")
    return Experiment("full readings", frames, [Measurement(1)], zones, scores, (seed,))


def pool_of(scene: str) -> str:
    """The panel that a scene is pooled into."""
    return f"N = {math.prod(scene_of(scene).shape)}"


@cache
def n_bytes(n: int, ratio: float, rows: str, phi: str) -> int:
    """Bytes of the message of a frame: of measurements, or of taxels with phi ""."""
    if not phi:
        return size_bytes(Taxels(stamp_ns=0, patch="skin", forces=np.zeros((1, n), np.float32)))
    y = np.zeros(n if phi == "full" else m_of(n, ratio, rows), np.float32)
    return size_bytes(Measurements(stamp_ns=0, patch="skin", y=y, phi="0" * 16))


def pooled(rows: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Rows of scenes of one size as one row: panel and `keys`, and `FIGURES` as stated there."""
    known = rows[rows["refused"] == ""].assign(panel=rows["scene"].map(pool_of))
    figures = {name: how for name, how in FIGURES.items() if name in rows}
    known = known.astype(dict.fromkeys(figures, float))
    found = known.groupby(["panel", *keys], sort=False).agg(figures).reset_index()
    return found.sort_values("panel", kind="stable")


def race(point: dict[str, Any]) -> dict[str, Any]:
    """Time one library to within 1 % of the minimum, each frame by itself from 0.

    The number of iterations is searched for first; the time is that of further calls with just as
    many, which have nothing to check: the shortest of three. `point`: peer, scene, seed, short,
    lambda_n, n_frames. Returns medians of processor time and iterations; mean_db, min_db; the
    largest ratio of the objective to the minimum; n_frames.
    """
    (frames,) = frames_of([point["scene"]], point["short"])
    take = frames.open(point["seed"])
    problem = Bpdn(take.mask.shape, CENTRE_RATIO, point["seed"], point["lambda_n"])
    peer = PEERS[point["peer"]]
    pairs = [pair for part in take.parts() for pair in part if in_contact(pair[0], take.f_max)]
    chosen = np.linspace(0, len(pairs) - 1, min(point["n_frames"], len(pairs))).round()
    spans_ms, counts, ratios, psnr = [], [], [], []
    for truth, taxels in (pairs[int(k)] for k in chosen):
        y = problem.phi.forward(taxels.reshape(-1))
        best = problem.solution(y)
        lowest = problem.objective(best, y)
        solve = peer.make(problem, best)
        iterations = _needed(problem, solve, y, WITHIN * lowest)
        theta, span_ms = _shortest(solve, y, iterations)
        spans_ms.append(span_ms)
        counts.append(iterations)
        ratios.append(problem.objective(theta, y) / lowest)
        psnr.append(psnr_db(problem.image(theta) - truth, take.f_max))
    return {
        "median_ms": round(float(np.median(spans_ms)), 4),
        "iterations": float(np.median(counts)),
        "mean_db": round(float(np.mean(psnr)), 3),
        "min_db": round(float(np.min(psnr)), 3),
        "objective": round(max(ratios), 4),
        "n_frames": len(psnr),
    }


def _shortest(solve: Solve, y: Floats, iterations: int) -> tuple[Floats, float]:
    """Coefficients that a peer finds, and the shortest of three processor times in ms."""
    spans_ns = []
    for _ in range(3):
        begin_ns = time.thread_time_ns()
        solved = solve(y, iterations)
        spans_ns.append(time.thread_time_ns() - begin_ns)
    return np.asarray(solved, dtype=np.float32), min(spans_ns) / 1e6


def _needed(problem: Bpdn, solve: Solve, y: Floats, enough: float) -> int:
    """The fewest of `STEPS` that come low enough; the most, where none does."""
    for iterations in STEPS:
        theta = np.asarray(solve(y, iterations), dtype=np.float32)
        if problem.objective(theta, y) <= enough:
            return iterations
    return STEPS[-1]


def gathered(experiments: Iterator[Experiment], out: Path, executor: str) -> pd.DataFrame:
    """Rows of some experiments, with n_bytes, label, and stated iterations (NaN: their own)."""
    rows = pd.concat(one.run(out, executor) for one in experiments).reset_index(drop=True)
    split = rows["method"].str.split(": ", expand=True).reindex(columns=[0, 1])
    shapes = [math.prod(scene_of(scene).shape) for scene in rows["scene"]]
    rotates = [ROTATING if label == ROTATED else "" for label in split[0]]
    sizes = map(n_bytes, shapes, rows["ratio"], rotates, rows["phi"])
    return rows.assign(label=split[0], stated=pd.to_numeric(split[1]), n_bytes=list(sizes))
