"""Phi and its transpose inside an iteration, on vectors whose order suits them."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.hadamard import hadamard_matrix
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats, Indices

MAX_BLOCK = 64
"""Larger Hadamard blocks are slower as a matrix than as butterflies (timed)."""


class Projection(ABC):
    """Phi on vectors that hold the taxels in an order of its own, measurements in rows.

    Attributes
    ----------
    order : ndarray of intp, shape (n,)
        Place p of a vector holds taxel order[p].
    n_rows : int
        Length of a vector of rows: m, or more where some rows are always 0.
    step_size : float
        1 / L, L the largest eigenvalue of Phi Phi^T.
    has_whole : bool
        True if W has rows that are not measured.
    measured : ndarray of float32, shape (n_rows,)
        Factor of each row of W: above 0 where it is measured, 0 where not.
    read : ndarray of float32, shape (n_rows,)
        1 where a row of W is measured, 0 where not.
    """

    order: Indices
    n_rows: int
    step_size: float
    has_whole = False
    measured: Floats
    read: Floats

    @abstractmethod
    def use(self, phi: Phi) -> None:
        """Become the projection of another row subset of the same W."""

    @abstractmethod
    def rows_of(self, y: Floats, out: Floats) -> None:
        """Write measurements, float32 (m,), to a vector of rows, float32 (n_rows,)."""

    @abstractmethod
    def forward(self, x: Floats, out: Floats) -> None:
        """Write Phi x to out: float32 (k, n) to float32 (k, n_rows)."""

    @abstractmethod
    def adjoint(self, rows: Floats, out: Floats) -> None:
        """Write Phi^T rows / L to out: float32 (n_rows,) to float32 (n,)."""

    @abstractmethod
    def whole(self, x: Floats, out: Floats) -> None:
        """Write W x to out, rows that are not measured included: float32 (n,) to (n_rows,)."""

    @abstractmethod
    def whole_adjoint(self, rows: Floats, out: Floats) -> None:
        """Write W^T rows / L to out: float32 (n_rows,) to float32 (n,)."""

    @abstractmethod
    def leave_out(self, kept: Floats) -> None:
        """Multiply the weights of rows by 0 or 1, float32 (n_rows,), until `use` or `weigh`."""

    @abstractmethod
    def weigh(self, weights: Floats | None) -> None:
        """Multiply the rows of W by weights, float32 (n_rows,), in both directions, until `use`.

        None: 1 where a row is measured, 0 where not.
        """


class PlainProjection(Projection):
    """Any phi, through its public operators."""

    def __init__(self, phi: Phi) -> None:
        self._phi = phi
        self.order = np.arange(phi.n)
        self.n_rows = phi.m
        self.step_size = 1 / phi.lipschitz
        self._step = np.array(self.step_size, dtype=np.float32)
        self.measured = self.read = np.ones(phi.m, dtype=np.float32)
        self._weighted = np.zeros(phi.m, dtype=np.float32)
        self.use(phi)

    def use(self, phi: Phi) -> None:
        self._phi = phi
        self._kept = self.measured

    def rows_of(self, y: Floats, out: Floats) -> None:
        np.copyto(out, y)

    def forward(self, x: Floats, out: Floats) -> None:
        self._phi.forward(x, out)
        np.multiply(out, self._kept, out)

    def adjoint(self, rows: Floats, out: Floats) -> None:
        self.whole_adjoint(np.multiply(rows, self._kept, self._weighted), out)

    def whole(self, x: Floats, out: Floats) -> None:
        self._phi.forward(x, out)

    def whole_adjoint(self, rows: Floats, out: Floats) -> None:
        self._phi.adjoint(rows, out)
        np.multiply(out, self._step, out)

    def weigh(self, weights: Floats | None) -> None:
        self._kept = self.measured if weights is None else weights

    def leave_out(self, kept: Floats) -> None:
        self._kept = kept


class SbheProjection(Projection):
    """The scrambled block Hadamard ensemble: taxels in permuted order, one product a block.

    Blocks are of `MAX_BLOCK` at most. A vector of rows has a place for every row of W; those that
    are not measured are 0. So neither direction needs a permutation.
    """

    has_whole = True

    def __init__(self, phi: SbhePhi) -> None:
        self.order = phi.permutation
        self.n_rows = phi.n
        self._weighted, self._left = np.zeros((2, phi.n), dtype=np.float32)
        self.step_size = 1.0
        self._tables: dict[str, tuple[Indices, Floats]] = {}
        self.use(phi)
        self._y_and_zero = np.zeros(phi.m + 1, dtype=np.float32)
        block = phi.block
        self._hadamard = (hadamard_matrix(block) / np.sqrt(block)).astype(np.float32)
        self._whole = phi.n - phi.n % block
        # Taxels that fill no whole block form smaller ones.
        self._rest = np.zeros((phi.n - self._whole,) * 2, dtype=np.float32)
        start = 0
        for size in phi.hadamard.sizes[self._whole // block :]:
            part = slice(start, start + size)
            self._rest[part, part] = hadamard_matrix(size) / np.sqrt(size)
            start += size

    def use(self, phi: Phi) -> None:
        if phi.fingerprint not in self._tables:
            assert isinstance(phi, SbhePhi)
            # Rows that are not measured read the 0 behind the last measurement.
            spread = np.full(phi.n, phi.m, dtype=np.intp)
            spread[phi.rows] = np.arange(phi.m)
            measured = np.zeros(phi.n, dtype=np.float32)
            measured[phi.rows] = 1
            self._tables[phi.fingerprint] = spread, measured
        self._spread, self.measured = self._tables[phi.fingerprint]
        self._weights = self.read = self.measured

    def rows_of(self, y: Floats, out: Floats) -> None:
        self._y_and_zero[:-1] = y
        self._y_and_zero.take(self._spread, None, out, "clip")

    def forward(self, x: Floats, out: Floats) -> None:
        self._transform(x, out)
        np.multiply(out, self._weights, out)

    def adjoint(self, rows: Floats, out: Floats) -> None:
        if self._weights is not self.measured:
            rows = np.multiply(rows, self._weights, self._weighted)
        self._transform(rows, out)

    def whole(self, x: Floats, out: Floats) -> None:
        self._transform(x, out)

    def whole_adjoint(self, rows: Floats, out: Floats) -> None:
        self._transform(rows, out)

    def weigh(self, weights: Floats | None) -> None:
        self._weights = self.measured if weights is None else weights

    def leave_out(self, kept: Floats) -> None:
        self._weights = np.multiply(self._weights, kept, self._left)

    def _transform(self, given: Floats, out: Floats) -> None:
        """Write W given to out; W is symmetric, as its blocks are."""
        block = len(self._hadamard)
        if not len(self._rest):
            np.dot(given.reshape(-1, block), self._hadamard, out.reshape(-1, block))
            return
        given, out = np.atleast_2d(given, out)
        for one, result in zip(given, out, strict=True):
            whole = one[: self._whole].reshape(-1, block)
            np.dot(whole, self._hadamard, result[: self._whole].reshape(-1, block))
            np.dot(self._rest, one[self._whole :], result[self._whole :])
