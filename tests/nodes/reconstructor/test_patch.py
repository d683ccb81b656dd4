"""One patch of a reconstructor: what it states of a frame, and why it does not trust it."""

import numpy as np
import pytest
from bags import skin_state
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pressed import noisy, sliding_disc

from sparseskin.messages import Reason
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.reconstructor import patch as patches
from sparseskin.nodes.reconstructor.estimates.uncertainty import Uncertainty
from sparseskin.nodes.reconstructor.limits import OTHER_ROWS
from sparseskin.nodes.reconstructor.patch import Patch
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.nodes.sensor.noise import NoiseModel

SIDE = 16
SHAPE = (SIDE, SIDE)
F_MAX = 2.5
NOISE = NoiseModel.for_range(F_MAX)
PHI = make_phi("sbhe", SIDE**2, SIDE**2 // 2, seed=0)
SKIN = {"n_rows": SIDE, "n_cols": SIDE, "mask": None, "f_max": F_MAX}
SKIN |= {"sigma_mid": NOISE.sigma_mid, "sigma_end": NOISE.sigma_end}
FRAMES = noisy(sliding_disc(SHAPE, 20, touch_at=3))


class Bench:
    """A patch and the row subsets of its Phi."""

    def __init__(
        self, rows="fixed", live=False, skin=None, phi=PHI, alike=None, **stated
    ):
        self.lines = []
        settings = ReconstructorSettings(**{"fast": "off"} | stated)
        self.patch = Patch(settings, self.lines.append)
        self.subsets = row_subsets(phi, rows)
        state = skin_state(**SKIN | (skin or {}))
        self.stated = self.patch.set_up(settings, self.subsets, state, live, alike)
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


def test_the_residual_is_that_of_the_forces_that_are_stated():
    """Of a press at the end of the range, where the forces are cut to it."""
    bench = Bench(skin={"f_max": 0.6})
    for readings in FRAMES:
        solved = bench.frame(readings)
    assert solved.forces.max() == np.float32(0.6)
    y = PHI.forward(FRAMES[-1].reshape(-1))
    unexplained = y - PHI.forward(solved.forces.reshape(-1))
    rms = np.sqrt(np.mean(np.square(unexplained)))
    assert solved.residual == pytest.approx(rms, rel=1e-4)


def test_of_missing_taxels_nothing_is_known():
    bench = Bench(uncertainty=True)
    for readings in FRAMES:
        solved = bench.frame(readings, cells((3, 4), (9, 9)))
    assert solved.sd[3, 4] == F_MAX
    assert solved.sd[9, 9] == F_MAX
    known = ~cells((3, 4), (9, 9))
    assert (solved.sd[known] < F_MAX).all()
    assert (bench.frame(FRAMES[-1]).sd < F_MAX).all()


def test_a_patch_that_is_told_of_no_missing_reading_misses_none():
    bench = Bench()
    bench.patch.read(PHI, PHI.forward(FRAMES[0].reshape(-1)))
    bench.patch.solve()
    assert bench.patch.check().reason == ""


def on_mask(mask):
    """A bench of a skin on which some cells do not exist."""
    n = int(mask.sum())
    return Bench(phi=make_phi("sbhe", n, n // 2, seed=0), skin={"mask": mask})


def test_masked_cells_have_no_force():
    mask = ~cells((3, 4), (8, 8), (8, 9))
    bench = on_mask(mask)
    for readings in FRAMES:
        solved = bench.frame(readings[mask])
    assert not solved.forces[~mask].any()
    assert solved.forces[mask].max() > 0.3


def test_a_cell_that_does_not_exist_is_no_neighbour_whose_reading_is_known():
    mask = np.ones(SHAPE, dtype=np.bool_)
    mask[7:10, 7:10] = False
    mask[8, 8] = True
    bench = on_mask(mask)
    bench.patch.set_missing(cells((8, 8)))
    assert bench.patch._reason("") == Reason.MISSING
    bench.patch.set_missing(cells((6, 6)))
    assert bench.patch._reason("") == ""


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


def test_a_frame_that_is_kept_has_the_fault_of_the_last_forces():
    bench = Bench(skin={"f_max": F_MAX / 10})
    for readings in FRAMES:
        bench.frame(readings)
    phi = bench.phi()
    bench.patch.keep(phi, phi.forward(FRAMES[3].reshape(-1)))
    assert bench.patch.solved.reason == Reason.RANGE


@pytest.mark.parametrize(
    ("missing", "sensed"), [(cells((3, 4)), ""), (None, Reason.CLIPPED)]
)
def test_no_touch_is_known_of_readings_that_are_missing_or_not_trusted(missing, sensed):
    bench = Bench(contacts=True)
    bench.frame(FRAMES[0])
    assert bench.patch._touch.touch.touched is False
    bench.frame(FRAMES[1], missing, sensed)
    assert bench.patch._touch.touch.touched is None


def test_the_usual_steps_of_a_budget_are_those_of_a_quarter_of_the_skin():
    solver = Bench().patch.solver
    # A frame has time for eight steps of all tiles.
    solver.use_times(8 * solver.most_tiles, 0)
    usual, _ = patches._usual_steps(solver, solver.n_steps)
    assert usual == solver.steps_for(solver.most_tiles // 4)[1]
    assert usual > solver.steps_for(solver.most_tiles)[1]


def test_a_frame_that_was_not_sent_has_the_last_forces_and_the_reasons_of_now():
    bench = Bench()
    for readings in FRAMES:
        last = bench.frame(readings)
    bench.patch.rest()
    rested = bench.patch.solved
    np.testing.assert_array_equal(rested.forces, last.forces)
    assert rested.iterations == 0
    assert rested.solve_ns == 0
    assert rested.reason == ""
    bench.patch.sensed = Reason.STUCK
    bench.patch.rest()
    assert bench.patch.solved.reason == Reason.STUCK


def test_the_first_frame_that_holds_nothing_is_of_zeros():
    bench = Bench()
    y = np.full(PHI.m, 0.3, dtype=np.float32)
    bench.patch.read(PHI, y)
    bench.patch.solve()
    solved = bench.patch.check()
    assert solved.reason == Reason.CONSTANT
    assert not solved.forces.any()
    assert solved.residual == pytest.approx(0.3)


def test_the_residual_of_the_largest_measurements_is_a_number():
    """Their squares are beyond float32."""
    bench = Bench(solver="fista", basis="haar")
    bench.patch.read(PHI, np.full(PHI.m, 1e29, dtype=np.float32))
    bench.patch.solve()
    assert bench.patch.check().residual == pytest.approx(1e29)


def test_faults_are_logged_and_measured_by_the_noise_and_range_of_the_skin():
    bench = Bench()
    for _ in range(6):
        bench.frame(FRAMES[-1])
    assert len(bench.lines) == 1
    silent = Bench(skin={"sigma_mid": 0.0, "sigma_end": 0.0})
    for _ in range(6):
        assert silent.frame(FRAMES[-1]).reason != Reason.FROZEN
    small = Bench(skin={"f_max": F_MAX / 10})
    for readings in FRAMES:
        solved = small.frame(readings)
    assert solved.reason == Reason.RANGE


@pytest.mark.parametrize(
    ("watch_rows", "is_subtracted"), [(True, True), (False, False)]
)
def test_an_offset_is_subtracted_where_rows_are_watched(watch_rows, is_subtracted):
    side = 32
    phi = make_phi("sbhe", side**2, side**2 // 2, seed=0)
    skin = {"n_rows": side, "n_cols": side}
    bench = Bench(phi=phi, skin=skin, watch_rows=watch_rows)
    rest = noisy(np.zeros((8, side, side), dtype=np.float32))
    for k, readings in enumerate(rest):
        y = phi.forward(readings.reshape(-1))
        bench.patch.read(phi, y if k < 4 else y + np.float32(0.7))
        bench.patch.solve()
        bench.patch.check()
    assert (bench.patch.faults.text != "") == is_subtracted


@pytest.mark.parametrize(
    ("sigmas", "f_min"), [((0.06, 0.02), 0.0), ((0.06, 0.02), -1.0), ((0.0, 0.0), 0.0)]
)
def test_the_solver_has_the_noise_that_the_skin_states(sigmas, f_min):
    skin = {"sigma_mid": sigmas[0], "sigma_end": sigmas[1], "f_min": f_min}
    solver = Bench(skin=skin).patch.solver
    assert solver.noise_sd == pytest.approx(sigmas[1] if f_min else 0.584 * sigmas[1])
    if not any(sigmas):
        assert solver.noise_model is None
        return
    expected = NoiseModel(F_MAX, *sigmas, clips=not f_min)
    assert vars(solver.noise_model) == vars(expected)


def budget_of(monkeypatch, **stated):
    """Time of a frame that a patch plans with, seconds; None if it plans with none."""
    budgets = []

    def steps(solver, phi, f_max, budget_s):
        budgets.append(budget_s)
        return 2, 0.001

    monkeypatch.setattr(patches, "steps_within", steps)
    Bench(**stated)
    return budgets[0] if budgets else None


@pytest.mark.parametrize("rate_hz", [20.0, 250.0])
@pytest.mark.parametrize("n_patches", [1, 4])
def test_half_of_the_time_between_live_frames_is_shared_by_the_patches(
    monkeypatch, rate_hz, n_patches
):
    names = tuple(f"p{k}" for k in range(n_patches)) if n_patches > 1 else ()
    stated = {"live": True, "skin": {"rate_hz": rate_hz}, "patches": names}
    budget_s = budget_of(monkeypatch, **stated)
    assert budget_s == pytest.approx(0.5 / rate_hz / n_patches)


@pytest.mark.parametrize(
    "stated",
    [
        {"live": False},
        {"live": True, "skin": {"rate_hz": 0.0}},
        {"live": True, "options": {"iterations": 5}},
        {"live": True, "solver": "fista", "basis": "haar"},
    ],
)
def test_frames_that_wait_or_have_their_iterations_stated_have_no_budget(
    monkeypatch, stated
):
    assert budget_of(monkeypatch, **stated) is None


def test_a_stated_budget_comes_before_that_of_the_rate(monkeypatch):
    stated = {"live": True, "budget_ms": 3.0, "skin": {"rate_hz": 20.0}}
    assert budget_of(monkeypatch, **stated) == pytest.approx(0.003)


def test_a_patch_of_the_same_skin_has_the_steps_of_the_first(monkeypatch):
    monkeypatch.setattr(patches, "steps_within", lambda *_: (7, 0.002))
    stated = {"solver": "fista", "basis": "haar", "iterations": 30, "budget_ms": 2.5}
    first = Bench(**stated)
    second = Bench(**stated, alike=first.patch)
    assert second.stated["iterations"] == 7
    assert second.stated["frame_ms"] == 0.0
    assert second.frame(FRAMES[5]).iterations == 7


def test_patches_of_the_same_skin_share_the_tables_of_touches_and_not_the_touches():
    first = Bench(contacts=True)
    second = Bench(contacts=True, alike=first.patch)
    assert second.patch._touch.test is first.patch._touch.test
    assert second.patch._touch is not first.patch._touch


def test_what_is_stated_of_a_solver_is_what_it_uses():
    bench = Bench(solver="fista", basis="haar", iterations=20, lambda_n=0.004)
    assert bench.stated["basis"] == "haar"
    assert bench.stated["lambda_n"] == pytest.approx(0.004)
    assert bench.stated["frame_ms"] == 0.0
    assert "max_iterations" not in bench.stated
    assert Bench().stated["lambda_n"] == 0.0


@given(st.floats(0.004, 0.05), st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_the_sum_of_clipped_noise_that_a_solver_leaves_is_stated(sd, seed):
    bench = Bench(preset="paper", skin={"sigma_mid": sd, "sigma_end": sd})
    rng = np.random.default_rng(seed)
    sums = []
    for _ in range(8):
        readings = np.clip(rng.normal(0, sd, SHAPE), 0, F_MAX)
        forces = bench.frame(readings.astype(np.float32)).forces
        sums.append(forces.sum())
    # Shrinkage takes a little of it; to set negative forces to 0 adds to it.
    assert np.mean(sums) == pytest.approx(bench.stated["noise_sum"], rel=0.3)


def test_the_default_solver_leaves_no_clipped_noise_in_a_total():
    assert Bench(skin={"sigma_end": 0.02}).stated["noise_sum"] == 0.0


@pytest.mark.parametrize(
    ("preset", "rows", "n_lines"),
    [("paper", "fixed", 1), ("skin", "fixed", 0), ("skin", "rotating", 0)],
)
def test_only_the_exact_method_of_the_paper_is_warned_of_other_rows(
    preset, rows, n_lines
):
    lines = Bench(rows, preset=preset).lines
    assert [OTHER_ROWS in line for line in lines] == [True] * n_lines


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


@pytest.mark.parametrize(
    ("kind", "stated", "is_warned"),
    [
        ("subsample", {}, True),
        ("sbhe", {}, False),
        ("subsample", {"solver": "fista", "basis": "haar"}, False),
    ],
)
def test_the_default_solver_is_advised_against_where_single_taxels_are_read(
    kind, stated, is_warned
):
    phi = make_phi(kind, SIDE**2, SIDE**2 // 2, seed=0)
    lines = Bench(phi=phi, **stated).lines
    assert (SkinSolver.warning_of_samples in lines) == is_warned


def test_another_solver_in_the_middle_of_a_stream_begins_with_the_last_forces():
    bench = Bench(solver="fista", basis="haar", iterations=60)
    for readings in FRAMES:
        before = bench.frame(readings)
    settings = ReconstructorSettings(
        solver="fista", basis="haar", iterations=1, fast="off"
    )
    bench.patch.set_up(settings, [PHI], skin_state(**SKIN), live=False)
    after = bench.frame(FRAMES[-1])
    change = np.linalg.norm(after.forces - before.forces)
    assert change < 0.2 * np.linalg.norm(before.forces)


def test_contacts_are_followed_only_where_they_are_asked_for():
    bench = Bench()
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        assert bench.patch.contacts(10_000_000 * k) is None
    bench = Bench(contacts=True)
    assert bench.patch.contacts(7) is None  # no frame yet
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        followed = bench.patch.contacts(10_000_000 * k)
    assert followed is not None
    assert len(followed.fields["id"]) == 1
    touch = sliding_disc(SHAPE, 20, touch_at=3)[-1]
    assert followed.fields["total"][0] == pytest.approx(touch.sum(), rel=0.2)


def test_contacts_keep_their_ids_where_the_solver_is_made_anew():
    bench = Bench(contacts=True)
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        before = bench.patch.contacts(10_000_000 * k)
    settings = ReconstructorSettings(fast="off", contacts=True)
    state = skin_state(**SKIN)
    bench.patch.set_up(settings, [PHI], state, live=False)
    bench.patch.set_noise(state)
    for k in range(8):
        bench.frame(FRAMES[-1])
        after = bench.patch.contacts(10_000_000 * (len(FRAMES) + k))
    assert after.fields["id"].tolist() == before.fields["id"].tolist()


def ages(silence_ns):
    """Age of a contact, seconds, of which nothing was sent for a while."""
    bench = Bench(contacts=True)
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        before = bench.patch.contacts(10_000_000 * k)
    now_ns = 10_000_000 * len(FRAMES) + silence_ns
    bench.patch.pass_silence(now_ns)
    bench.frame(FRAMES[-1])
    after = bench.patch.contacts(now_ns + 10_000_000)
    return before.fields["age_s"][0], after.fields["age_s"][0]


def test_a_contact_ages_while_nothing_is_sent():
    before_s, after_s = ages(silence_ns=10**9)
    assert after_s - before_s > 0.9


def test_what_counts_as_a_contact_may_be_changed():
    bench = Bench(contacts=True)
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        bench.patch.contacts(10_000_000 * k)
    strict = ReconstructorSettings(fast="off", contacts=True, contact_force=1e6)
    bench.patch.set_limits(strict)
    bench.frame(FRAMES[-1])
    followed = bench.patch.contacts(10**9)
    assert len(followed.fields["id"]) == 0


def test_a_patch_of_the_same_skin_has_as_many_tiles_a_frame_as_the_first(monkeypatch):
    def steps(solver, *_):
        solver.use_times(300, 7)
        return solver.n_steps, 0.0021234

    monkeypatch.setattr(patches, "steps_within", steps)
    first = Bench(budget_ms=2.5)
    second = Bench(budget_ms=2.5, alike=first.patch)
    assert first.stated["frame_ms"] == 2.123
    for stated in (first.stated, second.stated):
        assert stated["frame_tiles"] == 300
        assert stated["step_tiles"] == 7
    assert first.patch.solver.times == second.patch.solver.times == (300, 7)


@pytest.mark.parametrize(
    ("n_steps", "n_fitting", "is_warned"),
    [(60, 7, True), (60, 40, False), (3, 3, False), (3, 2, True)],
)
def test_a_budget_for_few_iterations_is_warned_of(
    monkeypatch, n_steps, n_fitting, is_warned
):
    """Of fewer than the solver needs, or than are stated where these are fewer."""
    least = FistaSolver.least_iterations
    assert 7 < least <= 40
    monkeypatch.setattr(patches, "steps_within", lambda *_: (n_fitting, 0.001))
    stated = {"solver": "fista", "basis": "haar", "options": {"iterations": n_steps}}
    lines = Bench(budget_ms=2.5, **stated).lines
    warnings = [line for line in lines if "budget of 2.5 ms" in line]
    assert [line.split()[0] for line in warnings] == [f"{n_fitting}"] * is_warned


@pytest.mark.parametrize(
    ("stated", "cls", "has_error"),
    [
        ({}, SkinSolver, True),
        ({"solver": "fista", "basis": "haar", "iterations": 30}, FistaSolver, False),
    ],
)
def test_deviations_are_those_of_the_error_or_else_of_the_residual(
    stated, cls, has_error
):
    bench = Bench(uncertainty=True, **stated)
    for readings in FRAMES:
        solved = bench.frame(readings)
    assert (solved.error is not None) == has_error
    uncertainty = Uncertainty(np.ones(SHAPE, np.bool_), 2.0, cls.calibrated)
    expected = uncertainty.of(solved.forces, solved.residual, solved.error)
    np.testing.assert_allclose(solved.sd, expected, rtol=1e-6)


def test_a_skin_of_another_grid_begins_without_the_last_forces():
    bench = Bench(solver="fista", basis="haar", iterations=3)
    for readings in FRAMES:
        bench.frame(readings)
    shape = (8, 16)
    phi = make_phi("sbhe", 128, 64, seed=0)
    settings = ReconstructorSettings(
        solver="fista", basis="haar", iterations=3, fast="off"
    )
    state = skin_state(**SKIN | {"n_rows": 8})
    fresh = Patch(settings, lambda line: None)
    readings = noisy(sliding_disc(shape, 9, touch_at=3))[-1]
    forces = []
    for patch in (bench.patch, fresh):
        patch.set_up(settings, [phi], state, live=False)
        patch.read(phi, phi.forward(readings.reshape(-1)))
        patch.solve()
        forces.append(patch.check().forces)
    np.testing.assert_array_equal(*forces)


def test_contacts_of_a_skin_of_another_grid_are_new_ones():
    bench = Bench(contacts=True)
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        bench.patch.contacts(10_000_000 * k)
    phi = make_phi("sbhe", 128, 64, seed=0)
    settings = ReconstructorSettings(fast="off", contacts=True)
    state = skin_state(**SKIN | {"n_rows": 8})
    bench.patch.set_up(settings, [phi], state, live=False)
    bench.patch.set_noise(state)
    for k, readings in enumerate(noisy(sliding_disc((8, 16), 20, touch_at=5))):
        bench.patch.read(phi, phi.forward(readings.reshape(-1)))
        bench.patch.solve()
        bench.patch.check()
        followed = bench.patch.contacts(10**9 + 10_000_000 * k)
    assert followed.fields["id"].tolist() == [1]


@pytest.mark.parametrize(("sigma_end", "is_watched"), [(0.02, True), (0.0, False)])
def test_touches_are_known_where_the_noise_is_stated(sigma_end, is_watched):
    skin = {"sigma_mid": sigma_end, "sigma_end": sigma_end}
    bench = Bench(contacts=True, skin=skin)
    assert (bench.patch._touch is not None) == is_watched


@pytest.mark.parametrize(("sigma", "n_contacts"), [(NOISE.sigma_end, 1), (2.0, 0)])
def test_contacts_stand_out_of_the_noise_that_the_skin_states_last(sigma, n_contacts):
    bench = Bench(contacts=True)
    state = skin_state(**SKIN | {"sigma_mid": sigma, "sigma_end": sigma})
    bench.patch.set_noise(state)
    for k, readings in enumerate(FRAMES):
        bench.frame(readings)
        followed = bench.patch.contacts(10_000_000 * k)
    ids = [] if followed is None else followed.fields["id"]
    assert len(ids) == n_contacts


@pytest.mark.parametrize("repeated", ["keep", "rest"])
def test_a_touch_begins_in_one_frame_alone(repeated):
    bench = Bench(contacts=True)
    begun = []
    for readings in FRAMES:
        bench.frame(readings)
        begun.append(bench.patch._touch.touch.begins)
        if begun[-1]:
            break
    assert begun[-1]
    if repeated == "keep":
        bench.patch.keep(bench.phi(), bench.phi().forward(FRAMES[4].reshape(-1)))
    else:
        bench.patch.rest()
    assert bench.patch._touch.touch.begins is False
    assert bench.patch._touch.touch.touched is True
