"""Frames as one buffer, of several patches too, and text of messages."""

import math
import struct
from dataclasses import replace

import msgpack
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
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
    Truth,
    UnknownSchemaError,
    VersionError,
    buffers,
    decode,
    encode,
)
from sparseskin.messages.buffers import (
    ALIGNMENT,
    MARK,
    MAX_DESCRIPTION_BYTES,
    MAX_STREAMS,
    frame_pieces,
    head_of,
    is_frame,
)
from sparseskin.messages.frames import of_patches, values_alone
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.text import printable
from sparseskin.messages.wire import received, wire_bytes
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.errors import SparseskinError


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
    return Taxels(
        stamp_ns=7, patch="skin", forces=np.full(shape, value, dtype=np.float32)
    )


@given(messages.filter(lambda m: is_frame(type(m))))
def test_arrays_are_aligned_views_of_the_buffer_and_not_written_to(message):
    buffer = wire_bytes(message)
    found = decode(*received(buffer))
    for value in vars(found).values():
        if (
            isinstance(value, np.ndarray)
            and not isinstance(value, Quantised)
            and value.size
        ):
            assert np.shares_memory(value, np.frombuffer(buffer, np.uint8))
            assert value.ctypes.data % ALIGNMENT == 0
            assert not value.flags.writeable


def test_wrong_sizes_topics_and_numbers_are_refused():
    topic, description, *rest = pieces(taxels())
    with pytest.raises(OversizedError, match=r"taxels: \d+ bytes, expected"):
        decode(topic, payload(description, *rest, b"x"))
    with pytest.raises(OversizedError, match="description of"):
        decode(topic, payload(bytes(MAX_DESCRIPTION_BYTES + 1), *rest))
    topic, description, numbers, data = pieces(taxels())
    assert decode(topic, payload(description, numbers, data)) == taxels()
    forces = np.frombuffer(data, np.float32).copy()
    forces[4] = np.inf
    with pytest.raises(NotFiniteError, match=r"forces\[1, 1\]"):
        decode(topic, payload(description, numbers, forces.tobytes()))
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
        ({"texts": ["skin", "", "", "", ""]}, MalformedError),
        ({"texts": "abcd"}, MalformedError),
        ({"texts": {"skin": "", "a": "", "b": "", "c": ""}}, MalformedError),
        ({"texts": None}, MalformedError),
        ({"arrays": [["forces", ["<f4", [1, 2, 3]]]]}, MalformedError),
        ({"arrays": {}}, MalformedError),
        ({"arrays": {"force": ["<f4", [1, 2, 3]]}}, MalformedError),
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


def test_senders_of_ever_new_descriptions_do_not_fill_the_memory():
    for k in range(MAX_STREAMS + 3):
        message = Taxels(stamp_ns=k, patch=f"p{k}", forces=np.ones((1, 2), np.float32))
        assert decode(*sent(message)) == message
        assert len(buffers._STREAMS) <= MAX_STREAMS
        assert len(buffers._DESCRIBED) <= MAX_STREAMS


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
    right = struct.pack("<d", y.step)
    assert sound.count(right) == 1
    packed = sound.replace(right, struct.pack("<d", step))
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


def test_fields_are_checked_in_each_frame_and_a_head_alone_says_which_message_it_is():
    topic, description, *rest = pieces(reconstruction(None))
    described = msgpack.unpackb(description)
    described["arrays"]["sd"] = ["<f4", [1, 1, 4]]
    with pytest.raises(ShapeError, match="sd: shape"):
        decode(topic, payload(msgpack.packb(described), *rest))
    message = taxels().published("0123456789abcdef", 5)
    assert head_of(*sent(message)) == ("0123456789abcdef", 5, 7)


NAMES = ("hand", "arm", "back")
HEAD = {"stamp_ns": 5, "patch": "body", "names": NAMES}
MAPS = np.arange(18, dtype=np.float32).reshape(3, 2, 3)


