"""Projection and FISTA iterations in compiled loops, for the scrambled block Hadamard ensemble."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.hadamard import side_by_side
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.kernels import (
    dealt_adjoint,
    dealt_forward,
    dealt_rows,
    fista,
    haar_synthesis,
)
from sparseskin.nodes.reconstructor.bases.fast_haar import Tiling
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis

from .descent import Descent
from .projection import Projection


class CompiledProjection(Projection):
    """As `SbheProjection`, for blocks of any size, in the order of the compiled loops.

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


class CompiledDescent(Descent):
    """As `SbheHaarDescent`, of fewer than `MAX_PLACES` cells; one or all iterations in a call."""

    def __init__(self, phi: SbhePhi, basis: HaarBasis, taxels: Indices) -> None:
        ready(fista, haar_synthesis)
        self._phi, self._basis = phi, basis
        self.step_size = 1.0
        tiling = Tiling(basis.n_rows, basis.n_cols)
        self.weights = tiling.weights
        self._cells = tiling.cells.astype(np.intp)
        columns, groups = side_by_side(phi.hadamard.sizes)
        self._kept = np.argsort(columns)[phi.rows]
        place_of_cell = np.argsort(tiling.order)
        # The transform is not scaled: there and back multiplies by the size of the block.
        keep = np.empty(phi.n, dtype=np.float32)
        for start, size, count in groups:
            keep[start : start + size * count] = 1 / size
        keep[self._kept] = 0
        self._measured = np.zeros(phi.n, dtype=np.float32)
        self._arrays = (
            *(np.zeros(tiling.order.size, np.float32), np.zeros(phi.n, np.float32)),
            place_of_cell[taxels[phi.permutation[columns]]].astype(np.uint16),
            *(keep, self._measured, groups, tiling.grid),
            np.zeros(tiling.n_scratch, np.float32),
        )
        self._weights2 = self.weights * self.weights
        self._tiling = tiling
        self._w = np.zeros((1, tiling.order.size), dtype=np.float32)
        self._in_place = np.arange(tiling.order.size, dtype=np.uint32)
        self._ones = np.ones(tiling.order.size, dtype=np.float32)

    def set_measurements(self, y: Floats) -> None:
        self._measured[self._kept] = y * self._phi.scale

    def image_of(self, w: Floats, out: Floats) -> None:
        # w is in the order and scale of the loops already.
        t, (v, *_, scratch) = self._tiling, self._arrays
        np.copyto(self._w[0], w)
        haar_synthesis(
            *(self._w, t.order, self._in_place, self._ones, t.grid, v, scratch), out.reshape(1, -1)
        )

    def coefficients_of(self, image: Floats, out: Floats) -> None:
        np.multiply(self._basis.analysis(image).reshape(-1)[self._cells], self.weights, out)

    def prepare(self, thetas: Floats, threshold: Floats) -> None:
        self._thetas, self._threshold = thetas, threshold

    def iterate(self, newest: int, betas: Floats) -> None:
        theta, before = self._thetas[newest], self._thetas[1 - newest]
        fista(theta, before, betas, self._weights2, self._threshold, *self._arrays)
