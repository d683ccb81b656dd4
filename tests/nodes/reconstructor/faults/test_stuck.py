"""Stuck taxels of any shape are doubted, left out, and used again; working ones never are."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin import Stream
from sparseskin.messages import Reason
from sparseskin.nodes.reconstructor.faults.stuck import (
    SETTLED,
    NewChanges,
    StuckTaxels,
    most_likely_range,
    probability_of,
)
from sparseskin.nodes.sensor.noise import NoiseModel

SHAPE = (24, 24)
N = 576
NOISE = NoiseModel()
SIGMAS = (NOISE.sigma_mid, NOISE.sigma_end)
UNTOUCHED = np.zeros(SHAPE, dtype=np.float32)
BEFORE = 30
"""Frames of a working skin before taxels get stuck: it shows its noise in them."""


@st.composite
def shapes(draw, largest=0.3):
    """Taxels, bool of SHAPE: a rectangle, or any, 2 to 30 % of the skin."""
    n_taxels = draw(st.integers(12, int(largest * N)))
    taxels = np.zeros(SHAPE, dtype=np.bool_)
    if draw(st.booleans()):
        n_rows = draw(st.integers(max(1, -(-n_taxels // SHAPE[1])), min(n_taxels, SHAPE[0])))
        n_cols = n_taxels // n_rows
        row = draw(st.integers(0, SHAPE[0] - n_rows))
        col = draw(st.integers(0, SHAPE[1] - n_cols))
        taxels[row : row + n_rows, col : col + n_cols] = True
        return taxels
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    taxels.flat[rng.choice(N, n_taxels, replace=False)] = True
    return taxels


class Skin:
    """A skin with the noise of the paper, which it states, reconstructed by a stream."""

    def __init__(self, ratio=3, rows="rotating", seed=0):
        self.stream = Stream(SHAPE, ratio=ratio, rows=rows, sigmas=SIGMAS)
        self._rng = np.random.default_rng(seed)

    def frame(self, truth, stuck=None, value=0.0):
        """Forces of a frame, in which taxels are stuck at a value, newtons."""
        readings = NOISE.apply(truth, self._rng)
        if stuck is not None:
            readings[stuck] = value
        return self.stream.reconstruct(self.stream.compress(readings))

    @property
    def left_out(self):
        """Taxels that are left out, bool of SHAPE."""
        return self.stream._watch._stuck.is_stuck.reshape(SHAPE)


@given(
    stuck=shapes(),
    value=st.floats(0.5, 2.0),
    ratio=st.sampled_from([2, 3, 4]),
    seed=st.integers(0, 99),
)
def test_stuck_taxels_are_doubted_in_a_hundred_frames(stuck, value, ratio, seed):
    """Half of such groups are doubted within 10 frames, and 90 % within 55. Nearer to the end of
    the range, where the noise is small, it takes longer.
    """
    skin = Skin(ratio, seed=seed)
    for _ in range(BEFORE):
        skin.frame(UNTOUCHED)
    reasons = []
    for _ in range(100):
        skin.frame(UNTOUCHED, stuck, value)
        reasons.append(skin.stream.reason)
        if Reason.STUCK in reasons:
            break
    assert Reason.STUCK in reasons
    assert not skin.left_out[~stuck].any()


@settings(max_examples=10)
@given(
    pressed=shapes(largest=0.5),
    force=st.floats(0.1, 2.4),
    ratio=st.sampled_from([2, 3, 4]),
    rows=st.sampled_from(["fixed", "rotating"]),
    seed=st.integers(0, 99),
)
def test_working_taxels_that_are_pressed_are_not_doubted_in_300_frames(
    pressed, force, ratio, rows, seed
):
    skin = Skin(ratio, rows, seed)
    truth = np.where(pressed, np.float32(force), np.float32(0))
    for k in range(300):
        skin.frame(UNTOUCHED if k < BEFORE else truth)
        assert skin.stream.reason != Reason.STUCK
    assert not skin.left_out.any()


def test_stuck_taxels_are_filled_by_their_neighbours_and_used_again_when_they_work():
    skin = Skin(ratio=2)
    stuck = np.zeros(SHAPE, dtype=np.bool_)
    stuck[[5, 5, 15], [5, 17, 9]] = True
    for _ in range(BEFORE):
        skin.frame(UNTOUCHED)
    for _ in range(2 * SETTLED):
        forces = skin.frame(UNTOUCHED, stuck, 1.3)
    np.testing.assert_array_equal(skin.left_out, stuck)
    assert forces[stuck].max() < 0.1

    pressed = UNTOUCHED.copy()
    pressed[2:9, 2:9] = 1.0
    for _ in range(20):
        forces = skin.frame(pressed, stuck, 1.3)
    beside = forces[4:7, 4:7].sum() - forces[5, 5]
    assert forces[5, 5] == pytest.approx(beside / 8, rel=1e-4)
    assert forces[5, 5] == pytest.approx(1.0, abs=0.15)

    for _ in range(100):
        forces = skin.frame(UNTOUCHED)
    assert not skin.left_out.any()
    assert forces.max() < 0.1
    assert skin.stream.trusted


def test_a_stuck_taxel_is_the_mean_of_the_working_ones_beside_it():
    exists = np.ones((4, 5), dtype=np.bool_)
    exists[0, 2] = False
    taxels = StuckTaxels(exists)
    image = np.arange(20, dtype=np.float32).reshape(4, 5) * exists
    # Cells (0, 0) and (0, 1).
    taxels.mark(np.array([0, 1]), is_stuck=True, values=np.float32(1))
    filled = taxels.filled(image, exists)
    assert filled[0, 0] == np.mean([5, 6])
    assert filled[0, 1] == np.mean([5, 6, 7])
    np.testing.assert_array_equal(filled.flat[2:], image.flat[2:])
    assert not taxels.is_blind(exists)


def test_stuck_taxels_without_a_working_one_beside_them_are_blind():
    exists = np.ones((4, 5), dtype=np.bool_)
    taxels = StuckTaxels(exists)
    taxels.mark(np.array([0, 1, 5, 6]), is_stuck=True, values=np.float32(1))
    assert taxels.is_blind(exists)


@given(n=st.integers(1, 2000), seed=st.integers(0, 99))
def test_odds_of_working_taxels_are_no_range(n, seed):
    odds = np.random.default_rng(seed).uniform(-2, 0, n)
    assert most_likely_range(odds).odds <= 0


@given(odds=st.lists(st.floats(-2, 30), min_size=1, max_size=40))
def test_the_most_likely_range_has_the_largest_sum(odds):
    group = most_likely_range(np.array(odds))
    sums = [
        sum(odds[start:stop])
        for start in range(len(odds) + 1)
        for stop in range(start, len(odds) + 1)
    ]
    assert sum(odds[group.start : group.stop]) == pytest.approx(max(sums), abs=1e-9)
    assert group.odds == pytest.approx(max(sums) - 2 * np.log(len(odds)), abs=1e-9)


@given(n=st.integers(100, 2000), part=st.floats(0.1, 0.5), each=st.floats(2, 8))
def test_taxels_of_one_force_that_show_little_each_are_a_range(n, part, each):
    """Of one of them it would not be known."""
    odds = np.full(n, -2.0)
    n_stuck = int(np.ceil(part * n))
    odds[n // 4 : n // 4 + n_stuck] = each
    group = most_likely_range(odds)
    assert group.start == n // 4
    assert group.stop == n // 4 + n_stuck
    assert group.odds > 2 * n_stuck - 2 * np.log(n) - 1e-9


@given(n=st.integers(30, 2000), part=st.floats(0.1, 0.5))
def test_stuck_taxels_of_a_group_are_told_from_working_ones(n, part):
    odds = np.full(n, -2.0)
    n_stuck = int(np.ceil(part * n))
    odds[:n_stuck] = 8.0
    probability = probability_of(odds)
    assert probability[:n_stuck].min() > 0.9
    assert probability[n_stuck:].max() < 0.2


@given(
    n_subsets=st.integers(1, 4),
    misfit=st.floats(0, 1e3),
    seed=st.integers(0, 99),
)
def test_what_repeats_is_not_new_and_noise_keeps_its_variance(n_subsets, misfit, seed):
    rng = np.random.default_rng(seed)
    repeats = misfit * rng.standard_normal((n_subsets, 400)).astype(np.float32)
    changes = NewChanges()
    powers = []
    for k in range(200 * n_subsets):
        subset = k % n_subsets
        noise = rng.standard_normal(400).astype(np.float32)
        new = changes.look(str(subset), repeats[subset] + noise)
        assert (new is None) == (k < n_subsets)
        if new is not None:
            powers.append(float(new @ new) / len(new))
    assert np.mean(powers) == pytest.approx(1, rel=0.05)


def test_after_a_step_the_next_change_alone_is_not_new():
    rng = np.random.default_rng(0)
    changes = NewChanges()
    for k in range(20):
        step = 100.0 if k == 10 else 0.0
        new = changes.look("", rng.standard_normal(400).astype(np.float32) + np.float32(step))
        if k >= 12:
            assert float(new @ new) / 400 < 1.3


def test_a_subset_is_new_again_after_changes_are_forgotten():
    changes = NewChanges()
    change = np.ones(4, dtype=np.float32)
    assert changes.look("", change) is None
    np.testing.assert_array_equal(changes.look("", change), 0)
    changes.forget()
    assert changes.look("", change) is None
