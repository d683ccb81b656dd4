"""Study `targets`: the solver "skin" against the paper's method and the full reading."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import CONTACT_FRACTION, PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.rotation import FIXED, PAPER, ROTATING
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.estimates.resultant import Estimate, ResultantEstimator
from sparseskin.nodes.reconstructor.estimates.uncertainty import Uncertainty
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.files.recorded import open_file
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.evaluate import (
    Estimator,
    Method,
    Reading,
    Scores,
    evaluate,
    in_contact,
    make_method,
    phis_at,
)
from sparseskin.studies.points import Function, StudyError, compute
from sparseskin.studies.report import frame_of
from sparseskin.studies.scene_frames import first_contact, scene_frames
from sparseskin.studies.speed_accuracy.peers import PEERS, PYLOPS, Bpdn, missing_peers

from .ablation import WITHOUT, changed_solver
from .page import DEVIATIONS, HELD, LIGHT_TOUCH_N, THRESHOLD_N, write
from .scenes import RANDOM, random_scene, side_of

SCENES = (
    *("lift_box_40", "lift_wrench_40", "drag_wrench_40", "path_40"),
    *("lift_box_64", "drag_wrench_64"),
)
#: By number; quick: one each of pressed, slid, rolled, several.
RANDOM_SCENES, QUICK_RANDOM_SCENES = range(10), (0, 3, 6, 9)
#: 1 is the reading itself; 16 is computed for 4096 taxels alone.
RATIOS = (1, 3, 4, 8, 16)
LONGEST_FRAMES, QUICK_FRAMES, ABLATION_FRAMES, BAND_FRAMES = 4000, 150, 300, 900
TRIALS, QUICK_TRIALS = 300, 40
#: Solver and ratio N / M: wanted is that skin at 4 is no worse than paper at 2.
RECORDED = tuple(
    (solver, ratio) for solver in ("paper", "skin", "skin, rotating") for ratio in (2, 4)
)
SUFFIXES = (".lst", ".csv", ".asf", ".npy", ".npz")

#: Untouched frames before the first contact, so that a solver has settled.
BEFORE = 20
#: Dead zones of the full reading, newtons.
DEAD_ZONES_N = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08)
#: FISTA as in the paper, and with its best lambda at 30 iterations.
SOLVERS: dict[str, dict[str, Any]] = {
    "paper": PRESETS["paper"],
    "fista, tuned": {**PRESETS["paper"], "lambda_n": 0.00625},
    "skin": PRESETS["skin"],
    f"skin, {ROTATING}": PRESETS["skin"],
}
LIGHT_TOUCH_SIDE, UNTOUCHED_FRAMES = 3, 500
#: PyLops is timed in one frame of so many: it takes the time of many.
PYLOPS_EVERY = 25

Point = dict[str, Any]


def run(out: Path, quick: bool, seed: int, executor: str, recordings: Path | None = None) -> None:
    """Compute the study and write its page; see `command.Study`.

    Without `recordings`, a folder of recordings of real skins, the page reports that they are left
    out. Raises StudyError also if that folder cannot be read.
    """
    files = recordings_in(recordings)
    numbers = QUICK_RANDOM_SCENES if quick else RANDOM_SCENES
    scenes = (*SCENES, *(f"{RANDOM}{k}" for k in numbers))
    n_frames = QUICK_FRAMES if quick else LONGEST_FRAMES
    reconstructing = [
        {"scene": scene, "ratio": ratio, "n_frames": n_frames, "seed": seed}
        for scene in scenes
        for ratio in RATIOS
        if ratio < 16 or side_of(scene) == 64
    ]
    n_trials = QUICK_TRIALS if quick else TRIALS
    touching = [
        {"side": side, "ratio": 4, "solver": solver, "n_trials": n_trials, "seed": seed}
        for side in (40, 64)
        for solver in ("paper", "skin", "skin, rotating")
    ]

    def of_skin(sampled: Sequence[tuple[int, str]], n_frames: int) -> list[Point]:
        """Points of "skin" alone: each scene at each ratio N / M and kind of rows."""
        common = {"n_frames": QUICK_FRAMES if quick else n_frames, "seed": seed}
        return [
            {"scene": scene, "ratio": ratio, "rows": kind, **common}
            for scene in scenes
            for ratio, kind in sampled
        ]

    banding = of_skin([(n, kind) for kind in (FIXED, ROTATING) for n in (3, 4, 8)], BAND_FRAMES)
    ablating = of_skin([(3, FIXED), (8, FIXED), (8, ROTATING)], ABLATION_FRAMES)
    recording = [
        {"path": str(path), "ratio": ratio, "solver": solver, "seed": seed}
        for path in files
        for solver, ratio in RECORDED
    ]

    def rows(function: Function, points: list[Point], label: str, by: str = "") -> pd.DataFrame:
        """A row a point; or a row a name, where figures are by name in `by` or at the top."""
        found = compute(function, points, out, executor, label)
        return frame_of(points, found, by)

    write(
        out,
        reconstructed=rows(reconstructed, reconstructing, "scenes", "method"),
        touched=rows(touched_lightly, touching, "touches"),
        banded=rows(banded, banding, "bands"),
        recorded=rows(recorded, recording, "recordings"),
        ablated=rows(ablated, ablating, "ablation", "without"),
    )


def recordings_in(folder: Path | None) -> list[Path]:
    """Return the recordings in a folder; logged on stderr where there is none.

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


