"""Accuracy of a design: scenes, readers, the light touch, and bands."""

import math

import numpy as np
import pytest

from sparseskin.plugins.design.budget import budget
from sparseskin.plugins.design.simulation import (
    ACTIVE,
    F_MAX_N,
    MOST_FRAMES,
    N_UNTOUCHED,
    SCENE_S,
    band,
    light_touch,
    make_reader,
    presses,
    simulated,
)
from sparseskin.plugins.design.simulation import simulate as simulate_on
from sparseskin.plugins.design.spec import make_design
from sparseskin.plugins.design.strategies import FEW_SCENES, N_SCENES, STRATEGIES
from sparseskin.studies.presses import BODIES, COURSES

ALL = np.ones((12, 12), dtype=np.bool_)


def simulate(name, n_rows, n_cols, *given, **more):
    """Simulate a strategy by its name, on a skin without a mask."""
    mask = np.ones((n_rows, n_cols), dtype=np.bool_)
    return simulate_on(STRATEGIES[name], mask, *given, **more)


def test_the_scenes_are_each_body_in_each_course():
    assert (len(BODIES), len(BODIES) * len(COURSES)) == (FEW_SCENES, N_SCENES)


@pytest.mark.parametrize("rate_hz", [30.0, 300.0])
def test_a_body_touches_the_skin_in_every_scene_at_any_rate(rate_hz):
    for scene in range(N_SCENES):
        frames = [truth for truth, _ in presses(scene, ALL, 0.01, rate_hz, seed=0)]
        assert len(frames) == N_UNTOUCHED + min(MOST_FRAMES, round(SCENE_S * rate_hz))
        assert not np.any(frames[:N_UNTOUCHED])
        touched = [np.count_nonzero(truth) for truth in frames]
        assert 1 <= max(touched) <= 2.5 * ACTIVE[1] * ALL.size


def test_readings_held_in_turn_are_those_of_a_raster_once_all_taxels_were_read():
    taxels = np.random.default_rng(0).uniform(0, F_MAX_N, ALL.shape).astype(np.float32)
    raster = make_reader(STRATEGIES["all taxels"], ALL, 0.01, 8, seed=0)
    held = make_reader(STRATEGIES["N/4 taxels in turn"], ALL, 0.01, 8, seed=0)
    whole = raster(taxels)
    parts = [held(taxels) for _ in range(4)]
    assert [np.count_nonzero(part) for part in parts] == [36, 72, 108, 144]
    np.testing.assert_array_equal(parts[-1], whole)
    # Steps of 1/255 of the range.
    assert np.abs(whole - taxels).max() <= 0.5 * F_MAX_N / 255 * 1.001


def test_the_light_touch_of_a_raster_grows_with_the_noise():
    def found(noise):
        reader = make_reader(STRATEGIES["all taxels"], ALL, noise, 24, seed=0)
        return light_touch(reader, ALL, noise, seed=0)

    # The same draws, and no rounding: in units of the noise it is the same.
    assert found(0.01) == pytest.approx(10 * found(0.001))
    # The mean of 9 readings has a third of their noise, and 3 x 3 untouched taxels reach some
    # standard deviations of it.
    assert 0.5 < found(0.01) / 0.01 < 3
    # A reader that sees nothing finds none.
    assert math.isnan(light_touch(np.zeros_like, ALL, 0.01, seed=0))


def test_the_full_raster_has_the_error_of_clipped_noise():
    # Noise s clipped at 0 has a mean square of s^2 / 2 on untouched taxels, and s^2 on touched
    # ones: PSNR lies 0 to 3 dB above -20 log10(s).
    for noise in (0.003, 0.03):
        found = simulate("all taxels", 10, 12, noise, 16, 100.0, seed=0)
        assert 0 < found.psnr_db + 20 * math.log10(noise) < 3.1
        assert found.low_db < found.psnr_db < found.high_db


def test_the_band_is_the_prediction_interval_of_a_normal_distribution():
    low, high = band(np.array([10.0, 12.0, 14.0]))
    # Student's t of 2 degrees of freedom at 95 % is 2.920; deviation 2, root of 4 / 3.
    half = 2.920 * 2 * math.sqrt(4 / 3)
    assert (low, high) == pytest.approx((12 - half, 12 + half), abs=0.01)


def test_rows_are_simulated_in_processes_as_in_this_one():
    design = make_design({"rows": 6, "cols": 6, "rate": 50})
    rows = simulated(budget(design)[:2], design, n_scenes=2)
    for row in rows:
        assert row.accuracy == simulate(
            row.strategy.name, 6, 6, design.noise, 10, row.reached_hz, n_scenes=2
        )
