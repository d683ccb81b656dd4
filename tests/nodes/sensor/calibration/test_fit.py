"""Gains, curves and faults from presses; the chain from counts to newtons, and its drift."""

from dataclasses import replace

import numpy as np
import pytest
from damaged import refusal
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sparseskin.nodes.sensor.calibration.chain import Chain
from sparseskin.nodes.sensor.calibration.description import Response, SkinDescription
from sparseskin.nodes.sensor.calibration.fit import (
    GRAVITY,
    CalibrationError,
    Press,
    fit,
    read_area,
    read_load,
)
from sparseskin.nodes.sensor.saturation import Clipped

SHAPE = (6, 8)
N = SHAPE[0] * SHAPE[1]
RNG = np.random.default_rng(2)
BASELINE = RNG.uniform(40, 90, SHAPE)
GAIN = RNG.lognormal(0, 0.3, SHAPE)
ALL = np.ones(SHAPE, np.bool_)


def linear(force):
    """Counts of a linear skin: 500 a newton for a taxel of gain 1."""
    return BASELINE + 500 * GAIN * force


def saturating(force):
    """Counts of a skin whose response is concave, of one shape for all taxels."""
    return BASELINE + 1500 * GAIN * force / (force + 1.0)


def frames(counts, n=50, sigma=0.0):
    return counts + np.random.default_rng(0).normal(0, sigma, (n, *SHAPE))


def even(model, force, **noise):
    return Press(f"{force:g}", force * N, frames(model(force), **noise), ALL)


def test_even_loads_give_each_taxel_of_a_linear_skin_its_gain():
    found = fit("p", frames(linear(0)), [even(linear, 0.5)], f_max=2.0)
    np.testing.assert_allclose(found.skin.gains, 1 / (500 * GAIN), rtol=1e-9)
    np.testing.assert_allclose(found.skin.baseline, BASELINE)
    assert found.skin.response is None
    chain = Chain(found.skin, 0.0)
    force = RNG.uniform(0, 2, SHAPE)
    np.testing.assert_allclose(chain.apply(linear(force), 0), force, atol=1e-6)
    (result,) = found.presses
    assert result.measured == pytest.approx(result.force)
    assert result.spread == pytest.approx(0, abs=1e-9)
    assert result.spread_before == pytest.approx(GAIN.std() / GAIN.mean())


LEVELS = np.linspace(0.1, 2.0, 20)


@pytest.mark.parametrize("curve", ["shared", "taxel"])
def test_a_curve_through_even_loads_is_exact_at_them_and_within_its_chords_between(
    curve,
):
    presses = [even(saturating, force) for force in LEVELS]
    chain = Chain(fit("p", frames(saturating(0)), presses, curve=curve).skin, 0.0)
    for force in LEVELS:
        np.testing.assert_allclose(chain.apply(saturating(force), 0), force, rtol=1e-6)
    # Between two knots of spacing h in force the chord errs by at most h**2 / 8 x the curvature of
    # force over reading, in newtons: |f''| h_u**2 / 8 with u = f / (f + 1), f'' = 2 / (1 - u)**3.
    for force in (LEVELS[1:] + LEVELS[:-1]) / 2:
        high = force + 0.05
        u = np.array([force - 0.05, high]) / (np.array([force - 0.05, high]) + 1)
        most = 2 / (1 - u[1]) ** 3 * (u[1] - u[0]) ** 2 / 8
        np.testing.assert_allclose(
            chain.apply(saturating(force), 0), force, atol=most + 1e-6
        )


def test_a_curve_that_differs_from_taxel_to_taxel_needs_one_each():
    knee = RNG.uniform(0.5, 3.0, SHAPE)

    def model(force):
        return BASELINE + 1500 * force / (force + knee)

    presses = [even(model, force) for force in LEVELS]
    worst = {}
    for curve in ("shared", "taxel"):
        found = fit("p", frames(model(0)), presses, curve=curve)
        worst[curve] = float(
            np.abs(Chain(found.skin, 0.0).apply(model(1.0), 0) - 1).max()
        )
    assert worst["taxel"] < 1e-6 < 0.02 < worst["shared"]


def test_totals_give_one_gain_for_all_and_those_that_it_does_not_explain_are_remarked():
    print_of_it = np.zeros(SHAPE)
    print_of_it[2:4, 3:6] = 0.7
    counts = BASELINE + 500 * print_of_it
    press = Press("5N", float(print_of_it.sum()), frames(counts))
    found = fit("p", frames(BASELINE), [press])
    np.testing.assert_allclose(found.skin.gains, 1 / 500)
    assert found.skin.f_max == pytest.approx(1.25 * 0.7, rel=0.05)
    assert found.remarks == [
        "f_max = 0.87 N is 1.25 times the largest force of a press"
    ]
    loads = [Press(f"{f}N", f * N, frames(saturating(f))) for f in (0.2, 2.0)]
    remarks = fit("p", frames(saturating(0)), loads).remarks
    assert any("off one gain for all" in line for line in remarks)


