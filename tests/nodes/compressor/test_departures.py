"""Scores and bounds of differences: closed forms, for any matrix, and chances as stated."""

import numpy as np
import pytest
from bags import skin_state
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from sparseskin.nodes.compressor.departures import (
    Departures,
    SquarePyramid,
    Weights,
    Windows,
    cumulants_clipped,
    variance_clipped,
)
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.sensor.noise import CLIPPED, NoiseModel

NOISE = NoiseModel()
KINDS = ("sbhe", "full", "subsample", "gaussian", "row_local", "local:4")


def skin(shape, mask=None, **changes):
    sigmas = {"sigma_mid": NOISE.sigma_mid, "sigma_end": NOISE.sigma_end}
    return skin_state(n_rows=shape[0], n_cols=shape[1], mask=mask, **sigmas | changes)


@given(st.floats(0.001, 30.0), st.floats(1.0, 2.0))
def test_cumulants_grow_as_the_bound_of_weighted_sums_needs(t, factor):
    small, large = cumulants_clipped(np.array([t, factor * t]))
    assert small <= large / factor**2 * (1 + 1e-6) + 1e-12
    below = cumulants_clipped(np.array([-min(t, 5.0)]))[0]
    above = cumulants_clipped(np.array([min(t, 5.0)]))[0]
    assert below <= above + 1e-12


@given(st.floats(3.0, 7.0), st.floats(0.0, 1.0), st.integers(1, 500))
def test_many_equal_weights_bound_like_a_normal_variable(z, own, n):
    few = variance_clipped(Weights(own, n, n), 1, z)
    many = variance_clipped(Weights(own, 1e7, 1e7), 1, z)
    assert many == pytest.approx(CLIPPED, rel=1e-2)
    assert many <= few * (1 + 1e-9)
    # A single clipped reading exceeds z exactly as often as a normal one.
    assert variance_clipped(Weights(), 1, z) > (1 - norm.sf(z)) * CLIPPED


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(KINDS), st.integers(3, 9), st.integers(3, 9), st.integers(0, 2**31)
)
def test_scores_are_matched_filters_of_unit_variance(kind, n_rows, n_cols, seed):
    rng = np.random.default_rng(seed)
    exists = rng.random((n_rows, n_cols)) < 0.8
    exists.flat[0] = True
    # Its rows are those of a whole grid.
    if kind == "row_local":
        exists[:] = True
    n = int(exists.sum())
    phi = make_phi(kind, n, n if kind == "full" else max(1, n // 2), seed % 1000)
    phi.lay_out(exists)
    subsets = row_subsets(phi, None)

    pyramid = SquarePyramid(exists.shape)
    rows = np.concatenate([
        pyramid.square_of_cell(level)[exists.reshape(-1)]
        == np.arange(span.stop - span.start)[:, np.newaxis]
        for level, span in enumerate(pyramid.spans)
    ]).astype(np.float64)  # fmt: skip
    difference = rng.normal(size=(2, phi.m)).astype(np.float32)
    for most in (None, 1):
        departures = Departures(skin(exists.shape, exists), 0.01, subsets, most=most)
        tail = slice(-departures.pyramid.n, None)
        for k, subset in enumerate(subsets):
            filters = rows @ subset.dense().T
            norms = np.linalg.norm(filters @ subset.dense(), axis=1)
            expected = difference @ filters.T / np.maximum(norms, 1e-9)
            expected[:, norms < 1e-5 * norms.max()] = 0.0
            scores = departures.scores(difference, k)
            assert scores == pytest.approx(expected[:, tail], abs=2e-3)


@given(st.integers(1, 40), st.integers(1, 5))
def test_windows_hold_the_last_frames(n_frames, n_windows):
    """Alarm exactly where a complete window of ones exceeds half a frame less than its number."""
    sizes = 2 ** np.arange(n_windows)
    for window in range(n_windows):
        limits = np.full((1, n_windows, 1), np.inf, dtype=np.float32)
        limits[0, window] = (sizes[window] - 0.5) / np.sqrt(sizes[window])
        windows = Windows(1, 1, n_windows)
        alarms = [
            bool(windows.alarms(np.ones((1, 1), np.float32), limits, np.zeros(1))[0])
            for _ in range(n_frames)
        ]
        expected = [(k + 1) % sizes[window] == 0 for k in range(n_frames)]
        assert alarms == expected


@pytest.mark.parametrize("ratio", [1, 3, 8])
@pytest.mark.parametrize("one_sided", [True, False])
def test_noise_alarms_at_most_as_often_as_stated(ratio, one_sided):
    shape = (16, 16)
    n = 256
    phis = row_subsets(make_phi("sbhe", n, n // ratio, seed=1), None)
    chance = 0.02
    departures = Departures(skin(shape), chance, phis, n_windows=4, one_sided=one_sided)
    untouched = np.zeros((1, *shape), dtype=np.float32)
    bounds = departures.bounds(untouched)
    rng = np.random.default_rng(5)
    mean = np.full(n, NOISE.sigma_end / np.sqrt(2 * np.pi), dtype=np.float32)
    k = 100
    windows = Windows(k, departures.pyramid.n, 4)
    n_alarms = 0
    for frame in range(60):
        phi = phis[frame % len(phis)]
        readings = NOISE.apply(np.zeros((k, n), dtype=np.float32), rng)
        difference = phi.forward(readings - mean)
        scores = departures.scores(difference, frame % len(phis))
        alarms = windows.alarms(scores, bounds.scores, np.zeros(k), one_sided)
        alarms |= departures.energy(difference, bounds) > bounds.energy
        n_alarms += np.count_nonzero(alarms)
    expected = chance * 60 * k
    assert n_alarms <= expected + 4 * np.sqrt(expected)
