"""Study `speed-accuracy`: solve time and bytes sent against PSNR, and other libraries.

Computed are every solver, basis and Phi, but not all combinations:

- Every solver, with its own settings and with those of each preset: iterations swept at M = N/3,
  and M swept at its own iterations; Haar, SBHE.
- Every solver on Phi "full": all taxels sent, and denoised.
- Every basis and every Phi, with the paper's solver and M swept: on fewer frames, as a dense Phi
  is slow.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Measurements, Taxels
from sparseskin.messages.wire import size_bytes
from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import BASES
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import (
    Method,
    Reading,
    Scores,
    evaluate,
    evaluate_one,
    in_contact,
    make_method,
    settings_of,
)
from sparseskin.studies.points import compute, compute_rows
from sparseskin.studies.scene_frames import first_contact, scene_frames, scene_of

from .page import write
from .peers import PEERS, Bpdn, Solve, missing_peers
from .rows import CENTRE_RATIO, DEAD_ZONES_N, PAPER_LABEL, gather, variants

#: One process at a time, so that what is timed has its core to itself.
TIMED_ON = "process:1"
SCENES = (
    *("lift_box_40", "lift_wrench_40", "drag_wrench_40", "path_40"),
    *("lift_box_64", "drag_wrench_64"),
)
QUICK_SCENES = ("drag_wrench_40", "lift_box_64")
ITERATIONS = (3, 5, 10, 20, 30)
QUICK_ITERATIONS = (5, 20)
RATIOS = (2, 3, 4, 8, 16)
QUICK_RATIOS = (3, 8)
#: Every Phi but the one that no solver of sums inverts.
SUM_KINDS = tuple(kind for kind in KINDS if kind not in ("acts", "adaptive", "row_local"))
#: With every basis and every Phi.
PARTS_RATIOS = (3, 4, 8)
#: Keys of a point that neither name a solver or basis nor set one.
_OF_THE_POINT = ("scene", "seed", "short", "label", "phi", "rows", "ratio")
#: Frames are 1 ms apart in all scenes, whatever their own step.
PERIOD_S = 1e-3
BEFORE, AFTER, LATER = 20, 180, 200
SHORT_AFTER, SHORT_LATER = 40, 40
#: Ratio to the minimum at which an objective counts as reached.
WITHIN = 1.01
#: Iterations that are tried until the objective is within 1 % of the minimum.
STEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 18, 22, 27, 33, 40, 50, 60, 75, 90, 120, 160, 220, 300)

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the points and write the page; see `command.Study`.

    `executor` is for what is not timed; solve times are measured on this host, one at a time.
    """
    scenes = QUICK_SCENES if quick else SCENES

    def readings(short: bool) -> dict[str, dict[str, Any]]:
        wanted = [{"scene": scene, "seed": seed, "short": short} for scene in scenes]
        found = compute(full_reading, wanted, out, executor, "full readings")
        return dict(zip(scenes, found, strict=True))

    full, full_short = readings(quick), readings(True)
    points = design(quick, seed)
    figures = compute(timed, points, out, TIMED_ON, "solvers")
    absent = missing_peers()
    for peer in absent:
        print(
            f"{peer} is left out: it is not installed (pip install 'sparseskin[peers]')",
            file=sys.stderr,
        )
    common = {"seed": seed, "short": quick, "ratio": CENTRE_RATIO}
    common |= {"lambda_n": PRESETS["paper"]["lambda_n"], "n_frames": 4 if quick else 10}
    present = [peer for peer in PEERS if peer not in absent]
    runners = [{"peer": peer, "scene": scene, **common} for scene in scenes for peer in present]
    ran = compute_rows(race, runners, out, TIMED_ON, "libraries")
    results = gather(points, figures, quick, full, full_short, ran)
    write(out, results, absent, quick)


def takes_iterations(solver: str) -> bool:
    """True if a number of iterations is a setting of the solver."""
    return "iterations" in settings_of(solver)


