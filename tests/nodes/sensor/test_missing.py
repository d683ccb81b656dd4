"""Readings that a skin lacks; the noise of the paper; a skin that is pressed as a graph begins."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import sparseskin
from sparseskin.messages import SkinState, Taxels
from sparseskin.messages.skin import Skin
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.sensor.missing import RENEWAL_NS, MissingReadings
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.sensor.noise import NoiseModel

NAN = float("nan")


@given(
    frames=arrays(
        np.float32,
        (4, 5, 6),
        elements=st.sampled_from([0.0, 0.5, 2.0, NAN, np.inf, -np.inf]),
    ),
    exists=arrays(np.bool_, (5, 6)).filter(np.any),
    way=st.sampled_from(["mask", "hold", "zero"]),
)
def test_readings_stay_and_no_other_number_is_unmarked(frames, exists, way):
    readings = MissingReadings(way, Skin(5, 6, 2.0, mask=exists), learns=way == "mask")
    for k, frame in enumerate(frames):
        known = np.isfinite(frame) & exists
        found = readings.fill(frame, k * RENEWAL_NS)
        assert (found is None) == (not known.any())
        if found is None:
            continue
        message = Taxels(stamp_ns=0, patch="skin", forces=found[0], missing=found[1])
        marked = message.missing_cells((5, 6))
        marked = np.zeros((5, 6), np.bool_) if marked is None else marked
        taxels = readings.skin.exists
        assert (taxels & ~marked == known).all()
        assert (message.forces[0][known] == frame[known]).all()
        assert (message.forces[0][~taxels] == 0).all()


@pytest.fixture
def driver(tmp_path, monkeypatch):
    """A function that returns the address of a driver of frames, 1 s apart."""
    monkeypatch.chdir(tmp_path)

    def write(frames):
        np.save("frames.npy", frames)
        Path("silent_skin.py").write_text(
            "import numpy as np\n\n\ndef made():\n"
            "    yield from ((k * 10**9, one) for k, one in enumerate(np.load('frames.npy')))\n"
        )
        return "silent_skin:made"

    return write


def test_a_driver_s_silent_cells_are_masked_until_they_give_a_number(driver):
    frames = np.full((4, 3, 4), 0.5, np.float32)
    frames[:, 0, 0] = NAN
    frames[:2, 1, 2] = NAN
    frames[3, 2, 3] = NAN
    source = driver(frames)
    bus = Bus({"sensor": (Sensor, Sensor.Settings(source=source, nan="mask"))})
    made = [message for messages in bus.frames(None) for message in messages]
    assert [one.skin.n_taxels for one in made if isinstance(one, SkinState)] == [10, 11]
    taxels = [one for one in made if isinstance(one, Taxels)]
    assert [one.missing is not None for one in taxels] == [False, False, False, True]
    assert taxels[3].forces[0, 2, 3] == 0.5  # as its neighbours
    assert taxels[3].forces[0, 0, 0] == 0
    bus.close()
    options = [f"sensor.source={source}", "sensor.nan=mask"]
    # none is refused
    assert len(list(sparseskin.run_launch("replay", None, options))) == 4


def test_a_taxel_that_was_silent_during_the_tare_has_no_force_before_the_next_one(
    driver,
):
    frames = np.full((4, 3, 4), 100.0, np.float32)
    frames[:2, 1, 2] = NAN
    frames[:1, 2, 2] = NAN
    chosen = ["sensor.nan=hold", "sensor.tare=2", "sensor.f_max=500"]
    chosen = [f"sensor.source={driver(frames)}", *chosen]
    found = list(sparseskin.run_launch("replay", None, chosen))
    assert len(found) == 2
    for frame in found:
        assert np.argwhere(frame.missing).tolist() == [[1, 2]]
        assert not frame.taxels.any()


def replayed(readings, folder, way):
    np.save(folder / "a.npy", readings)
    source = f"sensor.source=file:{folder / 'a.npy'}"
    options = (source, "sensor.f_max=2.5", f"sensor.nan={way}")
    return sparseskin.run_launch("replay", None, options)


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """Truth and readings while a body presses, (20, 40, 40), and the largest error of a frame."""
    truth, taxels = (part[300:] for part in sparseskin.simulate("path_40", 320))
    frames = replayed(taxels, tmp_path_factory.mktemp("whole"), "refuse")
    return (
        truth,
        taxels,
        max(rms(f.forces - t) for f, t in zip(frames, truth, strict=True)),
    )


@settings(max_examples=8)
@given(
    way=st.sampled_from(["mask", "hold"]),
    parts=st.lists(
        st.tuples(*[st.integers(0, 39)] * 4, st.integers(0, 19)), max_size=6
    ),
    flicker=st.floats(0, 0.2),
)
def test_missing_readings_spoil_no_trusted_force(
    pressed, tmp_path_factory, way, parts, flicker
):
    truth, taxels, usual = pressed
    readings = taxels.copy()
    for row, col, n_rows, n_cols, first in parts:
        readings[first:, row : row + 1 + n_rows // 4, col : col + 1 + n_cols // 4] = NAN
    readings[np.random.default_rng(len(parts)).random(readings.shape) < flicker] = NAN
    frames = replayed(readings, tmp_path_factory.mktemp("missing"), way)
    for frame, true, read in zip(frames, truth, readings, strict=True):
        error = (frame.forces - true)[np.isfinite(read)]
        assert not frame.trusted or rms(error) < 2 * usual


def forces(*values):
    return np.array(values, dtype=np.float32)


def test_sigma_is_largest_at_mid_range_and_falls_linearly_to_both_ends():
    sigma = NoiseModel().sigma(forces(0.0, 0.625, 1.25, 1.875, 2.5))
    np.testing.assert_allclose(
        sigma, [0.0141, 0.03845, 0.0628, 0.03845, 0.0141], rtol=1e-6
    )
    assert sigma.dtype == np.float32


@pytest.mark.parametrize("clips", [True, False])
def test_variance_is_that_of_the_readings(clips):
    model = NoiseModel(clips=clips)
    force = forces(0.0, 0.007, 0.0141, 0.03, 1.0)[:, np.newaxis]
    readings = force + model.sigma(force) * np.random.default_rng(1).standard_normal(
        (5, 100_000)
    )
    found = np.var(np.maximum(readings, 0 if clips else -1), axis=1, keepdims=True)
    np.testing.assert_allclose(model.variance(force), found, rtol=0.1)


def test_untouched_skin_has_a_noisy_psnr_of_48_db():
    model = NoiseModel()
    rng = np.random.default_rng(0)
    truth = np.zeros((40, 40), dtype=np.float32)
    psnr = [
        20
        * math.log10(
            2.5 / math.sqrt(np.mean(np.square(model.apply(truth, rng), dtype=float)))
        )
        for _ in range(400)
    ]
    assert np.mean(psnr) == pytest.approx(48.0, abs=0.3)


def test_readings_stay_in_the_range_and_the_truth_is_left_alone():
    truth = np.tile(forces(0.0, 1.25, 2.5), 130_000)
    kept = truth.copy()
    taxels = NoiseModel().apply(truth, np.random.default_rng(3))
    assert taxels.dtype == np.float32
    assert taxels.min() == 0.0
    assert taxels.max() == 2.5
    np.testing.assert_array_equal(truth, kept)
    # of zero mean and the stated sigma
    error = taxels[truth == 1.25].astype(float) - 1.25
    assert abs(error.mean()) < 5 * 0.0628 / math.sqrt(error.size)
    assert error.std() == pytest.approx(0.0628, rel=0.01)
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
def test_bad_parameter_is_named_with_its_value_and_the_allowed_range(
    name, value, allowed
):
    with pytest.raises(
        SettingsError, match=rf"{name} is {value!r}; allowed is {allowed}"
    ):
        NoiseModel(**{name: value})
