"""Phi and its transpose inside an iteration, on vectors whose order suits them."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.hadamard import HadamardProducts, side_by_side
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi, is_sbhe
from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.compiled import ready
from sparseskin.nodes.numerics.programs import run


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
    """The scrambled block Hadamard ensemble, taxels and rows in the orders of its products.

    A vector of rows has a place for every row of W; those that are not measured are 0. So neither
    direction needs a permutation.

    Attributes
    ----------
    places : ndarray of intp, shape (m,)
        Place of each measurement in a vector of rows.
    scale : ndarray of float32, shape (n,)
        Factor of each row of W after the transform.
    weights : ndarray of float32, shape (n,)
        `measured`, or `scale` times the weights of `weigh`.
    """

    has_whole = True

    def __init__(self, phi: SbhePhi) -> None:
        self.n_rows = phi.n
        self.step_size = 1.0
        self._left, self._weighted = np.zeros((2, phi.n), dtype=np.float32)
        self._tables: dict[str, tuple[Floats, Floats, Indices]] = {}
        columns, rows, self.scale = self._prepare(phi.sizes)
        self.order = phi.permutation[columns]
        self._place_of_row = np.argsort(rows)
        self.use(phi)

    def _prepare(self, sizes: list[int]) -> tuple[Indices, Indices, Floats]:
        """Return the column of W of each place of a vector, the row of each place, and `scale`."""
        hadamard = HadamardProducts(sizes, orthonormal=True)
        self._x, self._rows = np.zeros((2, sum(sizes)), dtype=np.float32)
        self._to_rows = hadamard.program(self._x, self._rows)
        self._to_x = hadamard.program(self._rows, self._x, back=True)
        return hadamard.order_in, hadamard.order_out, np.ones(sum(sizes), dtype=np.float32)

    def _ahead(self, x: Floats, weights: Floats, out: Floats) -> None:
        """Write weights * W x to out: float32 (k, n) to float32 (k, n)."""
        for one, result in zip(x, out, strict=True):
            np.copyto(self._x, one)
            run(self._to_rows)
            np.multiply(self._rows, weights, result)

    def _back(self, rows: Floats, weights: Floats, out: Floats) -> None:
        """Write W^T (weights * rows) to out: float32 (n,) to float32 (n,)."""
        np.multiply(rows, weights, self._rows)
        run(self._to_x)
        np.copyto(out, self._x)

    def use(self, phi: Phi) -> None:
        if phi.fingerprint not in self._tables:
            assert isinstance(phi, SbhePhi)
            places = self._place_of_row[phi.rows]
            measured, read = np.zeros((2, phi.n), dtype=np.float32)
            measured[places], read[places] = self.scale[places], 1
            self._tables[phi.fingerprint] = measured, read, places
        self.measured, self.read, self.places = self._tables[phi.fingerprint]
        self.weights = self.measured

    def rows_of(self, y: Floats, out: Floats) -> None:
        out.fill(0)
        out[self.places] = y

    def forward(self, x: Floats, out: Floats) -> None:
        self._ahead(x, self.weights, out)

    def adjoint(self, rows: Floats, out: Floats) -> None:
        self._back(rows, self.weights, out)

    def whole(self, x: Floats, out: Floats) -> None:
        self._ahead(x[None], self.scale, out[None])

    def whole_adjoint(self, rows: Floats, out: Floats) -> None:
        self._back(rows, self.scale, out)

    def weigh(self, weights: Floats | None) -> None:
        self.weights = self.measured
        if weights is not None:
            self.weights = np.multiply(weights, self.scale, self._weighted)

    def leave_out(self, kept: Floats) -> None:
        self.weights = np.multiply(self.weights, kept, self._left)


class CompiledProjection(SbheProjection):
    """As `SbheProjection` in compiled loops, for blocks of any size; needs numba.

    Attributes
    ----------
    groups : ndarray of int64, shape (k, 3)
        Start, size and number of the blocks of each size.
    """

    def _prepare(self, sizes: list[int]) -> tuple[Indices, Indices, Floats]:
        from sparseskin.nodes.numerics.kernels import dealt_adjoint, dealt_forward

        ready(dealt_forward, dealt_adjoint)
        self._dealt_forward, self._dealt_adjoint = dealt_forward, dealt_adjoint
        columns, self.groups = side_by_side(sizes)
        scale = np.repeat(1 / np.sqrt(sizes), sizes).astype(np.float32)
        return columns, columns, scale

    def _ahead(self, x: Floats, weights: Floats, out: Floats) -> None:
        self._dealt_forward(x, weights, self.groups, out)

    def _back(self, rows: Floats, weights: Floats, out: Floats) -> None:
        self._dealt_adjoint(rows, weights, self.groups, out)


def make_projection(phi: Phi, compiled: bool = False) -> Projection:
    """Return the fastest projection of a phi; one of compiled loops only if `compiled`."""
    if not is_sbhe(phi):
        return PlainProjection(phi)
    return CompiledProjection(phi) if compiled else SbheProjection(phi)
