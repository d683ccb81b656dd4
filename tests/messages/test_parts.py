"""Frames in parts: what goes in comes out, and nothing else comes in."""

from __future__ import annotations

import contextlib

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_strategies import messages

from sparseskin.messages import (
    FieldError,
    MalformedError,
    Measurements,
    Message,
    MessageError,
    NotFiniteError,
    OversizedError,
    Reconstruction,
    ShapeError,
    Taxels,
    TruncatedError,
    UnknownSchemaError,
    VersionError,
    decode,
    encode,
    size_bytes,
)
from sparseskin.messages.batches import BATCHES
from sparseskin.messages.parts import MAX_HEAD_BYTES, head_of, travels_in_parts
from sparseskin.messages.wire import SCHEMAS, Payload, payload_of, wire_parts
from sparseskin.nodes.compressor.quantiser import quantised

TOPIC = b"/skin/taxels"


def sent(message: Message) -> tuple[bytes, Payload]:
    """Topic and payload as they arrive."""
    parts = [bytes(part) for part in wire_parts(message)]
    return parts[0], payload_of(parts)


def taxels(value: float = 1.0, shape: tuple[int, int] = (2, 3)) -> Taxels:
    forces = np.full(shape, value, dtype=np.float32)
    return Taxels(stamp_ns=7, patch="skin", forces=forces)


@given(messages)
def test_parts_hold_the_message_and_their_lengths_are_its_size(message: Message) -> None:
    twin = decode(*sent(message))
    assert twin == message
    assert list(twin.__dict__) == list(decode(*encode(message)).__dict__)
    assert size_bytes(message) == sum(len(bytes(part)) for part in wire_parts(message))


def test_frames_with_arrays_travel_in_parts_and_their_map_is_read_too() -> None:
    found = {name for name, cls in SCHEMAS.items() if travels_in_parts(cls)}
    single = {"taxels", "truth", "measurements", "reconstruction"}
    assert found == single | {cls.schema for cls in BATCHES.values()}
    topic, payload = encode(taxels())
    assert decode(topic, payload_of([topic, payload])) == taxels()


def test_an_array_is_a_view_of_its_part_and_not_written_to() -> None:
    topic, payload = sent(taxels())
    found = decode(topic, payload)
    assert isinstance(found, Taxels)
    assert np.shares_memory(found.forces, np.frombuffer(payload[1], np.float32))  # type: ignore[arg-type]
    assert not found.forces.flags.writeable


@given(st.integers(2, 16), st.lists(st.floats(-1, 1, width=32), min_size=1, max_size=9))
def test_quantised_measurements_keep_codes_bits_and_step(bits: int, values: list[float]) -> None:
    y = quantised(np.array(values, dtype=np.float32), bits)
    message = Measurements(stamp_ns=1, patch="skin", y=y, phi="0" * 16)
    found = decode(*sent(message))
    assert found == message
    assert found.y.bits == bits  # type: ignore[attr-defined]
    assert found.y.step == y.step  # type: ignore[attr-defined]


