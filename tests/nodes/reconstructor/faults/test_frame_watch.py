"""Faults of single frames: outliers, offsets, dropouts, forces too large; a board that hangs."""

from dataclasses import replace

import numpy as np
import pytest
from bags import skin_state
from hypothesis import given
from hypothesis import strategies as st
from pressed import noisy, sliding_disc
from watched import DESK_SHAPE, NOISE, Desk, N

from sparseskin.messages import Reconstruction
from sparseskin.nodes.compressor.phi.adaptive import AdaptiveChoice, AdaptivePhi
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.reconstructor.faults.frame import FRAMES, SWINGS, FrameWatch, FrozenWatch
from sparseskin.nodes.reconstructor.faults.rows import Subset

PHI = make_phi("sbhe", N, N // 3, seed=0)
ROWS = Subset(PHI)
MASK = np.ones(DESK_SHAPE, np.bool_)
STATE = skin_state(n_rows=DESK_SHAPE[0], n_cols=DESK_SHAPE[1], mask=None, has_truth=False)
STATE = replace(STATE, rate_hz=0.0, sigma_mid=NOISE.sigma_mid, sigma_end=NOISE.sigma_end)
DISC = sliding_disc(DESK_SHAPE, 60, touch_at=0)
LEFT = np.zeros(PHI.m)


ADAPTIVE = AdaptivePhi(N, N // 3, seed=0)
ADAPTIVE.lay_out(MASK)
ADAPTIVE.state_noise(NOISE.sigma_end, NOISE.f_max)
CHOICE = AdaptiveChoice(ADAPTIVE)
CHOSEN = [CHOICE.measure(ADAPTIVE.tree.analysis(f.reshape(-1)).take) for f in noisy(DISC[:21])][-1]
"""Measurements of the disc in frame 20, with noise, of rows that were chosen."""


def measured(k):
    """Measurements of the disc in frame k, with noise."""
    return PHI.forward(noisy(DISC[k : k + 1], seed=k)[0].reshape(-1))


def expected(k):
    return PHI.forward(DISC[k].reshape(-1))


@given(row=st.integers(0, PHI.m - 1), value=st.sampled_from([-300.0, -5.0, 5.0, 50.0, 3e6]))
def test_an_outlier_is_replaced_by_its_expectation_and_nothing_else_is(row, value):
    watch, y = FrameWatch(STATE, MASK), measured(20)
    given_, believed = watch.cleaned(ROWS, y, expected(19))
    np.testing.assert_array_equal(believed, y)
    y[row] += value
    given_, believed = watch.cleaned(ROWS, y, expected(19))
    heavy = abs(PHI.forward(np.ones(N, np.float32))[row]) > 1
    if not heavy or abs(value) > 40:  # the sum of a block may be large itself
        assert (watch.n_outlying, believed[row]) == (1, expected(19)[row])
    np.testing.assert_array_equal(np.delete(believed, row), np.delete(y, row))
    np.testing.assert_array_equal(given_, y)


@given(
    row=st.integers(0, DESK_SHAPE[0] - 1),
    col=st.integers(0, DESK_SHAPE[1] - 1),
    side=st.integers(1, 12),
    force=st.floats(0.05, 2.5),
)
def test_no_press_is_an_outlier_or_an_offset(row, col, side, force):
    watch = FrameWatch(STATE, MASK)
    frame = np.zeros((1, *DESK_SHAPE), np.float32)
    frame[0, row : row + side, col : col + side] = force
    y = PHI.forward(noisy(frame)[0].reshape(-1))
    _, believed = watch.cleaned(ROWS, y, np.zeros(PHI.m, np.float32))
    assert (watch.n_outlying, watch.offset) == (0, 0.0)
    np.testing.assert_array_equal(believed, y)


@given(offset=st.floats(0.1, 30.0), sign=st.sampled_from([-1, 1]))
def test_an_offset_is_subtracted_while_it_lasts(offset, sign):
    watch, offset = FrameWatch(STATE, MASK), sign * offset
    for k in range(20, 25):
        y = measured(k) + np.float32(offset)
        _, believed = watch.cleaned(ROWS, y, expected(k - 1))
        # Its deviation is that of the mean of the measurements, and what moved meanwhile.
        assert watch.offset == pytest.approx(offset, abs=0.03)
        assert np.abs(believed - measured(k)).max() < 0.03 + 1e-5 * abs(offset)
    _, believed = watch.cleaned(ROWS, measured(25), expected(24))
    assert watch.offset == 0.0


@given(row=st.integers(0, N // 3 - 1), value=st.sampled_from([-300.0, -50.0, 50.0, 3e6]))
def test_of_rows_chosen_at_the_edge_garbage_and_an_offset_are_taken_out(row, value):
    watch = FrameWatch(STATE, MASK)
    y, before = CHOSEN.copy(), ADAPTIVE.forward(DISC[19].reshape(-1))
    np.testing.assert_array_equal(watch.cleaned_of_choice(ADAPTIVE, y, before), y)
    y[row] = value
    found = watch.cleaned_of_choice(ADAPTIVE, y, before)
    assert (watch.n_outlying, found[row]) == (1, before[row])
    np.testing.assert_array_equal(np.delete(found, row), np.delete(CHOSEN, row))
    found = watch.cleaned_of_choice(ADAPTIVE, CHOSEN + np.float32(0.7), before)
    assert watch.offset == pytest.approx(0.7, abs=0.01)
    assert not watch.contradicted
    watch.cleaned_of_choice(ADAPTIVE, CHOSEN * np.float32(1e3), before)
    assert watch.contradicted


def test_equal_measurements_are_no_reading_unless_they_may_be_equal():
    watch, zero = FrameWatch(STATE, MASK), np.zeros(PHI.m, np.float32)
    assert watch.is_constant(zero)
    assert watch.is_constant(zero + 3)
    assert not watch.is_constant(zero[:8])
    assert not watch.is_constant(measured(0))
    coarse = quantised(np.concatenate([zero, [90.0]]).astype(np.float32), 8)[:-1]
    assert not watch.is_constant(coarse)  # its step is above the noise
    assert not FrameWatch(replace(STATE, sigma_mid=0.0, sigma_end=0.0), MASK).is_constant(zero)


def test_forces_beyond_the_range_and_all_taxels_together_are_no_reading():
    watch = FrameWatch(STATE, MASK)
    forces, reason = watch.checked(DISC[9], LEFT, 0.0)
    np.testing.assert_array_equal(forces, DISC[9])
    assert reason == ""
    forces, reason = watch.checked(DISC[9] * np.float32(2.6 / 0.6), LEFT, 0.0)
    assert (forces.max(), reason) == (2.5, "")
    assert watch.checked(DISC[9] * np.float32(3.0 / 0.6), LEFT, 0.0)[1] == "range"
    risen = DISC[9] + np.float32(0.6 * NOISE.sigma_end)
    assert watch.checked(risen, LEFT, 0.1)[1] == ""  # the solver knows of an error
    assert watch.checked(risen, LEFT, 0.0)[1] == "uniform"
    sloped = np.linspace(0.05, 0.5, N, dtype=np.float32).reshape(DESK_SHAPE)
    assert FrameWatch(STATE, MASK).checked(sloped, LEFT, 0.0)[1] == ""  # a body on the whole skin


@pytest.mark.parametrize(("offset", "press"), [(0.02, 0.0), (-0.02, 0.0), (0.02, 0.3)])
def test_an_offset_of_one_block_is_doubted_but_for_where_a_body_may_have_made_it(offset, press):
    """It is a force on the one taxel whose column of Phi is constant; a negative one is none."""
    phi, watch = make_phi("sbhe", 256, 85, seed=0), FrameWatch(STATE, np.ones((16, 16), np.bool_))
    rows, forces = Subset(phi), np.zeros((16, 16), np.float32)
    row, col = np.unravel_index(rows.offset_like[0], forces.shape)
    forces[max(0, row - 1) : row + 2, max(0, col - 1) : col + 2] = press
    y = phi.forward(forces.reshape(-1)) + np.float32(offset)
    forces[row, col] += max(0, 16 * offset)
    watch.cleaned(rows, y, y)
    reason = watch.checked(forces, y - phi.forward(forces.reshape(-1)), 0.0)[1]
    assert reason == ("" if press else "offset")


def test_all_taxels_that_rise_in_one_frame_are_replaced_and_doubted_for_a_while():
    phi = make_phi("sbhe", 4 * N, 4 * N // 3, seed=0)
    rows, noise = Subset(phi), noisy(np.zeros((1, 2 * DESK_SHAPE[0], 2 * DESK_SHAPE[1])))[0]
    watch = FrameWatch(STATE, np.ones(noise.shape, np.bool_))
    y = phi.forward((noise + np.float32(10 * NOISE.sigma_end)).reshape(-1))
    _, believed = watch.cleaned(rows, y, np.zeros(phi.m, np.float32))
    assert watch.n_outlying == rows.heavy.size
    assert not believed[rows.heavy].any()
    reasons = [watch.checked(noise, LEFT, 0.0)[1] for _ in range(30)]
    assert reasons == ["uniform"] * SWINGS + [""] * (30 - SWINGS)


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_frames_with_faults_are_as_accurate_as_those_without_or_state_a_reason(rows):
    """Of 60 frames 30 has garbage in it, 35 is empty, and from 40 on there is an offset."""
    desk, clean = Desk(PHI, rows=rows), Desk(PHI, rows=rows)
    n_subsets = len(desk.subsets)
    frames = noisy(DISC)
    y = np.array([desk.subsets[k % n_subsets].forward(f.reshape(-1)) for k, f in enumerate(frames)])
    whole = clean.restore(y)
    y[30, 5] = 1000.0
    y[35] = 0
    y[40:] += 0.7
    found = [m for m in desk.messages(y) if isinstance(m, Reconstruction)]
    reasons = {k: m.reason[0] for k, m in enumerate(found) if k > 10 and not m.trusted[0]}
    assert reasons == {35: "constant"}
    np.testing.assert_array_equal(found[35].forces, found[34].forces)

    def error(forces, k):
        return float(np.linalg.norm(forces - DISC[k]))

    for k in (30, 31, 36, 40, 41, 50):
        assert error(found[k].forces[0], k) < 1.5 * error(whole[k], k)
    assert desk.node.state()["left_out"].startswith("offset of all measurements subtracted: 0.7")
    assert len(desk.lines) == 3


SIGMA = 0.02


def noise(seed, force=0.0):
    return np.random.default_rng(seed).normal(force, SIGMA, 30).astype(np.float32)


COARSE = quantised(np.array([0.0, 1.0, 50.0], dtype=np.float32), 4)
"""Its steps are above the noise."""


@pytest.mark.parametrize(
    ("sigma", "frames"),
    [
        (SIGMA, [noise(k // 2) for k in range(200)]),  # noise, each frame twice
        (0.0, [noise(0)] * 100),  # no noise is stated
        (SIGMA, [COARSE] * 100),
    ],
)
def test_what_may_repeat_is_no_hung_board(sigma, frames):
    watch = FrozenWatch(sigma)
    assert not any(watch.update("phi", y) for y in frames)
    assert not watch.frozen


@pytest.mark.parametrize(("last_touch", "rows"), [(0, "fixed"), (15, "rotating"), (30, "rotating")])
def test_frames_of_a_hung_board_are_not_trusted_and_logged_once(last_touch, rows):
    """The board hangs in frame 30 of 60: 15 frames after the contact has ended, in it, without."""
    desk = Desk(make_phi("sbhe", N, N // 2, seed=0), rows=rows)
    n_subsets = len(desk.subsets)
    touched = sliding_disc(DESK_SHAPE, 65, touch_at=0)
    touched[last_touch:60] = touched[last_touch] if last_touch == 30 else 0
    frames = noisy(touched)
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
    assert (desk.lines[-1], desk.node.state()["left_out"]) == ("measurements change again", "")


@pytest.mark.parametrize(("rows", "states_noise"), [("fixed", True), ("rotating", False)])
def test_frames_after_a_hung_board_are_nearly_as_accurate_as_others(rows, states_noise):
    """30 equal frames are one measurement; only the noise is learnt later after them."""
    truth = np.repeat(sliding_disc(DESK_SHAPE, 3, touch_at=0)[1:2], 40, axis=0)
    frames = noisy(truth)
    frames[:30] = frames[0]
    errors = []
    for first in (0, 30):
        desk = Desk(make_phi("sbhe", N, N // 2, seed=0), rows=rows, states_noise=states_noise)
        subsets = [desk.subsets[k % len(desk.subsets)] for k in range(40 - first)]
        y = [phi.forward(f.reshape(-1)) for phi, f in zip(subsets, frames[first:], strict=True)]
        off = desk.restore(np.array(y)) - truth[first:]
        errors.append(float(np.linalg.norm(off[30 - first :])))
    assert errors[0] < 1.3 * errors[1]
