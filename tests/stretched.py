"""A measurement matrix whose rows differ in length, as those of real wiring do."""

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Doubles, Floats


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
