"""Noise level, gain and clip bias, estimated from the measurements alone."""

from __future__ import annotations

import numpy as np
import pytest
from pressed import noisy, sliding_disc

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.reconstructor.skin.clip_bias import ClipBias
from sparseskin.nodes.reconstructor.skin.gain import AdaptiveGain
from sparseskin.nodes.reconstructor.skin.noise_level import NoiseLevel, row_power
from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.reconstructor.solvers.projection import make_projection
from sparseskin.nodes.sensor.noise import PAPER_SIGMA_END_N

SIGMA_N = 0.02


def drifting(n_frames: int, per_frame_n: float, m: int = 500) -> np.ndarray:
    """Measurements that all change at a constant rate, with noise."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, SIGMA_N, (n_frames, m))
    return (noise + per_frame_n * np.arange(n_frames)[:, None]).astype(np.float32)


def follow_level(level: NoiseLevel, y: np.ndarray, e2: float) -> None:
    """Process the measurements of a frame, as the solver does."""
    level.follow(e2, *level.changes(y), jumped=False)


def follow_gain(
    gain: AdaptiveGain,
    innovation: np.ndarray,
    correction: np.ndarray,
    m: int,
    s2: float,
    jumped: bool,
) -> None:
    """Process innovation and last correction of a frame, as the solver does."""
    products = ((innovation, innovation), (innovation, correction), (correction, correction))
    gain.follow(*(float(np.dot(a, b)) for a, b in products), m, s2, jumped)


@pytest.mark.parametrize(
    ("m", "n_subsets", "relative"), [(500, 1, 0.15), (500, 3, 0.15), (40_000, 1, 0.02)]
)
@pytest.mark.parametrize("per_frame_n", [0.0, 0.01, 0.5])
def test_the_level_is_the_noises_however_fast_the_forces_change_and_row_subsets_differ(
    per_frame_n: float, m: int, n_subsets: int, relative: float
) -> None:
    level, offsets = NoiseLevel(m), np.random.default_rng(1).normal(0, 1, (n_subsets, m))
    for k, y in enumerate(drifting(30 * n_subsets, per_frame_n, m)):
        level.use(k % n_subsets)
        follow_level(level, y + offsets[k % n_subsets].astype(np.float32), e2=1.5 * SIGMA_N**2)
    assert level.s2 == pytest.approx(SIGMA_N**2, rel=relative)


def test_the_level_is_never_above_the_innovation() -> None:
    level = NoiseLevel(500)
    for y in np.random.default_rng(0).normal(0, 1, (30, 500)).astype(np.float32):
        follow_level(level, y, e2=SIGMA_N**2)
    assert level.s2 <= SIGMA_N**2


def test_equal_frames_leave_the_level_at_the_stated_noise() -> None:
    level, unstated = NoiseLevel(500), NoiseLevel(500)
    level.stated = SIGMA_N**2
    read = drifting(1, 0.0)[0]
    for one in (level, unstated):
        for y in [*drifting(10, 0.0), *[read] * 100, *[0 * read] * 100]:
            one.follow(SIGMA_N**2, *one.changes(y), jumped=False, power=float(np.mean(y * y)))
    assert level.s2 == SIGMA_N**2
    assert unstated.s2 < 1e-6 * SIGMA_N**2


@pytest.mark.parametrize("kind", ["sbhe", "gaussian", "local:8"])
def test_noise_of_taxels_is_noise_of_rows_by_their_mean_squared_length(kind: str) -> None:
    phi = make_phi(kind, 1024, 256, seed=1)
    assert row_power(phi) == pytest.approx(float(np.mean((phi.dense() ** 2).sum(1))), rel=0.2)


def test_a_jump_is_reported_and_does_not_raise_the_level() -> None:
    level = NoiseLevel(500)
    for k, y in enumerate(drifting(30, 0.0)):
        follow_level(level, y, e2=SIGMA_N**2)
        assert level.jumped == (k == 0)
    before = level.s2
    jumped = drifting(1, 0.0)[0] + 1
    follow_level(level, jumped, e2=1.1 * TUNING.jump * before)
    assert level.jumped
    assert level.s2 < 1.5 * before
    follow_level(level, jumped, e2=SIGMA_N**2)
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
        bias.subtract(rows)
        bias.update(float(bias.ones @ rows), nothing, s2=float(rows @ rows) / m)
    assert bias.b == pytest.approx(PAPER_SIGMA_END_N / np.sqrt(2 * np.pi), rel=0.1)


@pytest.mark.parametrize("compiled", [False, True])
def test_rows_of_which_none_sees_a_bias_do_not_change_it(compiled: bool) -> None:
    """Only the first row of a block has a sum; of 64 taxels most row subsets at N/8 have none.

    Rounding leaves a sum of some 1e-7 in other rows: divided by its square, it would be a bias.
    """
    if compiled:
        pytest.importorskip("numba")
    blind = 0
    for phi in row_subsets(make_phi("sbhe", 64, 8, seed=0), "rotating"):
        bias = ClipBias(make_projection(phi, compiled), 64)
        if not np.allclose(phi.forward(np.ones(64, dtype=np.float32)), 0, atol=1e-3):
            continue
        blind += 1
        bias.update(1e-7, np.zeros(64, dtype=np.float32), s2=1.0)
        assert bias.b == 0
    assert blind > 4


def test_a_force_everywhere_is_not_taken_for_bias() -> None:
    """A value that noise of that level cannot cause stays a force."""
    phi = make_phi("sbhe", 1600, 533, seed=0)
    bias = ClipBias(make_projection(phi), 1600)
    pressed = np.full(1600, 0.5, dtype=np.float32)
    # A noisy contact does not let it grow: it is what the least noise of the skin allows.
    for k in range(100):
        bias.update(0.0, pressed, s2=0.01**2 if k < 50 else 0.1**2)
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
    bias.add_back(turned)
    np.testing.assert_allclose(turned, forces, atol=0.035 * bias.b)


def test_the_noise_of_a_touched_skin_is_found_in_its_measurements() -> None:
    truth = sliding_disc((40, 40), 60)
    phi = make_phi("sbhe", 1600, 533, seed=0)
    taxels = noisy(truth)
    y = phi.forward(taxels.reshape(-1, 1600))
    clean = phi.forward(truth.reshape(-1, 1600))
    level = NoiseLevel(533)
    for one in y:
        follow_level(level, one, e2=1.0)
    # The sums of blocks have a mean, the bias of clipped noise.
    noise2 = (y - clean)[40:].var(axis=0).mean()
    assert level.s2 == pytest.approx(float(noise2), rel=0.25)


def innovations(n_frames: int, scale: float = 1.0) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, scale * SIGMA_N, (n_frames, 500))
    return noise.astype(np.float32)


#: The correction of a frame that changed nothing.
NONE = np.zeros(500, dtype=np.float32)


@pytest.mark.parametrize("n_subsets", [1, 3])
def test_noise_alone_is_averaged_over_all_frames_of_a_row_subset_since_the_last_jump(
    n_subsets: int,
) -> None:
    gain = AdaptiveGain()
    gains = []
    for k, innovation in enumerate(innovations(12)):
        gain.use(k % n_subsets)
        follow_gain(gain, innovation, NONE, 500, 1.2 * SIGMA_N**2, jumped=k < n_subsets)
        gains.append(gain.gain)
    expected = 1 / np.arange(1, 12 // n_subsets + 1).repeat(n_subsets)
    np.testing.assert_allclose(gains, expected, rtol=1e-6)


@pytest.mark.parametrize("scale", [2.0, 5.0])
def test_the_gain_is_that_of_the_kalman_filter(scale: float) -> None:
    """K = P / (P + R), P + R the mean square of the innovation, to within 0.9 R."""
    gain = AdaptiveGain()
    for innovation in innovations(40):
        follow_gain(gain, innovation, NONE, 500, SIGMA_N**2, jumped=False)
    assert gain.gain < 0.25
    follow_gain(gain, innovations(1, scale)[0], NONE, 500, SIGMA_N**2, jumped=False)
    assert gain.gain == pytest.approx(1 - 1 / scale**2, abs=0.05)
    follow_gain(gain, innovations(1)[0], NONE, 500, SIGMA_N**2, jumped=True)
    assert gain.gain == 1


def followed(truth: np.ndarray, sigma_n: float, s2: float) -> AdaptiveGain:
    """Filter forces (n_frames, n), each measured in every frame: x = x_p + K e."""
    gain = AdaptiveGain()
    x = np.zeros(truth.shape[1])
    correction = np.zeros(truth.shape[1], dtype=np.float32)
    noise = np.random.default_rng(0).normal(0, sigma_n, truth.shape)
    for k, y in enumerate(truth + noise):
        innovation = (y - x).astype(np.float32)
        follow_gain(gain, innovation, correction, x.size, s2, jumped=k == 0)
        correction = np.float32(gain.gain) * innovation
        x += correction
    return gain


def test_the_noise_is_trusted_unless_the_estimate_lags() -> None:
    """Innovations about a constant force are white; at 100 times the noise, motion is no noise."""
    each = np.random.default_rng(1).uniform(0, 1, 5000)
    gain = followed(np.tile(each, (40, 1)), SIGMA_N, s2=1.2 * SIGMA_N**2)
    assert gain.noise == 1.2 * SIGMA_N**2
    assert gain.gain < 0.1
    gain = followed(np.arange(40)[:, None] * SIGMA_N * each, SIGMA_N / 100, s2=SIGMA_N**2)
    assert gain.noise < 0.2 * SIGMA_N**2
    assert gain.gain > 0.7


def test_a_lag_is_noticed_also_where_every_frame_measures_other_rows() -> None:
    """The correction is known in all taxels: its image under any row subset can be compared."""
    n = 1536
    subsets = row_subsets(make_phi("sbhe", n, n // 3, seed=0), "rotating")
    step = np.random.default_rng(1).uniform(0, SIGMA_N, n).astype(np.float32)
    gain = AdaptiveGain()
    x = np.zeros(n, dtype=np.float32)
    correction = np.zeros(n, dtype=np.float32)
    for k in range(30):
        phi = subsets[k % 3]
        gain.use(k % 3)
        innovation = phi.forward(k * step - x)
        follow_gain(gain, innovation, phi.forward(correction), phi.m, SIGMA_N**2, jumped=k == 0)
        correction = np.float32(gain.gain) * (k * step - x)
        x += correction
    assert gain.noise < 0.2 * SIGMA_N**2
    assert gain.gain > 0.7


@pytest.mark.parametrize("correlation", [-0.5, 0.0, 0.09, 0.4, 0.7, 1.0])
def test_the_noise_is_trusted_less_where_an_innovation_points_along_the_last_correction(
    correlation: float,
) -> None:
    """Beyond a correlation of 0.1, by exp(0.5 (0.1 - correlation)) a frame, down to 1/20."""
    gain = AdaptiveGain()
    angle = np.arccos(correlation)
    innovation = SIGMA_N * np.array([1, 0], dtype=np.float32)
    correction = 0.1 * SIGMA_N * np.array([np.cos(angle), np.sin(angle)], dtype=np.float32)
    trusts = []
    for _ in range(40):
        follow_gain(gain, innovation, correction, 2, SIGMA_N**2, jumped=False)
        trusts.append(gain.noise / SIGMA_N**2)
        assert gain.nis == pytest.approx(0.5 / trusts[-1], rel=1e-4)
    factor = np.exp(0.5 * (0.1 - correlation)) if correlation > 0.1 else 1.0
    np.testing.assert_allclose(trusts, np.maximum(factor ** np.arange(1, 41), 0.05), rtol=1e-3)
    before = gain.noise
    # The correction before a jump says nothing of the scene after it.
    follow_gain(gain, 10 * innovation, correction, 2, SIGMA_N**2, jumped=True)
    assert gain.noise == before
    # An orthogonal innovation restores the trust, by 5 % a frame.
    follow_gain(gain, innovation, correction[::-1] * [0, 1], 2, SIGMA_N**2, jumped=False)
    assert gain.noise == pytest.approx(min(1.05 * before, SIGMA_N**2), rel=1e-4)


@pytest.mark.parametrize(("n_subsets", "growth"), [(1, 1.4), (3, 1.05)])
def test_the_level_grows_by_40_percent_a_frame_at_most(n_subsets: int, growth: float) -> None:
    """By 5 % where rows rotate and all of the innovation looks like noise: it may be motion."""
    level = NoiseLevel(500)
    frames = np.random.default_rng(0).normal(0, 1, (31, 500)).astype(np.float32)
    for k, y in enumerate(frames):
        level.use(k % n_subsets)
        before = level.s2
        follow_level(level, y, e2=SIGMA_N**2 if k < 30 else 4 * before)
    assert not level.jumped
    assert level.s2 == pytest.approx(growth * before)
