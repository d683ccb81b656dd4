"""Numbers of few bits: float32 values that are whole multiples of a step, and travel as such."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

MIN_BITS, MAX_BITS = 2, 24


class Quantised(np.ndarray[tuple[int], np.dtype[np.float32]]):
    """A float32 array whose values are k * step, each k a whole number of `bits` bits.

    It is used like any array; what is computed from it is a plain one.

    Attributes
    ----------
    bits : int
        2..24; k lies in -(2^(bits-1) - 1) .. 2^(bits-1) - 1.
    step : float
        Above 0, in the unit of the values.
    """

    bits: int
    step: float

    def __array_wrap__(self, array: Any, *args: Any) -> Any:
        return np.asarray(array)

    @classmethod
    def of(cls, codes: npt.NDArray[np.int32], bits: int, step: float) -> Quantised:
        """The values of codes: int32, shape (m,), each of at most `bits` bits."""
        made = (codes * np.float32(step)).astype(np.float32).view(cls)
        made.bits, made.step = int(bits), float(np.float32(step))
        return made

    def codes(self) -> npt.NDArray[np.int32]:
        """The whole numbers k, int32, shape (m,)."""
        codes: npt.NDArray[np.int32] = np.rint(np.asarray(self) / np.float32(self.step)).astype(
            np.int32
        )
        return codes


def largest_code(bits: int) -> int:
    """The largest whole number that `bits` bits hold beside its negative."""
    return (1 << (bits - 1)) - 1


def packed(codes: npt.NDArray[np.int32], bits: int) -> bytes:
    """Codes as bytes, `bits` bits each and nothing between them, the highest bit first."""
    shifted = (codes + largest_code(bits)).astype(">u4")
    all_bits = np.unpackbits(shifted.view(np.uint8).reshape(-1, 4), axis=1)
    return np.packbits(all_bits[:, 32 - bits :]).tobytes()


def unpacked(data: bytes, m: int, bits: int) -> npt.NDArray[np.int32]:
    """Undo `packed`: m codes, int32; `data` must be of the length that `n_bytes` says."""
    rows = np.unpackbits(np.frombuffer(data, np.uint8), count=m * bits).reshape(m, bits)
    wide = np.zeros((m, 32), np.uint8)
    wide[:, 32 - bits :] = rows
    shifted: npt.NDArray[np.int32] = np.packbits(wide, axis=1).view(">u4").astype(np.int32)
    return shifted.reshape(m) - largest_code(bits)


def n_bytes(m: int, bits: int) -> int:
    """How many bytes `m` codes of `bits` bits take."""
    return (m * bits + 7) // 8
