"""Gains, curves, noise and faulty taxels from presses, against the skin that made the readings."""

from dataclasses import replace

import numpy as np
import pytest
from damaged import refusal

from sparseskin.nodes.sensor.calibration.chain import Chain
from sparseskin.nodes.sensor.calibration.fit import (
    GRAVITY,
    CalibrationError,
    Press,
    fit,
    read_area,
    read_load,
)

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
def test_a_curve_through_even_loads_is_exact_at_them_and_within_its_chords_between(curve):
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
        np.testing.assert_allclose(chain.apply(saturating(force), 0), force, atol=most + 1e-6)


def test_a_curve_that_differs_from_taxel_to_taxel_needs_one_each():
    knee = RNG.uniform(0.5, 3.0, SHAPE)

    def model(force):
        return BASELINE + 1500 * force / (force + knee)

    presses = [even(model, force) for force in LEVELS]
    worst = {}
    for curve in ("shared", "taxel"):
        found = fit("p", frames(model(0)), presses, curve=curve)
        worst[curve] = float(np.abs(Chain(found.skin, 0.0).apply(model(1.0), 0) - 1).max())
    assert worst["taxel"] < 1e-6 < 0.02 < worst["shared"]


def test_a_total_gives_one_gain_for_all():
    print_of_it = np.zeros(SHAPE)
    print_of_it[2:4, 3:6] = 0.7
    counts = BASELINE + 500 * print_of_it
    press = Press("5N", float(print_of_it.sum()), frames(counts))
    found = fit("p", frames(BASELINE), [press])
    np.testing.assert_allclose(found.skin.gains, 1 / 500)
    assert found.skin.f_max == pytest.approx(1.25 * 0.7, rel=0.05)
    assert found.remarks == ["f_max = 0.87 N is 1.25 times the largest force of a press"]


def test_totals_that_one_gain_does_not_explain_are_remarked():
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
    with pytest.raises(CalibrationError, match=r"1N: the load moves: .* let it stand still"):
        fit("p", frames(linear(0), sigma=1.0), [Press("1N", 1.0, moving, None)], f_max=2.0)
    touched = frames(linear(0), sigma=1.0)
    touched[:4] += 500 * (np.arange(N).reshape(SHAPE) < N // 4)
    found = fit("p", touched, f_max=2.0)
    assert found.remarks == ["2 % of the untouched readings come and go: was the skin touched?"]
    assert fit("p", frames(linear(0), sigma=1.0), f_max=2.0).remarks == []


def test_stuck_noisy_and_dead_taxels_are_masked():
    noise = np.random.default_rng(3).normal(0, 1.0, (200, *SHAPE))
    untouched, pressed = linear(0) + noise, linear(1.0) + noise[::-1]
    for readings in (untouched, pressed):
        readings[:, 0, 0] = 77.0
        readings[:, 1, 1] = linear(0)[1, 1] + 40 * noise[:, 1, 1]
    pressed[:, 2, 2] = untouched[:, 2, 2]
    found = fit("p", untouched, [Press("a", 1.0 * N, pressed, ALL)])
    assert (found.stuck, found.noisy, found.dead) == (1, 1, 1)
    assert found.skin.mask is not None
    assert [tuple(cell) for cell in np.argwhere(~found.skin.mask)] == [(0, 0), (1, 1), (2, 2)]
    # The dead ones carry their part of the load: the others still measure theirs.
    assert found.presses[0].measured == pytest.approx(N, rel=1e-3)


def test_a_skin_of_whole_counts_without_noise_has_no_stuck_taxels():
    found = fit("p", np.full((9, *SHAPE), 5.0), f_max=250.0, unit="raw")
    assert found.stuck == 0
    assert found.skin.mask is None
    assert (found.skin.unit, found.skin.noise) == ("raw", 0.0)


def test_taxels_under_no_even_load_get_the_median_gain():
    load = Press("a", 0.5 * 24, frames(linear(0.5)), read_area("0-5x0-3", SHAPE))
    found = fit("p", frames(linear(0)), [load])
    np.testing.assert_allclose(found.skin.gains[:, 4:], np.median(found.skin.gains[:, :4]))
    assert "24 taxels lay under no even load: they have the median gain" in found.remarks


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"untouched": frames(BASELINE)[:1]}, "untouched: 1 frames; at least 2 are needed"),
        ({"presses": [replace(even(linear, 1.0), frames=np.ones((2, 3, 3)))]}, "frames of shape"),
        (
            {"presses": [even(linear, 0.5), replace(even(linear, 0.4), force=N)]},
            "readings do not rise with the force of a taxel",
        ),
        ({"presses": [Press("1N", 1.0, frames(BASELINE))]}, "1N: no taxel reads more than its no"),
        ({"f_max": None}, "the range is not known"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(change, line):
    values = {"untouched": frames(BASELINE), "presses": [], "f_max": None}
    assert line in refusal(lambda: fit("p", **(values | change)), CalibrationError)


def test_loads_and_areas_are_read():
    assert read_load("500g") == pytest.approx(0.5 * GRAVITY)
    assert read_load(" 2.5 kg") == pytest.approx(2.5 * GRAVITY)
    assert (read_load("4.9N"), read_load("800mN")) == (4.9, 0.8)
    assert read_area("all", SHAPE).all()
    rows, cols = np.nonzero(read_area("1-2x3-4", SHAPE))
    assert (list(rows), list(cols)) == ([1, 1, 2, 2], [3, 4, 3, 4])
    for text in ("5", "5lb", "-5g", "1e9g", "nanN"):
        with pytest.raises(CalibrationError, match="is no load"):
            read_load(text)
    for text in ("1-2", "some", "0-6x0-7", "2-1x0-0"):
        with pytest.raises(CalibrationError):
            read_area(text, SHAPE)
