"""Geometry and range of a skin: what it allows, what is left without some cells, its noise."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from message_strategies import skin_states

from sparseskin.messages import (
    FieldError,
    Labels,
    MessageError,
    PhiState,
    ShapeError,
    SolverState,
    decode,
    encode,
)
from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.skin import (
    CONTACT_FRACTION,
    MAX_COORDINATE_M,
    PAPER_F_MAX_N,
    Skin,
    first_far,
)
from sparseskin.messages.state import CLIP_SD, SkinState, described

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=8)
#: Masks and points take ten times as long to draw as numbers.
FEW = settings(max_examples=25)
SIGMAS = {"sigma_mid": 0.06, "sigma_end": 0.02}


def state(**fields):
    known = {"stamp_ns": 0, "patch": "skin", "n_rows": 2, "n_cols": 3, "f_max": 2.5}
    known |= {"unit": "N", "pitch_m": None, "mask": None, "source": "test"}
    known |= {"seed": 0, "rate_hz": 0.0, "has_truth": False, **SIGMAS}
    return SkinState(**known | fields)


def on_points(n):
    points = np.zeros((n, 6), np.float32)
    points[:, 0] = np.arange(n)
    points[:, 5] = 1
    return points


@pytest.mark.parametrize("name", ["n_rows", "n_cols"])
@pytest.mark.parametrize(
    ("side", "is_allowed"),
    [(0, False), (1, True), (MAX_SIDE, True), (MAX_SIDE + 1, False), (2.0, False)],
)
def test_a_side_has_1_to_4096_taxels(name, side, is_allowed):
    sides = {"n_rows": 1, "n_cols": 1, name: side}
    if is_allowed:
        assert Skin(**sides, f_max=1.0).n_taxels == side
        return
    with pytest.raises(FieldError):
        Skin(**sides, f_max=1.0)


@pytest.mark.parametrize("f_max", [0.0, -1.0, np.inf, np.nan, True])
def test_a_range_that_is_not_finite_and_above_0_is_refused(f_max):
    with pytest.raises(FieldError):
        Skin(2, 3, f_max)


@FEW
@given(exists=hnp.arrays(np.bool_, SHAPES).filter(np.any), data=st.data())
def test_without_some_cells_the_others_are_left_with_their_points(exists, data):
    n = int(exists.sum())
    skin = Skin(
        *exists.shape,
        f_max=1.0,
        mask=exists,
        points=on_points(n),
        point_rows=np.arange(n, dtype=np.int32),
    )
    cells = data.draw(hnp.arrays(np.bool_, exists.shape))
    expected = exists & ~cells
    if not expected.any():
        with pytest.raises(FieldError):
            skin.without(cells)
        return
    rest = skin.without(cells)
    np.testing.assert_array_equal(rest.exists, expected)
    assert rest.n_taxels == expected.sum()
    rows = np.flatnonzero(expected[exists])
    np.testing.assert_array_equal(rest.points[:, 0], rows)
    np.testing.assert_array_equal(rest.point_rows, rows)


def test_a_grid_without_a_mask_loses_cells_too():
    cells = np.array([[True, False, False], [False, False, True]])
    rest = Skin(2, 3, 1.0).without(cells)
    np.testing.assert_array_equal(rest.exists, ~cells)
    assert rest.points is None
    assert Skin(2, 3, 1.0).exists.all()


@given(
    n=st.integers(1, 20),
    far=st.sets(st.tuples(st.integers(0, 19), st.integers(0, 2)), max_size=3),
    value=st.sampled_from([1.001 * MAX_COORDINATE_M, -np.inf, np.nan]),
)
def test_the_first_place_that_is_far_away_is_named(n, far, value):
    places = np.full((n, 3), MAX_COORDINATE_M)
    inside = [place for place in far if place[0] < n]
    for place in inside:
        places[place] = value
    expected = min((row for row, _ in inside), default=None)
    assert first_far(places) == expected


@pytest.mark.parametrize(
    ("length", "is_allowed"),
    [(0.9985, False), (0.9995, True), (1.0005, True), (1.0015, False)],
)
def test_a_normal_has_length_1_but_for_a_thousandth(length, is_allowed):
    points = on_points(2)
    points[1, 5] = length
    if is_allowed:
        Skin(1, 2, 1.0, points=points)
        return
    with pytest.raises(FieldError):
        Skin(1, 2, 1.0, points=points)


def test_a_skin_may_have_more_points_than_a_side_has_taxels():
    n = MAX_SIDE + 4
    points = on_points(n)
    points[:, 0] /= n
    message = state(n_rows=2, n_cols=n // 2, points=points)
    assert decode(*encode(message)).skin.n_taxels == n


def test_rows_of_points_are_whole_numbers_from_0_on():
    rows = np.array([0, 5], np.int32)
    Skin(1, 2, 1.0, points=on_points(2), point_rows=rows)
    with pytest.raises(ShapeError):
        Skin(1, 2, 1.0, points=on_points(2), point_rows=rows.astype(np.int64))
    with pytest.raises(FieldError):
        Skin(1, 2, 1.0, points=on_points(2), point_rows=rows - 1)


def test_a_contact_is_a_hundredth_of_a_newton_on_the_skin_of_the_paper():
    assert pytest.approx(0.01) == CONTACT_FRACTION * PAPER_F_MAX_N


def test_the_range_clips_noise_to_the_deviation_that_is_stated():
    noise = np.random.default_rng(0).normal(size=200_000)
    assert np.maximum(noise, 0).std() == pytest.approx(CLIP_SD, abs=0.003)


@given(
    sigma_mid=st.floats(0.001, 1.0),
    sigma_end=st.floats(0.001, 1.0),
    below=st.floats(0.0, 10.0),
)
def test_the_least_noise_is_that_of_an_untouched_taxel_where_the_range_clips_it(
    sigma_mid, sigma_end, below
):
    skin = state(sigma_mid=sigma_mid, sigma_end=sigma_end, f_min=-below)
    clips = below < 2 * sigma_end
    assert skin.clips_noise == clips
    least = min(sigma_mid, sigma_end)
    assert skin.least_sd == pytest.approx(least * CLIP_SD if clips else least)


def test_without_stated_noise_the_least_is_0():
    assert state(sigma_mid=0.0, sigma_end=0.0).least_sd == 0.0


@FEW
@given(message=skin_states())
def test_a_skin_has_the_fields_of_its_message(message):
    skin = message.skin
    for name in ("n_rows", "n_cols", "f_max", "unit", "pitch_m"):
        assert getattr(skin, name) == getattr(message, name)
    for name in ("mask", "points", "point_rows"):
        assert getattr(skin, name) is getattr(message, name)


@FEW
@given(message=skin_states(), rate_hz=st.none() | st.floats(0.0, 1e3))
def test_a_description_has_what_is_known(message, rate_hz):
    stated = described(message, rate_hz)
    expected = {"f_max", "unit"}
    for name in ("mask", "points", "point_rows"):
        if getattr(message, name) is not None:
            expected.add(name)
    if message.pitch_m:
        expected.add("pitch_m")
    if rate_hz:
        expected.add("rate_hz")
        assert stated["rate_hz"] == rate_hz
    assert set(stated) == expected
    assert stated["f_max"] == message.f_max


@pytest.mark.parametrize(
    ("name", "value", "is_allowed"),
    [
        ("n", 0, False),
        ("m", 0, False),
        ("block", 0, False),
        ("n", 1, True),
        ("m", 1, True),
        ("block", 1, True),
        ("n", 1 << 20, True),
        ("n", (1 << 20) + 1, False),
        ("rule", 0, False),
        ("rule", 1, True),
        ("rule", 3, True),
        ("rule", 4, False),
        ("seed", -1, False),
        ("fingerprint", "0" * 15, False),
        ("fingerprint", "0" * 17, False),
    ],
)
def test_numbers_of_a_matrix_are_in_their_range(name, value, is_allowed):
    fields = {"kind": "sbhe", "n": 9, "m": 3, "block": 8, "seed": 0}
    fields |= {"fingerprint": "0" * 16, name: value}
    if is_allowed:
        assert getattr(PhiState(stamp_ns=0, patch="skin", **fields), name) == value
        return
    with pytest.raises(MessageError):
        PhiState(stamp_ns=0, patch="skin", **fields)


@given(
    skin_states(),
    st.floats(0.0, 0.2),
    st.floats(0.0, 4.0),
    st.integers(0, 2**32 - 1),
)
def test_the_bias_of_clipped_noise_is_its_mean(skin, part, depth, seed):
    sd = part * skin.f_max
    f_min = -depth * sd
    skin = dataclasses.replace(skin, sigma_end=sd, f_min=f_min)
    n = 20_000
    noise = np.random.default_rng(seed).normal(0, 1, n)
    mean = sd * np.maximum(noise, -depth).mean()
    # Noise within two deviations is hardly clipped: 0.0085 of one.
    assert skin.clip_bias == pytest.approx(mean, abs=sd * (0.009 + 6 / np.sqrt(n)))
    assert (skin.clip_bias > 0) == (sd > 0 and skin.clips_noise)


@pytest.mark.parametrize(
    ("changes", "is_allowed"),
    [
        ({"iterations": 0}, True),
        ({"iterations": -1}, False),
        ({"iterations": 1_000_000}, True),
        ({"iterations": 1_000_001}, False),
        ({"max_iterations": 0}, True),
        ({"max_iterations": -1}, False),
        ({"lambda_n": -1e-9}, False),
        ({"frame_ms": -1e-9}, False),
        ({"step_tiles": -1}, False),
        ({"noise_sum": 9.0}, True),
        ({"noise_sum": -1e-9}, False),
    ],
)
def test_numbers_of_a_solver_are_in_their_range(changes, is_allowed):
    fields = {"solver": "skin", "basis": "", "preset": "skin", "iterations": 3}
    fields |= {"lambda_n": 0.0, **changes}
    if is_allowed:
        SolverState(stamp_ns=0, patch="skin", **fields)
        return
    with pytest.raises(MessageError):
        SolverState(stamp_ns=0, patch="skin", **fields)


@pytest.mark.parametrize(
    ("changes", "is_allowed"),
    [
        ({"share": 0.0}, True),
        ({"share": 1.0}, True),
        ({"share": 1.01}, False),
        ({"share": -0.01}, False),
        ({"label": "a" * 64}, True),
        ({"label": "a" * 65}, False),
        ({"age_s": -0.01}, False),
    ],
)
def test_numbers_of_a_label_are_in_their_range(changes, is_allowed):
    fields = {"label": "box", "share": 0.5, "age_s": 0.0, "done_ns": 7, **changes}
    if is_allowed:
        assert Labels(stamp_ns=0, patch="skin", **fields).trusted
        return
    with pytest.raises(MessageError):
        Labels(stamp_ns=0, patch="skin", **fields)


@pytest.mark.parametrize(
    ("changes", "is_allowed"),
    [
        ({"f_min": 0.0}, True),
        ({"f_min": 0.1}, False),
        ({"pitch_m": -1e-3}, False),
        ({"sigma_mid": -0.1}, False),
        ({"sigma_end": -0.1}, False),
        ({"rate_hz": -1.0}, False),
        ({"unit": "u" * 32}, True),
        ({"unit": "u" * 33}, False),
    ],
)
def test_numbers_of_a_skin_are_in_their_range(changes, is_allowed):
    if is_allowed:
        state(**changes)
        return
    with pytest.raises(MessageError):
        state(**changes)
