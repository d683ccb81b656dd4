"""What study `endurance` computes: one solver over very many frames of scenes that change."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.skin import SkinSolver
from sparseskin.nodes.sensor.noise import NoiseModel

from .targets_points import Floats, Point, phases_at
from .targets_scenes import F_MAX_N, random_scene

#: A round is so many scenes, each cut into its middle, where its body is down: from one to the
#: next everything changes between two frames. Every round has the same scenes, and other noise.
SCENES, FIRST, FRAMES = 50, 60, 160
PER_SCENE = FRAMES - FIRST
PER_ROUND = SCENES * PER_SCENE
#: In every fourth scene so many frames are lost from here on.
LOST_EVERY, LOST_FROM, LOST = 4, 30, 50
#: A jump is over when so many frames after it the error is near that of a solver that starts
#: there and has seen the same frames.
SETTLED_AFTER = 3
#: Beyond this both are as good as exact, an error of a sixth of the noise, and not set apart.
ENOUGH_DB = 60.0


def endured(point: Point) -> dict[str, Any]:
    """Restore a stream of scenes by one solver that is never reset.

    Parameters
    ----------
    point : dict
        side, ratio, rows ("fixed" or "rotating"), n_frames, seed.

    Returns
    -------
    dict
        "n_frames" restored, "not_finite" of them, "largest_n" the largest force; "rounds_db" the
        mean PSNR of each round; "jumps_db" and "losses_db": how many dB the third frame after
        each jump, and after each loss, is below that of a solver that starts there, what is
        above 60 dB counting as 60; "apart_db", after both, how many dB another such solver, which
        draws other shifts, is below the first; "frame_ms".
    """
    side: int = point["side"]
    phases = phases_at(side * side, point["ratio"], point["rows"], point["seed"])
    scenes = [_frames(number, side) for number in range(SCENES)]
    noise, rng = NoiseModel.for_range(F_MAX_N), np.random.default_rng(point["seed"])
    solver, fresh, other = (
        SkinSolver(phases[0], make_basis("haar", side, side), seed=seed) for seed in (0, 0, 1)
    )
    psnr: list[float] = []
    behind: dict[str, list[float]] = {"jump": [], "loss": []}
    apart: list[float] = []
    not_finite, largest_n, since, why = 0, 0.0, SETTLED_AFTER, "jump"
    begin = time.perf_counter()
    for k, (truth, event) in enumerate(_stream(scenes, point["n_frames"])):
        phi = phases[k % len(phases)]
        if truth is None:
            continue
        if event and k:
            since, why = 0, event
            fresh.reset()
            other.reset()
        y = phi.forward(noise.apply(truth, rng).reshape(-1))
        forces = _solved(solver, phi, y)
        largest_n = max(largest_n, float(forces.max()))
        psnr.append(psnr_db(forces - truth, F_MAX_N))
        not_finite += not math.isfinite(psnr[-1])
        if since < SETTLED_AFTER:
            since += 1
            anew, again = _solved(fresh, phi, y), _solved(other, phi, y)
            if since == SETTLED_AFTER:
                anew_db = _capped_db(anew, truth)
                behind[why].append(anew_db - min(psnr[-1], ENOUGH_DB))
                apart.append(anew_db - _capped_db(again, truth))
    return {
        "n_frames": len(psnr),
        "not_finite": not_finite,
        "largest_n": largest_n,
        "rounds_db": [float(np.mean(part)) for part in _rounds(psnr)],
        "jumps_db": behind["jump"],
        "losses_db": behind["loss"],
        "apart_db": apart,
        "frame_ms": (time.perf_counter() - begin) / len(psnr) * 1e3,
    }


def _frames(number: int, side: int) -> Floats:
    frames = list(random_scene(number, FRAMES, side)[1])
    return np.array(frames[FIRST:])


def _stream(scenes: list[Floats], n_frames: int) -> Iterator[tuple[Floats | None, str]]:
    """Yield each frame, None where it is lost, and what it follows: "jump", "loss" or ""."""
    for k in range(n_frames):
        scene, place = divmod(k, PER_SCENE)
        lossy = scene % LOST_EVERY == LOST_EVERY - 1
        lost = lossy and LOST_FROM <= place < LOST_FROM + LOST
        after_loss = lossy and place == LOST_FROM + LOST
        event = "jump" if place == 0 else "loss" if after_loss else ""
        yield (None if lost else scenes[scene % SCENES][place]), event


def _solved(solver: SkinSolver, phi: Phi, y: Floats) -> Floats:
    solver.use(phi)
    return solver.solve(y)


def _capped_db(forces: Floats, truth: Floats) -> float:
    return min(psnr_db(forces - truth, F_MAX_N), ENOUGH_DB)


def _rounds(psnr: list[float]) -> list[list[float]]:
    """Frames by whole rounds; a stream shorter than one is one by itself."""
    lossy = SCENES // LOST_EVERY
    per_round = PER_ROUND - lossy * LOST
    whole = [psnr[a : a + per_round] for a in range(0, len(psnr) - per_round + 1, per_round)]
    return whole or [psnr]
