"""Kinds of fields: what they allow, up to the very bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import (
    FieldError,
    MessageError,
    NotFiniteError,
    OversizedError,
    ShapeError,
)
from sparseskin.messages.fields import (
    MAX_ELEMENTS,
    MAX_SIDE,
    STEP_MAX,
    Array,
    Each,
    Flag,
    Integer,
    Names,
    Real,
    Samples,
    Text,
    Words,
)
from sparseskin.messages.quantised import (
    MAX_BITS,
    MIN_BITS,
    Quantised,
    largest_code,
    n_bytes,
    packed,
    step_of,
    unpacked,
)
from sparseskin.messages.ranges import HUGE, is_real, is_whole
from sparseskin.messages.text import without_users
from sparseskin.messages.topics import (
    MAX_NAME,
    MAX_NAMES,
    MAX_PATCHES,
    check_name,
    split_topic,
    topic_of,
)

BOUNDS = st.tuples(st.integers(-9, 9), st.integers(-9, 9)).map(sorted)
NAME_TEXTS = st.from_regex(r"[a-z][a-z0-9_]{0,31}", fullmatch=True)


def refuses(kind, value):
    try:
        kind.check("f", value)
    except MessageError:
        return True
    return False


@given(bounds=BOUNDS, value=st.integers(-12, 12))
def test_whole_numbers_within_their_bounds_are_allowed(bounds, value):
    low, high = bounds
    is_within = low <= value <= high
    for number in (value, np.int16(value)):
        assert refuses(Integer(low, high), number) != is_within
        assert is_whole(number, low, high) == is_within
    assert refuses(Integer(low, high), float(value))
    assert not is_whole(float(value), low, high)


@given(bounds=BOUNDS, value=st.integers(-24, 24).map(lambda k: k / 2))
def test_numbers_within_their_bounds_are_allowed(bounds, value):
    low, high = bounds
    is_within = low <= value <= high
    for number in (value, np.float32(value)):
        assert refuses(Real(low, high), number) != is_within
        assert is_real(number, low, high) == is_within
    if value.is_integer():
        assert is_real(int(value), low, high) == is_within
        assert is_real(np.int16(value), low, high) == is_within


@pytest.mark.parametrize("value", [True, False, "1", None, [1]])
def test_truth_values_and_texts_are_no_numbers(value):
    assert not is_whole(value)
    assert not is_real(value)
    assert refuses(Integer(), value)
    assert refuses(Real(), value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, HUGE, -HUGE])
def test_what_is_not_finite_is_no_number(value):
    assert not is_real(value)
    assert is_real(HUGE - 1)


@pytest.mark.parametrize("value", [0, 1, np.True_, None])
def test_only_true_and_false_are_truth_values(value):
    assert refuses(Flag(), value)


def test_none_stands_for_an_optional_number_that_is_not_known():
    assert Real(optional=True).check("f", None) is None
    assert refuses(Real(), None)
    with pytest.raises(NotFiniteError):
        Real(optional=True).check("f", np.nan)


@given(longest=st.integers(1, 80), n=st.integers(0, 90), has_other=st.booleans())
def test_a_text_is_of_its_pattern_and_no_longer_than_allowed(longest, n, has_other):
    text = "a" * n + ("B" if has_other else "")
    kind = Text(longest, "[a-z]*")
    assert refuses(kind, text) == (has_other or len(text) > longest)


@given(names=st.lists(NAME_TEXTS, min_size=1, max_size=6))
def test_names_are_told_apart(names):
    assert refuses(Names(), tuple(names)) == (len(set(names)) < len(names))


def test_as_many_names_are_allowed_as_stated():
    names = tuple(f"p{k}" for k in range(MAX_PATCHES))
    assert Names().check("names", names) == names
    with pytest.raises(OversizedError):
        Names().check("names", (*names, "one_more"))


@pytest.mark.parametrize(("n_more", "is_refused"), [(0, False), (1, True)])
def test_names_have_as_many_characters_as_stated(n_more, is_refused):
    # 128 names of 31 characters, and 127 spaces; the last name fills up what is left.
    names = [f"p{k:030d}" for k in range(127)]
    n_left = MAX_NAMES - len(" ".join(names)) - 1 + n_more
    names.append("q" * n_left)
    assert n_left <= MAX_NAME + 1
    assert refuses(Names(), tuple(names)) == is_refused


@pytest.mark.parametrize("value", [["a"], "a", ("a", 1), None])
def test_names_are_a_tuple_of_texts(value):
    with pytest.raises(FieldError):
        Names().check("names", value)


def test_a_single_number_stands_for_that_of_one_patch():
    assert Each(Integer()).check("f", 3) == (3,)
    assert Each(Integer()).check("f", (3, 4)) == (3, 4)
    with pytest.raises(FieldError):
        Each(Integer(0, 3)).check("f", (3, 4))
    with pytest.raises(FieldError):
        Each(Integer()).unpack("f", 3)


@given(st.lists(st.from_regex("[a-z]{0,4}", fullmatch=True), min_size=1, max_size=5))
def test_words_travel_as_one_text(words):
    kind = Words(Text(16, "[a-z]*"), unstated=("",))
    assert kind.unpack("f", kind.pack(tuple(words))) == tuple(words)


@pytest.mark.parametrize(
    ("kind", "shape", "is_refused"),
    [
        (Array("<f4", 2), (MAX_SIDE, 1), False),
        (Array("<f4", 2), (MAX_SIDE + 1, 1), True),
        (Array("<f4", 2), (1, MAX_SIDE + 1), True),
        (Array("<f4", 1), (MAX_SIDE + 1,), False),
        (Array("<f4", 1), (MAX_ELEMENTS,), False),
        (Array("<f4", 1), (MAX_ELEMENTS + 1,), True),
        (Array("<f4", 2), (1024, 1024), False),
        (Array("<f4", 2), (1024, 1025), True),
        (Array("<f4", 2, longest=3), (3, 3), False),
        (Array("<f4", 2, longest=3), (3, 4), True),
        (Array("<f4", 2), (0, 2), True),
        (Array("<f4", 2), (2, 0), True),
        (Array("<f4", 2), (2,), True),
        (Array("<f4", 2, sparse=True), (0, 2), False),
        (Array("<f4", 2, sparse=True), (2, 0), True),
        (Array("<f4", 1, sparse=True), (0,), False),
    ],
)
def test_sides_and_elements_are_those_allowed(kind, shape, is_refused):
    assert refuses(kind, np.zeros(shape, np.float32)) == is_refused


def test_an_array_of_one_patch_may_lack_its_axis_and_no_other_may():
    value = np.ones((2, 3), np.float32)
    assert Array("<f4", 3, patches=True).check("f", value).shape == (1, 2, 3)
    with pytest.raises(ShapeError):
        Array("<f4", 3).check("f", value)
    with pytest.raises(ShapeError):
        Array("<f4", 3, patches=True).check("f", value[0])


@pytest.mark.parametrize(
    ("n_patches", "place"), [(1, r"f\[1, 2\]"), (2, r"f\[0, 1, 2\]")]
)
def test_the_first_number_that_is_not_finite_is_named(n_patches, place):
    value = np.zeros((n_patches, 2, 3), np.float32)
    value[0, 1, 2] = np.nan
    value[-1, 1, 2] = np.inf
    value[0, 1, 2] = np.nan
    with pytest.raises(NotFiniteError, match=rf"^{place}: "):
        Array("<f4", 3, patches=True).check("f", value)


@given(
    bits=st.integers(MIN_BITS, MAX_BITS),
    codes=st.lists(st.floats(-1, 1), min_size=1, max_size=40),
)
def test_codes_of_any_bits_are_packed_without_a_gap(bits, codes):
    top = largest_code(bits)
    numbers = np.rint(np.array(codes) * top).astype(np.int32)
    data = packed(numbers, bits)
    assert len(data) == n_bytes(numbers.size, bits) == -(-numbers.size * bits // 8)
    np.testing.assert_array_equal(unpacked(data, numbers.size, bits), numbers)


@given(bits=st.integers(MIN_BITS, MAX_BITS), seed=st.integers(0, 99))
def test_quantised_numbers_are_multiples_of_their_step(bits, seed):
    top = largest_code(bits)
    codes = np.random.default_rng(seed).integers(-top, top + 1, 9, dtype=np.int32)
    values = Quantised.of(codes, bits, 0.25)
    np.testing.assert_array_equal(np.asarray(values), codes * np.float32(0.25))
    np.testing.assert_array_equal(values.codes(), codes)
    assert step_of(values) == 0.25
    assert step_of(np.asarray(values)) == 0.0
    assert values[2:4].bits == bits
    assert values[2:4].step == 0.25


@pytest.mark.parametrize(
    ("bits", "step", "is_refused"),
    [
        (MIN_BITS, 0.5, False),
        (MIN_BITS - 1, 0.5, True),
        (MAX_BITS, 0.5, False),
        (MAX_BITS + 1, 0.5, True),
        (8, STEP_MAX, True),
        (8, 0.99 * STEP_MAX, False),
        (8, 0.0, True),
    ],
)
def test_bits_and_step_of_a_quantiser_are_in_their_range(bits, step, is_refused):
    values = Quantised.of(np.zeros(3, np.int32), bits, step)
    assert refuses(Samples(), values) == is_refused


@pytest.mark.parametrize("dtype", ["int08", "int", "int8 ", "uint8", "INT8", 8, None])
def test_a_dtype_that_is_none_of_a_quantiser_is_refused(dtype):
    values = Quantised.of(np.zeros((1, 3), np.int32), 8, 0.5)
    form = Samples().pack(values)
    form["shape"] = list(form["shape"])
    assert Samples().unpack("y", form).bits == 8
    with pytest.raises(ShapeError):
        Samples().unpack("y", form | {"dtype": dtype})


@given(name=st.sampled_from(["dtype", "shape", "order", "data", "step"]))
def test_the_form_of_an_array_has_all_its_parts(name):
    values = Quantised.of(np.zeros((1, 3), np.int32), 8, 0.5)
    form = Samples().pack(values)
    del form[name]
    with pytest.raises(MessageError):
        Samples().unpack("y", form)


@given(patch=NAME_TEXTS, schema=NAME_TEXTS)
def test_a_topic_is_split_into_its_patch_and_schema(patch, schema):
    assert split_topic(topic_of(patch, schema)) == (patch, schema)


@pytest.mark.parametrize("topic", ["", "/a", "a/b", "x/a/b", "/a/b/c", "/A/b", "/a/B"])
def test_what_is_no_topic_is_refused(topic):
    with pytest.raises(FieldError):
        split_topic(topic)


@given(n=st.integers(MAX_NAME - 1, MAX_NAME + 1))
def test_a_name_has_32_characters_at_most(n):
    if n <= MAX_NAME:
        assert check_name("f", "a" * n) == "a" * n
        return
    with pytest.raises(OversizedError):
        check_name("f", "a" * n)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("tcp://me:secret@robot:5000", "tcp://***@robot:5000"),
        ("https://me@robot/a", "https://***@robot/a"),
        ("s3:/me:secret@bucket/a", "s3:/***@bucket/a"),
        ("tcp://robot:5000", "tcp://robot:5000"),
        ("me@robot", "me@robot"),
    ],
)
def test_users_and_passwords_of_addresses_are_not_shown(text, shown):
    assert without_users(text) == shown
