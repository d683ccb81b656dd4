"""Words and checks of files: numbers, masks and units at their bounds, and lines of errors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.checks import (
    MAX_EXAMPLES,
    check_number,
    check_unit,
    choose,
    is_missing,
    parse_mask,
    parse_number,
    parse_whole,
    reading,
    shown,
    spelled,
)
from sparseskin.nodes.sensor.layout.layout import UnstatedError

SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=6)


@given(text=st.text(max_size=80), limit=st.integers(8, 60))
def test_any_text_is_quoted_in_ascii_within_its_limit(text, limit):
    quoted = shown(text, limit)
    assert len(quoted) <= limit
    assert quoted.isascii()
    assert quoted.isprintable()
    assert quoted[0] in "'\""
    if len(ascii(text)) <= limit:
        assert quoted == ascii(text)
    else:
        assert quoted.endswith("...'")


def test_settings_behind_add_are_spelled_as_options_and_no_others():
    line = "a=1: is unknown; add tare=30 if b, or invert=true"
    assert spelled(line, lambda key: f"--{key} ") == (
        "a=1: is unknown; add --tare 30 if b, or --invert true"
    )
    assert spelled("a=1", lambda key: f"--{key} ") == "a=1"


@given(names=st.lists(st.text("abc", min_size=1), unique=True, max_size=12))
def test_the_only_candidate_is_chosen_and_of_several_the_stated_one(names):
    candidates = dict.fromkeys(names, "words")
    for name in names:
        assert choose(candidates, name, "file", "things") == name
    with pytest.raises(SourceError):
        choose(candidates, "other", "file", "things")
    if len(names) == 1:
        assert choose(candidates, "", "file", "things") == names[0]
        return
    with pytest.raises(UnstatedError if names else SourceError) as error:
        choose(candidates, "", "file", "things")
    assert str(error.value).count("(words)") == min(len(names), MAX_EXAMPLES)


@given(value=st.floats(), low=st.floats(-1e3, 0), high=st.floats(0, 1e3))
def test_a_number_is_finite_and_within_its_bounds(value, low, high):
    if math.isfinite(value) and low <= value <= high:
        assert parse_number(repr(value), "here", low, high) == value
        return
    with pytest.raises(SourceError, match=r"^here: "):
        parse_number(repr(value), "here", low, high)


@pytest.mark.parametrize("token", ["", "1_0", "x", "nan", "inf", "-inf", "1e999"])
def test_what_is_no_finite_number_is_refused(token):
    with pytest.raises(SourceError):
        parse_number(token, "here")


@given(value=st.integers(-20, 20), low=st.integers(0, 9), span=st.integers(0, 9))
def test_a_whole_number_is_within_its_bounds(value, low, span):
    high = low + span
    if low <= value <= high:
        assert parse_whole(str(value), "here", low, high) == value
        return
    with pytest.raises(SourceError, match=r"^here: "):
        parse_whole(str(value), "here", low, high)


@pytest.mark.parametrize(
    ("token", "is_allowed"),
    [
        ("999999999", True),
        ("1000000000", False),
        ("0000000001", False),
        ("+1", False),
        ("1.0", False),
        ("", False),
        ("\u0663", False),
    ],
)
def test_a_whole_number_has_nine_digits_at_most(token, is_allowed):
    if is_allowed:
        assert parse_whole(token, "here", 0, 10**12) == int(token)
        return
    with pytest.raises(SourceError):
        parse_whole(token, "here", 0, 10**12)


@given(mask=hnp.arrays(np.bool_, SHAPES))
def test_a_mask_is_written_as_a_text_a_row(mask):
    rows = ["".join("01"[cell] for cell in row) for row in mask.astype(int)]
    np.testing.assert_array_equal(parse_mask(rows, mask.shape, "here"), mask)
    n_rows, n_cols = mask.shape
    wrong = (
        [rows, (n_rows + 1, n_cols)],
        [rows, (n_rows, n_cols + 1)],
        [[*rows[:-1], "2" * n_cols], mask.shape],
        [[*rows[:-1], 1], mask.shape],
        [tuple(rows), mask.shape],
    )
    for texts, shape in wrong:
        with pytest.raises(SourceError):
            parse_mask(texts, shape, "here")


@pytest.mark.parametrize(
    ("value", "is_allowed"),
    [
        (None, True),
        (1e-9, True),
        (1e-10, False),
        (0, False),
        (-1.0, False),
        (5, True),
        (5.1, False),
        (True, False),
        ("1", False),
        (math.nan, False),
    ],
)
def test_a_stated_number_is_above_0_and_within_its_bound(value, is_allowed):
    if is_allowed:
        check_number("here", "x", value, 5)
        return
    with pytest.raises(SourceError):
        check_number("here", "x", value, 5)


@pytest.mark.parametrize(
    ("unit", "is_allowed"),
    [
        (None, True),
        ("N", True),
        ("u" * 32, True),
        ("u" * 33, False),
        ("", False),
        ("  ", False),
        ("a\nb", False),
        (3, False),
    ],
)
def test_a_unit_is_a_short_printable_text(unit, is_allowed):
    if is_allowed:
        check_unit("here", unit)
        return
    with pytest.raises(SourceError):
        check_unit("here", unit)


@pytest.mark.parametrize(
    ("token", "is_nothing"),
    [("", True), (" NaN ", True), ("N/A", True), ("-inf", True), ("0", False)],
)
def test_cells_without_a_number_are_known_by_their_words(token, is_nothing):
    assert is_missing(token) == is_nothing


def test_only_a_regular_file_that_is_not_empty_is_read(tmp_path):
    (tmp_path / "full").write_bytes(b"text")
    (tmp_path / "empty").touch()
    with reading(str(tmp_path / "full")) as file:
        assert file.read() == b"text"
    for name in ("empty", "gone", ".", "a\0b"):
        with pytest.raises(SourceError), reading(str(tmp_path / name)):
            pass
