"""Frames of a skin from frames that hold a piece of it each, and state its first reading.

A piece may end one frame of the skin and begin the next. Pieces come in order: a frame that lacks
one is counted and dropped, as its readings would be of two times.
"""

from __future__ import annotations

from dataclasses import replace

from .framing import Counts, Frame


class Pieces:
    """Puts frames of `n_readings` of `n_bytes` each together from their pieces, whose sequence
    numbers begin at 0 again after `modulus` (0: they have none). `counts`: those that the parser of
    the pieces has added to, as a piece is no frame.
    """

    def __init__(self, n_readings: int, n_bytes: int, modulus: int, counts: Counts) -> None:
        self._n, self._size, self._modulus, self._counts = n_readings, n_bytes, modulus, counts
        self._begun = bytearray()
        self._number = 0

    def reset(self) -> None:
        """Drop the frame that has begun: the stream was interrupted."""
        self._counts.bad_frames += bool(self._begun)
        self._counts.dropped_bytes += len(self._begun)
        self._begun.clear()

    def add(self, piece: Frame) -> Frame | None:
        """Add a piece; return the frame that it completes, with its stamp and end."""
        counts, at, whole = self._counts, piece.first * self._size, self._n * self._size
        counts.frames -= 1
        in_turn = not self._modulus or piece.sequence == self._number
        if piece.sequence is not None:
            self._number = (piece.sequence + 1) % max(1, self._modulus)
        if at != len(self._begun) or not in_turn:
            self.reset()
        used = piece.payload
        if at != len(self._begun):  # only what is of the next frame can be used
            used = used[whole - at :] if at < whole < at + len(used) else b""
            counts.dropped_bytes += len(piece.payload) - len(used)
        self._begun += used
        if len(self._begun) < whole:
            return None
        found = replace(piece, payload=bytes(self._begun[:whole]), first=0)
        del self._begun[:whole]
        counts.frames += 1
        return found
