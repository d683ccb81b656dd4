"""Frames as one buffer: what goes in comes out, and nothing else comes in."""

import math
import struct

import msgpack
import numpy as np
import pytest
from hypothesis import given
from message_strategies import messages, sent

from sparseskin.messages import (
    FieldError,
    MalformedError,
    Measurements,
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
)
from sparseskin.messages.buffers import (
    ALIGNMENT,
    MARK,
    MAX_DESCRIPTION_BYTES,
    frame_pieces,
    head_of,
    is_frame,
)
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.wire import received, wire_bytes
from sparseskin.nodes.compressor.quantiser import quantised


def pieces(message):
    """Topic, description, numbers with padding, and arrays."""
    begin, numbers, *data = frame_pieces(message)
    topic, _, rest = begin.partition(b"\0")
    return topic, rest[3:], numbers, b"".join(data)


def payload(description, *rest):
    """A payload with another description, other numbers or arrays."""
    begin = bytes([MARK]) + len(description).to_bytes(2, "little")
    return b"".join((begin, description, *rest))


def taxels(value=1.0, shape=(2, 3)):
    return Taxels(stamp_ns=7, patch="skin", forces=np.full(shape, value, dtype=np.float32))


@given(messages.filter(lambda m: is_frame(type(m))))
def test_arrays_are_aligned_views_of_the_buffer_and_not_written_to(message):
    buffer = wire_bytes(message)
    found = decode(*received(buffer))
    for value in vars(found).values():
        if isinstance(value, np.ndarray) and not isinstance(value, Quantised) and value.size:
            assert np.shares_memory(value, np.frombuffer(buffer, np.uint8))
            assert value.ctypes.data % ALIGNMENT == 0
            assert not value.flags.writeable


def test_bytes_too_many_and_a_description_too_long_are_refused():
    topic, description, *rest = pieces(taxels())
    with pytest.raises(OversizedError, match=r"taxels: \d+ bytes, expected"):
        decode(topic, payload(description, *rest, b"x"))
    with pytest.raises(OversizedError, match="description of"):
        decode(topic, payload(bytes(MAX_DESCRIPTION_BYTES + 1), *rest))


def test_forces_that_are_not_finite_are_refused_in_each_frame():
    topic, description, numbers, data = pieces(taxels())
    assert decode(topic, payload(description, numbers, data)) == taxels()
    forces = np.frombuffer(data, np.float32).copy()
    forces[4] = np.inf
    with pytest.raises(NotFiniteError, match=r"forces\[1, 1\]"):
        decode(topic, payload(description, numbers, forces.tobytes()))


def test_a_known_description_does_not_pass_under_another_topic():
    topic, *rest = pieces(taxels())
    decode(topic, payload(*rest))
    for other in (b"/other/taxels", b"/skin/taxels_batch", b"/skin/taxels\0"):
        with pytest.raises(FieldError, match="came under topic"):
            decode(other, payload(*rest))
    with pytest.raises(TruncatedError, match="another version"):
        decode(topic, b"")


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"wire": 2}, VersionError),
        ({"schema": "taxel"}, UnknownSchemaError),
        ({"schema": "skin", "version": 1}, MalformedError),
        ({"version": 1}, VersionError),
        ({"texts": ["skin", ""]}, MalformedError),
        ({"texts": ["Skin", "", ""]}, FieldError),
        ({"arrays": {"forces": ["<f8", [1, 2, 3]]}}, ShapeError),
        ({"arrays": {"forces": ["<f4", [1, 2, -3]]}}, ShapeError),
        ({"arrays": {"forces": ["<f4", [1, 4096, 4096]]}}, OversizedError),
        ({"more": 1}, MalformedError),
    ],
)
def test_wrong_descriptions_are_refused(change, error):
    topic, description, *rest = pieces(taxels())
    described = msgpack.packb(msgpack.unpackb(description) | change)
    with pytest.raises(error):
        decode(topic, payload(described, *rest))


@pytest.mark.parametrize("numbers", [(-1, 0), (7, -1)])
def test_wrong_numbers_are_refused(numbers):
    topic, description, sound, data = pieces(taxels())
    packed = struct.pack("<qq", *numbers) + sound[16:]
    with pytest.raises(FieldError):
        decode(topic, payload(description, packed, data))


@pytest.mark.parametrize("step", [0.0, -1.0, math.nan, math.inf])
def test_wrong_steps_are_refused(step):
    y = quantised(np.ones(3, dtype=np.float32), 8)
    topic, description, sound, data = pieces(
        Measurements(stamp_ns=1, patch="skin", y=y, phi="0" * 16)
    )
    packed = sound[:16] + struct.pack("<d", step) + sound[24:]
    with pytest.raises(MessageError):
        decode(topic, payload(description, packed, data))


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
    for error in (None, 0.25):
        assert decode(*sent(reconstruction(error))).error == (error,)
    topic, description, sound, data = pieces(reconstruction(None))
    packed = bytearray(sound)
    at = sound.index(struct.pack("<d", 0.1))
    packed[at : at + 8] = struct.pack("<d", math.nan)
    with pytest.raises(NotFiniteError, match="residual"):
        decode(topic, payload(description, bytes(packed), data))


def test_fields_that_depend_on_each_other_are_checked_in_each_frame():
    topic, description, *rest = pieces(reconstruction(None))
    described = msgpack.unpackb(description)
    described["arrays"]["sd"] = ["<f4", [1, 1, 4]]
    with pytest.raises(ShapeError, match="sd: shape"):
        decode(topic, payload(msgpack.packb(described), *rest))


def test_a_head_alone_says_which_message_it_is():
    message = taxels().published("0123456789abcdef", 5)
    assert head_of(*sent(message)) == ("0123456789abcdef", 5, 7)