def frames_of(scene: str, seed: int, n_frames: int | None) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, taxels) of a scene from shortly before its first contact, or of a random one.

    `n_frames` None: to the scene's end.
    """
    if not scene.startswith(RANDOM):
        first = max(0, first_contact(scene, seed) - BEFORE)
        yield from scene_frames(scene, seed, first, None if n_frames is None else first + n_frames)
        return
    number = int(scene.removeprefix(RANDOM))
    noise, rng = NoiseModel.for_range(PAPER_F_MAX_N), np.random.default_rng([seed, number])
    for truth in random_scene(number)[1]:
        yield truth, noise.apply(truth, rng)


def method_of(
    name: str,
    shape: tuple[int, int],
    ratio: int,
    seed: int,
    mask: Mask | None = None,
    f_max_n: float = PAPER_F_MAX_N,
) -> Method:
    """Make one of `SOLVERS` for a range, which a lambda is scaled with."""
    chosen = dict(SOLVERS[name])
    if "lambda_n" in chosen:
        chosen["lambda_n"] *= f_max_n / PAPER_F_MAX_N
    rows = ROTATING if name.endswith(ROTATING) else FIXED if name == "skin" else PAPER
    return make_method(chosen, shape, ratio, seed, rows=rows, mask=mask, f_max_n=f_max_n)


def figures_of(scores: Scores) -> dict[str, float]:
    """PSNR in dB and RMS error of the touched taxels in N, contact frames; solve times in ms."""
    return {
        "mean_db": scores.mean_db,
        "min_db": scores.min_db,
        "touched_n": float(np.sqrt(np.mean([squared for squared, _ in scores.touched]))),
        "p50_ms": scores.wall_ms(50),
        "p99_ms": scores.wall_ms(99),
    }


def reconstructed(point: Point) -> dict[str, Any]:
    """Reconstruct a scene at one ratio N / M by each method, on the same measurements.

    `point`: scene, ratio, n_frames (None: all), seed.

    Returns
    -------
    dict
        "n", "methods": by method the figures of `figures_of`, and "pylops_ms", the median time
        that FISTA of PyLops takes for some of the frames; None where it is not installed. Ratio 1
        is the reading itself: raw, with several dead zones, and through "skin" with M = N.
    """
    scene, ratio, seed = (point[key] for key in ("scene", "ratio", "seed"))
    shape = (side_of(scene), side_of(scene))
    estimators: dict[str, Estimator] = {}
    if ratio == 1:
        zones = {f"dead zone {zone:.2f} N": Reading(zone) for zone in DEAD_ZONES_N}
        estimators = {"raw": Reading(), **zones, "skin": method_of("skin", shape, 1, seed)}
    else:
        estimators = {name: method_of(name, shape, ratio, seed) for name in SOLVERS}
    some_taxels: list[Floats] = []

    def frames() -> Iterator[tuple[Floats, Floats]]:
        for k, (truth, taxels) in enumerate(frames_of(scene, seed, point["n_frames"])):
            if k % PYLOPS_EVERY == 0:
                some_taxels.append(taxels)
            yield truth, taxels

    scores = evaluate(estimators, frames())
    return {
        "n": math.prod(shape),
        "methods": {name: figures_of(one) for name, one in scores.items()},
        "pylops_ms": _pylops_ms(some_taxels, shape, ratio, seed) if ratio > 1 else None,
    }


def _pylops_ms(
    frames: Sequence[Floats], shape: tuple[int, int], ratio: int, seed: int
) -> float | None:
    """Median time that FISTA of PyLops takes with the paper's settings, ms; None without it."""
    if PYLOPS in missing_peers():
        return None
    problem = Bpdn(shape, ratio, seed, PRESETS["paper"]["lambda_n"])
    solve = PEERS[PYLOPS].make(problem, np.zeros(problem.n, dtype=np.float32))
    spans_s = []
    for taxels in frames:
        y = problem.phi.forward(taxels.reshape(-1))
        begin_s = time.perf_counter()
        solve(y, PRESETS["paper"]["iterations"])
        spans_s.append(time.perf_counter() - begin_s)
    return float(np.median(spans_s) * 1e3)