def reconstructed(*unchanged, **changes):
    left_out = np.array(unchanged or [False] * 3)
    fields = {
        **{"forces": MAPS[~left_out], "phi": "0" * 16, "done_ns": 9, "skipped": 2},
        **{
            "iterations": (4, 3, 2),
            "residual": (0.5, 0.25, 0.0),
            "solve_ns": (7, 8, 9),
        },
        **{"error": (None, 0.25, None), "unchanged": unchanged},
    }
    return Reconstruction(**{**HEAD, **fields, **changes})


def test_a_message_is_split_into_those_of_its_patches():
    for message in (
        Taxels(**HEAD, forces=MAPS),
        Measurements(**HEAD, y=MAPS[:, 0], phi="0" * 16),
        reconstructed(),
    ):
        parts = message.split()
        assert [(part.patch, part.names) for part in parts] == [
            (name, ()) for name in NAMES
        ]
        for k, part in enumerate(parts):
            for name in of_patches(type(message)):
                if (whole := getattr(message, name)) is not None:
                    np.testing.assert_array_equal(getattr(part, name), whole[k : k + 1])
            assert replace(part) == part  # its fields are valid
            assert part.split() == [part]


def test_one_patch_needs_no_axis_where_its_message_is_made():
    made = Taxels(stamp_ns=5, patch="arm", forces=MAPS[1])
    assert made == Taxels(**HEAD, forces=MAPS).split()[1]
    assert made.forces.shape == (1, 2, 3)
    np.testing.assert_array_equal(values_alone(made)["forces"], MAPS[1])
    found = values_alone(reconstructed().split()[1])
    assert found["iterations"] == 3
    assert found["error"] == 0.25
    assert found["trusted"]


def test_forces_of_an_unchanged_patch_are_not_sent_and_are_those_of_its_last_frame():
    held = {}
    before = reconstructed().split(held)
    now = reconstructed(False, True, False)
    assert len(now.forces) == 2
    parts = now.split(held)
    assert [part.forces.tobytes() for part in parts] == [
        one.forces.tobytes() for one in before
    ]
    assert [part.unchanged for part in parts] == [(False,), (True,), (False,)]
    # A reader that came later has not seen them.
    assert [part.patch for part in now.split()] == ["hand", "back"]
    idle = reconstructed(True, True, True)
    assert len(idle.forces) == 0
    assert [part.patch for part in idle.split(held)] == list(NAMES)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"names": ("hand", "arm")}, ShapeError),
        ({"names": ("hand", "hand", "arm")}, FieldError),
        ({"names": ("hand", "Arm", "back")}, FieldError),
        ({"names": ("hand arm", "back", "leg")}, ShapeError),
        ({"names": ()}, ShapeError),
        ({"names": tuple(f"p{k}" for k in range(257))}, OversizedError),
        ({"names": tuple(f"p{k:030d}" for k in range(256))}, OversizedError),
    ],
)
def test_names_that_do_not_fit_are_refused(changes, error):
    with pytest.raises(error):
        Truth(**{**HEAD, "forces": MAPS, **changes})


@pytest.mark.parametrize(
    ("changes", "error", "line"),
    [
        ({"forces": MAPS[:2]}, ShapeError, "forces: 2 rows for 3 patches"),
        ({"forces": MAPS[:0]}, ShapeError, "forces: 0 rows for 3 patches"),
        ({"iterations": (1, -1, 1)}, FieldError, "iterations: -1 is outside"),
        ({"iterations": ()}, ShapeError, "iterations: 0 rows for 3 patches"),
        ({"residual": (0.1,)}, ShapeError, "residual: 1 rows for 3 patches"),
        ({"trusted": True}, ShapeError, "trusted: 1 rows for 3 patches"),
    ],
)
def test_something_of_each_patch_is_needed(changes, error, line):
    with pytest.raises(error, match=line):
        reconstructed(**changes)


