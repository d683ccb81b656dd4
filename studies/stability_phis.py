"""Measurement matrices that are wrong on purpose: what happens to a user who brings such a one."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.compressor.sbhe import SbhePhi


class LongRows(Phi):
    """Scrambled block Hadamard with rows too long, that says they are of length 1.

    A solver then takes steps of `times` / L, L being the true largest eigenvalue.
    """

    kind = "long rows"

    def __init__(self, n: int, m: int, seed: int, times: float) -> None:
        super().__init__(n, m, seed)
        self._honest = SbhePhi(n, m, seed)
        self._length = np.float32(math.sqrt(times))
        self.fingerprint = self._honest.fingerprint

    def dense(self) -> npt.NDArray[np.float64]:
        return self._honest.dense() * float(self._length)

    def _forward(self, x: Floats, out: Floats) -> None:
        np.multiply(self._honest.forward(x), self._length, out=out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.multiply(self._honest.adjoint(y), self._length, out=out)


class Unscrambled(Phi):
    """Block Hadamard on neighbours along the rows of the skin: Q_M W without P_N."""

    kind = "unscrambled"

    def __init__(self, n: int, m: int, seed: int, block: int = 32) -> None:
        super().__init__(n, m, seed, block)
        self._scrambled = SbhePhi(n, m, seed, block)
        self._permutation = self._scrambled.permutation
        self.fingerprint = self._scrambled.fingerprint

    def dense(self) -> npt.NDArray[np.float64]:
        matrix = np.empty((self.m, self.n))
        matrix[:] = self._scrambled.dense()[:, self._permutation]
        return matrix

    def _forward(self, x: Floats, out: Floats) -> None:
        # What the scrambling deals to place j is to be taxel j itself.
        dealt = np.empty_like(x)
        dealt[self._permutation] = x
        self._scrambled.forward(dealt, out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        self._scrambled.adjoint(y).take(self._permutation, out=out)
