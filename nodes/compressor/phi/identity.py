"""Rows of the identity: taxels measured one by one, all of them or a random choice."""

import numpy as np

from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import Floats, Indices

from .base import BLOCK, BlockLayout, Phi, fingerprint_of
from .rotation import RotatingPhi


class FullPhi(Phi):
    """Phi = I, m = n (else PhiError): a skin without compression, as a yardstick."""

    kind = "full"

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        if m != n:
            raise PhiError(
                f'phi "full": m = {m} is not allowed; allowed: {n} (every taxel)'
            )
        self.fingerprint = fingerprint_of(self.kind, n, m, 1)

    def block_layout(self) -> BlockLayout | None:
        """As in `Phi`: blocks of one taxel each."""
        # A subclass may measure something else.
        if type(self) is not FullPhi:
            return None
        taxels = np.arange(self.n)
        sizes = [1] * self.n
        return BlockLayout(sizes, taxels, taxels, None)

    def _forward(self, x: Floats, out: Floats) -> None:
        np.copyto(out, x)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.copyto(out, y)


class SubsamplePhi(RotatingPhi):
    """Phi = Q_M: m single taxels, chosen at random; needs no wiring between taxels.

    `rows` are the taxels that are read, intp (m,), ascending. With one seed, a smaller m keeps a
    subset of them.
    """

    kind = "subsample"
    samples = True

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        rng = np.random.default_rng(seed)
        self._order: Indices = rng.permutation(n).astype(np.intp)
        rows = np.sort(self._order[:m])
        self._keep(rows)

    def block_layout(self) -> BlockLayout | None:
        """As in `Phi`: blocks of one taxel each."""
        # A subclass may measure something else.
        if type(self) is not SubsamplePhi:
            return None
        taxels = np.arange(self.n)
        sizes = [1] * self.n
        return BlockLayout(sizes, taxels, self.rows, None)

    def _forward(self, x: Floats, out: Floats) -> None:
        # "clip": with the default mode numpy copies through a buffer where `out` is stated.
        x.take(self.rows, None, out, "clip")

    def _adjoint(self, y: Floats, out: Floats) -> None:
        out.fill(0)
        out[self.rows] = y
