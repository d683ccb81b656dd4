"""The wire form: what goes in comes out, and nothing else comes in."""

import contextlib
import dataclasses
import math

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_strategies import messages, sent

from sparseskin.messages import (
    Calibration,
    End,
    FieldError,
    MalformedError,
    MessageError,
    NotFiniteError,
    OversizedError,
    PhiState,
    Reconstruction,
    ShapeError,
    SkinState,
    Taxels,
    TruncatedError,
    Truth,
    UnknownSchemaError,
    VersionError,
    decode,
    encode,
    size_bytes,
)
from sparseskin.messages.base import wire_fields
from sparseskin.messages.fields import Real
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.wire import _form_of, head_of, is_end, wire_bytes

MISSING = object()


def taxels(**changes):
    fields = {
        "stamp_ns": 7,
        "patch": "skin",
        "forces": np.arange(6, dtype=np.float32).reshape(2, 3),
    }
    return Taxels(**(fields | changes))


def body_of(message):
    return msgpack.unpackb(encode(message)[1])


def decode_body(body, topic=b"/skin/taxels"):
    return decode(topic, msgpack.packb(body, use_bin_type=True))


@given(messages)
def test_decoding_undoes_encoding(message):
    topic, payload = encode(message)
    twin = decode(topic, payload)
    assert twin == message
    assert list(twin.__dict__) == list(wire_fields(type(message)))
    assert encode(twin) == (topic, payload)


@given(messages)
def test_what_travels_is_the_topic_a_zero_byte_and_the_map_of_recordings(message):
    topic, payload = encode(message)
    buffer = wire_bytes(message)
    assert buffer == topic + b"\0" + payload
    assert sent(message) == (topic, payload)
    assert size_bytes(message) == len(buffer)


@given(messages, messages)
def test_a_size_is_that_of_the_wire_whatever_was_encoded_or_decoded_before(a, b):
    n_bytes_a = len(wire_bytes(a))
    n_bytes_b = len(wire_bytes(b))
    assert size_bytes(b) == n_bytes_b
    assert size_bytes(a) == n_bytes_a
    decoded_b = decode(*encode(b))
    assert size_bytes(decoded_b) == n_bytes_b
    assert size_bytes(a) == n_bytes_a


@given(messages)
def test_a_head_alone_says_which_message_it_is(message):
    payload = encode(message)[1]
    ends = isinstance(message, End)
    seq = message.n_messages if ends else message.seq
    assert head_of(payload) == (message.run_id, seq, message.stamp_ns, ends)
    assert is_end(payload) is ends


@given(messages)
def test_arrays_that_arrive_are_aligned_and_not_written_to(message):
    arrived = decode(*sent(message))
    for value in vars(arrived).values():
        if not isinstance(value, np.ndarray) or isinstance(value, Quantised):
            continue
        assert value.flags.aligned
        assert not value.flags.writeable


@given(message=messages, data=st.data())
def test_a_message_cut_short_is_refused(message, data):
    topic, payload = encode(message)
    n_bytes = data.draw(st.integers(0, len(payload) - 1))
    with pytest.raises(TruncatedError):
        decode(topic, payload[:n_bytes])


