"""Frames of an edge on the wire: start, sequence number, Phi, step, codes, CRC-16."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sparseskin.messages.quantised import Quantised, largest_code, packed, unpacked

from .description import CRC_BYTES, HEADER_BYTES, EdgeDescription

START = b"\xaa\x55"
_HEADER = struct.Struct("<HIf")
SEQ_MODULUS = 1 << 16


@dataclass(frozen=True)
class EdgeFrame:
    """One frame.

    Attributes
    ----------
    seq : int
        0..65535, of the frame before plus 1, modulo 65536.
    phi : str
        Fingerprint of its matrix.
    step : float
        Size of a code's step, counts.
    codes : ndarray of int32, shape (m,)
    """

    seq: int
    phi: str
    step: float
    codes: npt.NDArray[np.int32]

    def measurements(self, bits: int, unit: float) -> Quantised:
        """Return the measurements; `unit` is the force of one count."""
        return Quantised.of(self.codes, bits, self.step * unit)


def crc16(data: bytes) -> int:
    """Return the CRC-16 of polynomial 0x1021, start 0xffff (CRC-16/IBM-3740)."""
    return binascii.crc_hqx(data, 0xFFFF)


def frame_bytes(description: EdgeDescription, seq: int, phi: str, y: Quantised) -> bytes:
    """Return the bytes that the edge sends for the measurements of a frame.

    Parameters
    ----------
    description : EdgeDescription
    seq : int
        Number of the frame; it is sent modulo 65536.
    phi : str
        Fingerprint of the matrix.
    y : Quantised
        Measurements of shape (m,) in counts, of `description.bits` bits.
    """
    head = _HEADER.pack(seq % SEQ_MODULUS, int(phi[:8], 16), y.step)
    body = head + packed(y.codes(), description.bits)
    return START + body + crc16(body).to_bytes(2, "little")


class FrameReader:
    """Frames out of a stream of bytes that may begin anywhere and be damaged.

    A frame counts where its CRC is right, its matrix is one of the description and its step is a
    number above 0. After a damaged one the search goes on at its second byte, so that a good frame
    within it is found.

    Attributes
    ----------
    n_frames : int
        Frames read.
    n_damaged : int
        Starts without a valid CRC behind; a start within a frame that was passed over counts too.
    n_lost : int
        Frames that the sequence numbers show as missing.
    n_strangers : int
        Frames with a valid CRC whose matrix or step the description does not allow.
    stranger : str
        First 8 digits of the last such matrix.
    """

    def __init__(self, description: EdgeDescription) -> None:
        self._description = description
        self._waiting = bytearray()
        self._last_seq: int | None = None
        self.n_frames = self.n_damaged = self.n_lost = self.n_strangers = 0
        self.stranger = ""

    def feed(self, data: bytes) -> Iterator[EdgeFrame]:
        """Add received bytes; yield the frames that are complete."""
        waiting, size = self._waiting, self._description.frame_bytes
        waiting += data
        at = 0
        try:
            while True:
                begin = waiting.find(START, at)
                if begin < 0:
                    # The last byte may be the first half of a start.
                    at = max(at, len(waiting) - (len(START) - 1))
                    return
                at = begin
                if len(waiting) < at + size:
                    return
                body = bytes(waiting[at + len(START) : at + size])
                if not _is_whole(body):
                    self.n_damaged += 1
                    at += 1
                    continue
                at += size
                frame = self._frame(body)
                if frame is not None:
                    yield frame
        finally:
            del waiting[:at]

    def packet(self, data: bytes) -> EdgeFrame | None:
        """Read one packet that is to be a whole frame; None where it is not."""
        if len(data) != self._description.frame_bytes or not data.startswith(START):
            self.n_damaged += 1
            return None
        body = data[len(START) :]
        if not _is_whole(body):
            self.n_damaged += 1
            return None
        return self._frame(body)

    def _frame(self, body: bytes) -> EdgeFrame | None:
        d = self._description
        seq, tag, step = _HEADER.unpack_from(body)
        phi = d.tags.get(tag)
        if phi is None or not 0 < step < np.inf:
            self.n_strangers += 1
            self.stranger = f"{tag:08x}"
            return None
        if self._last_seq is not None:
            self.n_lost += (seq - self._last_seq - 1) % SEQ_MODULUS
        self._last_seq = seq
        begin = HEADER_BYTES - len(START)
        codes = unpacked(body[begin : begin + d.code_bytes], d.m, d.bits)
        # One code more than the quantiser uses fits the bits.
        np.minimum(codes, largest_code(d.bits), out=codes)
        self.n_frames += 1
        return EdgeFrame(seq, phi, step, codes)


def _is_whole(body: bytes) -> bool:
    """True if the CRC at the end of the bytes after a start is right."""
    return crc16(body[:-CRC_BYTES]) == int.from_bytes(body[-CRC_BYTES:], "little")
