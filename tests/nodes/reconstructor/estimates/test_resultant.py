"""Total force and centre of pressure, published before the frame, with their deviations."""

import itertools

import numpy as np
import pytest
from doubting import DOUBTING, ERROR
from pressed import noisy, sliding_disc
from watched import DESK_SHAPE as SHAPE
from watched import Desk, N

from sparseskin.messages import Reconstruction, Resultant, decode, encode
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.errors import RefusedError, SettingsError
from sparseskin.nodes.reconstructor.estimates.resultant import T
from sparseskin.nodes.reconstructor.node import ReconstructorSettings
from sparseskin.studies.presses import press_frames


def resultants(truth, ratio=3, rows=FIXED):
    desk = Desk(make_phi("sbhe", N, N // ratio, seed=0), rows=rows, preset="skin", resultant=True)
    taxels = zip(noisy(truth).reshape(-1, N), itertools.cycle(desk.subsets), strict=False)
    found = desk.messages(phi.forward(frame) for frame, phi in taxels)
    assert [type(message) for message in found] == [Resultant, Reconstruction] * len(truth)
    stamps = [message.stamp_ns for message in found]
    assert stamps[::2] == stamps[1::2]
    return [message for message in found if isinstance(message, Resultant)]


def test_total_and_centre_of_a_sliding_disc_are_within_their_bands():
    truth = sliding_disc(SHAPE, 80, touch_at=20)
    rows, cols = np.indices(SHAPE)
    off, apart = [], []
    for k, (frame, one) in list(enumerate(zip(truth, resultants(truth), strict=True)))[30:]:
        total = float(frame.sum())
        assert one.row_sd is not None
        assert one.col_sd is not None
        off.append(abs(one.total - total) / one.total_sd)
        off.append(abs(one.row - (rows * frame).sum() / total) / one.row_sd)
        off.append(abs(one.col - (cols * frame).sum() / total) / one.col_sd)
        # Bands have an upper limit, too: 5 % of the total; a centre is known to a taxel again 40
        # frames after the contact came.
        assert one.total_sd < 0.05 * total
        assert max(one.row_sd, one.col_sd) < (6 if k < 60 else 1.0)
        assert abs(one.total - total) < 0.03 * total
        apart.append(abs(one.col - (cols * frame).sum() / total))
    assert np.mean(np.array(off) < 1.645) > 0.8
    # A frame whose measurements are held out differently now and then is a little further off.
    assert np.mean(np.array(apart) < 0.2) > 0.95
    assert max(apart) < 0.25


def test_the_first_frame_of_a_contact_has_total_and_centre():
    truth = sliding_disc(SHAPE, 21, touch_at=20, peak_n=2.0)
    one = resultants(truth)[-1]
    total = float(truth[-1].sum())
    assert one.total == pytest.approx(total, abs=3 * one.total_sd)
    assert one.total_sd < 0.3 * total
    assert one.row == pytest.approx(SHAPE[0] / 2, abs=3)
    # A skin that is pressed from the start has a total as well.
    truth = sliding_disc(SHAPE, 1, touch_at=0, peak_n=2.0)
    assert resultants(truth)[0].total == pytest.approx(float(truth.sum()), rel=0.15)


def test_a_contact_that_jumps_has_its_new_centre_at_once_and_bounded_bands():
    """Three jumps by 25 taxels between two places, 20 frames each."""
    at = [(10, 10), (30, 25)]
    rows, cols = np.indices(SHAPE)
    discs = [1.5 * (np.hypot(rows - row, cols - col) < 5) for row, col in at]
    truth = np.repeat(np.float32([discs[0], discs[1], discs[0], discs[1]]), 20, axis=0)
    for k, one in enumerate(resultants(truth)):
        since, (row, col) = k % 20, at[k // 20 % 2]
        if k < 20:
            continue
        assert one.row_sd is not None
        assert one.col_sd is not None
        largest = {0: 4.5}.get(since, 0.5)
        assert abs(one.row - row) < min(largest, 4 * one.row_sd)
        assert abs(one.col - col) < min(largest, 4 * one.col_sd)
        # The frame of a jump knows its centre from its own image, the next ones from the first
        # frame after it: the mean over frames before the jump, 25 taxels off, is no part of them.
        assert T.centre_floor < max(one.row_sd, one.col_sd) < (3 if since == 0 else 1)


@pytest.mark.parametrize(
    ("course", "rows", "held"),
    [("sudden", ROTATING, ("row", "col")), ("moving", FIXED, ("total",))],
)
def test_bands_hold_in_taps_and_where_most_rows_are_never_read(course, rows, held):
    # A tap has a centre from its first frames on; fixed rows do not measure parts of the sum.
    truth = np.array([frame for frame, _ in press_frames("peg", SHAPE, 150, 1, course=course)])
    inside = {name: [] for name in held}
    for frame, one in zip(truth.astype(np.float64), resultants(truth, 8, rows), strict=True):
        if frame.max() > 0.01:
            row, col = (np.indices(SHAPE) * frame).sum(axis=(1, 2)) / frame.sum()
            true = {"total": frame.sum(), "row": row, "col": col}
            for name in held:
                found, sd = getattr(one, name), getattr(one, f"{name}_sd")
                if found is not None:
                    inside[name].append(abs(found - true[name]) <= 1.645 * sd)
    assert all(len(one) > 50 and np.mean(one) > 0.85 for one in inside.values())


def test_an_untouched_skin_has_no_centre_and_a_solver_with_a_bias_no_resultant():
    found = resultants(np.zeros((40, *SHAPE), np.float32))[20:]
    for one in found:
        assert one.row is None
        assert one.total < 1.0
    # A normal number is above two deviations in one frame of 44.
    assert np.mean([one.total <= 2 * one.total_sd for one in found]) >= 0.95
    with pytest.raises(SettingsError, match="resultant: is not available with solver fista"):
        ReconstructorSettings(preset="paper", resultant=True).check()


PHI = make_phi("sbhe", N, N // 3, seed=0)


def untouched(n_frames):
    """Measurements of the noise of a skin that nothing touches, float32 (n_frames, m)."""
    found = np.random.default_rng(0).normal(scale=0.01, size=(n_frames, PHI.m))
    return found.astype(np.float32)


def reconstructions(desk, n_frames):
    found = desk.messages(untouched(n_frames))
    return [message for message in found if isinstance(message, Reconstruction)]


def test_the_message_carries_what_the_solver_estimates():
    options = {"n_doubted": 2, "period": 3}
    # Every other row without noise looks stuck.
    desk = Desk(PHI, solver=DOUBTING, options=options, watch_taxels=False)
    found = reconstructions(desk, 6)
    assert [message.trusted for message in found] == [(False,), (False,), (True,)] * 2
    assert {message.error for message in found} == {(ERROR,)}
    for message in found:
        assert decode(*encode(message)) == message


@pytest.mark.parametrize("wrong", [{"error": -0.1}, {"error": float("nan")}, {"trusted": 1}])
def test_an_estimate_that_is_none_is_refused(wrong, monkeypatch):
    desk = Desk(PHI, solver=DOUBTING)
    solver = desk.node._patches[0].solver
    finish = solver.finish

    def finish_wrongly():
        forces = finish()
        for name, value in wrong.items():
            setattr(solver, name, value)
        return forces

    monkeypatch.setattr(solver, "finish", finish_wrongly)
    with pytest.raises(RefusedError, match=rf"doubting: {next(iter(wrong))} = .*; allowed: "):
        reconstructions(desk, 1)