def test_noise_is_measured_in_newtons_and_a_short_touch_does_not_count():
    untouched = frames(linear(0), n=400, sigma=2.0)
    untouched[:20] += 300.0
    found = fit("p", untouched, [even(linear, 1.0, n=400)], keep_noise=True)
    # The median taxel of a standard deviation of 2 counts, known to 3.5 % each.
    assert found.skin.noise == pytest.approx(2.0 / (500 * np.median(GAIN)), rel=0.1)
    assert found.skin.f_min == pytest.approx(-4 * found.skin.noise, rel=0.05)
    np.testing.assert_allclose(found.skin.baseline, BASELINE, atol=0.6)


def test_a_load_that_moves_is_refused_and_a_touched_skin_remarked():
    # One taxel after the other: the frames read the load, the median of each taxel does not.
    moving = frames(linear(0), n=N, sigma=1.0)
    for k in range(N):
        moving[k].flat[k] += 500
    with pytest.raises(
        CalibrationError, match=r"1N: the load moves: .* let it stand still"
    ):
        fit(
            "p",
            frames(linear(0), sigma=1.0),
            [Press("1N", 1.0, moving, None)],
            f_max=2.0,
        )
    touched = frames(linear(0), sigma=1.0)
    touched[:4] += 500 * (np.arange(N).reshape(SHAPE) < N // 4)
    found = fit("p", touched, f_max=2.0)
    assert found.remarks == [
        "2 % of the untouched readings come and go: was the skin touched?"
    ]
    assert fit("p", frames(linear(0), sigma=1.0), f_max=2.0).remarks == []


def test_stuck_noisy_and_dead_taxels_are_masked():
    noise = np.random.default_rng(3).normal(0, 1.0, (200, *SHAPE))
    untouched = linear(0) + noise
    pressed = linear(1.0) + noise[::-1]
    for readings in (untouched, pressed):
        readings[:, 0, 0] = 77.0
        readings[:, 1, 1] = linear(0)[1, 1] + 40 * noise[:, 1, 1]
    pressed[:, 2, 2] = untouched[:, 2, 2]
    found = fit("p", untouched, [Press("a", 1.0 * N, pressed, ALL)])
    assert found.stuck == 1
    assert found.noisy == 1
    assert found.dead == 1
    assert found.skin.mask is not None
    assert [tuple(cell) for cell in np.argwhere(~found.skin.mask)] == [
        (0, 0),
        (1, 1),
        (2, 2),
    ]
    # The dead ones carry their part of the load: the others still measure theirs.
    assert found.presses[0].measured == pytest.approx(N, rel=1e-3)


@given(st.integers(0, 2**32 - 1), st.integers(0, N - 8))
def test_cells_without_a_taxel_hide_no_stuck_taxel(seed, n_masked):
    rng = np.random.default_rng(seed)
    cells = rng.permutation(N)
    stuck = cells[:3]
    mask = np.ones(SHAPE, np.bool_)
    mask.reshape(-1)[cells[3 : 3 + n_masked]] = False

    # Wires without a taxel read a constant.
    readings = frames(linear(0), sigma=1.0)
    readings[:, ~mask] = 0.0
    readings.reshape(len(readings), N)[:, stuck] = 77.0
    found = fit("p", readings, f_max=2.0, mask=mask)

    works = mask.copy()
    works.reshape(-1)[stuck] = False
    assert found.stuck == len(stuck)
    np.testing.assert_array_equal(found.skin.mask, works)


@pytest.mark.parametrize(("n_noisy", "is_remarked"), [(1, False), (2, True), (4, True)])
def test_more_than_1_percent_of_noisy_taxels_were_touched(n_noisy, is_remarked):
    noise = np.random.default_rng(5).normal(0, 1.0, (50, 10, 15))
    noise.reshape(50, -1)[:, :n_noisy] *= 40
    remarks = fit("p", 60 + noise, f_max=2.0).remarks
    text = f"{n_noisy} taxels are noisy: was the skin touched where it should not be?"
    assert remarks == [text] * is_remarked


def test_whole_counts_are_not_stuck_and_taxels_under_no_even_load_get_the_median_gain():
    found = fit("p", np.full((9, *SHAPE), 5.0), f_max=250.0, unit="raw")
    assert found.stuck == 0
    assert found.skin.mask is None
    assert found.skin.unit == "raw"
    assert found.skin.noise == 0.0
    load = Press("a", 0.5 * 24, frames(linear(0.5)), read_area("0-5x0-3", SHAPE))
    found = fit("p", frames(linear(0)), [load])
    np.testing.assert_allclose(
        found.skin.gains[:, 4:], np.median(found.skin.gains[:, :4])
    )
    assert (
        "24 taxels lay under no even load: they have the median gain" in found.remarks
    )


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"untouched": frames(BASELINE)[:1]},
            "untouched: 1 frames; at least 2 are needed",
        ),
        (
            {"presses": [replace(even(linear, 1.0), frames=np.ones((2, 3, 3)))]},
            "frames of shape",
        ),
        (
            {"presses": [even(linear, 0.5), replace(even(linear, 0.4), force=N)]},
            "readings do not rise with the force of a taxel",
        ),
        (
            {"presses": [Press("1N", 1.0, frames(BASELINE))]},
            "1N: no taxel reads more than its no",
        ),
        ({"f_max": None}, "the range is not known"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(change, line):
    values = {"untouched": frames(BASELINE), "presses": [], "f_max": None}
    assert line in refusal(lambda: fit("p", **(values | change)), CalibrationError)


def test_loads_and_areas_are_read():
    assert read_load("500g") == pytest.approx(0.5 * GRAVITY)
    assert read_load(" 2.5 kg") == pytest.approx(2.5 * GRAVITY)
    assert read_load("4.9N") == 4.9
    assert read_load("800mN") == 0.8
    assert read_area("all", SHAPE).all()
    rows, cols = np.nonzero(read_area("1-2x3-4", SHAPE))
    assert list(rows) == [1, 1, 2, 2]
    assert list(cols) == [3, 4, 3, 4]
    for text in ("5", "5lb", "-5g", "1e9g", "nanN"):
        with pytest.raises(CalibrationError, match="is no load"):
            read_load(text)
    for text in ("1-2", "some", "0-6x0-7", "2-1x0-0"):
        with pytest.raises(CalibrationError):
            read_area(text, SHAPE)


GRID = (3, 4)
SECOND = 1_000_000_000


def skin(**changes):
    return SkinDescription("palm", *GRID, 2.5, **changes)


def still(description):
    """A chain that follows no drift."""
    return Chain(description, drift_rate=0.0)


counts = arrays(np.float64, GRID, elements=st.floats(0, 4095))
gains = arrays(
    np.float64, GRID, elements=st.floats(1e-4, 1e-2) | st.floats(-1e-2, -1e-4)
)
pressed = arrays(np.float64, GRID, elements=st.floats(0, 2.5))


@given(counts, gains, pressed)
def test_forces_come_back_from_counts(baseline, gain, force):
    curve = Response(np.array([0.2, 1.0, 2.0]), np.array([0.5, 1.2, 2.5]))
    raw = baseline + Response(curve.force, curve.reading).forces(force) / gain
    chain = still(skin(baseline=baseline, gains=gain, response=curve))
    np.testing.assert_allclose(chain.apply(raw, 0), force, atol=1e-6)


def test_a_tare_is_a_median_so_that_a_short_touch_does_not_count_and_forgets_the_drift():
    chain = Chain(skin(baseline=np.zeros(GRID)))
    run(chain, -0.02, 10)
    assert chain.drift.value.any()
    chain.tare([np.full(GRID, 7.0)] * 20 + [np.full(GRID, 900.0)] * 9)
    line = chain.state()["tared"]
    assert line.startswith(
        "forces changed by at most 7 N, of 12 taxels by more than 5 %"
    )
    assert not chain.drift.value.any()
    assert (chain.apply(np.full(GRID, 9.0), 0) == 2.0).all()
    first = Chain(skin())
    first.tare([np.full(GRID, 7.0)])
    assert first.state()["tared"] == "forces changed by at most 7 N"


def test_a_tare_measures_the_noise_that_no_file_states():
    rng = np.random.default_rng(0)
    chain = Chain(skin())
    stated = Chain(skin(noise=0.02))
    frames = [rng.normal(3.0, 0.01, GRID) for _ in range(1000)]
    for frame in frames[::7]:
        frame[1, 2] = np.nan
    for one in (chain, stated):
        one.tare(frames)
    # The deviation of 100 frames is off by 1 / sqrt(200) of itself, the median of 12 by a third.
    assert chain.description.sigmas == pytest.approx((0.01, 0.01), rel=0.1)
    assert stated.description.sigmas == (0.02, 0.02)


def test_masked_cells_are_0_and_readings_beyond_the_range_are_clipped_and_counted():
    mask = np.ones(GRID, dtype=np.bool_)
    mask[1, 2] = False
    raw = np.full(GRID, 1.5)
    raw[1, 2] = 1e9
    chain = still(skin(mask=mask))
    forces = chain.apply(raw, 0)
    assert forces[1, 2] == 0
    assert (forces[mask] == 1.5).all()
    assert chain.clipped.n == 0
    chain = still(skin(noise=0.01))
    raw = np.zeros(GRID)
    raw[0, :3] = 3.0, -0.05, -0.07
    assert list(chain.apply(raw, 0)[0]) == [2.5, 0, 0, 0]
    assert chain.clipped == Clipped(n_below=1, n_above=1, lowest=-0.07, highest=3.0)


def test_a_lower_end_below_0_keeps_the_mean_of_noise_centred_on_0():
    rng = np.random.default_rng(3)
    chain = still(skin(noise=0.01, f_min=-0.05))
    frames = np.stack([chain.apply(rng.normal(0, 0.01, GRID), 0) for _ in range(4000)])
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
            np.broadcast_to(np.asarray(value, float), GRID), round(t * SECOND)
        )
    return found


