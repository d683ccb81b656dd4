"""Phi and its transpose inside an iteration, on vectors whose order suits them."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.hadamard import HadamardProducts
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats, Indices
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
    place_of_row : ndarray of intp, shape (n,)
        Place of each row of W.
    """

    has_whole = True

    def __init__(self, phi: SbhePhi) -> None:
        hadamard = HadamardProducts(phi.hadamard.sizes, orthonormal=True)
        self._x, self._rows, self._left = np.zeros((3, phi.n), dtype=np.float32)
        self._to_rows, _ = hadamard.program(self._x, self._rows)
        self._to_x = hadamard.transposed(self._x, self._rows)
        self.order = phi.permutation[hadamard.order_in]
        self.place_of_row = np.argsort(hadamard.order_out)
        self.n_rows = phi.n
        self.step_size = 1.0
        self._tables: dict[str, tuple[Indices, Indices, Floats]] = {}
        self.use(phi)
        self._y_and_zero = np.zeros(phi.m + 1, dtype=np.float32)

    def use(self, phi: Phi) -> None:
        if phi.fingerprint not in self._tables:
            assert isinstance(phi, SbhePhi)
            places = self.place_of_row[phi.rows]
            # Rows that are not measured read the 0 behind the last measurement.
            spread = np.full(phi.n, phi.m, dtype=np.intp)
            spread[places] = np.arange(phi.m)
            measured = np.zeros(phi.n, dtype=np.float32)
            measured[places] = 1
            self._tables[phi.fingerprint] = places, spread, measured
        self.places, self._spread, self.measured = self._tables[phi.fingerprint]
        self._weights = self.read = self.measured

    def rows_of(self, y: Floats, out: Floats) -> None:
        self._y_and_zero[:-1] = y
        self._y_and_zero.take(self._spread, None, out, "clip")

    def forward(self, x: Floats, out: Floats) -> None:
        for one, result in zip(x, out, strict=True):
            np.copyto(self._x, one)
            run(self._to_rows)
            np.multiply(self._rows, self._weights, result)

    def adjoint(self, rows: Floats, out: Floats) -> None:
        np.multiply(rows, self._weights, self._rows)
        run(self._to_x)
        np.copyto(out, self._x)

    def whole(self, x: Floats, out: Floats) -> None:
        np.copyto(self._x, x)
        run(self._to_rows)
        np.copyto(out, self._rows)

    def whole_adjoint(self, rows: Floats, out: Floats) -> None:
        np.copyto(self._rows, rows)
        run(self._to_x)
        np.copyto(out, self._x)

    def weigh(self, weights: Floats | None) -> None:
        self._weights = self.measured if weights is None else weights

    def leave_out(self, kept: Floats) -> None:
        self._weights = np.multiply(self._weights, kept, self._left)
