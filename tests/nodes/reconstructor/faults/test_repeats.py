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


def frozen_at(m, n_frames=60):
    """Number of times a frame of m measurements repeats until it is frozen."""
    found = reasons_of([noise(3, m)] * n_frames)
    return found.index(Reason.FROZEN)


@given(m=st.integers(2, 60))
def test_a_frame_of_few_measurements_repeats_more_often_by_chance(m):
    """A measurement of one bit repeats in every other frame: of 10^9 cases one lasts 30 bits."""
    assert frozen_at(m) == max(4, -(-30 // m))


@given(m=st.integers(8, 200), n_tied=st.integers(1, 7), sign=st.sampled_from([-1, 1]))
def test_four_measurements_that_share_an_extreme_value_are_clipped(m, n_tied, sign):
    y = np.sort(noise(m, m)) * np.float32(sign)
    extreme = y.max() if sign > 0 else y.min()
    y[:n_tied] = y[0]
    y[-1] = extreme
    found = RepeatWatch(SIGMA).look("a", y)
    assert found is (Reason.CLIPPED if n_tied >= 4 else None)


@given(steps=st.sampled_from([0.5, 1.0, 1.5, 1.9, 2.0, 2.5]), seed=st.integers(0, 9))
def test_equal_codes_are_no_fault_where_a_step_is_twice_the_noise(steps, seed):
    noise_sd = 0.25
    y = Quantised.of(np.full(400, seed, np.int32), 8, steps * noise_sd)
    found = RepeatWatch(noise_sd).look("a", y)
    assert found is (Reason.CONSTANT if steps < 2 else None)


def lively_after(frames):
    watch = RepeatWatch(0.0)
    for y in frames:
        watch.look("a", y)
    return watch.is_lively


def test_ten_frames_that_change_show_that_there_is_noise():
    assert not lively_after([noise(k) for k in range(10)])
    assert lively_after([noise(k) for k in range(11)])


@given(place=st.integers(1, 10), part=st.floats(0.0, 0.19) | st.floats(0.21, 0.9))
def test_the_first_frames_count_alike(place, part):
    """Of ten that change, one repeats a part: 98 % changed if that is a fifth at most."""
    m = 1000
    frames = [noise(k, m) for k in range(11)]
    n_same = int(part * m)
    frames[place][:n_same] = frames[place - 1][:n_same]
    assert lively_after(frames) == (n_same <= 200)


@given(part=st.floats(0.05, 0.95))
def test_the_part_that_changes_is_a_running_mean_of_twenty_frames(part):
    """Of frames that all change, then some of which the first part repeats."""
    m = 1000
    frames = [noise(k, m) for k in range(60)]
    lively = 1.0
    for k in range(40, 60):
        n_same = int(part * m)
        frames[k][:n_same] = frames[k - 1][:n_same]
        lively += (1 - n_same / m - lively) / 20
        # Beside the bound, rounding decides.
        if abs(lively - 0.98) > 1e-6:
            assert lively_after(frames[: k + 1]) == (lively >= 0.98)


def test_of_measurements_half_of_which_repeat_one_needs_thirty_repeats():
    """As 2^-30 is one of 10^9."""
    rng = np.random.default_rng(0)
    watch = RepeatWatch(SIGMA)
    y = noise(0)
    first = None
    for k in range(1, 60):
        changes = rng.random(M) < 0.5
        changes[77] = False
        y = np.where(changes, noise(k), y)
        watch.look("a", y)
        if watch.faulty is not None and first is None:
            first = k
            assert np.flatnonzero(watch.faulty).tolist() == [77]
    assert 28 <= first <= 34


@given(m=st.integers(40, 600), seed=st.integers(0, 99))
def test_quantised_measurements_of_which_one_sticks_are_found(m, seed):
    rng = np.random.default_rng(seed)
    watch = RepeatWatch(SIGMA)
    for _ in range(60):
        codes = np.rint(rng.normal(0, 20, m)).astype(np.int32)
        codes[7] = 3
        watch.look("a", Quantised.of(codes, 12, SIGMA / 20))
    assert np.flatnonzero(watch.faulty).tolist() == [7]


def test_frames_of_subsets_of_other_sizes_do_not_repeat_each_other():
    frames = [np.full(5, k, np.float32) + np.arange(5) for k in range(2)]
    watch = RepeatWatch(SIGMA)
    for k in range(20):
        y = frames[0] if k % 2 else frames[0][:4]
        watch.look("ab"[k % 2], y.astype(np.float32) + np.float32(k))
    assert watch.look("b", frames[1].astype(np.float32)) is None


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
