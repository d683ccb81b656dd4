"""The iterations of FISTA for the scrambled block Hadamard ensemble and Haar, fast in numpy."""

from __future__ import annotations

from functools import partial

import numpy as np

from sparseskin.nodes.compressor.phi.hadamard import HadamardProducts
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.numerics.programs import Call, gather, run
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis


class SbheHaarFista:
    """As `Fista`, several times as fast: programs of calls on fixed buffers.

    With orthonormal rows L = 1, and the gradient step replaces the measured Hadamard coefficients
    of the image by y and keeps the others. Both transforms run in their inner orders, as products
    with small matrices; one gather each way does the work of the permutation, the restriction and
    both reorderings.
    """

    def __init__(self, phi: SbhePhi, basis: HaarBasis, mask: Mask, lambda_n: float) -> None:
        n_cells = basis.n_rows * basis.n_cols
        self._phi, self._basis = phi, basis
        # Two buffers that are swapped by each iteration: the newest theta and the one before it.
        self._thetas = np.zeros((2, basis.n_inner), dtype=np.float32)
        self._newest = 0
        z, u, clipped, self._w = np.zeros((4, basis.n_inner), dtype=np.float32)
        a, b, self._x = np.zeros((3, n_cells), dtype=np.float32)
        self._to_x = basis.synthesis_program(self._w, self._x)
        self._to_w = basis.analysis_program(self._x, self._w)
        hadamard = HadamardProducts(phi.hadamard.sizes)
        transform, rows = hadamard.program(a, b)
        rows = rows[: phi.n]
        self._row_places = np.argsort(hadamard.order_out)[phi.rows]

        # Cells without a taxel stand behind the transform's n places, unchanged by it.
        taxels = np.flatnonzero(mask)[phi.permutation[hadamard.order_in]]
        places = basis.place_of_pixel[np.concatenate([taxels, np.flatnonzero(~mask)])]
        # The transform is not scaled: there and back multiplies by the size of the block.
        keep: Floats = np.reciprocal(hadamard.size_at)
        keep[self._row_places] = 0
        self._measured = np.zeros(phi.n, dtype=np.float32)
        self._parts = np.zeros(2, dtype=np.float32)
        limit = np.full(basis.n_inner, lambda_n, dtype=np.float32)
        self._iterations: list[list[Call]] = [
            [
                (np.dot, (self._parts, self._thetas, z)),  # theta + beta (theta - before)
                *basis.synthesis_program(z, self._x),
                gather(self._x, places, a),
                *transform,
                (np.multiply, (rows, keep, rows)),
                (np.add, (rows, self._measured, rows)),
                *hadamard.transposed(a, b),
                gather(a, np.argsort(places), self._x),
                *basis.analysis_program(self._x, u),
                # soft(u) = u - clip(u). These two take no third argument by position.
                (partial(np.minimum, u, limit, out=clipped), ()),
                (partial(np.maximum, clipped, -limit, out=clipped), ()),
                (np.subtract, (u, clipped, before)),
            ]
            for before in self._thetas[::-1]
        ]

    def reset(self) -> None:
        """As in `Fista`."""
        self._thetas.fill(0)

    def begin(self, y: Floats, warm: Floats | None) -> None:
        """As in `Fista`."""
        newest, other = self._thetas[self._newest], self._thetas[1 - self._newest]
        if warm is not None:
            warm.reshape(-1).take(self._basis.order, None, self._x, "clip")
            run(self._to_w)
            np.copyto(newest, self._w)
        np.copyto(other, newest)
        # Both buffers are equal now. BLAS may round a product by which row is which, so that each
        # frame begins with the same one.
        self._newest = 0
        self._measured[self._row_places] = y * self._phi.scale

    def advance(self, betas: Floats) -> None:
        """As in `Fista`."""
        for beta in betas:
            self._parts[self._newest], self._parts[1 - self._newest] = 1 + beta, -beta
            run(self._iterations[self._newest])
            self._newest = 1 - self._newest

    def image(self) -> Floats:
        """As in `Fista`."""
        np.copyto(self._w, self._thetas[self._newest])
        run(self._to_x)
        return self._x[self._basis.place_of_pixel].reshape(self._basis.n_rows, self._basis.n_cols)
