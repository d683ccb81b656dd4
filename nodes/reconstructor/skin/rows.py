"""Orthonormal rows: the measurements as a solver sees them, of any Phi."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.compressor.phi.base import BlockLayout, Phi, block_layout
from sparseskin.nodes.compressor.phi.hadamard import HadamardProducts, side_by_side
from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, shared
from sparseskin.nodes.numerics.compiled import ready

LEAST_PART = 1e-4
"""Eigenvalue of Phi Phi^T, as a part of the largest, below which a direction counts as unmeasured.
Derived: errors of its measurement, as those of a converter, are divided by the root: 100 times."""
ORTHONORMAL = 1e-5
"""Largest entry of Phi Phi^T - I that is taken for rounding of float32."""


class Rows(ABC):
    """W, a matrix of orthonormal rows, some of which are read in each frame.

    Vectors are float32.

    Attributes
    ----------
    n, n_rows : int
        Number of taxels, and of rows.
    taxel : ndarray of intp, shape (n,)
        Place p of a vector of taxels holds taxel[p].
    read : ndarray of intp, shape (m,)
        Rows that this frame reads, ascending.
    blocks : ndarray of int64, shape (m,), or None
        Number of the block of taxels that each of them sums; None where rows are no blocks.
    """

    n: int
    n_rows: int
    taxel: Indices
    read: Indices
    blocks: Indices | None = None

    @abstractmethod
    def use(self, phi: Phi) -> bool:
        """Expect measurements of another row subset; return True if its rows are rows of this W,
        False if W is another one now.
        """

    @abstractmethod
    def values(self, y: Floats) -> Floats:
        """Return the values of the rows that measurements y, float32 (m,), read: (len(read),)."""

    @abstractmethod
    def forward(self, x: Floats) -> Floats:
        """Return W x: float32 (n,) to (n_rows,)."""

    @abstractmethod
    def adjoint(self, rows: Floats) -> Floats:
        """Return W^T rows: float32 (n_rows,) to (n,)."""

    @abstractmethod
    def measured(self, x: Floats, *phis: Phi) -> list[Floats]:
        """Return what each phi, a row subset, measures of x: float32 (m,) each."""

    def measured_of(self, x: Floats, x_rows: Floats, phi: Phi) -> Floats:
        """The same of one phi, where W x is known: `x_rows`, float32 (n_rows,)."""
        return self.measured(x, phi)[0]


class ReadRows(NamedTuple):
    """Rows that the measurements of a row subset read, by their place in W."""

    read: Indices  # ascending
    order: Indices  # of the measurements, so that their rows ascend
    places: Indices  # the row of each measurement
    blocks: Indices | None  # block of the rows, in their order


class HadamardRows(Rows):
    """All rows of a block Hadamard transform, also those that no frame reads: of a scrambled block
    Hadamard ensemble, or single taxels.

    Attributes
    ----------
    order : ndarray of intp, shape (m,)
        Order of the measurements in which their rows ascend.
    """

    order: Indices

    def __init__(self, phi: Phi) -> None:
        self.n = phi.n
        self.n_rows = phi.n
        layout = _layout_of(phi)
        taxels, rows = self._transform_of(layout.sizes)
        self.taxel = shared(layout.permutation[taxels])
        self._place_of_row = shared(np.argsort(rows))
        self._subsets: dict[str, ReadRows] = {}
        self.use(phi)

    def _transform_of(self, sizes: list[int]) -> tuple[Indices, Indices]:
        """Make the transform of blocks; return its orders of taxels and of rows."""
        self._hadamard = HadamardProducts(sizes)
        return self._hadamard.order_in, self._hadamard.order_out

    def use(self, phi: Phi) -> bool:
        subset = self._of(phi)
        self.read = subset.read
        self.order = subset.order
        self.blocks = subset.blocks
        return True

    def in_order(self, of_read: Floats, phi: Phi) -> Floats:
        """Numbers of the rows read, float32 (m,), in the order of the measurements of a phi."""
        of_measurements = np.empty_like(of_read)
        of_measurements[self._of(phi).order] = of_read
        return of_measurements

    def _of(self, phi: Phi) -> ReadRows:
        if phi.fingerprint not in self._subsets:
            layout = _layout_of(phi)
            places = self._place_of_row[layout.rows]
            order = np.argsort(places)
            blocks = None
            if layout.blocks is not None:
                blocks = shared(layout.blocks[order])
            self._subsets[phi.fingerprint] = ReadRows(
                read=shared(places[order]),
                order=shared(order),
                places=shared(places),
                blocks=blocks,
            )
        return self._subsets[phi.fingerprint]

    def values(self, y: Floats) -> Floats:
        return y.take(self.order, mode="clip")

    def forward(self, x: Floats) -> Floats:
        return self._hadamard.forward(x)

    def adjoint(self, rows: Floats) -> Floats:
        return self._hadamard.back(rows)

    def measured(self, x: Floats, *phis: Phi) -> list[Floats]:
        rows = self.forward(x)
        return [self.measured_of(x, rows, phi) for phi in phis]

    def measured_of(self, x: Floats, x_rows: Floats, phi: Phi) -> Floats:
        return x_rows.take(self._of(phi).places, mode="clip")


class CompiledRows(HadamardRows):
    """The same rows by a compiled loop, which needs numba.

    Attributes
    ----------
    groups : ndarray of int64, shape (k, 3)
        Start, size and number of the blocks of each size.
    scale : ndarray of float32, shape (n,)
        1 / sqrt(size of the block) of each row.
    """

    def _transform_of(self, sizes: list[int]) -> tuple[Indices, Indices]:
        from sparseskin.nodes.numerics.kernels import orthonormal

        ready(orthonormal)
        self._loop = orthonormal
        columns, self.groups = side_by_side(sizes)
        # Rows have the places of the columns: the transform is symmetric.
        of_rows = np.repeat(sizes, sizes)[columns]
        scale = np.reciprocal(np.sqrt(of_rows))
        self.scale: Floats = shared(scale.astype(np.float32))
        return columns, columns

    def forward(self, x: Floats) -> Floats:
        rows = x.copy()
        self._loop(rows, self.groups, self.scale)
        return rows

    def adjoint(self, rows: Floats) -> Floats:
        # W is symmetric.
        return self.forward(rows)


class WhitenedRows(Rows):
    """The rows of any Phi, made orthonormal: D^(-1/2) Q^T Phi with Phi Phi^T = Q D Q^T.

    Directions that Phi hardly measures are left out. The noise of taxels is the same in all rows
    then, whatever their length was.
    """

    def __init__(self, phi: Phi) -> None:
        self.n = phi.n
        self.taxel = np.arange(phi.n)
        self._subsets: dict[str, tuple[Phi, Floats | None]] = {}
        self._phi = phi
        self.use(phi)

    def use(self, phi: Phi) -> bool:
        last_phi = self._phi
        if phi.fingerprint not in self._subsets:
            self._subsets[phi.fingerprint] = phi, _whitening(phi)
        self._phi, self._mix = self._subsets[phi.fingerprint]
        self.n_rows = phi.m
        if self._mix is not None:
            self.n_rows = len(self._mix)
        # All rows of this W are read: that of another subset is another W.
        self.read = np.arange(self.n_rows)
        return phi.fingerprint == last_phi.fingerprint

    def values(self, y: Floats) -> Floats:
        if self._mix is None:
            return y
        return self._mix @ y

    def forward(self, x: Floats) -> Floats:
        return self.values(self._phi.forward(x))

    def adjoint(self, rows: Floats) -> Floats:
        if self._mix is not None:
            rows = self._mix.T @ rows
        return self._phi.adjoint(rows)

    def measured(self, x: Floats, *phis: Phi) -> list[Floats]:
        return [phi.forward(x) for phi in phis]


def _layout_of(phi: Phi) -> BlockLayout:
    """The layout of a matrix that has one."""
    layout = block_layout(phi)
    assert layout is not None
    return layout


def _whitening(phi: Phi) -> Floats | None:
    """Return D^(-1/2) Q^T, float32 (n_rows, m); None for orthonormal rows."""
    dense = np.asarray(phi.dense(), dtype=np.float64)
    gram = dense @ dense.T
    deviations = np.abs(gram - np.eye(phi.m))
    if deviations.max() < ORTHONORMAL:
        return None
    # In ascending order.
    values, vectors = np.linalg.eigh(gram)
    bound = max(LEAST_PART * values[-1], TINY)
    is_measured = values > bound
    columns = vectors[:, is_measured] / np.sqrt(values[is_measured])
    return np.ascontiguousarray(columns.T, dtype=np.float32)


def rows_of(phi: Phi, compiled: bool = False) -> Rows:
    """Return the rows of any Phi; `compiled`: by compiled loops, where they are those of a block
    transform.
    """
    if block_layout(phi) is None:
        return WhitenedRows(phi)
    return CompiledRows(phi) if compiled else HadamardRows(phi)
