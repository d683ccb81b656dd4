"""A board that hangs: all measurements repeat exactly, on a skin with noise."""

import numpy as np
import pytest
from pressed import noisy as readings
from pressed import sliding_disc
from watched import DESK_SHAPE, Desk, N

from sparseskin.messages import Reconstruction
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.reconstructor.faults.frame import FRAMES, FrozenWatch

SIGMA = 0.02


def noisy(seed, force=0.0):
    return np.random.default_rng(seed).normal(force, SIGMA, 30).astype(np.float32)


COARSE = quantised(np.array([0.0, 1.0, 50.0], dtype=np.float32), 4)  # steps above the noise


@pytest.mark.parametrize(
    ("sigma", "frames"),
    [
        (SIGMA, [noisy(k // 2) for k in range(200)]),  # noise, each frame twice
        (0.0, [noisy(0)] * 100),  # no noise is stated
        (SIGMA, [COARSE] * 100),
    ],
)
def test_what_may_repeat_is_no_hung_board(sigma, frames):
    watch = FrozenWatch(sigma)
    assert not any(watch.update("phi", y) for y in frames)
    assert not watch.frozen


@pytest.mark.parametrize(("last_touch", "rows"), [(0, "fixed"), (15, "rotating"), (30, "rotating")])
def test_its_frames_are_not_trusted_and_one_line_is_logged_before_in_and_after_a_contact(
    last_touch, rows
):
    """The board hangs in frame 30 of 60: 15 frames after the contact has ended, in it, without."""
    desk = Desk(make_phi("sbhe", N, N // 2, seed=0), rows=rows)
    n_subsets = len(desk.subsets)
    touched = sliding_disc(DESK_SHAPE, 65, touch_at=0)
    touched[last_touch:60] = touched[last_touch] if last_touch == 30 else 0
    frames = readings(touched)
    frames[30:60] = frames[30]
    y = np.array([desk.subsets[k % n_subsets].forward(f.reshape(-1)) for k, f in enumerate(frames)])

    hung = [m for m in desk.messages(y[:60]) if isinstance(m, Reconstruction)]
    assert all(m.trusted[0] for m in hung[10:30])
    assert not any(m.trusted[0] for m in hung[30 + n_subsets + FRAMES :])
    assert len([line for line in desk.lines if "does the board hang?" in line]) == 1
    # Hung noise may look like forces to the solver; a contact is as it was.
    of_frames = [line for line in desk.lines if "compiling" not in line]  # once on a machine
    assert last_touch < 30 or len(of_frames) == 1
    assert desk.node.state()["left_out"].startswith("all measurements repeat exactly")
    assert "all measurements repeat exactly" in desk.node.status()

    again = [m for m in desk.messages(y[60:]) if isinstance(m, Reconstruction)]
    assert all(m.trusted[0] for m in again)
    assert desk.lines[-1] == "measurements change again"
    assert desk.node.state()["left_out"] == ""


@pytest.mark.parametrize(("rows", "states_noise"), [("fixed", True), ("rotating", False)])
def test_frames_after_a_hung_board_are_as_accurate_as_those_of_one_that_begins(rows, states_noise):
    """30 equal frames are one measurement: the solver is no surer of it than of any other."""
    truth = np.repeat(sliding_disc(DESK_SHAPE, 3, touch_at=0)[1:2], 40, axis=0)
    frames = readings(truth)
    frames[:30] = frames[0]
    errors = []
    for first in (0, 30):
        desk = Desk(make_phi("sbhe", N, N // 2, seed=0), rows=rows, states_noise=states_noise)
        subsets = [desk.subsets[k % len(desk.subsets)] for k in range(40 - first)]
        y = [phi.forward(f.reshape(-1)) for phi, f in zip(subsets, frames[first:], strict=True)]
        off = desk.restore(np.array(y)) - truth[first:]
        errors.append(float(np.linalg.norm(off[30 - first :])))
    assert errors[0] < 1.1 * errors[1]
