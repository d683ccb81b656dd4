"""Noise level, weight and clip bias: found in the measurements of a skin nobody described."""

from __future__ import annotations

import numpy as np
import pytest
from reconstructor.pressed import noisy, sliding_disc

from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.reconstructor.clip_bias import ClipBias
from sparseskin.nodes.reconstructor.kalman_weight import LEAST_WEIGHT, KalmanWeight
from sparseskin.nodes.reconstructor.noise_level import JUMP, NoiseLevel
from sparseskin.nodes.reconstructor.projection import make_projection
from sparseskin.nodes.sensor.noise import PAPER_SIGMA_END_N

SIGMA_N = 0.02


def drifting(n_frames: int, per_frame_n: float, m: int = 500) -> np.ndarray:
    """Measurements that all change at a constant rate, with noise."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, SIGMA_N, (n_frames, m))
    return (noise + per_frame_n * np.arange(n_frames)[:, None]).astype(np.float32)


@pytest.mark.parametrize("per_frame_n", [0.0, 0.01, 0.5])
def test_the_level_is_the_noises_however_fast_the_forces_change(per_frame_n: float) -> None:
    level = NoiseLevel(500)
    for y in drifting(30, per_frame_n):
        level.update(y, e2=1.5 * SIGMA_N**2)
    assert level.s2 == pytest.approx(SIGMA_N**2, rel=0.15)


def test_the_level_is_never_above_the_misfit() -> None:
    level = NoiseLevel(500)
    for y in np.random.default_rng(0).normal(0, 1, (30, 500)).astype(np.float32):
        level.update(y, e2=SIGMA_N**2)
    assert level.s2 <= SIGMA_N**2


def test_a_jump_is_told_and_does_not_raise_the_level() -> None:
    level = NoiseLevel(500)
    for k, y in enumerate(drifting(30, 0.0)):
        level.update(y, e2=SIGMA_N**2)
        assert level.jumped == (k == 0)
    before = level.s2
    jumped = drifting(1, 0.0)[0] + 1
    level.update(jumped, e2=1.1 * JUMP * before)
    assert level.jumped
    assert level.s2 < 1.5 * before
    level.update(jumped, e2=SIGMA_N**2)
    assert not level.jumped


def test_the_bias_of_an_untouched_skin_is_found() -> None:
    """0.399 sigma: the mean of normal noise whose negative half is 0."""
    n, m = 1600, 533
    phi = make_phi("sbhe", n, m, seed=0)
    projection = make_projection(phi)
    bias = ClipBias(projection, n)
    rows = np.zeros(projection.n_rows, dtype=np.float32)
    nothing = np.zeros(n, dtype=np.float32)
    frames = noisy(np.zeros((40, n), dtype=np.float32))
    for y in phi.forward(frames):
        projection.rows_of(y, rows)
        bias.take_off(rows)
        bias.update(float(bias.ones @ rows), nothing, s2=float(rows @ rows) / m)
    assert bias.b == pytest.approx(PAPER_SIGMA_END_N / np.sqrt(2 * np.pi), rel=0.1)


def test_a_force_everywhere_is_not_taken_for_bias() -> None:
    """What noise of that level cannot cause stays a force."""
    phi = make_phi("sbhe", 1600, 533, seed=0)
    bias = ClipBias(make_projection(phi), 1600)
    pressed = np.full(1600, 0.5, dtype=np.float32)
    for _ in range(50):
        bias.update(0.0, pressed, s2=0.01**2)
    assert bias.b <= 0.01


def test_forces_are_the_means_of_clipped_readings_turned_back() -> None:
    """E max(0, f + sigma n), less b, gives f again to within 0.03 b."""
    sigma = PAPER_SIGMA_END_N
    forces = np.linspace(0, 6 * sigma, 60)
    normal = np.random.default_rng(0).normal(0, sigma, 200_001)
    normal -= normal.mean()
    means = np.array([np.maximum(0, f + normal).mean() for f in forces])
    bias = ClipBias(make_projection(make_phi("sbhe", 64, 32, seed=0)), 64)
    bias.b = float(means[0])
    turned = (means - bias.b).astype(np.float32)
    bias.give_back(turned)
    np.testing.assert_allclose(turned, forces, atol=0.035 * bias.b)


def test_the_noise_of_a_touched_skin_is_found_in_its_measurements() -> None:
    truth = sliding_disc((40, 40), 60)
    phi = make_phi("sbhe", 1600, 533, seed=0)
    taxels = noisy(truth)
    y = phi.forward(taxels.reshape(-1, 1600))
    clean = phi.forward(truth.reshape(-1, 1600))
    level = NoiseLevel(533)
    for one in y:
        level.update(one, e2=1.0)
    assert level.s2 == pytest.approx(float((y - clean)[40:].var()), rel=0.25)


def misfits(n_frames: int, scale: float = 1.0) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, scale * SIGMA_N, (n_frames, 500))
    return noise.astype(np.float32)


def test_noise_alone_is_averaged_over_all_frames_since_the_last_jump() -> None:
    weight = KalmanWeight(500)
    weights = []
    for k, misfit in enumerate(misfits(12)):
        weight.update(misfit, 500, 1.2 * SIGMA_N**2, jumped=k == 0)
        weights.append(weight.weight)
    np.testing.assert_allclose(weights, 1 / np.arange(1, 13), rtol=1e-6)


@pytest.mark.parametrize("scale", [2.0, 5.0])
def test_what_is_more_than_noise_is_news(scale: float) -> None:
    """K = P / (P + R), P + R the mean square of the misfit, to within what is not doubted."""
    weight = KalmanWeight(500)
    for misfit in misfits(40):
        weight.update(misfit, 500, SIGMA_N**2, jumped=False)
    assert weight.weight < 0.25
    weight.update(misfits(1, scale)[0], 500, SIGMA_N**2, jumped=False)
    assert weight.weight == pytest.approx(1 - 1 / scale**2, abs=0.05)
    weight.update(misfits(1)[0], 500, SIGMA_N**2, jumped=True)
    assert weight.weight == 1


def test_misfits_that_are_alike_raise_the_weight_whatever_the_noise_level_says() -> None:
    lagging = np.full(500, SIGMA_N, dtype=np.float32)
    weight = KalmanWeight(500)
    for misfit in misfits(30):
        weight.update(misfit, 500, SIGMA_N**2, jumped=False)
    assert LEAST_WEIGHT <= weight.weight < 0.25
    for _ in range(15):
        weight.update(lagging, 500, SIGMA_N**2, jumped=False)
    assert weight.weight > 0.8


def test_where_rows_rotate_frames_of_one_phase_are_compared() -> None:
    """Phases differ far more from each other than noise does; that is not taken for noise."""
    level = NoiseLevel(500)
    rng = np.random.default_rng(0)
    offsets = rng.normal(0, 1, (3, 500))
    for k in range(60):
        level.use(k % 3)
        y = offsets[k % 3] + rng.normal(0, SIGMA_N, 500)
        level.update(y.astype(np.float32), e2=2 * SIGMA_N**2)
    assert level.s2 == pytest.approx(SIGMA_N**2, rel=0.15)


def test_what_a_frame_cannot_explain_bounds_the_level_of_the_next() -> None:
    level = NoiseLevel(500)
    for y in np.random.default_rng(0).normal(0, 1, (30, 500)).astype(np.float32):
        level.limit(SIGMA_N**2)
        level.update(y, e2=1.0)
    assert level.s2 == pytest.approx(SIGMA_N**2, rel=1e-3)


def test_where_rows_rotate_each_phase_has_been_averaged_over_its_own_frames() -> None:
    weight = KalmanWeight(500)
    weights = []
    for k, misfit in enumerate(misfits(12)):
        weight.use(k % 3)
        weight.update(misfit, 500, 1.2 * SIGMA_N**2, jumped=k < 3)
        weights.append(weight.weight)
    expected = np.repeat([1, 1 / 2, 1 / 3, 1 / 4], 3)
    np.testing.assert_allclose(weights, expected, rtol=1e-6)


def test_a_noisy_contact_does_not_let_the_bias_grow() -> None:
    """The bias is an untouched taxel's: what the least noise of the skin allows."""
    bias = ClipBias(make_projection(make_phi("sbhe", 1600, 533, seed=0)), 1600)
    pressed = np.full(1600, 0.5, dtype=np.float32)
    bias.update(0.0, pressed, s2=0.01**2)
    for _ in range(50):
        bias.update(0.0, pressed, s2=0.1**2)
    assert bias.b < 0.01