@given(messages.filter(lambda m: travels_in_parts(type(m))), st.data())
@settings(max_examples=300)
def test_mutated_parts_decode_or_raise_a_message_error(
    message: Message, data: st.DataObject
) -> None:
    topic, payload = sent(message)
    parts = [bytearray(part) for part in payload]
    for _ in range(data.draw(st.integers(1, 4))):
        part = parts[data.draw(st.integers(0, len(parts) - 1))]
        part[data.draw(st.integers(0, len(part) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(MessageError):
        decode(topic, tuple(map(bytes, parts)))


@given(st.lists(st.binary(max_size=200), min_size=2, max_size=5))
def test_random_parts_raise_a_message_error(parts: list[bytes]) -> None:
    with pytest.raises(MessageError):
        decode(TOPIC, tuple(parts))


@given(messages.filter(lambda m: travels_in_parts(type(m))), st.data())
def test_parts_cut_short_are_refused_as_truncated(message: Message, data: st.DataObject) -> None:
    topic, (head, *arrays) = sent(message)
    assert isinstance(head, bytes)
    cut = data.draw(st.integers(0, len(head) - 1))
    with pytest.raises(TruncatedError):
        decode(topic, (head[:cut], *arrays))
    with pytest.raises(TruncatedError):
        decode(topic, (head, *arrays[:-1], arrays[-1][:-1]))
    with pytest.raises(TruncatedError):
        decode(topic, (head, *arrays[:-1]))


def test_a_part_too_many_and_an_array_too_long_are_refused() -> None:
    topic, (head, data) = sent(taxels())
    with pytest.raises(MalformedError, match="2 arrays, expected 1"):
        decode(topic, (head, data, data))
    with pytest.raises(OversizedError, match=r"shape \[2, 3\] does not fit 48 bytes"):
        decode(topic, (head, data + data))
    assert payload_of([topic, head, *[data] * 15]) == b""
    with pytest.raises(OversizedError, match="head of"):
        decode(topic, (bytes(MAX_HEAD_BYTES + 1), data))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_forces_that_are_not_finite_are_refused_in_each_frame(bad: float) -> None:
    topic, (head, data) = sent(taxels())
    assert decode(topic, (head, data)) == taxels()
    forces = np.frombuffer(data, np.float32).copy()
    forces[4] = bad
    with pytest.raises(NotFiniteError, match=r"forces\[1, 1\]"):
        decode(topic, (head, forces.tobytes()))


def test_a_known_description_does_not_pass_under_another_topic() -> None:
    topic, payload = sent(taxels())
    decode(topic, payload)
    with pytest.raises(FieldError, match="came under topic"):
        decode(b"/other/taxels", payload)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"wire": 3}, VersionError),
        ({"schema": "taxel"}, UnknownSchemaError),
        ({"schema": "skin"}, MalformedError),
        ({"version": 2}, VersionError),
        ({"texts": ["skin"]}, MalformedError),
        ({"texts": ["Skin", ""]}, FieldError),
        ({"texts": ["skin", 3]}, FieldError),
        ({"arrays": {}}, MalformedError),
        ({"arrays": {"force": ["<f4", [2, 3]]}}, MalformedError),
        ({"arrays": {"forces": ["<f4"]}}, MalformedError),
        ({"arrays": {"forces": ["<f8", [2, 3]]}}, ShapeError),
        ({"arrays": {"forces": ["<f4", [6]]}}, ShapeError),
        ({"arrays": {"forces": ["<f4", [2, -3]]}}, ShapeError),
        ({"arrays": {"forces": ["<f4", [4096, 4096]]}}, OversizedError),
        ({"arrays": {"forces": ["<f4", [2, 3.0]]}}, MalformedError),
        ({"more": 1}, MalformedError),
    ],
)
def test_wrong_descriptions_are_refused(change: dict[str, object], error: type[Exception]) -> None:
    topic, (head, data) = sent(taxels())
    description, *numbers = msgpack.unpackb(head)
    described = msgpack.unpackb(description) | change
    with pytest.raises(error):
        decode(topic, (msgpack.packb([msgpack.packb(described), *numbers]), data))


@pytest.mark.parametrize(
    ("numbers", "error"),
    [([7], MalformedError), ([7, 0, 1], MalformedError), ([-1, 0], FieldError),
     ([7, 0.0], FieldError), ([7, None], FieldError), (["7", 0], FieldError)],
)  # fmt: skip
def test_wrong_numbers_are_refused(numbers: list[object], error: type[Exception]) -> None:
    topic, (head, data) = sent(taxels())
    description = msgpack.unpackb(head)[0]
    with pytest.raises(error):
        decode(topic, (msgpack.packb([description, *numbers]), data))


@pytest.mark.parametrize("step", [0.0, -1.0, float("nan"), float("inf"), 1, None, "1"])
def test_wrong_steps_are_refused(step: object) -> None:
    y = quantised(np.ones(3, dtype=np.float32), 8)
    topic, (head, data) = sent(Measurements(stamp_ns=1, patch="skin", y=y, phi="0" * 16))
    *numbers, _ = msgpack.unpackb(head)
    with pytest.raises(MessageError):
        decode(topic, (msgpack.packb([*numbers, step]), data))


def test_fields_that_depend_on_each_other_are_checked_in_each_frame() -> None:
    fields = {"stamp_ns": 1, "patch": "skin", "phi": "0" * 16, "iterations": 3, "residual": 0.1}
    forces = np.zeros((2, 2), dtype=np.float32)
    message = Reconstruction(**fields, solve_ns=1, done_ns=2, forces=forces, sd=forces)  # type: ignore[arg-type]
    topic, (head, *arrays) = sent(message)
    description, *numbers = msgpack.unpackb(head)
    described = msgpack.unpackb(description)
    described["arrays"]["sd"] = ["<f4", [1, 4]]
    with pytest.raises(ShapeError, match="sd: shape"):
        decode(topic, (msgpack.packb([msgpack.packb(described), *numbers]), *arrays))


def test_a_head_alone_says_which_message_it_is() -> None:
    message = taxels().published("0123456789abcdef", 5)
    _, (head, _) = sent(message)
    assert isinstance(head, bytes)
    assert head_of(head) == ("0123456789abcdef", 5, 7)
