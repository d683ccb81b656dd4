"""Grids and measurement matrices for tests."""

import numpy as np
from hypothesis import strategies as st

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask


@st.composite
def grids(draw: st.DrawFn) -> Mask:
    """Grids of up to 24 x 24 cells of which some are taxels, one at least."""
    rows, cols = (draw(st.integers(1, 24)) for _ in range(2))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    exists = rng.random((rows, cols)) < draw(st.sampled_from([0.1, 0.7, 1.0]))
    exists[rng.integers(rows), rng.integers(cols)] = True
    return exists


class Stretched(Phi):
    """A Phi of another one's rows, the i-th of length 1 + i."""

    kind = "stretched"

    def __init__(self, of: Phi) -> None:
        super().__init__(of.n, of.m, 0)
        self._of, self.lengths = of, 1 + np.arange(of.m, dtype=np.float32)
        self.fingerprint = "stretched"

    @property
    def lipschitz(self) -> float:
        return float(self.lengths[-1] ** 2)

    def dense(self) -> Doubles:
        stretched: Doubles = self.lengths[:, None] * self._of.dense()
        return stretched

    def _forward(self, x: Floats, out: Floats) -> None:
        np.multiply(self._of.forward(x), self.lengths, out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.copyto(out, self._of.adjoint(y * self.lengths))
