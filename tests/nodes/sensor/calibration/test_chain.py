"""From counts to newtons: each step in closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparseskin.nodes.sensor.calibration.chain import Chain
from sparseskin.nodes.sensor.calibration.description import Response, SkinDescription
from sparseskin.nodes.sensor.saturation import Clipped

SHAPE = (3, 4)
SECOND = 1_000_000_000


def skin(**changes):
    return SkinDescription("palm", *SHAPE, 2.5, **changes)


def still(description):
    """A chain that follows no drift."""
    return Chain(description, drift_rate=0.0)


counts = arrays(np.float64, SHAPE, elements=st.floats(0, 4095))
gains = arrays(np.float64, SHAPE, elements=st.floats(1e-4, 1e-2) | st.floats(-1e-2, -1e-4))
pressed = arrays(np.float64, SHAPE, elements=st.floats(0, 2.5))


@given(counts, gains, pressed)
def test_forces_come_back_from_counts(baseline, gain, force):
    curve = Response(np.array([0.2, 1.0, 2.0]), np.array([0.5, 1.2, 2.5]))
    raw = baseline + Response(curve.force, curve.reading).forces(force) / gain
    chain = still(skin(baseline=baseline, gains=gain, response=curve))
    np.testing.assert_allclose(chain.apply(raw, 0), force, atol=1e-6)


def test_a_tare_is_a_median_so_that_a_short_touch_does_not_count_and_forgets_the_drift():
    chain = Chain(skin(baseline=np.zeros(SHAPE)))
    run(chain, -0.02, 10)
    assert chain.drift.value.any()
    chain.tare([np.full(SHAPE, 7.0)] * 20 + [np.full(SHAPE, 900.0)] * 9)
    line = chain.state()["tared"]
    assert line.startswith("forces changed by at most 7 N, of 12 taxels by more than 5 %")
    assert not chain.drift.value.any()
    assert (chain.apply(np.full(SHAPE, 9.0), 0) == 2.0).all()
    first = Chain(skin())
    first.tare([np.full(SHAPE, 7.0)])
    assert first.state()["tared"] == "forces changed by at most 7 N"


def test_a_tare_measures_the_noise_that_no_file_states():
    rng = np.random.default_rng(0)
    chain, stated = Chain(skin()), Chain(skin(noise=0.02))
    frames = [rng.normal(3.0, 0.01, SHAPE) for _ in range(1000)]
    for frame in frames[::7]:
        frame[1, 2] = np.nan
    for one in (chain, stated):
        one.tare(frames)
    # The deviation of 100 frames is off by 1 / sqrt(200) of itself, the median of 12 by a third.
    assert chain.description.sigmas == pytest.approx((0.01, 0.01), rel=0.1)
    assert stated.description.sigmas == (0.02, 0.02)


def test_masked_cells_are_0_whatever_they_read():
    mask = np.ones(SHAPE, dtype=np.bool_)
    mask[1, 2] = False
    raw = np.full(SHAPE, 1.5)
    raw[1, 2] = 1e9
    chain = still(skin(mask=mask))
    forces = chain.apply(raw, 0)
    assert forces[1, 2] == 0
    assert (forces[mask] == 1.5).all()
    assert chain.clipped.n == 0


def test_readings_beyond_the_range_are_clipped_and_counted_noise_below_0_is_not():
    chain = still(skin(noise=0.01))
    raw = np.zeros(SHAPE)
    raw[0, :3] = 3.0, -0.05, -0.07
    assert list(chain.apply(raw, 0)[0]) == [2.5, 0, 0, 0]
    assert chain.clipped == Clipped(n_below=1, n_above=1, lowest=-0.07, highest=3.0)


def test_a_lower_end_below_0_keeps_the_mean_of_noise_centred_on_0():
    rng = np.random.default_rng(3)
    chain = still(skin(noise=0.01, f_min=-0.05))
    frames = np.stack([chain.apply(rng.normal(0, 0.01, SHAPE), 0) for _ in range(4000)])
    # Of 48000 readings the mean is normal with 0.01 / sqrt(48000).
    assert abs(frames.mean()) < 4 * 0.01 / np.sqrt(frames.size)
    clipped = np.clip(frames, 0, None).mean()
    assert clipped == pytest.approx(0.01 / np.sqrt(2 * np.pi), rel=0.02)


def run(chain, force, seconds, rate_hz=100.0):
    """Forces at the end of `seconds` under a force, a number or a function of time in seconds."""
    n = round(seconds * rate_hz)
    for k in range(n + 1):
        t = k / rate_hz
        value = force(t) if callable(force) else force
        found = chain.apply(
            np.broadcast_to(np.asarray(value, dtype=float), SHAPE), round(t * SECOND)
        )
    return found


def test_a_steady_press_of_60_s_and_its_edge_lose_nothing():
    # The threshold of a skin whose noise is not known: 0.004 of 2.5 N.
    press = np.zeros(SHAPE)
    press[1, 1], press[1, 2], press[2, 3] = 1.0, 0.008, 0.011
    found = run(Chain(skin()), press, 60, rate_hz=20.0)
    np.testing.assert_allclose(found, press, atol=1e-7)


PAD = (12, 12)
PRESSED = np.s_[4:8, 4:8]
FOLLOWED = np.ones(PAD, np.bool_)
FOLLOWED[2:10, 2:10] = False  # a press holds the taxels around it


def drift_under_a_light_press(percent, noise, *, drift=0.0, seconds=62.0):
    """Drift followed, in parts of f_max, under a press of some % from second 2 on."""
    chain = Chain(SkinDescription("palm", *PAD, 2.5, noise=noise or None))
    rng = np.random.default_rng(0)
    for k in range(round(20 * seconds)):
        raw = rng.normal(0, noise, PAD) + 2.5 * drift * k / 20
        if k >= 40:
            raw[PRESSED] += 0.025 * percent
        chain.apply(raw, k * SECOND // 20)
    return chain.drift.value / 2.5


@pytest.mark.parametrize(("percent", "noise"), [(0.3, 0.005), (1.0, 0.0)])
def test_a_light_press_of_60_s_loses_less_than_1_percent_of_itself(percent, noise):
    assert drift_under_a_light_press(percent, noise)[PRESSED].mean() <= 0.01 * percent / 100


@pytest.mark.parametrize("percent", [0.0, 1.0])
def test_a_light_press_loses_nothing_beside_a_drift_at_the_bounded_rate(percent):
    rate = 1e-4  # 0.6 % of f_max a minute
    followed = drift_under_a_light_press(percent, 0.005, drift=rate)
    if percent:  # what had drifted before it, and no more: of 2 s
        assert followed[PRESSED].mean() <= 2 * rate + 0.01 * percent / 100
    # Untouched taxels follow, by the lag of the time constant less: 62 s and 10 s, and noise.
    assert followed[FOLLOWED].mean() == pytest.approx(52 * rate, rel=0.1)


def test_the_drift_is_followed_again_after_a_light_press():
    chain = Chain(skin())
    run(chain, lambda t: 0.008 if 2 < t < 10 else 0.004 * (t > 10), 12)
    assert not chain.drift.value.any()
    run(chain, 0.004, 40)  # stamps go back: a new recording
    assert (chain.drift.value > 0).all()


def test_a_drift_slower_than_the_rate_is_followed_with_the_lag_of_the_time_constant():
    # A first-order low pass lags a ramp of rate q by tau q: 10 s x 1e-4 N/s.
    found = run(Chain(skin()), lambda t: 1e-4 * t, 200, rate_hz=20.0)
    np.testing.assert_allclose(found, 1e-3, rtol=0.02)


@pytest.mark.parametrize(("raw", "seconds", "followed"), [(-0.02, 400, -0.02), (-1.0, 2000, -0.25)])
def test_a_drift_is_followed_downwards_from_any_depth_to_a_tenth_of_the_range(
    raw, seconds, followed
):
    chain = Chain(skin())
    run(chain, raw, seconds, rate_hz=2.0)
    np.testing.assert_allclose(chain.drift.value, followed, atol=1e-4)


def test_a_pause_is_not_made_up_for():
    chain = Chain(skin())
    chain.apply(np.full(SHAPE, 0.005), 0)
    chain.apply(np.full(SHAPE, 0.005), 3600 * SECOND)
    assert (chain.drift.value <= 0.5 * 1e-4 * 2.5 + 1e-12).all()


def test_frames_of_a_board_that_hangs_repeat_exactly_and_show_no_drift():
    rng, chain = np.random.default_rng(0), Chain(skin(noise=0.0141))
    for k in range(300):
        raw = rng.normal(0.01, 0.0141, SHAPE)
        raw[0, 0] += 1.0
        chain.apply(raw, k * 10_000_000)
    followed = chain.drift.value.copy()
    assert followed.any()
    hung = [chain.apply(raw.copy(), (300 + k) * 10_000_000) for k in range(500)]
    np.testing.assert_array_equal(chain.drift.value, followed)
    # The drift that is subtracted is that before each frame.
    assert all(np.array_equal(one, hung[0]) for one in hung)
