"""Measurements of fewer bits: what rounding costs, and what travels."""

import math

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import Measurements, MessageError, decode, encode
from sparseskin.nodes.compressor.quantiser import quantised


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
    topic, payload = encode(made)
    found = decode(topic, payload)
    assert found == made
    assert found.y.bits == bits
    assert found.y.step == made.y.step
    # Encoded again, as by a recorder, it is the same message.
    assert encode(found) == (topic, payload)
    assert len(msgpack.unpackb(payload)["y"]["data"]) == -(-m * bits // 8)


def test_computed_numbers_are_a_plain_array_and_zeros_stay_zeros():
    assert type(quantised(frame(9, 0), 8) + 1) is np.ndarray
    assert not np.asarray(quantised(np.zeros(5, np.float32), 4)).any()


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"dtype": "int99"}, "99 bits is outside 2..24"),
        ({"dtype": "float8"}, "expected dtype intB"),
        ({"dtype": "<f4"}, "expected dtype intB"),
        ({"step": 0.0}, "a step of 0.0"),
        ({"step": -1.0}, "a step of -1.0"),
        ({"step": math.nan}, "a step of nan"),
        ({"step": math.inf}, "a step of inf"),
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
