"""Stuck taxels of any shape are doubted, left out, and used again; working ones never are."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin import Stream
from sparseskin.messages import Reason
from sparseskin.nodes.reconstructor.faults.stuck import (
    ENOUGH,
    SETTLED,
    StuckTaxels,
    mixture_of,
)
from sparseskin.nodes.sensor.noise import NoiseModel

SHAPE, N = (24, 24), 576
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
    taxels.is_stuck[[0, 1]] = True  # cells (0, 0) and (0, 1)
    filled = taxels.filled(image, exists)
    assert filled[0, 0] == np.mean([5, 6])
    assert filled[0, 1] == np.mean([5, 6, 7])
    np.testing.assert_array_equal(filled.flat[2:], image.flat[2:])
    assert not taxels.is_blind(exists)


def test_stuck_taxels_without_a_working_one_beside_them_are_blind():
    exists = np.ones((4, 5), dtype=np.bool_)
    taxels = StuckTaxels(exists)
    taxels.is_stuck[[0, 1, 5, 6]] = True
    assert taxels.is_blind(exists)


@given(n=st.integers(1, 2000), seed=st.integers(0, 99))
def test_odds_of_working_taxels_are_no_mixture(n, seed):
    odds = np.random.default_rng(seed).uniform(-2, 0, n)
    assert mixture_of(odds).odds < ENOUGH


@given(n=st.integers(30, 2000), part=st.floats(0.1, 0.5))
def test_many_taxels_that_show_little_each_are_a_mixture(n, part):
    """Of one of them it would not be known."""
    odds = np.full(n, -2.0)
    n_stuck = int(np.ceil(part * n))
    odds[:n_stuck] = ENOUGH - 2
    mixture = mixture_of(odds)
    assert mixture.odds > ENOUGH
    assert mixture.posterior[:n_stuck].min() > 0.9
    assert mixture.posterior[n_stuck:].max() < 0.2
