"""Taxels that repeat their readings: found where noise shows, and nowhere else."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import Reason, Taxels
from sparseskin.messages.skin import Skin
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.sensor.doubt.repeats import LEAST_RUN_AT_END, Repeats
from sparseskin.nodes.sensor.layout.layout import MAX_WAYS
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.sensor.repetition import CHANCE, QUIETER

F_MAX = 2.5
SIGMA = 0.014
MARGIN = 6 * SIGMA
N_BEFORE = 12
PRESSED = slice(4, 10)
SKIN = Skin(14, 14, F_MAX)


def frames(seed, n_frames, step=0.0, force=1.0):
    """Noisy readings of a press that rises and stays; `step`: that of a converter, 0 for none."""
    rng = np.random.default_rng(seed)
    for k in range(n_frames):
        truth = np.zeros((14, 14))
        truth[PRESSED, PRESSED] = force * min(1, max(0, k - 4) / 6)
        readings = np.clip(truth + SIGMA * rng.standard_normal(truth.shape), 0, F_MAX)
        if step:
            readings = np.rint(readings / step) * step
        yield readings.astype(np.float32)


@given(
    seed=st.integers(0, 2**32 - 1),
    n_stuck=st.integers(4, 150),
    value=st.floats(0.5, F_MAX),
)
def test_stuck_taxels_of_any_shape_are_found_and_no_others(seed, n_stuck, value):
    places = np.random.default_rng(seed).choice(14 * 14, n_stuck, replace=False)
    watch = Repeats(SKIN)
    reasons = []
    for k, readings in enumerate(
        frames(seed, N_BEFORE + 2 * LEAST_RUN_AT_END, force=0.3)
    ):
        if k >= N_BEFORE:
            readings.flat[places] = value
        reasons.append(watch.reason(readings))
    assert set(reasons[:N_BEFORE]) == {""}
    assert reasons[-1] in (Reason.STUCK, Reason.CLIPPED)


@given(
    seed=st.integers(0, 2**32 - 1),
    n_missing=st.integers(1, 150),
    value=st.floats(0.5, F_MAX),
)
def test_forces_that_stand_for_missing_readings_are_not_stuck(seed, n_missing, value):
    places = np.random.default_rng(seed).choice(14 * 14, n_missing, replace=False)
    missing = np.zeros((14, 14), np.bool_)
    missing.flat[places] = True
    watch = Repeats(SKIN)
    reasons = []
    for readings in frames(seed, N_BEFORE + 2 * LEAST_RUN_AT_END, force=0.3):
        readings[missing] = value
        reasons.append(watch.reason(readings, missing=missing))
        assert not watch.stuck.any()
    assert set(reasons) == {""}


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.05, 0.02]))
def test_nothing_is_concluded_where_a_converter_hides_the_noise(seed, step):
    watch = Repeats(SKIN)
    assert {watch.reason(readings) for readings in frames(seed, 200, step)} == {""}


@given(st.integers(0, 2**32 - 1))
def test_a_force_just_at_the_end_of_the_range_is_none_of_stuck_taxels(seed):
    watch = Repeats(SKIN)
    reasons = {watch.reason(readings) for readings in frames(seed, 60, force=F_MAX)}
    assert reasons == {""}


def test_forces_beyond_the_range_are_clipped():
    watch = Repeats(SKIN)
    reasons = [watch.reason(readings) for readings in frames(1, 60, force=F_MAX + 1)]
    assert reasons[-1] == Reason.CLIPPED


def test_a_frame_that_repeats_as_a_whole_is_frozen():
    watch = Repeats(SKIN)
    for readings in frames(2, 30):
        assert watch.reason(readings) == ""
    reasons = [watch.reason(readings) for _ in range(40)]
    assert reasons[0] == ""
    assert reasons[-1] == Reason.FROZEN


@pytest.mark.parametrize("share", [0.001, 0.05])
def test_the_number_of_repetitions_follows_from_the_noise_of_untouched_taxels(share):
    """A share of the readings repeat; (4 p)^n is at most `CHANCE`."""
    rng = np.random.default_rng(3)
    watch = Repeats(Skin(100, 100, F_MAX))
    readings = rng.uniform(0.01, MARGIN, (100, 100)).astype(np.float32)
    n_repeats = -1  # the first reading of 2 is none
    while not watch.reason(readings):
        changes = rng.random(readings.shape) >= share
        noise = rng.uniform(0.01, MARGIN, readings.shape).astype(np.float32)
        readings = np.where(changes, noise, readings)
        readings[0] = 2.0  # nearly all of the forces
        n_repeats += 1
    needed = math.log(CHANCE) / math.log(QUIETER * share)
    assert n_repeats == pytest.approx(needed, rel=0.15, abs=1)


@given(
    seed=st.integers(0, 2**32 - 1),
    n_stuck=st.integers(1, 40),
    value=st.floats(0.5, 2.4),
)
def test_stuck_taxels_have_the_mean_of_the_working_ones_beside_them(
    seed, n_stuck, value
):
    places = np.random.default_rng(seed).choice(14 * 14, n_stuck, replace=False)
    watch = Repeats(SKIN)
    for k, readings in enumerate(frames(seed, N_BEFORE + 20, force=0.3)):
        if k >= N_BEFORE:
            readings.flat[places] = value
        watch.reason(readings)
        filled = watch.filled(readings)
        if k < N_BEFORE:
            assert filled is readings
    assert watch.cells == sorted(places)

    works = np.ones((14, 14), dtype=np.bool_)
    works.flat[places] = False
    np.testing.assert_array_equal(filled[works], readings[works])
    for row, col in np.argwhere(~works):
        around = np.s_[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2]
        working = readings[around][works[around]]
        expected = working.mean() if working.size else 0.0
        assert filled[row, col] == pytest.approx(expected, abs=1e-5)


def test_readings_at_the_end_of_the_range_and_of_frozen_frames_stay():
    watch = Repeats(SKIN)
    for readings in frames(1, 60, force=F_MAX + 1):
        watch.reason(readings)
        assert watch.filled(readings) is readings
    for _ in range(40):
        reason = watch.reason(readings)
        assert watch.filled(readings) is readings
    assert reason == Reason.FROZEN


def test_a_taxel_that_works_again_is_used_at_once():
    watch = Repeats(SKIN)
    for k, readings in enumerate(frames(4, 40, force=0.3)):
        if N_BEFORE <= k < 39:
            readings[2, 3] = 1.5
        watch.reason(readings)
        assert (watch.cells == [2 * 14 + 3]) == (20 <= k < 39) or k < 20
    assert watch.cells == []


def test_a_sensor_states_its_stuck_taxels_and_logs_them_once(tmp_path):
    recorded = np.stack(list(frames(5, 40, force=0.3)))
    recorded[N_BEFORE:, :2, 3:9] = 1.5
    np.save(tmp_path / "stuck.npy", recorded)
    lines = []
    context = Context("sensor", ManualClock(), log=lines.append)
    chosen = Sensor.Settings(source=f"file:{tmp_path}/stuck.npy", tare=0, f_max=F_MAX)
    sensor = Sensor(chosen, context)
    messages = []
    for k in range(39):  # the state is that of the frame after it
        messages += sensor.acquire(Tick(k, k))
    taxels = [message for message in messages if isinstance(message, Taxels)]

    cells = [row * 14 + col for row in range(2) for col in range(3, 9)]
    assert sensor.state()["faulty_taxels"] == cells
    assert taxels[-1].reason == (Reason.STUCK,)
    assert taxels[-1].forces[0, :2, 3:9].max() < MARGIN
    about = [line for line in lines if line.startswith("stuck taxels")]
    assert len(about) == 1
    assert about[0].count("(") == MAX_WAYS
    assert about[0].endswith("(1, 4), ...")
