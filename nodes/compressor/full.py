"""Every taxel by itself: the uncompressed reading."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi, fingerprint_of
from sparseskin.nodes.errors import PhiError


class FullPhi(Phi):
    """Phi = I, m = n: what a skin without compression sends, as a yardstick.

    Raises
    ------
    PhiError
        If m is not n; and as in `Phi`.
    """

    kind = "full"

    def __init__(self, n: int, m: int, seed: int, block: int = 32) -> None:
        super().__init__(n, m, seed, block)
        if m != n:
            raise PhiError(f'phi "full": m = {m} is not allowed; allowed: {n} (every taxel)')
        self.fingerprint = fingerprint_of(self.kind, n, m, 1)

    def dense(self) -> npt.NDArray[np.float64]:
        """Return the explicit matrix, float64, shape (n, n)."""
        return np.eye(self.n)

    def _forward(self, x: Floats, out: Floats) -> None:
        np.copyto(out, x)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.copyto(out, y)
