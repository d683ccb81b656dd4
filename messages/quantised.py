"""Quantised numbers: float32 values that are whole multiples of a step, sent in few bits."""

from typing import Any, Self

import numpy as np
import numpy.typing as npt

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
    def of(cls, codes: npt.NDArray[np.int32], bits: int, step: float) -> Self:
        """Values of codes: int32, of any shape, each of at most `bits` bits."""
        # The step that a reader gets is a float32, too.
        step_32 = np.float32(step)
        values = (codes * step_32).astype(np.float32).view(cls)
        values.bits = int(bits)
        values.step = float(step_32)
        return values

    def codes(self) -> npt.NDArray[np.int32]:
        """Whole numbers k, int32, in the shape of the values."""
        values = np.asarray(self)
        codes = np.rint(values / np.float32(self.step))
        return np.asarray(codes, dtype=np.int32)


def step_of(values: npt.NDArray[np.float32]) -> float:
    """Step of quantised numbers, in their unit; 0 of others."""
    if isinstance(values, Quantised):
        return values.step
    return 0.0


def largest_code(bits: int) -> int:
    """Largest code of `bits` bits: 2^(bits-1) - 1."""
    return (1 << (bits - 1)) - 1


def packed(codes: npt.NDArray[np.int32], bits: int) -> bytes:
    """Codes as bytes: `bits` bits each without gaps, the highest bit first."""
    # 0 or more, 4 bytes each.
    shifted = (codes + largest_code(bits)).astype(">u4")
    code_bytes = shifted.view(np.uint8).reshape(-1, 4)
    all_bits = np.unpackbits(code_bytes, axis=1)
    return np.packbits(all_bits[:, 32 - bits :]).tobytes()


def unpacked(data: bytes | memoryview, m: int, bits: int) -> npt.NDArray[np.int32]:
    """Inverse of `packed`: m codes, int32, from `n_bytes(m, bits)` bytes."""
    # The highest bits of the 4 bytes of each code are 0.
    packed_bytes = np.frombuffer(data, np.uint8)
    all_bits = np.unpackbits(packed_bytes, count=m * bits)
    wide = np.zeros((m, 32), np.uint8)
    wide[:, 32 - bits :] = all_bits.reshape(m, bits)
    code_bytes = np.packbits(wide, axis=1)

    shifted: npt.NDArray[np.int32] = code_bytes.view(">u4").astype(np.int32)
    return shifted.reshape(m) - largest_code(bits)


def n_bytes(m: int, bits: int) -> int:
    """Number of bytes of `m` codes of `bits` bits."""
    return (m * bits + 7) // 8
