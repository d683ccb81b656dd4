"""Readings outside the range, and of the other sign: which are counted, and what noise may do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sparseskin.nodes.sensor.saturation import Clipped
from sparseskin.nodes.sensor.sign import Margin, Sign

LOW = -1.0
HIGH = 2.0
SHAPE = (4, 5)
ANY = st.sampled_from([-3.0, -1.5, -1.0, -0.5, 0.0, 1.0, 2.0, 2.5, 9.0, np.nan])
FRAMES = hnp.arrays(np.float64, SHAPE, elements=ANY)


def known(frame):
    return frame[~np.isnan(frame)]


@given(frames=st.lists(FRAMES, min_size=1, max_size=4))
def test_readings_beyond_each_end_are_counted(frames):
    clipped = Clipped()
    for frame in frames:
        is_beyond = clipped.add(frame, LOW, HIGH)
        values = known(frame)
        assert is_beyond == bool(((values < LOW) | (values > HIGH)).any())
    values = np.concatenate([known(frame) for frame in frames])
    assert clipped.n_below == np.count_nonzero(values < LOW)
    assert clipped.n_above == np.count_nonzero(values > HIGH)
    assert clipped.n == clipped.n_below + clipped.n_above
    if clipped.n_above:
        assert clipped.highest == values.max()
    if clipped.n_below:
        assert clipped.lowest == values.min()


@given(frame=FRAMES, mask=hnp.arrays(np.bool_, SHAPE))
def test_readings_of_cells_that_do_not_exist_are_not_counted(frame, mask):
    clipped = Clipped(mask=mask)
    clipped.add(frame, LOW, HIGH)
    values = known(frame[mask])
    assert clipped.n == np.count_nonzero((values < LOW) | (values > HIGH))


@given(frame=FRAMES, noise=st.sampled_from([0.01, 0.05, 0.2]))
def test_of_known_noise_six_deviations_may_be_below_the_range(frame, noise):
    clipped = Clipped()
    clipped.add(frame, LOW, HIGH, noise)
    values = known(frame)
    lower_end = LOW - 6 * noise
    assert clipped.n_below == np.count_nonzero(values < lower_end)
    assert clipped.n_above == np.count_nonzero(values > HIGH)
    beyond = (values < lower_end) | (values > HIGH + 6 * noise)
    assert clipped.n_now == np.count_nonzero(beyond)


@given(frame=FRAMES)
def test_frames_that_are_watched_are_doubted_and_not_counted(frame):
    clipped = Clipped()
    clipped.watch(frame, LOW, HIGH)
    assert clipped.n == 0
    assert clipped.report(LOW, HIGH, "N") == {"clipped": 0}
    added = Clipped()
    added.add(frame, LOW, HIGH)
    assert clipped.n_now == added.n_now


def test_a_report_has_the_counts_and_the_range():
    frame = np.zeros(SHAPE)
    frame[0] = 9.0
    frame[1, 0] = -3.0
    clipped = Clipped()
    clipped.add(frame, LOW, HIGH)
    assert clipped.report(LOW, HIGH, "N") == {
        "clipped": 6,
        "clipped_below": 1,
        "clipped_above": 5,
        "lowest": -3.0,
        "highest": 9.0,
        "f_min": LOW,
        "f_max": HIGH,
        "unit": "N",
    }


def add(sign, frame):
    """Add a frame whose noise is at most 0.1."""
    sign.update(frame, 0.0, 0.1, np.nanmin(frame))


def fallen(n_falls, n_rises):
    """The sign of readings of which some are below rest and others above."""
    sign = Sign()
    frame = np.zeros(40)
    add(sign, frame)
    frame[:n_falls] = -1.0
    frame[20 : 20 + n_rises] = 1.0
    add(sign, frame)
    return sign


@given(n_falls=st.integers(0, 20), n_rises=st.integers(0, 20))
def test_readings_fall_where_more_than_three_do_for_each_that_rises(n_falls, n_rises):
    sign = fallen(n_falls, n_rises)
    assert sign.n_falls == n_falls
    assert sign.n_rises == n_rises
    assert sign.falls == (n_falls > 3 * n_rises)
    assert sign.is_found == (n_falls > 3 * n_rises and n_falls >= 4)
    assert sign.lowest == (-1.0 if n_falls else 0.0)
    # Later frames are in doubt only where the sign is found.
    add(sign, np.zeros(40))
    assert sign.falls == sign.is_found


def test_a_taxel_falls_once_until_it_has_been_back():
    sign = Sign()
    for value, n_falls, n_rises in (
        (-1.0, 1, 0),
        (-2.0, 1, 0),
        (0.0, 1, 0),
        (-1.0, 2, 0),
        (1.0, 2, 1),
        (2.0, 2, 1),
        (0.05, 2, 1),
        (1.0, 2, 2),
    ):
        add(sign, np.array([value]))
        assert sign.n_falls == n_falls
        assert sign.n_rises == n_rises
    assert sign.lowest == -2.0
    sign.reset()
    assert sign.n_falls == 0
    assert sign.lowest == 0.0


def test_noise_is_no_fall_and_no_rise():
    sign = Sign()
    add(sign, np.array([-0.1, 0.1, np.nan]))
    assert sign.n_falls == 0
    assert sign.n_rises == 0


@given(noise=st.floats(0.0, 1.0), f_max=st.floats(0.1, 100.0))
def test_the_margin_of_known_noise_is_six_deviations_or_a_contact(noise, f_max):
    margin = Margin().of(np.zeros(9), f_max, noise)
    assert margin == pytest.approx(max(6 * noise, 0.004 * f_max))


@given(seed=st.integers(0, 99), sd=st.floats(0.02, 0.5), n=st.sampled_from([300, 5000]))
def test_noise_that_is_not_known_is_measured(seed, sd, n):
    rng = np.random.default_rng(seed)
    margin = Margin()
    for _ in range(9):
        found = margin.of(rng.normal(0, sd, n), 1.0, None)
    assert found == pytest.approx(6 * sd, rel=0.3)


@pytest.mark.parametrize(
    ("value", "f_max", "expected"),
    [(0.5, 10.0, 0.1), (3.0, 10.0, 0.3), (3.0, 50.0, 1.5), (3.0, 1000.0, 10.0)],
)
def test_without_noise_the_margin_is_that_of_steps_a_converter_may_have(
    value, f_max, expected
):
    margin = Margin()
    for _ in range(3):
        found = margin.of(np.full(SHAPE, value), f_max, None)
    assert found == pytest.approx(expected)


def test_whole_numbers_of_a_large_range_move_by_two_and_a_half():
    assert Margin().of(np.full(SHAPE, 3.0), 100.0, None) == pytest.approx(2.5)


def test_a_frame_without_a_number_has_the_margin_of_an_unknown_noise():
    margin = Margin().of(np.full(SHAPE, np.nan), 10.0, None)
    assert margin == pytest.approx(0.1)


def test_a_motion_does_not_pass_for_noise_nor_does_a_load():
    rng = np.random.default_rng(0)
    level = rng.uniform(0, 1, 400)
    margin = Margin()
    for k in range(20):
        # A load that all taxels bear, other forces on each; it jumps in one frame of five.
        load = level * (1 + k // 5)
        found = margin.of(load + rng.normal(0, 0.01, 400), 3.0, None)
    assert found == pytest.approx(0.06, rel=0.3)
