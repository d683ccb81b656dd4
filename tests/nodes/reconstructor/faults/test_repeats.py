"""Measurements without noise are found; those that may repeat or be equal are not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import Reason
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.reconstructor.faults.repeats import FRAMES, LEARNING, RepeatWatch

SIGMA = 0.02
M = 533


def noise(seed, m=M):
    """Measurements of an untouched skin, newtons."""
    return np.random.default_rng(seed).normal(0, SIGMA, m).astype(np.float32)


def reasons_of(frames, least_sd=SIGMA, subsets=("a",)):
    """What a watch finds of frames whose row subsets take turns."""
    watch = RepeatWatch(least_sd)
    return [watch.look(subsets[k % len(subsets)], y) for k, y in enumerate(frames)]


@given(value=st.floats(-2.5, 2.5, width=32), m=st.integers(4, 600))
def test_equal_measurements_are_constant(value, m):
    y = np.full(m, value, dtype=np.float32)
    assert RepeatWatch(SIGMA).look("a", y) is Reason.CONSTANT


def test_three_equal_measurements_may_be_so_by_chance():
    assert RepeatWatch(SIGMA).look("a", np.zeros(3, dtype=np.float32)) is None


@given(seed=st.integers(0, 999), m=st.integers(32, 600), sign=st.sampled_from([-1, 1]))
def test_measurements_of_one_sign_are_clipped(seed, m, sign):
    y = np.maximum(noise(seed, m), 0) * np.float32(sign)
    assert RepeatWatch(SIGMA).look("a", y) is Reason.CLIPPED


@given(seed=st.integers(0, 999), m=st.integers(300, 900), sign=st.sampled_from([-1, 1]))
def test_quantised_measurements_of_one_sign_are_clipped(seed, m, sign):
    codes = np.rint(noise(seed, m) / SIGMA).astype(np.int32)
    y = Quantised.of(sign * np.maximum(codes, 0), 8, SIGMA)
    assert RepeatWatch(SIGMA).look("a", y) is Reason.CLIPPED


@given(n_subsets=st.integers(1, 4), n_before=st.integers(1, 8))
def test_a_frame_that_repeats_four_times_is_frozen_whatever_its_rows(
    n_subsets, n_before
):
    frames = [noise(k) for k in range(n_before)] + [noise(99)] * (FRAMES + 3)
    found = reasons_of(frames, subsets="abcd"[:n_subsets])
    assert found == [None] * (n_before + FRAMES) + [Reason.FROZEN] * 3


def test_a_cycle_of_frames_that_repeats_is_frozen():
    cycle = [noise(k) for k in range(3)]
    found = reasons_of(cycle * 3, subsets="abc")
    assert found == [None] * (3 + FRAMES - 1) + [Reason.FROZEN] * (6 - FRAMES + 1)


def test_frames_that_change_after_others_that_repeat_are_no_longer_frozen():
    frames = [noise(0)] * 20 + [noise(1), noise(2)]
    found = reasons_of(frames)
    assert found[19] is Reason.FROZEN
    assert found[20:] == [None, None]


@pytest.mark.parametrize("n_times", [2, FRAMES])
def test_frames_that_are_delivered_several_times_are_not_marked(n_times):
    frames = [noise(k // n_times) for k in range(200)]
    assert reasons_of(frames) == [None] * 200


@given(
    presses=st.lists(
        st.tuples(st.booleans(), st.integers(1, 30)), min_size=1, max_size=6
    ),
    subsets=st.sampled_from(["a", "abc"]),
)
def test_a_skin_whose_untouched_taxels_read_zero_is_never_marked(presses, subsets):
    """Forces stand still, or one row in ten measures nothing of them."""
    watch = RepeatWatch(0.0)
    n_frames = 0
    for is_pressed, n_held in presses:
        y = noise(n_frames) if is_pressed else np.zeros(M, dtype=np.float32)
        y[::10] = 0
        for _ in range(n_held):
            assert watch.look(subsets[n_frames % len(subsets)], y) is None
            assert watch.faulty is None
            n_frames += 1


def test_a_skin_that_states_no_noise_shows_it():
    found = reasons_of(
        [noise(k) for k in range(LEARNING + 1)] + [noise(99)] * 6, least_sd=0.0
    )
    assert found[-2:] == [Reason.FROZEN] * 2


@pytest.mark.parametrize("subsets", ["a", "abc"])
def test_one_measurement_that_repeats_alone_is_faulty_in_three_repeats(subsets):
    watch = RepeatWatch(SIGMA)
    n_subsets = len(subsets)
    n_working = 10 * n_subsets
    for k in range(n_working + 20 * n_subsets):
        y = noise(k, 1600)
        if k >= n_working:
            y[77] = 0.3
        assert watch.look(subsets[k % n_subsets], y) is None
        n_repeats = (k - n_working) // n_subsets
        if n_repeats < 3:
            assert watch.faulty is None
        else:
            assert watch.faulty is not None
            assert np.flatnonzero(watch.faulty).tolist() == [77]


def test_a_measurement_that_changes_again_counts_again():
    watch = RepeatWatch(SIGMA)
    for k in range(40):
        y = noise(k)
        if k < 30:
            y[5] = 0
        watch.look("a", y)
        assert k != 29 or watch.faulty is not None
        assert k < 30 or watch.faulty is None


@given(
    m=st.integers(96, 600),
    steps=st.floats(0.2, 3.0),
    seed=st.integers(0, 999),
)
def test_quantised_measurements_are_not_marked(m, steps, seed):
    """With steps of up to three times the noise: from two on, they may repeat."""
    rng = np.random.default_rng(seed)
    step = steps * SIGMA
    watch = RepeatWatch(SIGMA)
    for _ in range(60):
        codes = np.rint(rng.normal(0, SIGMA, m) / step).astype(np.int32)
        assert watch.look("a", Quantised.of(codes, 8, step)) is None
        assert watch.faulty is None
