"""The default solver over a stream that never ends: jumps, losses, drift; at full size a million.

Random scenes follow each other, each time with other noise, and the solver is never reset. From one
scene to the next everything changes between two frames; in every fourth frames are lost. The third
frame after each of these is compared with that of a solver that starts there with the same frames:
a solver locked in to its state would be far behind it. Every round has the same scenes, so that a
solver that drifts would show it in its mean PSNR.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from random_scenes import random_scene
from stress.graphs import FULL

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.evaluate import phis_at

#: Rows and columns, N / M, rows of the measurement matrix.
STREAMS = ((20, 3, "fixed"), (20, 3, "rotating"), (20, 8, "rotating"))
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
ENOUGH_DB = 60.0
"""PSNR from which frames count as equal: an error of a sixth of the noise."""
#: Frames of a stream, an eighth of which are lost.
LONG_FRAMES = 1_150_000


def endured(point: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct a stream of scenes by one solver that is never reset.

    `point`: side, ratio, rows ("fixed" or "rotating"), n_frames, seed.

    Returns
    -------
    dict
        "n_frames" reconstructed, "not_finite" of them, "largest_n" the largest force; "rounds_db"
        the mean PSNR of each round; "jumps_db" and "losses_db": dB by which the third frame after
        each jump, and after each loss, is below that of a solver that starts there, where 60 dB
        and more count as 60; "apart_db", after both, dB by which another such solver, which draws
        other shifts, is below the first.
    """
    side: int = point["side"]
    phis = phis_at(side * side, point["ratio"], point["rows"], point["seed"])
    scenes = [_frames(number, side) for number in range(SCENES)]
    noise, rng = NoiseModel.for_range(PAPER_F_MAX_N), np.random.default_rng(point["seed"])
    solver, fresh, other = (
        make_solver("skin", phis[0], make_basis("haar", side, side), seed=seed)
        for seed in (0, 0, 1)
    )
    psnr: list[float] = []
    behind: dict[str, list[float]] = {"jump": [], "loss": []}
    apart: list[float] = []
    not_finite, largest_n, since, why = 0, 0.0, SETTLED_AFTER, "jump"
    for k, (truth, event) in enumerate(_stream(scenes, point["n_frames"])):
        phi = phis[k % len(phis)]
        if truth is None:
            continue
        if event and k:
            since, why = 0, event
            fresh.reset()
            other.reset()
        y = phi.forward(noise.apply(truth, rng).reshape(-1))
        solver.use(phi)
        forces = solver.solve(y)
        largest_n = max(largest_n, float(forces.max()))
        psnr.append(psnr_db(forces - truth, PAPER_F_MAX_N))
        not_finite += not math.isfinite(psnr[-1])
        if since < SETTLED_AFTER:
            since += 1
            fresh.use(phi)
            other.use(phi)
            anew, again = fresh.solve(y), other.solve(y)
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
    }


def _frames(number: int, side: int) -> Floats:
    frames = list(random_scene(number, FRAMES, side)[1])
    return np.array(frames[FIRST:])


def _stream(scenes: list[Floats], n_frames: int) -> Iterator[tuple[Floats | None, str]]:
    """Yield each frame, None where it is lost, and the event before it: "jump", "loss" or ""."""
    for k in range(n_frames):
        scene, place = divmod(k, PER_SCENE)
        lossy = scene % LOST_EVERY == LOST_EVERY - 1
        lost = lossy and LOST_FROM <= place < LOST_FROM + LOST
        after_loss = lossy and place == LOST_FROM + LOST
        event = "jump" if place == 0 else "loss" if after_loss else ""
        yield (None if lost else scenes[scene % SCENES][place]), event


def _capped_db(forces: Floats, truth: Floats) -> float:
    return min(psnr_db(forces - truth, PAPER_F_MAX_N), ENOUGH_DB)


def _rounds(psnr: list[float]) -> list[list[float]]:
    """Frames by whole rounds; a shorter stream counts as one."""
    lossy = SCENES // LOST_EVERY
    per_round = PER_ROUND - lossy * LOST
    whole = [psnr[a : a + per_round] for a in range(0, len(psnr) - per_round + 1, per_round)]
    return whole or [psnr]


@pytest.mark.parametrize("stream", STREAMS if FULL else STREAMS[:2])
def test_over_jumps_and_losses_nothing_is_lost_for_good(
    stream: tuple[int, int, str], full: bool, note: Any
) -> None:
    side, ratio, rows = stream
    n_scenes = LONG_FRAMES // PER_SCENE if full else 12
    point = {
        "side": side,
        "ratio": ratio,
        "rows": rows,
        "n_frames": n_scenes * PER_SCENE,
        "seed": 1,
    }
    found = endured(point)
    n_losses, rounds = n_scenes // LOST_EVERY, found["rounds_db"]
    assert found["n_frames"] == n_scenes * PER_SCENE - n_losses * LOST
    assert found["not_finite"] == 0
    assert found["largest_n"] < 5
    assert (len(found["jumps_db"]), len(found["losses_db"])) == (n_scenes - 1, n_losses)
    behind = np.array(found["jumps_db"] + found["losses_db"])
    note(
        **{"M": f"N/{ratio}, {rows}", "frames": found["n_frames"], "largest": found["largest_n"]},
        **{"first_round_db": rounds[0], "last_round_db": rounds[-1]},
        within_1_db=float(np.mean(behind <= 1)),
        two_fresh_within_1_db=float(np.mean(np.array(found["apart_db"]) <= 1)),
    )
    assert float(np.median(behind)) < 1
    assert len(found["apart_db"]) == len(behind)
    assert np.any(found["apart_db"])
    assert rounds[0] > (40 if ratio == 3 else 30)
    assert abs(rounds[-1] - rounds[0]) < 0.5
