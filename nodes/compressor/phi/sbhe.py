"""The scrambled block Hadamard ensemble, the paper's measurement matrix."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeGuard

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.programs import run

from .base import fingerprint_of
from .hadamard import BlockHadamard, hadamard_matrix
from .rotation import RotatingPhi

if TYPE_CHECKING:
    from .fast import CompiledForward


class SbhePhi(RotatingPhi):
    """Phi = Q_M W P_N with orthonormal rows.

    P_N is a random permutation of the taxels, W is block-diagonal with Hadamard blocks of size B
    divided by sqrt(B), Q_M keeps m of its rows, chosen at random. Where B does not divide n, the
    remainder gets smaller blocks (16 + 8 + 4 + 2 + 1). With one seed, a smaller m keeps a subset
    of the rows of a larger one.

    Attributes
    ----------
    permutation : ndarray of intp, shape (n,)
        P_N: column j of W sees taxel permutation[j].
    rows : ndarray of intp, shape (m,)
        Q_M: measurement i is row rows[i] of W; ascending.

    Raises
    ------
    PhiError
        As in `Phi`.

    Notes
    -----
    Source: the paper, section IV-B; Gan, Do, Tran, "Fast compressive imaging using scrambled
    block Hadamard ensemble", EUSIPCO 2008. The paper's rows hold plain +1 and -1: they are
    sqrt(B) times as long.
    """

    kind = "sbhe"
    by_blocks = True  # of this class itself; a subclass has to state it anew

    def __init__(self, n: int, m: int, seed: int, block: int = 32) -> None:
        super().__init__(n, m, seed, block)
        rng = np.random.default_rng(seed)
        permutation = rng.permutation(n).astype(np.intp)
        self._order: Indices = rng.permutation(n).astype(np.intp)

        self.hadamard = BlockHadamard(n, block)
        self._arrange(permutation)
        self._y_and_zero = np.zeros(m + 1, dtype=np.float32)
        self._keep(np.sort(self._order[:m]))

        self._a = np.zeros(n, dtype=np.float32)
        b = np.zeros(n, dtype=np.float32)
        self._transform, self._result = self.hadamard.program(self._a, b)
        self._transposed = self.hadamard.transposed(self._a, b)

    def _arrange(self, permutation: Indices) -> None:
        """Set P_N, intp, shape (n,)."""
        permutation.setflags(write=False)
        self.permutation: Indices = permutation
        #: Taxel that belongs to each place of the transform's input, shape (n,).
        self.scramble: Indices = permutation[self.hadamard.order_in]
        self._unscramble: Indices = np.argsort(self.scramble)

    def _keep(self, rows: Indices) -> None:
        rows.setflags(write=False)
        self.rows: Indices = rows
        self._compiled: CompiledForward | None = None
        self.fingerprint = fingerprint_of(
            self.kind, self.n, self.m, self.block, self.permutation, rows
        )
        place_of_row = np.argsort(self.hadamard.order_out)
        #: Place of the transform's output where each measurement appears, shape (m,).
        self.row_places: Indices = place_of_row[rows]
        #: 1 / sqrt(B) of each measurement's block, shape (m,).
        self.scale: Floats = np.reciprocal(np.sqrt(self.hadamard.size_at[self.row_places]))
        # Places of rows that are not kept take the zero behind the last measurement.
        self._spread: Indices = np.full(self.n, self.m, dtype=np.intp)
        self._spread[self.row_places] = np.arange(self.m)

    def dense(self) -> npt.NDArray[np.float64]:
        """Return the explicit matrix, float64, shape (m, n), built from its definition."""
        matrix = np.zeros((self.m, self.n))
        start = 0
        for size in self.hadamard.sizes:
            taxels = self.permutation[start : start + size]
            mine = (self.rows >= start) & (self.rows < start + size)
            block = hadamard_matrix(size) / np.sqrt(size)
            matrix[np.ix_(mine, taxels)] = block[self.rows[mine] - start]
            start += size
        return matrix

    def compile(self) -> None:
        """Compute `forward` in compiled loops from now on: the same bits; needs numba."""
        from .fast import CompiledForward

        self._compiled = CompiledForward(
            self.permutation, self.hadamard.sizes, self.rows, self.scale
        )

    def _forward(self, x: Floats, out: Floats) -> None:
        if self._compiled is not None:
            self._compiled(x, out)
            return
        x.take(self.scramble, None, self._a, "clip")
        run(self._transform)
        self._result.take(self.row_places, None, out, "clip")
        np.multiply(out, self.scale, out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        np.multiply(y, self.scale, self._y_and_zero[:-1])
        self._y_and_zero.take(self._spread, None, self._result, "clip")
        run(self._transposed)
        self._a.take(self._unscramble, None, out, "clip")


def is_sbhe(phi: object) -> TypeGuard[SbhePhi]:
    """Return True if permutation, blocks and rows state all of a matrix, so that a solver may apply
    it by them: not for a subclass, which may have changed what its operators do, unless it says so.
    """
    return isinstance(phi, SbhePhi) and vars(type(phi)).get("by_blocks", False) is True
