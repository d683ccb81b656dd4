"""The noise of a skin is shown by its innovations, and missed where it is absent."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.reconstructor.faults.noise import (
    AT_LEAST,
    LEARNING,
    NoiseWatch,
    PressedNoise,
)

STATED = 0.02**2
M = 100


def innovations(n_frames, variance, seed=0):
    """Mean squared innovations of frames of M normal values."""
    rng = np.random.default_rng(seed)
    return variance * rng.chisquare(M, n_frames) / M


def watched(*parts):
    """A watch after frames of these mean squared innovations, one after the other."""
    watch = NoiseWatch()
    for innovation2 in np.concatenate(parts):
        watch.look(float(innovation2), STATED)
    return watch


@pytest.mark.parametrize("part", [0.7, 1.0, 2.0])
def test_noise_as_stated_is_shown_and_not_missed(part):
    for n_frames in range(2 * LEARNING, 200):
        watch = watched(innovations(n_frames, part * STATED, seed=n_frames))
        assert watch.is_shown
        assert not watch.is_quiet


def test_few_frames_show_no_noise():
    assert not watched(innovations(LEARNING - 1, STATED)).is_shown


@pytest.mark.parametrize("part", [0.0, 0.3])
def test_a_skin_that_states_too_much_noise_is_not_quiet(part):
    watch = watched(innovations(300, part * STATED))
    assert not watch.is_shown
    assert not watch.is_quiet


def test_measurements_scaled_down_are_quiet_until_they_are_right_again():
    before = innovations(60, STATED)
    scaled = innovations(30, STATED / 100, seed=1)
    assert not watched(before, scaled[:5]).is_quiet
    assert watched(before, scaled).is_quiet
    assert not watched(before, scaled, innovations(10, STATED, seed=2)).is_quiet


def test_motion_does_not_hide_that_the_noise_is_missing_for_long():
    before = innovations(60, STATED)
    moving = np.full(20, 1e6 * STATED)
    quiet = np.zeros(40)
    assert not watched(before, moving).is_quiet
    assert watched(before, moving, quiet).is_quiet


@given(
    n_pressed=st.integers(1, 500),
    force=st.floats(0.05, 5),
    noise2=st.floats(1e-6, 1e-2),
    untouched=st.floats(1e-6, 1e-4),
)
def test_pressed_taxels_have_a_part_of_the_measured_noise(n_pressed, force, noise2, untouched):
    noise = PressedNoise()
    pressed = np.full(n_pressed, force, dtype=np.float32)
    for _ in range(5):
        noise.look(pressed, n_pressed * noise2)
    variance = noise.variance(np.array([0, force, 3 * force], dtype=np.float32), untouched)
    expected = AT_LEAST * np.array([untouched, untouched + noise2, untouched + noise2])
    np.testing.assert_allclose(variance, expected, rtol=1e-5)


def test_noise_of_pressed_taxels_is_that_of_untouched_ones_before_any_was_pressed():
    variance = PressedNoise().variance(np.array([0.0, 1.0], dtype=np.float32), 1e-4)
    np.testing.assert_allclose(variance, AT_LEAST * 1e-4)
