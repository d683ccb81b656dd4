"""The bias of untouched taxels: how fast it is known, and within what bounds."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.reconstructor.skin.bias import Bias
from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning

N = 100
SD = 0.25
SUBSET = SimpleNamespace(ones_energy=40.0)


def follow(bias, excess, by_rows=1.0, subset=SUBSET, repeated=0.0):
    """A frame whose readings exceed the bias, as rows or as untouched taxels show it."""
    settled = SimpleNamespace(
        along_ones=by_rows * excess * subset.ones_energy,
        unpressed=(1 - by_rows) * excess * N,
    )
    bias.follow(settled, subset, N, SD**2, repeated)


def followed(true, n_frames, by_rows=1.0):
    """The bias after some frames of a skin whose untouched taxels read more than 0."""
    bias = Bias(SkinTuning())
    for _ in range(n_frames):
        follow(bias, true - bias.value, by_rows)
    return bias


@given(
    true=st.floats(0.02, 0.5 * SD),
    n_frames=st.integers(1, 50),
    by_rows=st.floats(0.0, 1.0),
)
def test_what_is_left_of_a_bias_falls_with_the_cube_of_the_frames(
    true, n_frames, by_rows
):
    """Rates of 3 / (k + 3) leave 6 / ((k + 1) (k + 2) (k + 3)) of it."""
    k = n_frames
    left = 6 / ((k + 1) * (k + 2) * (k + 3))
    assert followed(true, k, by_rows).value == pytest.approx(true * (1 - left))


def test_later_a_twentieth_of_the_difference_is_followed():
    bias = followed(0.1, 100)
    follow(bias, 0.08)
    assert bias.value == pytest.approx(0.1 + 0.05 * 0.08, abs=1e-5)


@given(excess=st.floats(0.5 * SD, 1e6), sign=st.sampled_from([-1, 1]))
def test_a_frame_counts_for_half_a_deviation_at_most(excess, sign):
    bias = followed(0.1, 100)
    follow(bias, sign * excess)
    assert bias.value == pytest.approx(0.1 + sign * 0.05 * SD / 2, abs=1e-5)


def test_a_bias_is_within_0_and_three_quarters_of_a_deviation():
    bias = Bias(SkinTuning())
    for _ in range(200):
        follow(bias, 10.0)
    assert bias.value == pytest.approx(0.75 * SD)
    for _ in range(200):
        follow(bias, -10.0)
    assert bias.value == 0.0


@given(repeated=st.floats(0.0, 1.0))
def test_measurements_that_repeat_show_nothing_new(repeated):
    whole = followed(0.1, 3)
    part = followed(0.1, 3)
    before = whole.value
    follow(whole, 0.05)
    follow(part, 0.05, repeated=repeated)
    expected = before + (1 - repeated) * (whole.value - before)
    assert part.value == pytest.approx(expected)


def test_rows_that_see_no_bias_show_none():
    bias = Bias(SkinTuning())
    follow(bias, 0.1, subset=SimpleNamespace(ones_energy=1e-6 * N))
    assert bias.value == 0.0
    follow(bias, 0.1, by_rows=0.0, subset=SimpleNamespace(ones_energy=0.0))
    assert bias.value > 0.0


@pytest.mark.parametrize(("part", "is_0"), [(1.2e-3, True), (1.5e-3, False)])
def test_a_thousandth_of_a_deviation_is_no_bias(part, is_0):
    """Of which the first frame follows three quarters."""
    bias = Bias(SkinTuning())
    follow(bias, part * SD)
    assert (bias.value == 0.0) == is_0


@pytest.mark.parametrize(("n_frames", "is_known"), [(8, False), (9, True)])
def test_a_bias_is_known_after_more_than_eight_frames(n_frames, is_known):
    bias = followed(0.1, n_frames)
    assert bias.is_known == is_known
    for _ in range(20):
        follow(bias, 0.0, repeated=1.0)
    assert bias.is_known == is_known


def test_a_bias_that_is_forgotten_is_that_of_a_new_one():
    bias = followed(0.1, 20)
    bias.forget()
    assert bias.value == 0.0
    assert not bias.is_known
    follow(bias, 0.1)
    assert bias.value == pytest.approx(0.75 * 0.1)
