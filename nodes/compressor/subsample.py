"""Some taxels by themselves, the others not at all."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.phi import fingerprint_of
from sparseskin.nodes.compressor.rotation import RotatingPhi


class SubsamplePhi(RotatingPhi):
    """Phi = Q_M: m single taxels, chosen at random; needs no wiring between taxels.

    Attributes
    ----------
    rows : ndarray of intp, shape (m,)
        The taxels that are read, ascending. With one seed, a smaller m keeps a subset of them.

    Raises
    ------
    PhiError
        As in `Phi`.
    """

    kind = "subsample"

    def __init__(self, n: int, m: int, seed: int, block: int = 32) -> None:
        super().__init__(n, m, seed, block)
        self._order: Indices = np.random.default_rng(seed).permutation(n).astype(np.intp)
        self._keep(np.sort(self._order[:m]))

    def _keep(self, rows: Indices) -> None:
        """Read these taxels, ascending."""
        rows.setflags(write=False)
        self.rows: Indices = rows
        self.fingerprint = fingerprint_of(self.kind, self.n, self.m, 1, rows)

    def dense(self) -> npt.NDArray[np.float64]:
        """Return the explicit matrix, float64, shape (m, n)."""
        matrix = np.zeros((self.m, self.n))
        for measurement, taxel in enumerate(self.rows):
            matrix[measurement, taxel] = 1
        return matrix

    def _forward(self, x: Floats, out: Floats) -> None:
        x.take(self.rows, None, out, "clip")

    def _adjoint(self, y: Floats, out: Floats) -> None:
        out.fill(0)
        out[self.rows] = y
