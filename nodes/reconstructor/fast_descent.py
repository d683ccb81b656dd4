"""Iterations of FISTA in compiled loops, for the scrambled block Hadamard ensemble and Haar."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.fast_sbhe import side_by_side
from sparseskin.nodes.compressor.sbhe import SbhePhi
from sparseskin.nodes.fast import ready
from sparseskin.nodes.fast_kernels import fista, haar_synthesis
from sparseskin.nodes.reconstructor.descent import Descent
from sparseskin.nodes.reconstructor.fast_haar import Tiling
from sparseskin.nodes.reconstructor.haar import HaarBasis


class CompiledDescent(Descent):
    """As `SbheHaarDescent`, an iteration or all of a frame's in one call.

    Parameters
    ----------
    phi : SbhePhi
    basis : HaarBasis
    taxels : ndarray of intp, shape (n,)
        Place in the flat grid of each existing taxel; fewer than `MAX_PLACES` cells in all.
    """

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
        # The order and scale of the loops already: nothing to reorder or to weigh.
        t, (v, *_, scratch) = self._tiling, self._arrays
        np.copyto(self._w[0], w)
        haar_synthesis(
            *(self._w, t.order, self._in_place, self._ones, t.grid, v, scratch),
            out.reshape(1, -1),
        )

    def coefficients_of(self, image: Floats, out: Floats) -> None:
        np.multiply(self._basis.analysis(image).reshape(-1)[self._cells], self.weights, out)

    def prepare(self, thetas: Floats, threshold: Floats) -> None:
        self._thetas, self._threshold = thetas, threshold

    def iterate(self, newest: int, betas: Floats) -> None:
        theta, before = self._thetas[newest], self._thetas[1 - newest]
        fista(theta, before, betas, self._weights2, self._threshold, *self._arrays)