def touched_lightly(point: Point) -> dict[str, Any]:
    """Press 3 x 3 taxels with 0.05 N at random places; count those detected within three frames.

    `point`: side, ratio, solver (of `SOLVERS`), n_trials, seed.

    Returns
    -------
    dict
        "found": part of the trials; "false": part of `UNTOUCHED_FRAMES` untouched frames that
        are detected as touched.
    """
    side: int = point["side"]
    method = method_of(point["solver"], (side, side), point["ratio"], point["seed"])
    noise, rng = NoiseModel.for_range(PAPER_F_MAX_N), np.random.default_rng(point["seed"])
    nothing = np.zeros((side, side), dtype=np.float32)
    untouched = [noise.apply(nothing, rng) for _ in range(UNTOUCHED_FRAMES)]
    false = sum(_detected(method.reconstruct(taxels).forces) for taxels in untouched[BEFORE:])
    found = 0
    for _ in range(point["n_trials"]):
        row, col = rng.integers(side - LIGHT_TOUCH_SIDE, size=2)
        here = slice(row, row + LIGHT_TOUCH_SIDE), slice(col, col + LIGHT_TOUCH_SIDE)
        truth = nothing.copy()
        truth[here] = LIGHT_TOUCH_N
        method.reset()
        for taxels in untouched[:BEFORE]:
            method.reconstruct(taxels)
        # Each of the three frames draws its noise, detected or not.
        frames = [method.reconstruct(noise.apply(truth, rng)).forces[here] for _ in range(3)]
        found += any(_detected(forces) for forces in frames)
    return {"found": found / point["n_trials"], "false": false / (UNTOUCHED_FRAMES - BEFORE)}


def _detected(forces: Floats) -> bool:
    windows = np.lib.stride_tricks.sliding_window_view(forces, (3, 3))
    return bool(windows.mean(axis=(-2, -1)).max() > THRESHOLD_N)


