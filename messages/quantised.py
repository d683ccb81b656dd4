"""Quantised numbers: float32 values that are whole multiples of a step, sent in few bits."""

from typing import Any, Self

import numpy as np

from .arrays import Floats, Integers

MIN_BITS = 2
MAX_BITS = 24


class Quantised(np.ndarray[Any, np.dtype[np.float32]]):
    """A float32 array whose values are k * step, step above 0 in their unit, each k a whole number
    of `bits` bits, 2..24, in -(2^(bits-1) - 1) .. 2^(bits-1) - 1. It is used like any array;
    results of computations are plain arrays.
    """

    bits: int
    step: float

    def __array_finalize__(self, of: Any) -> None:
        if isinstance(of, Quantised):
            # A view, as of the samples of one patch.
            self.bits = of.bits
            self.step = of.step

    def __array_wrap__(self, array: Any, *args: Any) -> Any:
        return np.asarray(array)

    @classmethod
    def of(cls, codes: Integers, bits: int, step: float) -> Self:
        """Values of codes: int32, of any shape, each of at most `bits` bits."""
        # The step that a reader gets is a float32, too.
        step_32 = np.float32(step)
        products = codes * step_32
        values = products.astype(np.float32).view(cls)
        values.bits = int(bits)
        values.step = float(step_32)
        return values

    def codes(self) -> Integers:
        """Whole numbers k, int32, in the shape of the values."""
        values = np.asarray(self)
        codes = np.rint(values / np.float32(self.step))
        return np.asarray(codes, dtype=np.int32)


def step_of(values: Floats) -> float:
    """Step of quantised numbers, in their unit; 0 of others."""
    if isinstance(values, Quantised):
        return values.step
    return 0.0


def largest_code(bits: int) -> int:
    """Largest code of `bits` bits: 2^(bits-1) - 1."""
    return (1 << (bits - 1)) - 1


def packed(codes: Integers, bits: int) -> bytes:
    """Codes as bytes: `bits` bits each without gaps, the highest bit first."""
    # 0 or more, 4 bytes each: the highest byte first, as the bits are sent.
    not_negative = codes + largest_code(bits)
    code_bytes = not_negative.astype(">u4").view(np.uint8)
    all_bits = np.unpackbits(code_bytes).reshape(-1, 32)

    sent_bits = all_bits[:, 32 - bits :]
    return np.packbits(sent_bits).tobytes()


def unpacked(data: bytes | memoryview, m: int, bits: int) -> Integers:
    """Inverse of `packed`: m codes, int32, from `n_bytes(m, bits)` bytes."""
    # The last byte is filled up with bits of no code.
    packed_bytes = np.frombuffer(data, np.uint8)
    sent_bits = np.unpackbits(packed_bytes, count=m * bits)

    # The highest bits of the 4 bytes of each code are 0.
    all_bits = np.zeros((m, 32), np.uint8)
    all_bits[:, 32 - bits :] = sent_bits.reshape(m, bits)
    code_bytes = np.packbits(all_bits)

    not_negative: Integers = code_bytes.view(">u4").astype(np.int32)
    return not_negative - largest_code(bits)


def n_bytes(m: int, bits: int) -> int:
    """Number of bytes of `m` codes of `bits` bits."""
    return (m * bits + 7) // 8
