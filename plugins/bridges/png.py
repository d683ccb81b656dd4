"""Forces as grey levels of an 8-bit PNG.

Source of the format: ISO/IEC 15948 (PNG), colour type 0.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Floats

LEVELS = 255
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
FASTEST = 1
"""Level of compression: an untouched skin is small at any."""

Greys = npt.NDArray[np.uint8]


def greys(forces: Floats, full_scale: float) -> Greys:
    """Grey levels of forces: round(255 force / full_scale), 255 from full_scale on, 0 for 0 and
    less. Shape as the forces; `full_scale` in their unit, above 0.
    """
    levels: Greys = np.rint(np.clip(forces / full_scale, 0.0, 1.0) * LEVELS).astype(np.uint8)
    return levels


def png(grey: Greys) -> bytes:
    """A PNG of grey levels of shape (height, width)."""
    height, width = grey.shape
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    lines = np.zeros((height, width + 1), np.uint8)  # each begins with its filter, 0: none
    lines[:, 1:] = grey
    data = zlib.compress(lines.tobytes(), FASTEST)
    chunks = ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
    return _SIGNATURE + b"".join(_chunk(kind, body) for kind, body in chunks)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