def test_a_steady_press_of_60_s_and_its_edge_lose_nothing():
    # The threshold of a skin whose noise is not known: 0.004 of 2.5 N.
    press = np.zeros(GRID)
    press[1, 1] = 1.0
    press[1, 2] = 0.008
    press[2, 3] = 0.011
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
    assert (
        drift_under_a_light_press(percent, noise)[PRESSED].mean()
        <= 0.01 * percent / 100
    )


@pytest.mark.parametrize("percent", [0.0, 1.0])
def test_a_light_press_loses_nothing_beside_a_drift_at_the_bounded_rate(percent):
    rate = 1e-4  # 0.6 % of f_max a minute
    followed = drift_under_a_light_press(percent, 0.005, drift=rate)
    if percent:  # what had drifted before it, and no more: of 2 s
        assert followed[PRESSED].mean() <= 2 * rate + 0.01 * percent / 100
    # Untouched taxels follow, by the lag of the time constant less: 62 s and 10 s, and noise.
    assert followed[FOLLOWED].mean() == pytest.approx(52 * rate, rel=0.1)


def test_a_slow_drift_is_followed_with_the_lag_of_the_time_constant_and_again_after_a_press():
    chain = Chain(skin())
    run(chain, lambda t: 0.008 if 2 < t < 10 else 0.004 * (t > 10), 12)
    assert not chain.drift.value.any()
    run(chain, 0.004, 40)  # stamps go back: a new recording
    assert (chain.drift.value > 0).all()
    # A first-order low pass lags a ramp of rate q by tau q: 10 s x 1e-4 N/s.
    found = run(Chain(skin()), lambda t: 1e-4 * t, 200, rate_hz=20.0)
    np.testing.assert_allclose(found, 1e-3, rtol=0.02)


