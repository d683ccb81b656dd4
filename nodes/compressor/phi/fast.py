"""Phi = Q_M W P_N in compiled loops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import measure

from .hadamard import side_by_side


class CompiledForward:
    """y = Phi x as `SbhePhi` computes it, to the bit.

    Parameters
    ----------
    permutation : ndarray of intp, shape (n,)
        Taxel of each column of W.
    sizes : sequence of int
        Sizes of its blocks.
    rows : ndarray of intp, shape (m,)
        Row of W of each measurement.
    scale : ndarray of float32, shape (m,)
        Factor of each measurement.
    """

    def __init__(
        self, permutation: Indices, sizes: Sequence[int], rows: Indices, scale: Floats
    ) -> None:
        ready(measure)
        columns, self._groups = side_by_side(sizes)
        self._deal = permutation[columns].astype(np.uint32)
        self._places = np.argsort(columns)[rows].astype(np.uint32)
        self._scale = scale.copy()
        self._vector = np.zeros(permutation.size, dtype=np.float32)

    def __call__(self, x: Floats, out: Floats) -> None:
        """Write Phi x to out: float32 (n,) to float32 (m,)."""
        measure(x, self._deal, self._groups, self._places, self._scale, self._vector, out)
