"""One patch of a reconstructor: what it states of a frame, and why it does not trust it."""

import numpy as np
import pytest
from bags import skin_state
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pressed import noisy, sliding_disc

from sparseskin.messages import PhiState, Reason
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.reconstructor import patch as patches
from sparseskin.nodes.reconstructor.patch import Patch
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings
from sparseskin.nodes.sensor.noise import NoiseModel

SIDE = 16
SHAPE = (SIDE, SIDE)
F_MAX = 2.5
NOISE = NoiseModel.for_range(F_MAX)
PHI = make_phi("sbhe", SIDE**2, SIDE**2 // 2, seed=0)
SKIN = {"n_rows": SIDE, "n_cols": SIDE, "mask": None, "f_max": F_MAX}
SKIN |= {"sigma_mid": NOISE.sigma_mid, "sigma_end": NOISE.sigma_end}
FRAMES = noisy(sliding_disc(SHAPE, 20, touch_at=3))


def announced(phi, rows="fixed"):
    """The message of a compressor with that Phi."""
    return PhiState(
        stamp_ns=0,
        patch="skin",
        kind="sbhe",
        n=phi.n,
        m=phi.m,
        block=32,
        seed=0,
        fingerprint=phi.fingerprint,
        rows=rows,
        rule=phi.rule,
    )


class Bench:
    """A patch and the row subsets of its Phi."""

    def __init__(self, rows="fixed", live=False, rate_hz=100.0, **stated):
        self.lines = []
        settings = ReconstructorSettings(**{"fast": "off"} | stated)
        self.patch = Patch(settings, self.lines.append)
        self.subsets = row_subsets(PHI, rows)
        state = skin_state(**SKIN, rate_hz=rate_hz)
        self.stated = self.patch.set_up(
            settings, self.subsets, state, announced(self.subsets[0], rows), live
        )
        self.patch.set_noise(state)
        self.n_frames = 0

    def phi(self):
        return self.subsets[self.n_frames % len(self.subsets)]

    def frame(self, readings, missing=None, sensed=""):
        """What the patch states of the next frame."""
        phi = self.phi()
        self.patch.set_missing(missing)
        self.patch.sensed = sensed
        self.patch.read(phi, phi.forward(readings.reshape(-1)))
        self.patch.solve()
        self.n_frames += 1
        return self.patch.check()


def cells(*places):
    mask = np.zeros(SHAPE, dtype=np.bool_)
    for place in places:
        mask[place] = True
    return mask


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_a_press_is_reconstructed_from_each_row_subset(rows):
    bench = Bench(rows)
    for readings in FRAMES:
        solved = bench.frame(readings)
    truth = sliding_disc(SHAPE, 20, touch_at=3)[-1]
    assert np.linalg.norm(solved.forces - truth) < 0.15 * np.linalg.norm(truth)
    assert solved.reason == ""
    assert solved.iterations > 0
    assert solved.solve_ns > 0


def test_the_residual_is_the_root_mean_square_of_what_the_forces_do_not_explain():
    bench = Bench()
    for readings in FRAMES:
        solved = bench.frame(readings)
    y = PHI.forward(FRAMES[-1].reshape(-1))
    unexplained = y - PHI.forward(solved.forces.reshape(-1))
    assert solved.residual == pytest.approx(
        np.sqrt(np.mean(np.square(unexplained))), rel=1e-4
    )


def test_of_missing_taxels_nothing_is_known():
    bench = Bench(uncertainty=True)
    for readings in FRAMES:
        solved = bench.frame(readings, cells((3, 4), (9, 9)))
    assert solved.sd[3, 4] == F_MAX
    assert solved.sd[9, 9] == F_MAX
    known = ~cells((3, 4), (9, 9))
    assert (solved.sd[known] < F_MAX).all()
    assert (bench.frame(FRAMES[-1]).sd < F_MAX).all()


def test_without_the_setting_no_uncertainty_is_stated():
    assert Bench().frame(FRAMES[0], cells((3, 4))).sd is None


@given(missing=arrays(np.bool_, SHAPE, elements=st.sampled_from([True, True, False])))
def test_a_missing_reading_whose_neighbours_are_missing_is_not_replaced(missing):
    bench = Bench()
    bench.patch.set_missing(missing)
    blind = any(
        missing[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2].all()
        for row, col in np.argwhere(missing)
    )
    assert bench.patch._reason("") == (Reason.MISSING if blind else "")


def test_what_the_sensor_states_comes_before_missing_readings_and_behind_no_information():
    bench = Bench()
    bench.patch.set_missing(np.ones(SHAPE, dtype=np.bool_))
    assert bench.patch._reason(Reason.ERROR) == Reason.MISSING
    assert bench.patch._reason(Reason.FROZEN) == Reason.FROZEN
    bench.patch.sensed = Reason.SIGN
    assert bench.patch._reason("") == Reason.SIGN
    bench.patch.set_missing(None)
    bench.patch.sensed = ""
    assert bench.patch._reason("") == ""


def test_a_frame_that_holds_nothing_has_the_last_forces_and_no_iterations():
    bench = Bench()
    for readings in FRAMES:
        last = bench.frame(readings)
    for _ in range(6):
        frozen = bench.frame(FRAMES[-1])
    assert frozen.reason == Reason.FROZEN
    assert frozen.iterations == 0
    assert frozen.solve_ns == 0
    assert frozen.error is None
    assert frozen.common_error == 0.0
    np.testing.assert_allclose(frozen.forces, last.forces, atol=3 * NOISE.sigma_mid)


def test_a_frame_that_is_kept_has_the_last_forces_and_is_looked_at():
    bench = Bench()
    for readings in FRAMES:
        last = bench.frame(readings)
    phi = bench.phi()
    y = phi.forward(FRAMES[3].reshape(-1))
    bench.patch.keep(phi, y)
    kept = bench.patch.solved
    np.testing.assert_array_equal(kept.forces, last.forces)
    assert kept.iterations == 0
    assert kept.solve_ns == 0
    assert kept.reason == ""

    bench.patch.sensed = Reason.CLIPPED
    bench.patch.keep(phi, phi.forward(FRAMES[4].reshape(-1)))
    assert bench.patch.solved.reason == Reason.CLIPPED
    bench.patch.keep(phi, np.full(phi.m, 0.3, dtype=np.float32))
    assert bench.patch.solved.reason == Reason.CONSTANT


def test_iterations_that_are_stated_are_those_of_a_frame():
    bench = Bench(solver="fista", basis="haar", iterations=7)
    assert bench.stated["iterations"] == 7
    assert bench.frame(FRAMES[5]).iterations == 7


@pytest.mark.parametrize("changes", [{}, {"iterations": 9}])
def test_frames_that_wait_for_each_other_have_no_budget(changes):
    bench = Bench(solver="fista", basis="haar", **changes)
    assert bench.stated["frame_ms"] == 0.0


def test_a_budget_bounds_the_steps_and_its_time_is_stated(monkeypatch):
    monkeypatch.setattr(patches, "steps_within", lambda *_: (7, 0.002))
    bench = Bench(solver="fista", basis="haar", iterations=30, budget_ms=2.5)
    assert bench.stated["frame_ms"] == 2.0
    assert bench.stated["iterations"] == 7
    assert bench.frame(FRAMES[5]).iterations == 7


def test_a_warning_is_logged_once():
    bench = Bench(solver="fista", basis="haar", iterations=5)
    (line,) = (line for line in bench.lines if line.startswith("iterations"))
    assert "fista takes several frames" in line


def test_another_solver_in_the_middle_of_a_stream_begins_with_the_last_forces():
    bench = Bench(solver="fista", basis="haar", iterations=60)
    for readings in FRAMES:
        before = bench.frame(readings)
    settings = ReconstructorSettings(
        solver="fista", basis="haar", iterations=1, fast="off"
    )
    bench.patch.set_up(settings, [PHI], skin_state(**SKIN), announced(PHI), live=False)
    after = bench.frame(FRAMES[-1])
    change = np.linalg.norm(after.forces - before.forces)
    assert change < 0.2 * np.linalg.norm(before.forces)


def test_contacts_are_followed_only_where_they_are_asked_for():
    bench = Bench()
    bench.frame(FRAMES[10])
    assert bench.patch.contacts(7) is None
    bench = Bench(contacts=True)
    assert bench.patch.contacts(7) is None  # no frame yet
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        followed = bench.patch.contacts(10_000_000 * k)
    assert followed is not None
