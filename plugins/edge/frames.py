"""Frames of an edge on the wire: start, sequence number, version, Phi, step, codes, CRC-16.

`compressed` is the edge in Python: the bytes that its program sends, by the compressor's own Phi.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.messages.quantised import Quantised, largest_code, packed, unpacked
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.plugins.boards.framing import Framing

from .description import EdgeDescription

Counts = npt.NDArray[np.uint16]
_HEAD = struct.Struct("<BIf")
VERSION = 1
"""Form of a frame, its first byte after the sequence number."""


class EdgeFrame(NamedTuple):
    """The payload of a frame: fingerprint of its matrix, size of a code's step in counts, codes
    int32 (m,).
    """

    phi: str
    step: float
    codes: npt.NDArray[np.int32]

    def measurements(self, bits: int, unit: float) -> Quantised:
        """Return the measurements; `unit` is the force of one count."""
        return Quantised.of(self.codes, bits, self.step * unit)


def framing_of(description: EdgeDescription) -> Framing:
    return Framing(
        _HEAD.size + description.code_bytes, start=b"\xaa\x55", sequence_bytes=2, checksum="crc16"
    )


def frame_bytes(description: EdgeDescription, seq: int, phi: str, y: Quantised) -> bytes:
    """The bytes that the edge sends for frame `seq`, modulo 65536, of the matrix with fingerprint
    `phi`; `y`: measurements (m,) in counts, of `description.bits` bits.
    """
    head = _HEAD.pack(VERSION, int(phi[:8], 16), y.step)
    return framing_of(description).encode(head + packed(y.codes(), description.bits), seq)


def compressed(description: EdgeDescription, frames: Iterable[Counts]) -> Iterator[bytes]:
    """Yield the bytes that the edge sends for successive frames of counts, uint16 (n_rows, n_cols);
    those above full scale are read as full scale.

    Sums of counts are exact in float32, so that they are the same in integers. The float32
    operations that follow (a product with 1 / sqrt(B), two quotients) are rounded as IEEE 754
    states, which the program does in integers.
    """
    subsets = description.subsets
    for seq, counts in enumerate(frames):
        phi = subsets[seq % len(subsets)]
        given = np.minimum(counts.reshape(-1)[description.cells], description.full_scale)
        y = quantised(phi.forward(given.astype(np.float32)), description.bits)
        yield frame_bytes(description, seq, phi.fingerprint, y)


def stated(payload: bytes) -> str:
    """Version and matrix of a payload, for a person."""
    version, tag, _ = _HEAD.unpack_from(payload)
    return f"{tag:08x}" if version == VERSION else f"form {version}, read is {VERSION}"


def read_frame(description: EdgeDescription, payload: bytes) -> EdgeFrame | None:
    """Read a payload; None if its form or matrix is another one, or its step not above 0."""
    d = description
    version, tag, step = _HEAD.unpack_from(payload)
    phi = d.tags.get(tag)
    if version != VERSION or phi is None or not 0 < step < np.inf:
        return None
    codes = unpacked(payload[_HEAD.size :], d.m, d.bits)
    # One code more than the quantiser uses fits the bits.
    np.minimum(codes, largest_code(d.bits), out=codes)
    return EdgeFrame(phi, step, codes)
