"""What study `targets` computes: scenes restored by each method, light touches, recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi import Phi, make_phi
from sparseskin.nodes.compressor.rotation import FIXED, ROTATING, phases_of
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.presets import PRESETS
from sparseskin.nodes.reconstructor.rotating import make_rotating_solver
from sparseskin.nodes.reconstructor.solver import Mask
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.recorded import open_file

from .scene_frames import first_contact, in_contact, scene_frames
from .targets_peer import PeerClock
from .targets_scenes import F_MAX_N, random_scene

Floats = npt.NDArray[np.float32]
Point = dict[str, Any]

RANDOM = "random "
#: Frames before the first contact: a solver has then seen some of an untouched skin.
BEFORE = 20
#: Forces above this part of the range are those of touched taxels.
TOUCHED = 0.004
DEAD_ZONES_N = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08)
#: FISTA as in the paper, and with the lambda that serves it best at 30 iterations.
SOLVERS: dict[str, dict[str, Any]] = {
    "paper": PRESETS["paper"],
    "fista, tuned": {**PRESETS["paper"], "lambda_n": 0.00625},
    "skin": PRESETS["skin"],
    f"skin, {ROTATING}": PRESETS["skin"],
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
            on_touched = error[truth > TOUCHED * F_MAX_N]
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


def phases_at(n: int, ratio: int, rows: str, seed: int) -> list[Phi]:
    """Phi of N taxels at a ratio N / M, one of each phase: M is rounded down where rows are fixed,
    and up where they rotate, so that all phases together hold every row.
    """
    m = n // ratio if rows == FIXED else -(-n // ratio)
    return phases_of(make_phi("sbhe", n, m, seed=seed), rows)


class Method:
    """One of `SOLVERS` with the measurements it asks for, frame after frame.

    Parameters
    ----------
    name : str
    ratio : int
        N / M, as `phases_at` takes it.
    exists : ndarray of bool, shape (n_rows, n_cols)
        Where there are taxels.
    seed : int
        Of Phi.
    f_max_n : float
        Range, which a lambda goes with.
    """

    def __init__(
        self, name: str, ratio: int, exists: Mask, seed: int, f_max_n: float = F_MAX_N
    ) -> None:
        chosen = dict(SOLVERS[name])
        if "lambda_n" in chosen:
            chosen["lambda_n"] *= f_max_n / F_MAX_N
        rows = ROTATING if name.endswith(ROTATING) else FIXED
        self._phases = phases_at(int(exists.sum()), ratio, rows, seed)
        basis = make_basis(chosen.pop("basis"), *exists.shape)
        self._solver = make_rotating_solver(
            chosen.pop("solver"), self._phases, basis, exists, **chosen
        )
        self._exists = exists
        self._n_frames = 0

    def reset(self) -> None:
        """Forget all frames."""
        self._solver.reset()
        self._n_frames = 0

    def restore(self, taxels: Floats) -> tuple[Floats, float]:
        """Measure a frame and restore it: the forces, and the seconds that the solver took."""
        phi = self._phases[self._n_frames % len(self._phases)]
        self._n_frames += 1
        y = phi.forward(taxels[self._exists])
        begin = time.perf_counter()
        self._solver.use(phi)
        forces = self._solver.solve(y)
        return forces, time.perf_counter() - begin


def restored(point: Point) -> dict[str, Any]:
    """Restore a scene at one ratio N / M by each method, on the same measurements.

    Parameters
    ----------
    point : dict
        scene, ratio, n_frames (None: all), seed.

    Returns
    -------
    dict
        "n", by method the figures of `Tally`, and "pylops_ms", the median time that FISTA of
        PyLops takes for some of the frames; None where it is not installed. Ratio 1 is the
        reading itself: raw, with several dead zones, and through the solver "skin" with M = N.
    """
    ratio: int = point["ratio"]
    frames = frames_of(point["scene"], point["seed"], point["n_frames"])
    tallies: dict[str, Tally] = {}
    made: dict[str, Method] = {}
    peer: PeerClock | None = None
    n = 0
    for truth, taxels in frames:
        if not n:
            n = truth.size
            everywhere = np.ones(truth.shape, dtype=np.bool_)
            names = ["skin"] if ratio == 1 else list(SOLVERS)
            made = {name: Method(name, ratio, everywhere, point["seed"]) for name in names}
            zones = [f"dead zone {zone:.2f} N" for zone in DEAD_ZONES_N] if ratio == 1 else []
            readings = ["raw", *zones] if ratio == 1 else []
            peer = PeerClock(truth.shape, ratio, point["seed"]) if ratio > 1 else None
            tallies = {name: Tally() for name in (*readings, *names)}
        if ratio == 1:
            tallies["raw"].add(taxels, truth, 0.0)
            for zone in DEAD_ZONES_N:
                cut = np.where(taxels < zone, np.float32(0), taxels)
                tallies[f"dead zone {zone:.2f} N"].add(cut, truth, 0.0)
        for name, method in made.items():
            estimate, seconds = method.restore(taxels)
            tallies[name].add(estimate, truth, seconds)
        if peer is not None:
            peer.restore(taxels)
    return {
        "n": n,
        "methods": {name: tally.figures() for name, tally in tallies.items()},
        "pylops_ms": None if peer is None else peer.p50_ms,
    }


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
    everywhere = np.ones((side, side), dtype=np.bool_)
    method = Method(point["solver"], point["ratio"], everywhere, point["seed"])
    noise, rng = NoiseModel.for_range(F_MAX_N), np.random.default_rng(point["seed"])
    nothing = np.zeros((side, side), dtype=np.float32)
    untouched = [noise.apply(nothing, rng) for _ in range(UNTOUCHED_FRAMES)]
    false = sum(_told(method.restore(taxels)[0]) for taxels in untouched[BEFORE:])
    found = 0
    for _ in range(point["n_trials"]):
        row, col = rng.integers(side - LIGHT_TOUCH_SIDE, size=2)
        here = slice(row, row + LIGHT_TOUCH_SIDE), slice(col, col + LIGHT_TOUCH_SIDE)
        truth = nothing.copy()
        truth[here] = LIGHT_TOUCH_N
        method.reset()
        for taxels in untouched[:BEFORE]:
            method.restore(taxels)
        # Each of the three frames draws its noise, told or not.
        frames = [method.restore(noise.apply(truth, rng))[0][here] for _ in range(3)]
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
    method = Method(point["solver"], point["ratio"], mask, point["seed"], skin.f_max)
    errors, seconds = [], []
    for _, frame in source:
        estimate, took = method.restore(frame)
        seconds.append(took)
        if in_contact(frame, skin.f_max):
            errors.append(float(np.linalg.norm(estimate - frame) / np.linalg.norm(frame)))
    return {
        "n": int(mask.sum()),
        "n_contact": len(errors),
        "error": float(np.mean(errors)) if errors else 0.0,
        "p50_ms": float(np.median(seconds) * 1e3),
    }