@pytest.mark.parametrize(
    ("raw", "seconds", "followed"), [(-0.02, 400, -0.02), (-1.0, 2000, -0.25)]
)
def test_a_drift_is_followed_downwards_to_a_tenth_of_the_range(raw, seconds, followed):
    chain = Chain(skin())
    run(chain, raw, seconds, rate_hz=2.0)
    np.testing.assert_allclose(chain.drift.value, followed, atol=1e-4)


def test_a_pause_is_not_made_up_for():
    chain = Chain(skin())
    chain.apply(np.full(GRID, 0.005), 0)
    chain.apply(np.full(GRID, 0.005), 3600 * SECOND)
    assert (chain.drift.value <= 0.5 * 1e-4 * 2.5 + 1e-12).all()


def test_frames_of_a_board_that_hangs_repeat_exactly_and_show_no_drift():
    rng = np.random.default_rng(0)
    chain = Chain(skin(noise=0.0141))
    for k in range(300):
        raw = rng.normal(0.01, 0.0141, GRID)
        raw[0, 0] += 1.0
        chain.apply(raw, k * 10_000_000)
    followed = chain.drift.value.copy()
    assert followed.any()
    hung = [chain.apply(raw.copy(), (300 + k) * 10_000_000) for k in range(500)]
    np.testing.assert_array_equal(chain.drift.value, followed)
    # The drift that is subtracted is that before each frame.
    assert all(np.array_equal(one, hung[0]) for one in hung)
