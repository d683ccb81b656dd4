"""The edge in Python: the bytes that the exported program sends, by the compressor's own Phi."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.quantiser import quantised

from .description import EdgeDescription
from .frames import frame_bytes

Counts = npt.NDArray[np.uint16]


def compressed(description: EdgeDescription, frames: Iterable[Counts]) -> Iterator[bytes]:
    """Yield the bytes that the edge sends for successive frames of counts.

    Sums of counts are exact in float32, so that they are the same in integers. The float32
    operations that follow (a product with 1 / sqrt(B), two quotients) are rounded as IEEE 754
    states, which the program does in integers.

    Parameters
    ----------
    description : EdgeDescription
    frames : iterable of ndarray of uint16, shape (n_rows, n_cols)
        Counts; those above full scale are read as full scale.
    """
    subsets = description.subsets
    for seq, counts in enumerate(frames):
        phi = subsets[seq % len(subsets)]
        given = np.minimum(counts.reshape(-1)[description.cells], description.full_scale)
        y = quantised(phi.forward(given.astype(np.float32)), description.bits)
        yield frame_bytes(description, seq, phi.fingerprint, y)


def check_counts(description: EdgeDescription, k: int) -> Counts:
    """Return the counts of test frame k, uint16 (n_rows, n_cols), as `edge_check.c` makes them."""
    d = description
    counts = np.zeros(d.n_cells, dtype=np.uint16)
    if k == 1:
        counts[:] = d.full_scale
    elif k == 2:
        counts[d.cells[0]] = 1
    elif k > 2:
        state = 2463534242 + k
        for i in range(d.n_cells):
            state ^= (state << 13) & 0xFFFFFFFF
            state ^= state >> 17
            state ^= (state << 5) & 0xFFFFFFFF
            if k & 1 or state >> 28 == 0:
                counts[i] = state & d.full_scale
    return counts.reshape(d.n_rows, d.n_cols)


def fnv1a(data: bytes) -> int:
    """Return the 32-bit FNV-1a hash of bytes."""
    value = 0x811C9DC5
    for byte in data:
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return value
