"""From frames to readings: pieces put together; type, order of the taxels, zero and scale."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from sparseskin.nodes.numerics.arrays import AnyArray, Floats, Indices
from sparseskin.nodes.sensor.layout.arrangement import Arrangement

from .framing import Counts, Frame

DTYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")


class Decoder:
    """Decodes payloads of counts of a `DTYPES` and byte order, whose places `arrangement` states. A
    reading is (count - zero) * scale.
    """

    def __init__(
        self,
        dtype: str,
        byte_order: str,
        arrangement: Arrangement,
        scale: float = 1.0,
        zero: float = 0.0,
    ) -> None:
        order: Literal["<", ">"] = "<" if byte_order == "little" else ">"
        self._dtype = np.dtype(dtype).newbyteorder(order)
        self._shape = arrangement.shape
        self._places: Indices | None = arrangement.places
        self._scale = scale
        self._zero = zero

    @property
    def n_bytes(self) -> int:
        """Length of a payload."""
        return self._shape[0] * self._shape[1] * self._dtype.itemsize

    def __call__(self, payload: bytes, missing: Sequence[float] = ()) -> Floats:
        """Readings, float32 (n_rows, n_cols), NaN where the count is one of `missing`; neither
        clipped nor checked for other NaN.
        """
        counts = np.frombuffer(payload, self._dtype)
        if self._places is not None:
            counts = counts[self._places]
        counts = counts.reshape(self._shape)
        readings = self._readings(counts)
        for number in missing:
            readings[counts == number] = np.nan
        return readings

    def _readings(self, counts: AnyArray) -> Floats:
        # A float64 beyond float32 becomes infinite.
        with np.errstate(all="ignore"):
            if self._zero == 0 and self._scale == 1:
                return counts.astype(np.float32)

            # Counts of up to 24 bits are exact in float32.
            if self._dtype.itemsize > 2:
                readings = (counts.astype(np.float64) - self._zero) * self._scale
                return readings.astype(np.float32)
            above_zero = counts.astype(np.float32) - np.float32(self._zero)
            return above_zero * np.float32(self._scale)


class Pieces:
    """Puts frames of `n_readings` of `n_bytes` each together from pieces, which state their first
    reading, and whose numbers begin at 0 again after `modulus` (0: they have none). A piece may end
    one frame and begin the next; a frame that lacks one is counted and dropped, as its readings
    would be of two times. `counts`: those of the parser of the pieces.
    """

    def __init__(
        self, n_readings: int, n_bytes: int, modulus: int, counts: Counts
    ) -> None:
        self._n = n_readings
        self._size = n_bytes
        self._modulus = modulus
        self._counts = counts
        self._begun = bytearray()
        self._number = 0

    def reset(self) -> None:
        """Drop the frame that has begun: the stream was interrupted."""
        self._counts.bad_frames += bool(self._begun)
        self._counts.dropped_bytes += len(self._begun)
        self._begun.clear()

    def add(self, piece: Frame) -> Frame | None:
        """Add a piece; return the frame that it completes, with its stamp and end."""
        counts = self._counts
        at = piece.first * self._size
        n_frame_bytes = self._n * self._size
        # The parser has counted the piece as a frame.
        counts.frames -= 1
        is_in_turn = not self._modulus or piece.sequence == self._number
        # A piece that was lost is seen by the number of the next one.
        if piece.sequence is not None:
            self._number = (piece.sequence + 1) % max(1, self._modulus)
        if at != len(self._begun) or not is_in_turn:
            self.reset()

        # Of a piece out of turn, only what is of the next frame can be used.
        used = piece.payload
        if at != len(self._begun):
            ends_frame = at < n_frame_bytes < at + len(used)
            used = b""
            if ends_frame:
                used = piece.payload[n_frame_bytes - at :]
            counts.dropped_bytes += len(piece.payload) - len(used)
        self._begun += used
        if len(self._begun) < n_frame_bytes:
            return None

        frame = replace(piece, payload=bytes(self._begun[:n_frame_bytes]), first=0)
        # What is left begins the next frame.
        del self._begun[:n_frame_bytes]
        counts.frames += 1
        return frame
