"""What study `targets` computes: scenes restored by each method, light touches, recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi import Phi, make_phi
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.presets import PRESETS
from sparseskin.nodes.reconstructor.solver import Mask, Solver, make_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.recorded import open_file

from .scene_frames import first_contact, in_contact, scene_frames
from .targets_scenes import F_MAX_N, random_scene

Floats = npt.NDArray[np.float32]
Point = dict[str, Any]

RANDOM = "random "
#: Frames before the first contact: a solver has then seen some of an untouched skin.
BEFORE = 20
DEAD_ZONES_N = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08)
#: FISTA as in the paper, and with the lambda that serves it best at 30 iterations.
SOLVERS: dict[str, dict[str, Any]] = {
    "paper": PRESETS["paper"],
    "fista, tuned": {**PRESETS["paper"], "lambda_n": 0.00625},
    "skin": PRESETS["skin"],
}
LIGHT_TOUCH_N, LIGHT_TOUCH_SIDE = 0.05, 3
#: A touch is told by a mean of nine taxels above this.
TOLD_N = 0.01
UNTOUCHED_FRAMES = 500


class Tally:
    """PSNR in contact, error on touched taxels, and solve times of one method on one scene."""

    def __init__(self) -> None:
        self.psnr: list[float] = []
        self.touched: list[float] = []
        self.seconds: list[float] = []

    def add(self, estimate: Floats, truth: Floats, seconds: float) -> None:
        self.seconds.append(seconds)
        if in_contact(truth, F_MAX_N):
            error = estimate - truth
            self.psnr.append(psnr_db(error, F_MAX_N))
            on_touched = error[truth > 0.004 * F_MAX_N]
            self.touched.append(float(np.mean(np.square(on_touched, dtype=np.float64))))

    def figures(self) -> dict[str, float]:
        """Means over contact frames, in dB, N and ms."""
        return {
            "mean_db": float(np.mean(self.psnr)),
            "min_db": float(np.min(self.psnr)),
            "touched_n": float(np.sqrt(np.mean(self.touched))),
            "p50_ms": float(np.median(self.seconds) * 1e3),
            "p99_ms": float(np.percentile(self.seconds, 99) * 1e3),
        }


def frames_of(scene: str, seed: int, n_frames: int | None) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, taxels) of a scene from shortly before its first contact, or of a random one.

    `n_frames` None: to the scene's end.
    """
    if not scene.startswith(RANDOM):
        first = max(0, first_contact(scene, seed) - BEFORE)
        yield from scene_frames(scene, seed, first, None if n_frames is None else first + n_frames)
        return
    number = int(scene.removeprefix(RANDOM))
    noise, rng = NoiseModel.for_range(F_MAX_N), np.random.default_rng([seed, number])
    for truth in random_scene(number)[1]:
        yield truth, noise.apply(truth, rng)


def solver_of(
    chosen: dict[str, Any], phi: Phi, shape: tuple[int, int], mask: Mask | None
) -> Solver:
    """Make a solver of a preset's settings."""
    settings = {k: v for k, v in chosen.items() if k not in ("solver", "basis")}
    basis = make_basis(chosen["basis"], *shape)
    return make_solver(chosen["solver"], phi, basis, mask, **settings)


