"""Contacts of a frame: split by patch, in columns of a table, and what does not fit together."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_strategies import contacts

from sparseskin.messages import Contacts, FieldError, ShapeError
from sparseskin.messages.base import array_fields
from sparseskin.messages.contacts import EVENTS

#: A message of contacts takes ten times as long to draw as any other.
FEW = settings(max_examples=25)
#: Arrays without an entry for each contact.
NO_COLUMNS = {"events", "patch_of"}
PLACES = {"row": ("centre", 0), "col": ("centre", 1)}
PLACES |= {"row_sd": ("centre_sd", 0), "col_velocity": ("velocity", 1)}
PLACES |= {"x_mm": ("place_mm", 0), "z_mm": ("place_mm", 2)}
PLACES |= {"y_sd_mm": ("place_sd_mm", 1), "z_mm_s": ("velocity_mm_s", 2)}
PLACES |= {"x_normal": ("normal", 0)}


def columns_of(message):
    """Arrays of a message with an entry or a row for each contact."""
    values = vars(message)
    names = set(array_fields(Contacts)) - NO_COLUMNS
    return {name: values[name] for name in names if values[name] is not None}


def two_contacts(**changes):
    """A message of the contacts 1 and 2, of the patches "left" and "right"."""
    fields = {"stamp_ns": 5, "done_ns": 9, "patch": "body", "names": ("left", "right")}
    fields |= {"id": np.array([1, 2], np.int32), "area": np.array([3, 4], np.int32)}
    fields |= dict.fromkeys(("total", "total_sd", "peak", "age_s"), np.ones(2, "f4"))
    fields |= dict.fromkeys(("centre", "centre_sd", "velocity"), np.ones((2, 2), "f4"))
    fields |= dict.fromkeys(("over", "sliding"), np.zeros(2, np.bool_))
    fields["patch_of"] = np.array([0, 1], np.int32)
    return Contacts(**fields | changes)


@FEW
@given(message=contacts())
def test_a_part_has_the_contacts_of_its_patch_alone(message):
    patch_of = np.zeros(message.id.size, np.int32)
    if message.patch_of is not None:
        patch_of = message.patch_of
    parts = message.split()
    assert tuple(part.patch for part in parts) == message.patches
    for k, part in enumerate(parts):
        for name, column in columns_of(message).items():
            np.testing.assert_array_equal(getattr(part, name), column[patch_of == k])
        assert part.trusted == (message.trusted[k],)
        assert part.stamp_ns == message.stamp_ns


@FEW
@given(message=contacts())
def test_a_part_has_the_events_of_its_patch_alone(message):
    events = np.zeros((0, 3), np.int32)
    if message.events is not None:
        events = message.events
    for k, part in enumerate(message.split()):
        of_patch = events[events[:, 0] == k]
        expected = [(number, EVENTS[kind]) for _, number, kind in of_patch.tolist()]
        assert part.named_events == expected
        if expected:
            # It is the only patch of its message.
            assert not part.events[:, 0].any()
        else:
            assert part.events is None


@FEW
@given(message=contacts())
def test_splitting_leaves_the_message_as_it_is(message):
    before = None if message.events is None else message.events.copy()
    message.split()
    np.testing.assert_equal(message.events, before)


def test_the_contacts_of_a_message_without_rows_of_patches_are_those_of_the_first():
    whole = two_contacts(patch_of=None)
    first, second = whole.split()
    np.testing.assert_array_equal(first.id, whole.id)
    assert not second.id.size


@FEW
@given(message=contacts())
def test_a_table_has_each_column_and_nan_where_a_number_is_not_known(message):
    columns = message.columns()
    n = message.id.size
    assert {column.shape for column in columns.values()} == {(n,)}
    np.testing.assert_array_equal(columns["stamp_ns"], np.full(n, message.stamp_ns))
    np.testing.assert_array_equal(columns["trusted"], np.full(n, message.trusted[0]))
    for name, (field, axis) in PLACES.items():
        expected = np.full(n, np.nan)
        values = getattr(message, field)
        if values is not None:
            expected = values[:, axis]
        np.testing.assert_array_equal(columns[name], expected)
    assert not NO_COLUMNS & columns.keys()


@FEW
@given(message=contacts(), stamp_ns=st.integers(0, 99), done_ns=st.integers(0, 99))
def test_contacts_at_another_time_differ_in_their_times_and_trust_alone(
    message, stamp_ns, done_ns
):
    trusted = tuple(not flag for flag in message.trusted)
    later = message.at(stamp_ns, done_ns, trusted)
    assert later.stamp_ns == stamp_ns
    assert later.done_ns == done_ns
    assert later.trusted == trusted
    back = later.at(message.stamp_ns, message.done_ns, message.trusted)
    assert back == message


@pytest.mark.parametrize(
    "changes",
    [
        {"total": np.ones(3, np.float32)},
        {"centre": np.ones((2, 3), np.float32)},
        {"place_mm": np.ones((2, 2), np.float32)},
        {"area_mm2": np.ones(1, np.float32)},
        {"patch_of": np.array([0], np.int32)},
        {"patch_of": np.array([0, 2], np.int32)},
        {"patch_of": np.array([-1, 0], np.int32)},
        {"events": np.array([[0, 1]], np.int32)},
        {"events": np.array([[2, 1, 0]], np.int32)},
        {"events": np.array([[-1, 1, 0]], np.int32)},
        {"events": np.array([[0, 1, len(EVENTS)]], np.int32)},
        {"events": np.array([[0, 1, -1]], np.int32)},
    ],
)
def test_columns_and_events_that_do_not_fit_are_refused(changes):
    two_contacts()
    with pytest.raises(ShapeError):
        two_contacts(**changes)


def test_the_last_patch_and_the_last_event_are_allowed():
    last = np.array([[1, 2, len(EVENTS) - 1]], np.int32)
    assert two_contacts(events=last).named_events == [(2, EVENTS[-1])]


@pytest.mark.parametrize("name", ["stamp_ns", "done_ns"])
def test_a_time_below_0_is_refused(name):
    with pytest.raises(FieldError):
        two_contacts(**{name: -1})