@given(message=messages, data=st.data())
def test_mutated_bytes_decode_or_raise_a_message_error(message, data):
    topic, payload = encode(message)
    mutated = bytearray(payload)
    # Most bytes are those of arrays: half of the changes are made in the fields before them.
    n_head = min(160, len(mutated))
    for _ in range(data.draw(st.integers(1, 4))):
        last = data.draw(st.sampled_from((n_head, len(mutated)))) - 1
        mutated[data.draw(st.integers(0, last))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(MessageError):
        decode(topic, bytes(mutated))


@given(st.binary(max_size=400), st.binary(max_size=200))
def test_random_bytes_raise_a_message_error(topic, payload):
    for place in (topic, b"/skin/taxels"):
        with pytest.raises(MessageError):
            decode(place, payload)


def test_senders_of_ever_new_sets_of_fields_fill_no_memory():
    state = PhiState(
        stamp_ns=1, patch="skin", kind="sbhe", n=9, m=3, block=8, seed=0,
        fingerprint="0" * 16,
    )  # fmt: skip
    body = body_of(state)
    bound = _form_of.cache_info().maxsize
    for k in range(2 * bound):
        keys = list(body)
        np.random.default_rng(k).shuffle(keys)
        assert decode_body({key: body[key] for key in keys}, b"/skin/phi") == state
        with pytest.raises(MalformedError):
            decode_body(body | {f"surplus_{k}": 1}, b"/skin/phi")
    assert _form_of.cache_info().currsize <= bound


def test_messages_are_immutable_and_compare_by_value():
    message = taxels()
    with pytest.raises(dataclasses.FrozenInstanceError):
        message.seq = 5
    assert message == taxels()
    assert message != taxels(forces=np.ones((2, 3), np.float32))
    assert message != Truth(stamp_ns=7, patch="skin", forces=message.forces)


@pytest.mark.parametrize("shape", [(3, 2), (1, 6), (6, 1)])
def test_messages_of_the_same_numbers_in_another_shape_differ(shape):
    message = taxels()
    other = taxels(forces=message.forces[0].reshape(shape))
    assert other.forces.tobytes() == message.forces.tobytes()
    assert message != other


@given(
    st.integers(0, 2**62), st.sampled_from([math.nan, math.inf, -math.inf]), st.data()
)
def test_a_following_message_is_the_one_that_is_made_anew_and_its_arrays_are_checked(
    stamp_ns, bad, data
):
    forces = np.random.default_rng(stamp_ns).uniform(0, 2, (3, 4)).astype(np.float32)
    first = Taxels(stamp_ns=0, patch="skin", forces=np.zeros((3, 4), np.float32))
    expected = Taxels(stamp_ns=stamp_ns, patch="skin", forces=forces)
    assert first.following(stamp_ns=stamp_ns, forces=forces) == expected
    by_columns = np.asfortranarray(forces)
    assert encode(first.following(stamp_ns=stamp_ns, forces=by_columns)) == encode(
        expected
    )

    forces[data.draw(st.integers(0, 2)), data.draw(st.integers(0, 3))] = bad
    with pytest.raises(NotFiniteError):
        first.following(stamp_ns=stamp_ns, forces=forces)
    with pytest.raises(ShapeError):
        first.following(stamp_ns=stamp_ns, forces=forces.astype(np.float64))


def test_forces_that_are_not_finite_are_refused_and_the_cell_is_named():
    forces = np.zeros((2, 3), np.float32)
    forces[1, 2] = -np.inf
    with pytest.raises(NotFiniteError, match=r"forces\[1, 2\]"):
        taxels(forces=forces)
    body = body_of(taxels())
    body["forces"]["data"] = forces.tobytes()
    with pytest.raises(NotFiniteError, match=r"forces\[1, 2\]"):
        decode_body(body)


@pytest.mark.filterwarnings("error")
def test_the_largest_finite_forces_are_taken():
    forces = np.full((40, 40), np.finfo(np.float32).max)
    assert decode(*encode(taxels(forces=forces))) == taxels(forces=forces)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"schema": "taxel"}, UnknownSchemaError),
        ({"version": 1}, VersionError),
        ({"seq": -1}, FieldError),
        ({"patch": "Skin"}, FieldError),
        ({"patch": "s" * 33}, OversizedError),
        ({"patch": "other"}, FieldError),
        ({"run_id": "xyz"}, FieldError),
        ({"surplus": 1}, MalformedError),
        ({"stamp_ns": MISSING}, MalformedError),
        ({"forces": [0.0]}, MalformedError),
        ({"forces": {"dtype": "<f8"}}, ShapeError),
        ({"forces": {"order": "F"}}, ShapeError),
        ({"forces": {"shape": [6]}}, ShapeError),
        ({"forces": {"shape": [True, 2, 3]}}, MalformedError),
        ({"forces": {"shape": [1, 4096, 4096]}}, OversizedError),
        ({"forces": {"data": b""}}, ShapeError),
        ({"forces": {"more": 1}}, MalformedError),
    ],
)
def test_wrong_fields_are_refused(change, error):
    body = body_of(taxels())
    if isinstance(of_array := change.get("forces"), dict):
        change = {"forces": body["forces"] | of_array}
    body |= change
    left = {name: value for name, value in body.items() if value is not MISSING}
    with pytest.raises(error):
        decode_body(left)


