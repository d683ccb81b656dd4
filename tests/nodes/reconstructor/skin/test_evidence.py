"""Measurements held out of a solve: the error of an estimate, and the choice between two models."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.skin.evidence import HAAR, SMOOTH, HeldOut
from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.reconstructor.solvers.projection import make_projection

N, M = 1600, 400
N_HELD = M // TUNING.held_one_of


def held_out(n: int = N, m: int = M, one_by_one: bool = False) -> HeldOut:
    return HeldOut(make_projection(make_phi("sbhe", n, m, seed=0)), n, m, one_by_one)


def residual(mean_square: float) -> Floats:
    """Held-out residuals of one magnitude and both signs."""
    signs = np.where(np.arange(N_HELD) % 2, 1, -1)
    return (math.sqrt(mean_square) * signs).astype(np.float32)


def frame(held: HeldOut, haar: float, smooth: float, noise: float = 0.0) -> tuple[str, ...]:
    """Process a frame in which each model has this mean square; return those that were asked."""
    asked = held.models(failed=False, coarse=False)
    errors = {HAAR: haar, SMOOTH: smooth}
    held.choose({name: residual(errors[name]) for name in asked}, noise, failed=False, gain=0.0)
    return asked


@pytest.mark.parametrize(
    ("n", "m", "one_by_one", "n_held"),
    [
        (N, M, False, N_HELD),
        (N, 1024, False, TUNING.held_most),
        (64, 8, False, 1),
        (64, 64, False, 0),
        (64, 21, True, 0),
        (64, 64, True, 0),
    ],
)
def test_one_measurement_of_16_is_held_out_and_none_where_all_are_predicted_or_measured(
    n: int, m: int, one_by_one: bool, n_held: int
) -> None:
    held = held_out(n, m, one_by_one)
    assert held.measurements.size == np.unique(held.measurements).size == n_held
    assert np.count_nonzero(held.kept == 0) == n_held
    assert np.count_nonzero(held.kept == 1) == held.kept.size - n_held
    assert held.tests == (m < n)


def test_the_same_measurements_are_held_out_of_numpy_and_of_compiled_loops() -> None:
    pytest.importorskip("numba")
    n, m = 203, 50
    subsets = row_subsets(make_phi("sbhe", n, m, seed=0), "rotating")
    numbers = np.arange(1, m + 1, dtype=np.float32)
    found = []
    for compiled in (False, True):
        projection = make_projection(subsets[0], compiled)
        held = HeldOut(projection, n, m, one_by_one=False)
        for k, phi in enumerate(subsets):
            projection.use(phi)
            held.use(k)
            rows = np.zeros(projection.n_rows, dtype=np.float32)
            projection.rows_of(numbers, rows)
            left = rows[held.kept == 0]
            np.testing.assert_array_equal(np.sort(left), held.measurements + 1)
            np.testing.assert_array_equal(held.residual(rows, 0 * rows), left)
            found.append(held.measurements)
    assert len(found) == 2 * len(subsets)
    for one, other in zip(found[: len(subsets)], found[len(subsets) :], strict=True):
        np.testing.assert_array_equal(one, other)


def normal_errors(mean_square: float, noise: float, n_frames: int = 400) -> list[float]:
    """error2 of frames whose held-out residuals are normal."""
    rng = np.random.default_rng(0)
    held, found = held_out(), []
    for _ in range(n_frames):
        drawn = rng.normal(0, math.sqrt(mean_square), N_HELD).astype(np.float32)
        held.choose({HAAR: drawn}, noise, failed=False, gain=0.0)
        found.append(held.error2(noise))
    return found


def test_residuals_that_are_noise_are_no_error() -> None:
    """A mean of squares is 2 of its standard deviations too large in about 3 frames of 100."""
    noise = 4e-4
    found = normal_errors(noise, noise)
    assert np.count_nonzero(found) < 0.1 * len(found)
    assert max(found) < noise


def test_residuals_far_above_the_noise_are_the_error() -> None:
    found = normal_errors(1.0, noise=1e-4)
    # The larger of two means is above their expectation of 1.
    assert 1.0 < np.mean(found) < 1.3
    assert min(found) > 0.6
    held = held_out()
    for _ in range(30):
        held.choose({HAAR: residual(0.25)}, 1e-4, failed=False, gain=0.0)
    assert held.error2(1e-4) == pytest.approx(0.25, rel=1e-2)


def test_a_single_bad_frame_counts_in_full_at_once_and_ends_with_what_caused_it() -> None:
    held = held_out()
    for _ in range(10):
        held.choose({HAAR: residual(1e-4)}, 0.0, failed=False, gain=0.0)
    held.choose({HAAR: residual(1.0)}, 0.0, failed=False, gain=0.0)
    assert held.error2(0.0) == pytest.approx(1, rel=1e-5)
    held.choose({HAAR: residual(1e-4)}, 0.0, failed=False, gain=0.0)
    assert held.error2(0.0) == pytest.approx(
        (TUNING.error_memory * TUNING.error_fading + 1 - TUNING.error_memory) * 1e-4, rel=1e-4
    )
    # Errors before a scene jumped are forgotten.
    held.choose({HAAR: residual(1e-6)}, 0.0, failed=True, gain=0.0)
    assert held.error2(0.0) == pytest.approx(1e-6, rel=1e-5)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3, 1.0])
@pytest.mark.parametrize(("above", "model"), [(-0.02, HAAR), (0.02, SMOOTH)])
def test_the_smooth_model_is_chosen_only_if_haars_error_exceeds_its_own_by_the_noise(
    above: float, model: str, noise: float
) -> None:
    smooth = 0.3
    clearly = 1 + 2 * TUNING.margin / math.sqrt(N_HELD * TUNING.error_frames)
    held = held_out()
    for _ in range(TUNING.trial):
        # Held-out residuals bound the noise, too.
        frame(held, clearly * smooth + min(noise, smooth) + above, smooth, noise)
    assert held.model == model


def waits(haar: float, smooth: float, n_frames: int) -> list[int]:
    """Frames from the end of a comparison to the begin of the next."""
    held = held_out()
    compared = [len(frame(held, haar, smooth)) == 2 for _ in range(n_frames)]
    begins = [k for k in range(n_frames) if compared[k] and not (k and compared[k - 1])]
    assert begins[0] == 0
    for begin in begins[:-1]:
        assert all(compared[begin : begin + TUNING.trial])
    return [int(gap) - TUNING.trial + 1 for gap in np.diff(begins)]


def test_models_are_compared_more_rarely_while_the_same_is_better() -> None:
    found = waits(1.0, 1.5, 500)
    assert found[:4] == [8, 16, 32, 64]
    assert set(found[4:]) == {TUNING.seldom}
    # A change of the model comes first.
    found = waits(2.0, 1.0, 500)
    assert found[:5] == [4, 8, 16, 32, 64]
    assert set(found[5:]) == {TUNING.seldom}


def test_models_are_compared_where_the_error_exceeds_the_noise_or_is_large() -> None:
    held = held_out()
    for _ in range(100):
        frame(held, 1.0, 0.9, noise=1.0)
    assert held.models(failed=False, coarse=False) == (HAAR,)
    assert held.suffices(residual(1.0), 1.0)
    assert not held.suffices(residual(4.0), 1.0)
    assert held.models(failed=False, coarse=True) == (HAAR, SMOOTH)
    assert held.models(failed=True, coarse=False) == (HAAR, SMOOTH)
    # What exceeds the noise asks for a comparison in the next frame.
    frame(held, 4.0, 0.5, noise=1.0)
    assert frame(held, 4.0, 0.5, noise=1.0) == (HAAR, SMOOTH)


def test_models_are_compared_at_once_when_the_error_doubles() -> None:
    held = held_out()
    for _ in range(60):
        frame(held, 1.0, 2.0)
    assert frame(held, 0.95 * TUNING.worse, 4.0) == (HAAR,)
    assert frame(held, 1.0, 4.0) == (HAAR,)
    for _ in range(5):
        frame(held, 1.0, 4.0)
    assert frame(held, 1.1 * TUNING.worse, 4.0) == (HAAR,)
    assert frame(held, 1.1 * TUNING.worse, 4.0) == (HAAR, SMOOTH)


@pytest.mark.parametrize(
    ("n", "m", "one_by_one", "model"),
    [
        (N, TUNING.comparable - 1, False, SMOOTH),
        (256, TUNING.comparable - 1, True, SMOOTH),
        (256, 256, False, HAAR),
    ],
)
def test_models_that_cannot_be_compared_are_not(
    n: int, m: int, one_by_one: bool, model: str
) -> None:
    held = held_out(n, m, one_by_one)
    for failed in (True, False, True):
        assert held.models(failed, coarse=False) == (model,)
        held.choose({model: residual(1.0)}, 0.0, failed, gain=0.0)
    assert held.model == model


def test_reset_forgets_all_frames() -> None:
    held = held_out()
    for _ in range(30):
        frame(held, 9.0, 1.0)
    assert (held.model, held.error2(0.0) > 0) == (SMOOTH, True)
    held.reset()
    assert (held.model, held.error2(0.0)) == (HAAR, 0)
    assert held.models(failed=False, coarse=False) == (HAAR, SMOOTH)


@pytest.mark.parametrize(("gain", "chosen"), [(0.0, HAAR), (1.0, SMOOTH)])
def test_the_noise_that_haar_averages_out_counts_as_far_as_it_does(
    gain: float, chosen: str
) -> None:
    held = held_out()
    errors = {HAAR: residual(1.5), SMOOTH: residual(1.0)}
    assert held.choose(errors, 1.0, failed=True, gain=gain) == chosen