def test_places_are_those_of_one_patch():
    made = {"phi": "0" * 16, "places": np.array([0b11000000], np.uint8)}
    assert (
        Measurements(stamp_ns=1, patch="arm", y=MAPS[0, 0, :2], **made).places
        is not None
    )
    with pytest.raises(FieldError, match="of one patch"):
        Measurements(**HEAD, y=MAPS[:, 0, :2], **made)


def message(y):
    return Measurements(stamp_ns=1, patch="skin", y=y, phi="0" * 16)


def frame(m, seed):
    return np.random.default_rng(seed).normal(scale=3.0, size=m).astype(np.float32)


@given(bits=st.integers(4, 16), m=st.integers(1, 300), seed=st.integers(0, 99))
def test_no_measurement_is_off_by_more_than_half_a_step_and_none_is_clipped(
    bits, m, seed
):
    y = frame(m, seed)
    rounded = quantised(y, bits)
    step = float(np.abs(y).max()) / (2 ** (bits - 1) - 1)
    assert rounded.step == pytest.approx(step, rel=1e-6)
    # Half a step, of a step that is a float32, and the rounding of k * step to float32.
    bound = 0.5 * rounded.step + 2.0**-24 * float(np.abs(y).max())
    off = np.asarray(rounded, np.float64) - y
    assert float(np.abs(off).max()) <= bound


@given(bits=st.integers(2, 16), m=st.integers(1, 300), seed=st.integers(0, 99))
def test_quantised_measurements_survive_the_wire_to_the_bit(bits, m, seed):
    made = message(quantised(frame(m, seed), bits))
    for form in (encode, sent):
        topic, payload = form(made)
        found = decode(topic, payload)
        assert found == made
        assert found.y.bits == bits
        assert found.y.step == made.y.step
        # Encoded again, as by a recorder, it is the same message.
        assert form(found) == (topic, payload)
    assert len(msgpack.unpackb(encode(made)[1])["y"]["data"]) == -(-m * bits // 8)


def test_computed_numbers_are_a_plain_array_and_zeros_stay_zeros():
    assert type(quantised(frame(9, 0), 8) + 1) is np.ndarray
    assert not np.asarray(quantised(np.zeros(5, np.float32), 4)).any()


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"dtype": "int99"}, "99 bits is outside 2..24"),
        ({"dtype": "float8"}, "expected dtype intB"),
        ({"step": 0.0}, "a step of 0.0"),
        ({"step": 1}, "step must be a float"),
        ({"shape": [1, 8]}, r"\[1, 8\] of int6 does not fit 7 bytes"),
        ({"shape": [1, 0]}, "none empty"),
        ({"data": b"\xff" * 7}, "a code beyond 31"),
        ({"more": 1}, "expected a map of dtype"),
    ],
)
def test_a_malformed_quantised_array_is_refused(changes, word):
    topic, payload = encode(message(quantised(frame(9, 0), 6)))
    body = msgpack.unpackb(payload)
    body["y"] |= changes
    with pytest.raises(MessageError, match=word):
        decode(topic, msgpack.packb(body))


@given(st.text())
@example("".join(map(chr, range(0x110000))))
def test_every_text_becomes_one_printable_line_and_stays_it(text):
    shown = printable(text)
    assert shown.isprintable()
    assert printable(shown) == shown


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]0;owned\x07", r"\x1b]0;owned\x07"),
        ("a\r\nb\tc", "a  b c"),
        ("\x9b31m", r"\x9b31m"),
        ("\u202eevil\u2066", r"\u202eevil\u2066"),
        ("\u2028a\u200b", r" a\u200b"),
        ("\ud800 \U000e0001", r"\ud800 \U000e0001"),
    ],
)
def test_what_would_act_on_a_terminal_is_spelt_out(text, shown):
    assert printable(text) == shown


def test_an_error_names_what_a_file_holds_without_acting_it_out():
    assert str(SparseskinError("a\x1b[2J\nb", "c\x07")) == "a\\x1b[2J b\nc\\x07"
