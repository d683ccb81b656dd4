"""Row memory: what earlier frames have read counts while it holds, and no longer."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.skin.row_memory import RowMemory
from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.reconstructor.solvers.projection import Projection, make_projection

N, RATIO = 256, 4
M = N // RATIO
S2 = 1e-4


class Setting:
    """A memory for 256 taxels of which each frame reads a quarter of the rows."""

    def __init__(self) -> None:
        self.phases = row_subsets(make_phi("sbhe", N, M, seed=0), "rotating")
        self.projection: Projection = make_projection(self.phases[0])
        self.whole = np.zeros(N, dtype=np.float32)
        self.memory = RowMemory(self.projection, M, self.whole)
        self.target = np.zeros(N, dtype=np.float32)

    def remember(
        self,
        subset: int,
        x: Floats | None,
        y: Floats,
        weight: float = 0.5,
        nis: float = 1.0,
        settling: bool = False,
    ) -> None:
        """Compare the rows of a frame and set target and weights, as the solver does."""
        change2 = self.memory.compare(x, y)
        counted = self.memory.counted(subset, change2, S2, nis * S2, settling)
        self.memory.follow(weight, counted, self.target)

    def frame(
        self, k: int, taxels: Floats, nis: float = 1.0, weight: float = 0.5, settling: bool = False
    ) -> Floats:
        """Remember the k-th frame, nothing predicted; what each row counts by."""
        phi = self.phases[k % RATIO]
        self.projection.use(phi)
        y = np.zeros(N, dtype=np.float32)
        self.projection.rows_of(phi.forward(taxels), y)
        self.remember(k % RATIO, None, y, weight, nis, settling)
        rows = np.zeros((1, N), dtype=np.float32)
        self.projection.forward(taxels[self.projection.order][None], rows)
        self.projection.weigh(None)
        whole = np.zeros(N, dtype=np.float32)
        self.projection.whole(taxels[self.projection.order], whole)
        counted: Floats = rows[0] / whole
        return counted


def taxels_of(seed: int) -> Floats:
    return np.random.default_rng(seed).random(N, dtype=np.float32) + np.float32(0.1)


def test_a_still_skin_counts_all_rows_once_they_are_read_and_aims_at_what_was_measured() -> None:
    setting, taxels = Setting(), taxels_of(0)
    for k in range(2 * RATIO):
        counted = setting.frame(k, taxels)
        known = min(k + 1, RATIO) * M
        assert np.isclose(counted, 1, atol=1e-3).sum() == M
        assert np.isclose(counted, TUNING.memory_weight, atol=1e-3).sum() == known - M
        assert np.isclose(counted, 0, atol=1e-3).sum() == N - known
    # Nothing was predicted: K = 1/2 of what was measured, times what a row counts.
    whole = np.zeros(N, dtype=np.float32)
    setting.projection.whole(taxels[setting.projection.order], whole)
    np.testing.assert_allclose(setting.target, counted * whole / 2, atol=1e-5)
    assert setting.memory.m_counted == pytest.approx(
        M * (1 + TUNING.memory_weight**2 * (RATIO - 1))
    )


def test_rows_count_less_the_more_the_skin_has_changed_since_they_were_read() -> None:
    least = []
    for change_n in (0.0, 0.02, 0.2):
        setting, taxels = Setting(), taxels_of(0)
        for k in range(RATIO):
            setting.frame(k, taxels)
        noise = np.random.default_rng(1).normal(0, change_n, N).astype(np.float32)
        least.append(float(setting.frame(RATIO, taxels + noise).min()))
    assert least[0] == pytest.approx(TUNING.memory_weight, abs=1e-3)
    assert least[0] > least[1] > 5 * least[2]


def test_before_a_round_is_over_an_innovation_beyond_the_noise_counts_as_a_change() -> None:
    setting, taxels = Setting(), taxels_of(0)
    setting.frame(0, taxels)
    surprised = setting.frame(1, taxels, nis=50.0)
    assert np.isclose(surprised, 1, atol=1e-3).sum() == M
    assert 0 < surprised[surprised > 1e-4].min() < TUNING.memory_weight / 5


def test_while_an_estimate_settles_earlier_rows_are_kept_and_count_nothing() -> None:
    setting, taxels = Setting(), taxels_of(0)
    for k in range(RATIO):
        setting.frame(k, taxels)
    counted = setting.frame(RATIO, taxels, settling=True)
    assert np.isclose(counted, 0, atol=1e-6).sum() == N - M
    counted = setting.frame(RATIO + 1, taxels)
    assert np.isclose(counted, TUNING.memory_weight, atol=1e-3).sum() == N - M
    setting.memory.forget()
    counted = setting.frame(RATIO, taxels)
    assert np.isclose(counted, 1, atol=1e-3).sum() == setting.memory.m_counted == M


def test_variances_of_rows_grow_by_their_age_times_the_drift_that_is_seen() -> None:
    setting, taxels = Setting(), taxels_of(0)
    for k in range(RATIO):
        setting.frame(k, taxels)
    np.testing.assert_allclose(setting.memory.variances(S2), S2)
    moved = taxels + np.random.default_rng(1).normal(0, 0.1, N).astype(np.float32)
    setting.frame(RATIO, moved)
    variances = setting.memory.variances(S2)
    values, counts = np.unique(variances, return_counts=True)
    assert counts.tolist() == [M] * RATIO
    np.testing.assert_allclose(values[0], S2, rtol=1e-6)
    np.testing.assert_allclose(np.diff(values), values[1] - S2, rtol=1e-3)
    # The change in RATIO frames has a mean square of 0.01; an age of one is a part of it.
    assert values[1] - S2 == pytest.approx(TUNING.memory_doubt * 0.01 / RATIO, rel=0.3)


def test_a_prediction_that_moves_moves_what_is_known_along() -> None:
    """Rows of a skin that changed just as was predicted still count in full."""
    setting, before, after = Setting(), taxels_of(0), taxels_of(2)
    for k in range(RATIO):
        setting.frame(k, before)
    order = setting.projection.order
    setting.projection.whole(before[order], setting.whole)
    phi = setting.phases[0]
    setting.projection.use(phi)
    y = np.zeros(N, dtype=np.float32)
    setting.projection.rows_of(phi.forward(after), y)
    setting.remember(0, after[order], y)
    assert setting.memory.m_counted == pytest.approx(
        M * (1 + TUNING.memory_weight**2 * (RATIO - 1)), rel=1e-4
    )
    setting.projection.weigh(None)
    whole = np.zeros(N, dtype=np.float32)
    setting.projection.whole(after[order], whole)
    np.testing.assert_allclose(setting.whole, whole, atol=1e-6)