def test_a_field_that_an_older_message_has_not_is_its_default_and_costs_no_bytes():
    told = {
        "stamp_ns": 1,
        "patch": "skin",
        "kind": "sbhe",
        "n": 9,
        "m": 3,
        "block": 8,
        "seed": 0,
    }
    fixed = PhiState(**told, fingerprint="0" * 16)
    assert "rows" not in body_of(fixed)
    assert decode(*encode(fixed)).rows == "fixed"
    rotating = PhiState(**told, fingerprint="0" * 16, rows="rotating")
    assert body_of(rotating)["rows"] == "rotating"
    assert decode(*encode(rotating)) == rotating
    with pytest.raises(FieldError, match="rows"):
        decode_body(body_of(rotating) | {"rows": "spinning"}, b"/skin/phi")


def test_whole_numbers_are_allowed_up_to_the_largest_of_64_bits_with_a_sign():
    largest = taxels(stamp_ns=2**63 - 1, seq=0)
    assert decode(*encode(largest)).stamp_ns == 2**63 - 1
    assert taxels(stamp_ns=np.int64(2**63 - 1)) == largest
    for beyond in (2**63, -1, np.uint64(2**63)):
        with pytest.raises(FieldError, match=r"is outside 0\.\.9223372036854775807"):
            taxels(stamp_ns=beyond)
    with pytest.raises(FieldError, match="stamp_ns"):
        decode_body(body_of(largest) | {"stamp_ns": 2**63})


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (1e30, None),
        (np.float32(0.5), None),
        (-1e-9, FieldError),
        (True, FieldError),
        (np.float32("nan"), NotFiniteError),
        (10**400, FieldError),
    ],
)
def test_numbers_are_finite_and_in_range(value, error):
    field = Real(0.0, 1e30)
    if error is None:
        assert field.check("f", value) == float(value)
        return
    with pytest.raises(error, match=r"^f: "):
        field.check("f", value)


def test_two_objects_in_one_payload_and_another_topic_are_refused():
    topic, payload = encode(taxels())
    with pytest.raises(MalformedError, match="more than one"):
        decode(topic, payload + b"\x00")
    with pytest.raises(FieldError, match="came under topic"):
        decode(b"/skin/truth", payload)


@pytest.mark.parametrize(
    ("forces", "error"),
    [
        (np.zeros((2, 3), np.float64), ShapeError),
        (np.zeros((0, 3), np.float32), ShapeError),
        ([[0.0]], FieldError),
    ],
)
def test_wrong_arrays_are_refused_by_name(forces, error):
    with pytest.raises(error, match=r"^forces: "):
        taxels(forces=forces)


def test_the_largest_message_is_taken_and_a_larger_one_refused_before_it_is_read():
    largest = taxels(forces=np.ones((1024, 1024), np.float32))
    assert decode(*encode(largest)) == largest
    with pytest.raises(OversizedError):
        taxels(forces=np.ones((1025, 1024), np.float32))
    with pytest.raises(OversizedError):
        # Two of the largest arrays of four bytes an element, and 64 KiB.
        decode(b"/skin/taxels", bytes(2 * 4 * 2**20 + 65537))
    # Two names of 32 letters, and their slashes.
    with pytest.raises(OversizedError):
        decode(b"/" * 67, b"\x80")
    named = Taxels(stamp_ns=0, patch="p" * 32, forces=np.ones((1, 1), np.float32))
    assert decode(*encode(named)) == named


def test_a_mask_must_fit_the_grid_and_hold_booleans():
    state = on_points(None, np.array([[True, False], [True, True]]))
    assert state.skin.n_taxels == 3
    body = body_of(state)
    for change, error in (
        ({"n_rows": 3}, ShapeError),
        ({"f_max": 0.0}, FieldError),
        ({"mask": body["mask"] | {"data": b"\x01\x02\x00\x01"}}, MalformedError),
        ({"mask": body["mask"] | {"data": b"\x00\x00\x00\x00"}}, FieldError),
    ):
        with pytest.raises(error):
            decode_body(body | change, b"/skin/skin")


