"""The default solver over a stream that never ends: no drift; at full size a million frames.

Random presses follow each other, each with other noise, and the solver is never reset. From one
scene to the next everything changes between two frames; in every fourth frames are lost. Every
round has the same scenes, so that a solver that drifts, or is locked in to its state, would show it
in its mean PSNR.
"""

import numpy as np
import pytest
from stress.graphs import FULL

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.evaluate import make_method
from sparseskin.studies.presses import BODIES, press_frames

#: Rows and columns, N / M, rows of the measurement matrix.
STREAMS = ((20, 3, "fixed"), (20, 3, "rotating"), (20, 8, "rotating"))
#: A round is so many scenes, each cut into its middle, where its body is down.
SCENES, FIRST, FRAMES = 50 if FULL else 6, 60, 160
ROUNDS = 230 if FULL else 2
#: In every fourth scene so many frames are lost from here on.
LOST_EVERY, LOST_FROM, LOST = 4, 30, 50


def one_round(side):
    """Yield each frame, None where it is lost."""
    for scene in range(SCENES):
        body = BODIES[scene % len(BODIES)]
        frames = [truth for truth, _ in press_frames(body, (side, side), FRAMES, scene)]
        for k, frame in enumerate(frames[FIRST:]):
            is_lost = (
                scene % LOST_EVERY == LOST_EVERY - 1
                and LOST_FROM <= k < LOST_FROM + LOST
            )
            yield None if is_lost else frame


@pytest.mark.parametrize(("side", "ratio", "rows"), STREAMS if FULL else STREAMS[:2])
def test_over_jumps_and_losses_the_psnr_stays_as_it_was(side, ratio, rows, note):
    method = make_method({"solver": "skin"}, (side, side), ratio, 1, rows=rows)
    noise, rng = NoiseModel.for_range(PAPER_F_MAX_N), np.random.default_rng(1)
    frames = list(one_round(side))
    rounds = []
    for _ in range(ROUNDS):
        psnr = []
        for truth in frames:
            if truth is None:
                method.n_frames += 1  # its rows are left out
                continue
            forces = method.reconstruct(noise.apply(truth, rng)).forces
            assert forces.max() < 5
            psnr.append(psnr_db(forces - truth, PAPER_F_MAX_N))
        rounds.append(float(np.mean(psnr)))
    note(
        **{"M": f"N/{ratio}, {rows}", "frames": ROUNDS * len(frames)},
        **{"first_round_db": rounds[0], "last_round_db": rounds[-1]},
    )
    assert rounds[0] > (40 if ratio == 3 else 30)
    assert abs(rounds[-1] - rounds[0]) < 0.5
