"""The noise model of the paper, and its effect on an untouched skin."""

import math

import numpy as np
import pytest

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.rest import Rest


def forces(*values):
    return np.array(values, dtype=np.float32)


def test_sigma_is_largest_at_mid_range_and_falls_linearly_to_both_ends():
    sigma = NoiseModel().sigma(forces(0.0, 0.625, 1.25, 1.875, 2.5))
    np.testing.assert_allclose(sigma, [0.0141, 0.03845, 0.0628, 0.03845, 0.0141], rtol=1e-6)
    assert sigma.dtype == np.float32


@pytest.mark.parametrize("clips", [True, False])
def test_variance_is_that_of_the_readings(clips):
    model, force = NoiseModel(), forces(0.0, 0.007, 0.0141, 0.03, 1.0)[:, np.newaxis]
    readings = force + model.sigma(force) * np.random.default_rng(1).standard_normal((5, 100_000))
    found = np.var(np.maximum(readings, 0 if clips else -1), axis=1, keepdims=True)
    np.testing.assert_allclose(model.variance(force, clips), found, rtol=0.1)


def test_untouched_skin_has_a_noisy_psnr_of_48_db():
    model, rng = NoiseModel(), np.random.default_rng(0)
    truth = np.zeros((40, 40), dtype=np.float32)
    psnr = [
        20 * math.log10(2.5 / math.sqrt(np.mean(np.square(model.apply(truth, rng), dtype=float))))
        for _ in range(400)
    ]
    assert np.mean(psnr) == pytest.approx(48.0, abs=0.3)


def test_noise_at_mid_range_has_zero_mean_and_the_stated_sigma():
    truth = np.full(400_000, 1.25, dtype=np.float32)
    error = NoiseModel().apply(truth, np.random.default_rng(2)).astype(float) - 1.25
    assert abs(error.mean()) < 5 * 0.0628 / math.sqrt(truth.size)
    assert error.std() == pytest.approx(0.0628, rel=0.01)


def test_readings_stay_in_the_range_and_the_truth_is_left_alone():
    truth = np.tile(forces(0.0, 1.25, 2.5), 5000)
    kept = truth.copy()
    taxels = NoiseModel().apply(truth, np.random.default_rng(3))
    assert (taxels.dtype, taxels.min(), taxels.max()) == (np.float32, 0.0, 2.5)
    np.testing.assert_array_equal(truth, kept)
    assert not np.shares_memory(taxels, truth)


def test_noise_is_a_multiple_of_the_papers_in_parts_of_the_range_and_may_be_none():
    model = NoiseModel.for_range(25.0, times=3.0)
    assert (model.sigma_mid, model.sigma_end) == pytest.approx((1.884, 0.423))
    truth = forces(0.0, 1.0, 2.5)
    none = NoiseModel.for_range(2.5, times=0.0)
    np.testing.assert_array_equal(none.apply(truth, np.random.default_rng(6)), truth)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("f_max", 0.0, "a finite number above 0"),
        ("sigma_mid", 3.0, "0 to f_max = 2.5"),
        ("sigma_end", -0.1, "0 to f_max = 2.5"),
    ],
)
def test_bad_parameter_is_named_with_its_value_and_the_allowed_range(name, value, allowed):
    with pytest.raises(SettingsError, match=rf"{name} is {value!r}; allowed is {allowed}"):
        NoiseModel(**{name: value})


SKIN = Skin(10, 10, f_max=2.5)


@pytest.mark.parametrize(
    ("level", "n_lifted", "found"), [(0.3, 100, True), (0.3, 80, False), (0.0, 100, False)]
)
def test_what_nearly_all_taxels_read_at_first_is_named_with_its_remedy(level, n_lifted, found):
    rng, rest = np.random.default_rng(0), Rest(SKIN)
    told = []
    for _ in range(60):
        frame = rng.normal(0, 0.02, 100)
        frame[:n_lifted] += level
        told.append(rest.update(frame.clip(0).astype(np.float32).reshape(SKIN.shape)))
    assert (sum(told), "sensor.tare=30" in rest.line) == (found, found)
