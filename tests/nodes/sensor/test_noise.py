"""The noise of a taxel: its closed forms, and what the range leaves of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.sensor.noise import NoiseModel

RANGES = st.floats(0.1, 1000.0)
PARTS = st.floats(0.0, 1.0)


@given(f_max=RANGES, mid=PARTS, end=PARTS, place=PARTS)
def test_the_deviation_is_a_line_from_both_ends_to_the_middle(f_max, mid, end, place):
    noise = NoiseModel(f_max, mid * f_max, end * f_max)
    force = np.array([place * f_max], dtype=np.float32)
    from_middle = abs(2 * place - 1)
    expected = f_max * (mid + (end - mid) * from_middle)
    assert noise.sigma(force)[0] == pytest.approx(expected, abs=1e-5 * f_max)


@given(f_max=RANGES, times=st.floats(0.0, 5.0))
def test_the_noise_of_another_range_is_that_of_the_paper_scaled(f_max, times):
    noise = NoiseModel.for_range(f_max, times)
    assert noise.f_max == f_max
    assert noise.sigma_mid == pytest.approx(times * 0.0628 * f_max / 2.5)
    assert noise.sigma_end == pytest.approx(times * 0.0141 * f_max / 2.5)


@given(sigma=st.floats(0.01, 0.3), n_sigmas=st.floats(0.0, 3.0))
def test_the_variance_is_that_of_clipped_readings(sigma, n_sigmas):
    """Of readings near 0, as a line that is off by most, 0.095, at its end."""
    noise = NoiseModel(2.5, sigma, sigma)
    force = np.float32(n_sigmas * sigma)
    drawn = np.random.default_rng(0).normal(n_sigmas, 1.0, 100_000)
    expected = np.maximum(drawn, 0).var()
    found = noise.variance(np.array([force], dtype=np.float32))[0] / sigma**2
    assert found == pytest.approx(expected, abs=0.1)


def test_readings_that_are_not_clipped_have_all_of_the_noise():
    forces = np.linspace(0, 2.5, 11, dtype=np.float32)
    noise = NoiseModel(2.5, 0.06, 0.02, clips=False)
    np.testing.assert_allclose(
        noise.variance(forces), np.square(noise.sigma(forces)), rtol=1e-4
    )
    clipped = NoiseModel(2.5, 0.06, 0.02)
    # An untouched taxel keeps 1/2 - 1/(2 pi) of its variance.
    assert clipped.variance(forces)[0] == pytest.approx(0.3408 * 0.02**2, rel=1e-3)
    np.testing.assert_allclose(
        clipped.variance(forces[1:]), noise.variance(forces[1:]), rtol=1e-4
    )


def test_forces_beyond_the_range_have_the_noise_of_its_end():
    noise = NoiseModel(2.5, 0.06, 0.02)
    forces = np.array([2.5, 4.0], dtype=np.float32)
    np.testing.assert_allclose(noise.variance(forces), 0.02**2, rtol=1e-4)


def test_taxels_that_are_not_read_have_no_noise():
    forces = np.array([0.0, 1.0], dtype=np.float32)
    noise = NoiseModel(2.5, 0.06, 0.02, of_touched=True)
    untouched, touched = noise.variance(forces)
    assert untouched == 0
    assert touched > 0


@given(seed=st.integers(0, 99), f_max=RANGES)
def test_readings_are_in_the_range_and_those_of_the_same_draw_are_the_same(seed, f_max):
    noise = NoiseModel.for_range(f_max, 5.0)
    truth = np.linspace(0, f_max, 300, dtype=np.float32)
    readings = noise.apply(truth, np.random.default_rng(seed))
    assert readings.min() >= 0
    assert readings.max() <= np.float32(f_max)
    again = noise.apply(truth, np.random.default_rng(seed))
    np.testing.assert_array_equal(readings, again)
    assert np.abs(readings - truth).max() < 6 * noise.sigma_mid


@pytest.mark.parametrize(
    ("f_max", "mid", "end", "is_allowed"),
    [
        (2.5, 0.0, 0.0, True),
        (2.5, 2.5, 2.5, True),
        (2.5, 2.51, 0.0, False),
        (2.5, 0.0, 2.51, False),
        (2.5, -0.01, 0.0, False),
        (2.5, 0.0, -0.01, False),
        (0.0, 0.0, 0.0, False),
        (-1.0, 0.0, 0.0, False),
        (np.inf, 0.0, 0.0, False),
        (np.nan, 0.0, 0.0, False),
    ],
)
def test_deviations_are_within_the_range(f_max, mid, end, is_allowed):
    if is_allowed:
        NoiseModel(f_max, mid, end)
        return
    with pytest.raises(SettingsError):
        NoiseModel(f_max, mid, end)
