"""The default solver over a stream that never ends: jumps, losses, drift; at full size a million.

Random scenes follow each other, each time with other noise, and the solver is never reset. From one
scene to the next everything changes between two frames; in every fourth frames are lost. The third
frame after each of these is compared with that of a solver that starts there with the same frames:
a solver locked in to its state would be far behind it. Every round has the same scenes, so that a
solver that drifts would show it in its mean PSNR.
"""

from __future__ import annotations

from collections import Counter
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


def stream(side: int, n_frames: int) -> Iterator[tuple[Floats | None, str]]:
    """Yield each frame, None where it is lost, and the event before it: "jump", "loss" or ""."""
    scenes = [list(random_scene(k, FRAMES, side)[1])[FIRST:] for k in range(SCENES)]
    for k in range(n_frames):
        scene, place = divmod(k, PER_SCENE)
        lossy = scene % LOST_EVERY == LOST_EVERY - 1
        lost = lossy and LOST_FROM <= place < LOST_FROM + LOST
        after_loss = lossy and place == LOST_FROM + LOST
        event = "jump" if place == 0 else "loss" if after_loss else ""
        yield (None if lost else scenes[scene % SCENES][place]), event


def capped_db(forces: Floats, truth: Floats) -> float:
    return min(psnr_db(forces - truth, PAPER_F_MAX_N), ENOUGH_DB)


def mean_of_rounds(psnr: list[float]) -> list[float]:
    """Mean PSNR of whole rounds; a shorter stream counts as one."""
    per_round = PER_ROUND - SCENES // LOST_EVERY * LOST
    whole = [psnr[a : a + per_round] for a in range(0, len(psnr) - per_round + 1, per_round)]
    return [float(np.mean(part)) for part in whole or [psnr]]


@pytest.mark.parametrize(("side", "ratio", "rows"), STREAMS if FULL else STREAMS[:2])
def test_over_jumps_and_losses_nothing_is_lost_for_good(
    side: int, ratio: int, rows: str, full: bool, note: Any
) -> None:
    n_scenes = LONG_FRAMES // PER_SCENE if full else 12
    n_losses = n_scenes // LOST_EVERY
    phis = phis_at(side * side, ratio, rows, 1)
    noise, rng = NoiseModel.for_range(PAPER_F_MAX_N), np.random.default_rng(1)
    # One is never reset, one starts at each event, and one too that draws other shifts.
    solver, fresh, other = (
        make_solver("skin", phis[0], make_basis("haar", side, side), seed=seed)
        for seed in (0, 0, 1)
    )
    psnr: list[float] = []
    events = Counter[str]()
    #: dB by which the third frame after each event is below that of `fresh`, where 60 dB and more
    #: count as 60; and by which that of `other` is.
    behind: list[float] = []
    apart: list[float] = []
    largest_n, since = 0.0, SETTLED_AFTER
    for k, (truth, event) in enumerate(stream(side, n_scenes * PER_SCENE)):
        phi = phis[k % len(phis)]
        if truth is None:
            continue
        if event and k:
            events[event] += 1
            since = 0
            fresh.reset()
            other.reset()
        y = phi.forward(noise.apply(truth, rng).reshape(-1))
        solver.use(phi)
        forces = solver.solve(y)
        largest_n = max(largest_n, float(forces.max()))
        psnr.append(psnr_db(forces - truth, PAPER_F_MAX_N))
        if since < SETTLED_AFTER:
            since += 1
            fresh.use(phi)
            other.use(phi)
            anew, again = (capped_db(one.solve(y), truth) for one in (fresh, other))
            if since == SETTLED_AFTER:
                behind.append(anew - min(psnr[-1], ENOUGH_DB))
                apart.append(anew - again)
    rounds = mean_of_rounds(psnr)
    note(
        **{"M": f"N/{ratio}, {rows}", "frames": len(psnr), "largest": largest_n},
        **{"first_round_db": rounds[0], "last_round_db": rounds[-1]},
        within_1_db=float(np.mean(np.array(behind) <= 1)),
        two_fresh_within_1_db=float(np.mean(np.array(apart) <= 1)),
    )
    assert len(psnr) == n_scenes * PER_SCENE - n_losses * LOST
    assert np.isfinite(psnr).all()
    assert largest_n < 5
    assert events == {"jump": n_scenes - 1, "loss": n_losses}
    assert len(behind) == len(apart) == events.total()
    assert float(np.median(behind)) < 1
    assert np.any(apart)
    assert rounds[0] > (40 if ratio == 3 else 30)
    assert abs(rounds[-1] - rounds[0]) < 0.5