def on_points(points, mask=None):
    numbers = dict.fromkeys(
        ("stamp_ns", "seed", "rate_hz", "sigma_mid", "sigma_end"), 0
    )
    grid = {"n_rows": 2, "n_cols": 2, "f_max": 2.5, "unit": "N", "pitch_m": 0.01}
    texts = {"patch": "skin", "source": "test"}
    return SkinState(
        **numbers, **grid, **texts, has_truth=False, mask=mask, points=points
    )


def test_points_are_those_of_the_cells_that_exist():
    points = np.zeros((3, 6), np.float32)
    points[:, 0] = (-1, 0, 1000)
    points[:, 5] = 1
    mask = np.array([[True, False], [True, True]])
    state = on_points(points, mask)
    assert state.skin.points is not None
    assert decode(*encode(state)) == state
    with pytest.raises(ShapeError, match=r"expected float32 \[4, 6\]"):
        on_points(points)
    with pytest.raises(ShapeError):
        on_points(points.astype(np.float64), mask)
    for place, value, what in (
        ((1, 1), 1001.0, "point 1 is not within 1000 m"),
        ((2, 0), np.nan, "not a finite number"),
        ((2, 5), 0.0, "normal 2 has length 0, expected 1"),
        ((0, 3), 0.1, "normal 0 has length 1.005"),
    ):
        wrong = points.copy()
        wrong[place] = value
        with pytest.raises(MessageError, match=what):
            on_points(wrong, mask)
    for rows, fault in (
        (np.zeros(2, np.int32), r"expected int32 \[3\]"),
        (np.zeros(3, np.int32) - 1, "-1 is below 0"),
    ):
        with pytest.raises(MessageError, match=fault):
            dataclasses.replace(state, point_rows=rows)
    with pytest.raises(MessageError, match="without points"):
        dataclasses.replace(state, points=None, point_rows=np.zeros(3, np.int32))


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"response_force": None}, "expected both of them or none"),
        ({"response_force": np.ones(3, np.float32)}, "2 knots, but 3 forces"),
        ({"gains": np.ones((3, 2), np.float32)}, "expected one shape"),
        ({"response_reading": np.ones((2, 3, 2), np.float32)}, "expected one shape"),
    ],
)
def test_a_calibration_whose_parts_do_not_fit_is_refused(changes, what):
    fields = {
        "name": "palm",
        "baseline": np.zeros((2, 3), np.float32),
        "gains": None,
        "response_reading": np.ones((2, 1, 1), np.float32),
        "response_force": np.ones(2, np.float32),
    }
    Calibration(stamp_ns=0, patch="skin", **fields)
    with pytest.raises(ShapeError, match=what):
        Calibration(stamp_ns=0, patch="skin", **(fields | changes))


def reconstruction(error):
    forces = np.zeros((2, 2), dtype=np.float32)
    fields = {
        "stamp_ns": 1,
        "patch": "skin",
        "phi": "0" * 16,
        "iterations": (3,),
        "residual": (0.1,),
    }
    return Reconstruction(
        **fields, solve_ns=(1,), done_ns=2, forces=forces, sd=forces, error=(error,)
    )


def test_a_number_that_is_not_known_is_none_and_no_other_is_nan():
    topic = b"/skin/reconstruction"
    for error in (None, 0.25):
        assert decode(*encode(reconstruction(error))).error == (error,)
    body = body_of(reconstruction(0.25))
    for name in ("error", "residual"):
        with pytest.raises(NotFiniteError, match=name):
            decode_body(body | {name: [math.nan]}, topic)
    with pytest.raises(FieldError, match="residual"):
        decode_body(body | {"residual": [None]}, topic)
    body["sd"]["shape"] = [1, 1, 4]
    with pytest.raises(ShapeError, match="sd: shape"):
        decode_body(body, topic)
