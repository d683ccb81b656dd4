"""Messages of frames: missing readings, patches that have not changed, and times."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from message_strategies import messages

from sparseskin.messages import (
    FieldError,
    Measurements,
    MessageError,
    Reconstruction,
    ShapeError,
    Taxels,
    Truth,
)
from sparseskin.messages.base import wire_fields
from sparseskin.messages.frames import kinds_alone, known_forces, values_alone

NAMES = ("hand", "arm", "back", "leg")
SHAPES = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9)


def taxels(shape, **fields):
    forces = np.ones(shape, dtype=np.float32)
    return Taxels(stamp_ns=7, patch="skin", forces=forces, **fields)


def reconstruction(n_sent, **fields):
    """A message of the patches `NAMES`, of which the forces of some are sent."""
    n = len(NAMES)
    forces = np.arange(n_sent, dtype=np.float32).reshape(n_sent, 1, 1) + np.ones((2, 3))
    numbers = {"iterations": (1,) * n, "residual": (0.5,) * n, "solve_ns": (7,) * n}
    times = {"stamp_ns": 5, "done_ns": 9}
    head = {"patch": "body", "names": NAMES, "phi": "0" * 16}
    forces = forces.astype(np.float32)
    return Reconstruction(forces=forces, **head, **numbers, **times, **fields)


def measurements(n_sent, **fields):
    y = np.arange(3 * n_sent, dtype=np.float32).reshape(n_sent, 3)
    return Measurements(
        stamp_ns=5, patch="body", names=NAMES, phi="0" * 16, y=y, **fields
    )


@given(cells=hnp.arrays(np.bool_, SHAPES))
def test_marked_cells_are_those_whose_reading_is_missing(cells):
    message = taxels(cells.shape, missing=np.packbits(cells))
    np.testing.assert_array_equal(message.missing_cells(cells.shape), cells)
    known = known_forces(message)
    np.testing.assert_array_equal(np.isnan(known), cells)
    assert (known[~cells] == 1).all()


@given(shape=SHAPES)
def test_without_marks_no_reading_is_missing(shape):
    message = taxels(shape)
    assert message.missing_cells(shape) is None
    np.testing.assert_array_equal(known_forces(message), np.ones(shape))


def test_all_forces_of_a_truth_are_known():
    forces = np.ones((2, 3), dtype=np.float32)
    message = Truth(stamp_ns=7, patch="skin", forces=forces)
    np.testing.assert_array_equal(known_forces(message), forces)


@given(cells=hnp.arrays(np.bool_, SHAPES), n_more=st.sampled_from([-1, 1]))
def test_marks_of_another_grid_are_refused(cells, n_more):
    marks = np.packbits(cells)
    wrong = np.resize(marks, marks.size + n_more)
    if not wrong.size:
        return
    with pytest.raises(ShapeError):
        taxels(cells.shape, missing=wrong).missing_cells(cells.shape)


def test_marks_are_those_of_one_patch():
    forces = np.ones((1, 2, 4), dtype=np.float32)
    marks = np.array([0b10000000], np.uint8)
    Taxels(stamp_ns=7, patch="body", names=("arm",), forces=forces, missing=marks)
    with pytest.raises(FieldError):
        Taxels(
            stamp_ns=7,
            patch="body",
            names=("arm", "hand"),
            forces=np.repeat(forces, 2, axis=0),
            missing=marks,
        )


UNCHANGED = st.lists(st.booleans(), min_size=len(NAMES), max_size=len(NAMES))
#: A frame of which no patch has changed is not sent.
SOME_CHANGED = UNCHANGED.filter(lambda unchanged: not all(unchanged))


@given(unchanged=SOME_CHANGED)
def test_measurements_that_are_sent_are_those_of_the_patches_that_changed(unchanged):
    changed = [name for name, same in zip(NAMES, unchanged, strict=True) if not same]
    message = measurements(len(changed), unchanged=tuple(unchanged))
    parts = message.split()
    assert [part.patch for part in parts] == changed
    for row, part in enumerate(parts):
        np.testing.assert_array_equal(part.y, message.y[row : row + 1])
        assert part.unchanged == (False,)
    assert message.all_sent == (len(changed) == len(NAMES))


@given(unchanged=UNCHANGED)
def test_measurements_of_patches_that_are_unchanged_may_be_sent(unchanged):
    message = measurements(len(NAMES), unchanged=tuple(unchanged))
    assert message.all_sent
    parts = message.split()
    assert [part.patch for part in parts] == list(NAMES)
    assert [part.unchanged for part in parts] == [(same,) for same in unchanged]


@pytest.mark.parametrize("make", [measurements, reconstruction])
@given(unchanged=SOME_CHANGED, n_sent=st.integers(0, len(NAMES) + 2))
def test_rows_are_those_of_all_patches_or_of_those_that_changed(
    make, unchanged, n_sent
):
    if n_sent in (len(NAMES), unchanged.count(False)):
        make(n_sent, unchanged=tuple(unchanged))
        return
    with pytest.raises(MessageError):
        make(n_sent, unchanged=tuple(unchanged))


@given(unchanged=UNCHANGED)
def test_forces_that_are_not_sent_are_the_last_ones_of_their_patch(unchanged):
    last_forces = {}
    before = reconstruction(len(NAMES)).split(last_forces)
    n_sent = unchanged.count(False)
    now = reconstruction(n_sent, unchanged=tuple(unchanged))
    parts = now.split(last_forces)
    row = 0
    for k, part in enumerate(parts):
        expected = before[k].forces
        if not unchanged[k]:
            expected = now.forces[row : row + 1]
            row += 1
        np.testing.assert_array_equal(part.forces, expected)


def test_a_standard_deviation_for_each_patch_is_of_the_grid_of_the_forces():
    n = len(NAMES)
    reconstruction(n, sd=np.ones((n, 2, 3), np.float32))
    for shape in ((n, 3, 2), (n, 2, 4), (n - 1, 2, 3)):
        with pytest.raises(ShapeError):
            reconstruction(n, sd=np.ones(shape, np.float32))


def test_what_is_not_stated_of_patches_has_its_default_for_each():
    message = reconstruction(len(NAMES))
    n = len(NAMES)
    assert message.trusted == (True,) * n
    assert message.unchanged == (False,) * n
    assert message.reason == ("",) * n
    assert message.error == (None,) * n
    assert message.quiet == 0
    assert message.skipped == 0


@given(n_marked=st.integers(0, 16), m=st.integers(1, 16))
def test_each_marked_taxel_has_one_measurement(n_marked, m):
    bits = np.zeros(16, np.bool_)
    bits[:n_marked] = True
    fields = {"phi": "0" * 16, "y": np.ones(m, np.float32)}
    fields["places"] = np.packbits(bits)
    if n_marked == m:
        Measurements(stamp_ns=1, patch="arm", **fields)
        return
    with pytest.raises(ShapeError):
        Measurements(stamp_ns=1, patch="arm", **fields)


def test_nodes_of_a_tree_are_those_of_one_patch():
    tree = np.ones(2, np.uint8)
    measured = Measurements(
        stamp_ns=1, patch="arm", phi="0" * 16, y=np.ones(3, np.float32), nodes=tree
    )
    np.testing.assert_array_equal(measured.nodes, tree)
    with pytest.raises(FieldError):
        measurements(len(NAMES), nodes=tree)


@given(message=messages, by_ns=st.integers(-(2**40), 2**40))
def test_all_times_of_a_message_move_and_nothing_else(message, by_ns):
    later = message.moved(by_ns)
    for name in wire_fields(type(message)):
        before = getattr(message, name)
        after = getattr(later, name)
        if name in ("stamp_ns", "done_ns"):
            assert after == before + by_ns
        else:
            assert after is before


@given(message=messages, seq=st.integers(0, 2**60))
def test_a_published_message_has_run_and_number_and_is_the_same_else(message, seq):
    run_id = "0123456789abcdef"
    sent = message.published(run_id, seq)
    assert sent.run_id == run_id
    assert sent.seq == seq
    assert sent.published(message.run_id, message.seq) == message


@given(message=messages)
def test_values_without_the_axis_of_patches_are_named_as_their_kinds(message):
    if len(getattr(message, "patches", ())) > 1:
        return
    values = values_alone(message)
    assert set(values) == set(kinds_alone(type(message)))
    assert "names" not in values
    for value in values.values():
        assert not isinstance(value, tuple)