def restored(point: Point) -> dict[str, Any]:
    """Restore a scene at one ratio N / M by each method, on the same measurements.

    Parameters
    ----------
    point : dict
        scene, ratio, n_frames (None: all), seed.

    Returns
    -------
    dict
        "n", and by method the figures of `Tally`. Ratio 1 is the reading itself: raw, with
        several dead zones, and through the solver "skin" with M = N.
    """
    ratio: int = point["ratio"]
    frames = frames_of(point["scene"], point["seed"], point["n_frames"])
    tallies: dict[str, Tally] = {}
    made: list[tuple[str, Phi, Solver]] = []
    n = 0
    for truth, taxels in frames:
        if not n:
            n = truth.size
            phi = make_phi("sbhe", n, n // ratio, seed=point["seed"])
            names = ["skin"] if ratio == 1 else list(SOLVERS)
            made = [(name, phi, solver_of(SOLVERS[name], phi, truth.shape, None)) for name in names]
            zones = [f"dead zone {zone:.2f} N" for zone in DEAD_ZONES_N] if ratio == 1 else []
            readings = ["raw", *zones] if ratio == 1 else []
            tallies = {name: Tally() for name in (*readings, *names)}
        if ratio == 1:
            tallies["raw"].add(taxels, truth, 0.0)
            for zone in DEAD_ZONES_N:
                cut = np.where(taxels < zone, np.float32(0), taxels)
                tallies[f"dead zone {zone:.2f} N"].add(cut, truth, 0.0)
        y = phi.forward(taxels.reshape(-1))
        for name, _, solver in made:
            begin = time.perf_counter()
            estimate = solver.solve(y)
            tallies[name].add(estimate, truth, time.perf_counter() - begin)
    return {"n": n, "methods": {name: tally.figures() for name, tally in tallies.items()}}


def touched_lightly(point: Point) -> dict[str, Any]:
    """Press 3 x 3 taxels with 0.05 N at random places: how many are told within three frames.

    Parameters
    ----------
    point : dict
        side, ratio, solver (of `SOLVERS`), n_trials, seed.

    Returns
    -------
    dict
        "found": part of the trials; "false": part of `UNTOUCHED_FRAMES` untouched frames that
        would be told as touched.
    """
    side: int = point["side"]
    n = side * side
    phi = make_phi("sbhe", n, n // point["ratio"], seed=point["seed"])
    solver = solver_of(SOLVERS[point["solver"]], phi, (side, side), None)
    noise, rng = NoiseModel.for_range(F_MAX_N), np.random.default_rng(point["seed"])

    def measured(truth: Floats) -> Floats:
        return phi.forward(noise.apply(truth, rng).reshape(-1))

    nothing = np.zeros((side, side), dtype=np.float32)
    untouched = [measured(nothing) for _ in range(UNTOUCHED_FRAMES)]
    false = sum(_told(solver.solve(y)) for y in untouched[BEFORE:])
    found = 0
    for _ in range(point["n_trials"]):
        row, col = rng.integers(side - LIGHT_TOUCH_SIDE, size=2)
        here = slice(row, row + LIGHT_TOUCH_SIDE), slice(col, col + LIGHT_TOUCH_SIDE)
        truth = nothing.copy()
        truth[here] = LIGHT_TOUCH_N
        solver.reset()
        for y in untouched[:BEFORE]:
            solver.solve(y)
        # Each of the three frames draws its noise, told or not.
        frames = [solver.solve(measured(truth))[here] for _ in range(3)]
        found += any(_told(forces) for forces in frames)
    return {"found": found / point["n_trials"], "false": false / (UNTOUCHED_FRAMES - BEFORE)}


def _told(forces: Floats) -> bool:
    windows = np.lib.stride_tricks.sliding_window_view(forces, (3, 3))
    return bool(windows.mean(axis=(-2, -1)).max() > TOLD_N)


def recorded(point: Point) -> dict[str, Any]:
    """Restore a recording by one solver at one ratio: mean relative error of contact frames.

    Parameters
    ----------
    point : dict
        path, ratio, solver (of `SOLVERS`), seed.
    """
    source = open_file(Path(point["path"]))
    skin = source.skin
    mask = np.ones((skin.n_rows, skin.n_cols), dtype=np.bool_) if skin.mask is None else skin.mask
    n = int(mask.sum())
    chosen = dict(SOLVERS[point["solver"]])
    if "lambda_n" in chosen:
        chosen["lambda_n"] *= skin.f_max / F_MAX_N
    phi = make_phi("sbhe", n, n // point["ratio"], seed=point["seed"])
    solver = solver_of(chosen, phi, mask.shape, mask)
    errors, seconds = [], []
    for _, frame in source:
        y = phi.forward(frame[mask])
        begin = time.perf_counter()
        estimate = solver.solve(y)
        seconds.append(time.perf_counter() - begin)
        if in_contact(frame, skin.f_max):
            errors.append(float(np.linalg.norm(estimate - frame) / np.linalg.norm(frame)))
    return {
        "n": n,
        "n_contact": len(errors),
        "error": float(np.mean(errors)) if errors else 0.0,
        "p50_ms": float(np.median(seconds) * 1e3),
    }