def recorded(point: Point) -> dict[str, Any]:
    """Reconstruct a recording by one solver at one ratio: mean relative error of contact frames.

    `point`: path, ratio, solver (of `SOLVERS`), seed.
    """
    source = open_file(Path(point["path"]))
    skin = source.skin
    shape = (skin.n_rows, skin.n_cols)
    arguments = (shape, point["ratio"], point["seed"], skin.exists, skin.f_max)
    method = method_of(point["solver"], *arguments)
    errors, spans_s = [], []
    for _, frame in source:
        solved = method.reconstruct(frame)
        spans_s.append(solved.wall_s)
        if in_contact(frame, skin.f_max):
            errors.append(float(np.linalg.norm(solved.forces - frame) / np.linalg.norm(frame)))
    return {
        "n": skin.n_taxels,
        "n_contact": len(errors),
        "error": float(np.mean(errors)) if errors else 0.0,
        "p50_ms": float(np.median(spans_s) * 1e3),
    }


def banded(point: Point) -> dict[str, Any]:
    """Reconstruct a scene by "skin" with its standard deviations, and count what bands hold.

    `point`: scene, ratio, rows ("fixed" or "rotating"), n_frames, seed.

    Returns
    -------
    dict
        By name in `HELD`, the part of all contact frames' bands that hold the truth, 0..1; NaN
        where there was none.
    """
    ratio, rows, side = point["ratio"], point["rows"], side_of(point["scene"])
    shape = (side, side)
    method = make_method(PRESETS["skin"], shape, ratio, point["seed"], rows=rows)
    first = method.phi
    uncertainty = Uncertainty(np.ones(shape, dtype=np.bool_), first.ratio, "skin", rows)
    resultant = ResultantEstimator(first, method.solver.taxels, shape)
    held: dict[str, list[float]] = {name: [] for name in HELD}
    for truth, taxels in frames_of(point["scene"], point["seed"], point["n_frames"]):
        phi, y = method.phi, method.measure(taxels)
        estimate = resultant.estimate(phi, y)
        forces = method.solve(y).forces
        fitted = phi.forward(forces.reshape(-1))
        residual = math.sqrt(float(np.mean(np.square(fitted - y, dtype=np.float64))))
        sd = uncertainty.update(forces, residual)
        resultant.learn(phi, y, forces.reshape(-1), fitted)
        resultant.prepare(method.phi)
        if in_contact(truth, PAPER_F_MAX_N):
            _count(held, truth, np.abs(forces - truth) <= DEVIATIONS * sd, estimate)
    return {name: mean(values) if values else math.nan for name, values in held.items()}


def _count(held: dict[str, list[float]], truth: Floats, inside: Any, estimate: Estimate) -> None:
    touched = truth > CONTACT_FRACTION * PAPER_F_MAX_N
    held["touched"].append(float(inside[touched].mean()))
    held["untouched"].append(float(inside[truth == 0].mean()))
    total = float(truth.sum(dtype=np.float64))
    held["total"].append(abs(estimate.total - total) <= DEVIATIONS * estimate.total_sd)
    if estimate.centre is None or estimate.centre_sd is None:
        return
    places = np.indices(truth.shape, dtype=np.float64)
    for name, place, middle, deviation in zip(
        ("row", "col"), places, estimate.centre, estimate.centre_sd, strict=True
    ):
        centre = float((place * truth).sum()) / total
        held[name].append(abs(middle - centre) <= DEVIATIONS * deviation)


def ablated(point: Point) -> dict[str, Any]:
    """Reconstruct a scene by "skin" without each ingredient in turn, on the same measurements.

    `point`: scene, ratio, rows ("fixed" or "rotating"), n_frames, seed.

    Returns
    -------
    dict
        By ingredient the figures of `figures_of`.
    """
    side, seed = side_of(point["scene"]), point["seed"]
    methods = {}
    for name in WITHOUT:
        phis = phis_at(side * side, point["ratio"], point["rows"], seed)
        methods[name] = Method(changed_solver(name, phis[0], (side, side)), phis)
    scores = evaluate(methods, frames_of(point["scene"], seed, point["n_frames"]))
    return {name: figures_of(one) for name, one in scores.items()}