def design(quick: bool, seed: int) -> list[Point]:
    """All points of the study, scene by scene, so that a worker reads a scene's frames once."""
    scenes = QUICK_SCENES if quick else SCENES
    points = [{"scene": scene, "seed": seed, **way} for scene in scenes for way in _ways(quick)]
    return list({str(point): point for point in points}.values())


def _ways(quick: bool) -> Iterator[Point]:
    ratios = QUICK_RATIOS if quick else RATIOS
    for label, chosen in variants().items():
        way = {"label": label, "short": quick, "phi": "sbhe", **chosen}
        if takes_iterations(chosen["solver"]):
            for iterations in QUICK_ITERATIONS if quick else ITERATIONS:
                yield {**way, "ratio": CENTRE_RATIO, "iterations": iterations}
        for ratio in ratios:
            yield {**way, "ratio": ratio}
        if "rows" not in chosen:
            yield {**way, "phi": "full", "ratio": 1}
    paper = {"label": PAPER_LABEL, "short": True, "phi": "sbhe", **PRESETS["paper"]}
    for ratio in QUICK_RATIOS if quick else PARTS_RATIOS:
        for basis in BASES:
            yield {**paper, "basis": basis, "ratio": ratio}
        for phi in SUM_KINDS:
            yield {**paper, "phi": phi, "ratio": 1 if phi == "full" else ratio}


