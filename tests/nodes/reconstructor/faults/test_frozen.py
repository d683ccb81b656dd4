"""A board that hangs: all measurements repeat exactly, on a skin with noise."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.faults.frozen import FRAMES, FrozenWatch

SIGMA = 0.02


def noisy(seed: int, force: float = 0.0) -> Floats:
    return np.random.default_rng(seed).normal(force, SIGMA, 30).astype(np.float32)


@pytest.mark.parametrize("force", [0.0, 1.0])
@pytest.mark.parametrize("n_subsets", [1, 3])
def test_it_is_found_after_20_repeats_and_works_again_with_the_first_other_frame(
    force: float, n_subsets: int
) -> None:
    watch = FrozenWatch(SIGMA)
    subsets = [f"phi {k}" for k in range(n_subsets)]
    for k in range(2 * n_subsets):
        watch.update(subsets[k % n_subsets], noisy(k % n_subsets if k >= n_subsets else 9, force))
    changes = [watch.update(subsets[k % n_subsets], noisy(k % n_subsets, force)) for k in range(40)]
    assert changes.index(True) == FRAMES - 1
    assert sum(changes) == 1
    assert watch.frozen
    assert watch.update(subsets[0], noisy(77, force))
    assert not watch.frozen


def test_noise_and_single_repeated_frames_are_none() -> None:
    watch = FrozenWatch(SIGMA)
    for k in range(200):
        assert not watch.update("phi", noisy(k // 2))
    assert not watch.frozen


def test_a_skin_that_states_no_noise_may_repeat() -> None:
    watch = FrozenWatch(0.0)
    for _ in range(100):
        assert not watch.update("phi", noisy(0))


def test_measurements_in_steps_above_the_noise_may_repeat() -> None:
    coarse = quantised(np.array([0.0, 1.0, 50.0], dtype=np.float32), 4)
    assert isinstance(coarse, Quantised)
    assert coarse.step > 2 * SIGMA
    watch = FrozenWatch(SIGMA)
    for _ in range(100):
        assert not watch.update("phi", coarse)
