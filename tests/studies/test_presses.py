"""Analytic presses: their size, speed, course and their noise."""

import itertools

import numpy as np
import pytest

from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.presses import (
    BODIES,
    COURSES,
    N_BEFORE,
    RAMP,
    SKINS,
    Timing,
    press_frames,
    scattered_mask,
)


def frames_of(body="peg", shape=(20, 20), n=80, seed=0, **chosen):
    pairs = list(press_frames(body, shape, n, seed, **chosen))
    return np.array([truth for truth, _ in pairs]), np.array([reading for _, reading in pairs])


@pytest.mark.parametrize("shape", SKINS)
def test_every_body_presses_every_skin_within_its_range(shape):
    for body, course in itertools.product(BODIES, COURSES):
        truth, reading = frames_of(body, shape, 70, course=course)
        assert truth.dtype == reading.dtype == np.float32
        assert truth.shape == (70, *shape)
        np.testing.assert_array_equal(truth, reading)
        assert truth.min() == 0
        assert 0.2 < truth.max() <= 2.5
        assert not truth[:N_BEFORE].any()
        assert truth[N_BEFORE + RAMP // 2].any()


@pytest.mark.parametrize("active", [0.01, 0.6])
@pytest.mark.parametrize("body", BODIES)
def test_a_body_touches_about_the_stated_part_of_the_skin(body, active):
    truth, _ = frames_of(body, (40, 40), 120, active=active)
    touched = np.count_nonzero(truth[N_BEFORE + RAMP :], axis=(1, 2)) / 1600
    assert 0.6 * active < np.median(touched) < 1.25 * active + 0.005


def test_a_moving_body_moves_by_its_speed_in_each_frame_but_where_it_turns_back():
    speed = 0.3
    truth, _ = frames_of("peg", (64, 64), 150, speed=speed, active=0.02)
    i, j = np.indices((64, 64))
    pressed = truth[N_BEFORE + 1 :].astype(np.float64)
    totals = pressed.sum(axis=(1, 2))
    centres = np.stack([(pressed * of).sum(axis=(1, 2)) / totals for of in (i, j)], axis=1)
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert np.median(steps) == pytest.approx(speed, rel=0.05)


def test_parts_of_a_course_last_as_many_frames_as_are_stated():
    timing = Timing(before=3, ramp=5, pause=2, held=4)
    ramped, _ = frames_of("gaussian", course="ramped", n=15, timing=timing)
    totals = ramped.sum(axis=(1, 2))
    np.testing.assert_allclose(
        totals / totals.max(),
        [0, 0, 0, 0.2, 0.4, 0.6, 0.8, 1, 0.8, 0.6, 0.4, 0.2, 0, 0, 0],
        rtol=1e-5,
    )
    sudden, _ = frames_of("gaussian", course="sudden", n=15, timing=timing)
    touched = sudden.any(axis=(1, 2)).tolist()
    assert touched == 3 * [False] + 4 * [True] + 2 * [False] + 4 * [True] + 2 * [False]
    moving, _ = frames_of("peg", course="moving", n=15, speed=0.0, timing=timing)
    rising = moving.sum(axis=(1, 2))
    assert np.argmax(rising > 0.999 * rising.max()) == 3 + 5 - 1


def test_frames_follow_from_the_seed_and_not_from_their_number():
    chosen = {"noise": NoiseModel()}
    longer, shorter = (frames_of("wrench", n=n, seed=3, **chosen) for n in (70, 40))
    for of_longer, of_shorter in zip(longer, shorter, strict=True):
        np.testing.assert_array_equal(of_longer[:40], of_shorter)
    assert not np.array_equal(frames_of("wrench", n=70, seed=4, **chosen)[0], longer[0])
    # Noise is of the readings alone.
    np.testing.assert_array_equal(frames_of("wrench", n=70, seed=3)[0], longer[0])
    assert not np.array_equal(*longer)


def test_cells_without_a_taxel_bear_no_force_and_read_0():
    mask = scattered_mask((20, 20), 42, seed=1)
    assert np.count_nonzero(mask) == 42
    truth, reading = frames_of(active=0.5, mask=mask, noise=NoiseModel())
    assert not truth[:, ~mask].any()
    assert not reading[:, ~mask].any()
    touched = np.count_nonzero(truth[N_BEFORE + RAMP :], axis=(1, 2)) / 42
    assert 0.3 < np.median(touched) < 0.7