@cache
def sequences(scene: str, seed: int, short: bool) -> tuple[tuple[Floats, Floats], ...]:
    """Truth and taxels of two parts of a scene: around its first contact, and half way on.

    Returns
    -------
    tuple of (truth, taxels)
        float32, shape (k, n_rows, n_cols), newtons; frames 1 ms apart.
    """
    every = max(1, round(PERIOD_S / (scene_of(scene).dt_ns * 1e-9)))
    contact = first_contact(scene, seed)
    begins = (contact - BEFORE * every, (contact + scene_of(scene).n_steps) // 2)
    lengths = (BEFORE + (SHORT_AFTER if short else AFTER), SHORT_LATER if short else LATER)
    found = []
    for first, length in zip(begins, lengths, strict=True):
        frames = list(scene_frames(scene, seed, first, first + length * every, every))
        truth, taxels = (np.stack(images) for images in zip(*frames, strict=True))
        found.append((truth, taxels))
    return tuple(found)


def timed(point: Point) -> dict[str, Any]:
    """Reconstruct a scene's frames, each timed by itself.

    `point`: scene, seed, short, phi, rows ("fixed" where absent, of fista "paper"), ratio, solver,
    basis, and the solver's settings.

    Returns
    -------
    dict
        As `figures_of`; median_ms, processor time a frame; p99_ms, time by the clock; cpu_share,
        the part of that time that the process had a core; bytes of a measurements message; done,
        the mean number of iterations.
        Or refused: the reason why these do not go together.
    """
    seed, scene = point["seed"], scene_of(point["scene"])
    parts = sequences(point["scene"], seed, point["short"])
    chosen = {key: value for key, value in point.items() if key not in _OF_THE_POINT}
    rows = point.get("rows", PAPER if point["solver"] == "fista" else FIXED)
    how = {"phi": point["phi"], "rows": rows, "f_max_n": scene.f_max_n}

    def frames(method: Method) -> Iterator[tuple[Floats, Floats]]:
        for truths, taxels in parts:
            method.reset()
            yield from zip(truths, taxels, strict=True)

    try:
        method = make_method(chosen, scene.shape, point["ratio"], seed, **how)
        scores = evaluate_one(method, frames(method), scene.f_max_n)
    except SparseskinError as error:
        return {"refused": str(error)}
    y, phi = method.measure(parts[-1][1][-1]), method.phi
    message = Measurements(stamp_ns=0, patch="skin", y=y, phi=phi.fingerprint)
    return {
        **figures_of(scores),
        "median_ms": round(scores.cpu_ms(50), 4),
        "p99_ms": round(scores.wall_ms(99), 4),
        "cpu_share": round(sum(scores.cpu_s) / sum(scores.wall_s), 3),
        "bytes": size_bytes(message),
        "done": round(float(np.mean(scores.n_steps)), 2),
    }


def figures_of(scores: Scores) -> dict[str, float]:
    """Figures over the frames in contact.

    Returns
    -------
    dict
        mean_db, worst_db: PSNR; touched_mn: root mean square error of the taxels that bear more
        than 0.4 % of the range, in millinewtons.
    """
    squared, n_touched = zip(*scores.touched, strict=True)
    rmse_n = float(np.sqrt(np.average(squared, weights=n_touched)))
    return {
        "mean_db": round(scores.mean_db, 3),
        "worst_db": round(scores.min_db, 3),
        "touched_mn": round(rmse_n * 1e3, 3),
    }


def full_reading(point: Point) -> dict[str, Any]:
    """Score the noisy taxels themselves, all N of them sent, with dead zones of several widths.

    `point`: scene, seed, short.

    Returns
    -------
    dict
        bytes of a taxels message; by_dead_zone: for each of `DEAD_ZONES_N`, as `figures_of`.
    """
    parts = sequences(point["scene"], point["seed"], point["short"])
    frames = [pair for part in parts for pair in zip(*part, strict=True)]
    zones = {str(width_n): Reading(width_n) for width_n in DEAD_ZONES_N}
    scores = evaluate(zones, frames, scene_of(point["scene"]).f_max_n)
    return {
        "bytes": size_bytes(Taxels(stamp_ns=0, patch="skin", forces=parts[0][1][0])),
        "by_dead_zone": [figures_of(one) for one in scores.values()],
    }


def race(point: Point) -> dict[str, Any]:
    """Time one library to within 1 % of the minimum, each frame by itself from 0.

    The number of iterations is searched for first; the time is that of further calls with just as
    many, which have nothing to check: the shortest of three.

    `point`: peer, scene, seed, short, ratio, lambda_n, n_frames.

    Returns
    -------
    dict
        median_ms, processor time a frame; iterations: their median; mean_db, worst_db; objective:
        the largest ratio to the minimum; nonzeros: median; n_frames.
    """
    problem = Bpdn(scene_of(point["scene"]).shape, point["ratio"], point["seed"], point["lambda_n"])
    peer = PEERS[point["peer"]]
    spans_ms, counts, ratios, psnr = [], [], [], []
    for truth, taxels in _frames(point):
        y = problem.phi.forward(taxels.reshape(-1))
        best = problem.solution(y)
        lowest = problem.objective(best, y)
        solve = peer.make(problem, best)
        if peer.stops_by_itself:
            iterations = STEPS[-1]
            solve(y, iterations)  # a first call, not timed, as the others have in the search
        else:
            iterations = _needed(problem, solve, y, WITHIN * lowest)
        theta, span_ms = _shortest(solve, y, iterations)
        spans_ms.append(span_ms)
        counts.append(iterations)
        ratios.append(problem.objective(theta, y) / lowest)
        psnr.append(psnr_db(problem.image(theta) - truth, scene_of(point["scene"]).f_max_n))
    return {
        "median_ms": round(float(np.median(spans_ms)), 4),
        "iterations": float(np.median(counts)),
        "mean_db": round(float(np.mean(psnr)), 3),
        "worst_db": round(float(np.min(psnr)), 3),
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


def _frames(point: Point) -> list[tuple[Floats, Floats]]:
    """Frames in contact, evenly spread over those of the scene."""
    f_max = scene_of(point["scene"]).f_max_n
    pairs = [
        pair
        for truth, taxels in sequences(point["scene"], point["seed"], point["short"])
        for pair in zip(truth, taxels, strict=True)
        if in_contact(pair[0], f_max)
    ]
    chosen = np.linspace(0, len(pairs) - 1, min(point["n_frames"], len(pairs))).round()
    return [pairs[int(k)] for k in chosen]
