"""Messages of frames of several patches; measurements of few bits."""

from dataclasses import replace

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from message_strategies import sent

from sparseskin.messages import (
    FieldError,
    Measurements,
    MessageError,
    OversizedError,
    Reconstruction,
    ShapeError,
    Taxels,
    Truth,
    decode,
    encode,
)
from sparseskin.messages.frames import values_alone
from sparseskin.nodes.compressor.quantiser import quantised

NAMES = ("hand", "arm", "back")
HEAD = {"stamp_ns": 5, "patch": "body", "names": NAMES}
MAPS = np.arange(18, dtype=np.float32).reshape(3, 2, 3)


def reconstruction(*unchanged, **changes):
    left_out = np.array(unchanged or [False] * 3)
    fields = {
        **{"forces": MAPS[~left_out], "phi": "0" * 16, "done_ns": 9, "skipped": 2},
        **{"iterations": (4, 3, 2), "residual": (0.5, 0.25, 0.0), "solve_ns": (7, 8, 9)},
        **{"error": (None, 0.25, None), "unchanged": unchanged},
    }
    return Reconstruction(**{**HEAD, **fields, **changes})


def test_a_message_is_split_into_those_of_its_patches():
    for message in (
        Taxels(**HEAD, forces=MAPS),
        Measurements(**HEAD, y=MAPS[:, 0], phi="0" * 16),
        reconstruction(),
    ):
        parts = message.split()
        assert [(part.patch, part.names) for part in parts] == [(name, ()) for name in NAMES]
        for k, part in enumerate(parts):
            for name in message.of_patches():
                if (whole := getattr(message, name)) is not None:
                    np.testing.assert_array_equal(getattr(part, name), whole[k : k + 1])
            assert replace(part) == part  # its fields are valid
            assert part.split() == [part]


def test_one_patch_needs_no_axis_where_its_message_is_made():
    made = Taxels(stamp_ns=5, patch="arm", forces=MAPS[1])
    assert (made, made.forces.shape) == (Taxels(**HEAD, forces=MAPS).split()[1], (1, 2, 3))
    np.testing.assert_array_equal(values_alone(made)["forces"], MAPS[1])
    found = values_alone(reconstruction().split()[1])
    assert (found["iterations"], found["error"], found["trusted"]) == (3, 0.25, True)


def test_forces_of_an_unchanged_patch_are_not_sent_and_are_those_of_its_last_frame():
    held = {}
    before = reconstruction().split(held)
    now = reconstruction(False, True, False)
    assert len(now.forces) == 2
    parts = now.split(held)
    assert [part.forces.tobytes() for part in parts] == [one.forces.tobytes() for one in before]
    assert [part.unchanged for part in parts] == [(False,), (True,), (False,)]
    # A reader that came later has not seen them.
    assert [part.patch for part in now.split()] == ["hand", "back"]
    idle = reconstruction(True, True, True)
    assert (len(idle.forces), [part.patch for part in idle.split(held)]) == (0, list(NAMES))


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
        reconstruction(**changes)


def test_places_are_those_of_one_patch():
    made = {"phi": "0" * 16, "places": np.array([0b11000000], np.uint8)}
    assert Measurements(stamp_ns=1, patch="arm", y=MAPS[0, 0, :2], **made).places is not None
    with pytest.raises(FieldError, match="of one patch"):
        Measurements(**HEAD, y=MAPS[:, 0, :2], **made)


def message(y):
    return Measurements(stamp_ns=1, patch="skin", y=y, phi="0" * 16)


def frame(m, seed):
    return np.random.default_rng(seed).normal(scale=3.0, size=m).astype(np.float32)


@given(bits=st.integers(4, 16), m=st.integers(1, 300), seed=st.integers(0, 99))
def test_no_measurement_is_off_by_more_than_half_a_step_and_none_is_clipped(bits, m, seed):
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
        assert (found, found.y.bits, found.y.step) == (made, bits, made.y.step)
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
