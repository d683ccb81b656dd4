"""The projection of the scrambled block Hadamard ensemble in compiled loops."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.fast_sbhe import side_by_side
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.compressor.sbhe import SbhePhi
from sparseskin.nodes.fast import ready
from sparseskin.nodes.fast_kernels import dealt_adjoint, dealt_forward, dealt_rows
from sparseskin.nodes.reconstructor.projection import Projection


class CompiledProjection(Projection):
    """As `SbheProjection`, for blocks of any size, in the order that compiled loops want.

    Parameters
    ----------
    phi : SbhePhi

    Attributes
    ----------
    groups : ndarray of int64, shape (k, 3)
        Start, size and number of the blocks of each size.
    measured : ndarray of float32, shape (n,)
        1 / sqrt(B) where a row is measured, 0 where not.
    scale : ndarray of float32, shape (n,)
        1 / sqrt(B).
    weights : ndarray of float32, shape (n,)
        `measured`, or `scale` times the weights of `weigh`.
    """

    has_whole = True

    def __init__(self, phi: SbhePhi) -> None:
        ready(dealt_rows, dealt_forward, dealt_adjoint)
        columns, self.groups = side_by_side(phi.hadamard.sizes)
        self._place_of_row = np.argsort(columns)
        self.order = phi.permutation[columns]
        self.scale = np.empty(phi.n, dtype=np.float32)
        for start, size, count in self.groups:
            self.scale[start : start + size * count] = 1 / np.sqrt(size)
        self._weighted = np.zeros(phi.n, dtype=np.float32)
        self.n_rows = phi.n
        self.step_size = 1.0
        self._y = np.zeros(phi.m, dtype=np.float32)
        self._tables: dict[str, tuple[Floats, np.ndarray[tuple[int], np.dtype[np.uint32]]]] = {}
        self.use(phi)

    def use(self, phi: Phi) -> None:
        if phi.fingerprint not in self._tables:
            assert isinstance(phi, SbhePhi)
            places = self._place_of_row[phi.rows].astype(np.uint32)
            measured = np.zeros(phi.n, dtype=np.float32)
            measured[places] = phi.scale
            self._tables[phi.fingerprint] = measured, places
        self.measured, self._places = self._tables[phi.fingerprint]
        self.weights = self.measured

    def rows_of(self, y: Floats, out: Floats) -> None:
        # A copy, as measurements may be read-only, which compiled loops do not take.
        np.copyto(self._y, y)
        dealt_rows(self._y, self._places, out)

    def forward(self, x: Floats, out: Floats) -> None:
        dealt_forward(x, self.weights, self.groups, out)

    def adjoint(self, rows: Floats, out: Floats) -> None:
        dealt_adjoint(rows, self.weights, self.groups, out)

    def whole(self, x: Floats, out: Floats) -> None:
        dealt_forward(x[None], self.scale, self.groups, out[None])

    def weigh(self, weights: Floats | None) -> None:
        self.weights = self.measured
        if weights is not None:
            self.weights = np.multiply(weights, self.scale, self._weighted)
