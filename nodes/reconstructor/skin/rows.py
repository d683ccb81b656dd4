"""Orthonormal rows: the measurements as a solver sees them, of any Phi."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.hadamard import HadamardProducts, side_by_side
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi, is_sbhe
from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, shared
from sparseskin.nodes.numerics.compiled import ready

from .backend import ONE, Array, Backend

LEAST_PART = 1e-4
"""Eigenvalue of Phi Phi^T, as a part of the largest, below which a direction counts as unmeasured.
Derived: errors of its measurement, as those of a converter, are divided by the root: 100 times."""
ORTHONORMAL = 1e-5
"""Largest entry of Phi Phi^T - I that is taken for rounding of float32."""


class Rows(ABC):
    """W, a matrix of orthonormal rows, some of which are read in each frame.

    Vectors are float32; those of several patches, (p, n) in place of (n,), `HadamardRows` alone
    takes.

    Attributes
    ----------
    n, n_rows : int
        Number of taxels, and of rows.
    taxel : ndarray of intp, shape (n,)
        Place p of a vector of taxels holds taxel[p].
    read : ndarray of intp, shape (m,)
        Rows that this frame reads, ascending.
    """

    n: int
    n_rows: int
    taxel: Indices
    read: Indices

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


class HadamardRows(Rows):
    """All rows of a scrambled block Hadamard ensemble, also those that no frame reads.

    Parameters
    ----------
    phi : SbhePhi
    backend : OnePatch or ManyPatches
        Where the vectors are.
    """

    def __init__(self, phi: SbhePhi, backend: Backend = ONE) -> None:
        self.n = self.n_rows = phi.n
        self._array, self._joined = backend.array, backend.xp.concatenate
        taxels, rows = self._transform_of(phi)
        self.taxel = shared(phi.permutation[taxels])
        self._place_of_row = shared(np.argsort(rows))
        #: By row subset: the rows read; the order of their measurements; the row of each of these.
        self._known: dict[str, tuple[Array, Array, Indices]] = {}
        self.use(phi)

    def _transform_of(self, phi: SbhePhi) -> tuple[Indices, Indices]:
        """Make the transform; return its orders of taxels and of rows."""
        self._hadamard = HadamardProducts(phi.sizes, self._array)
        return self._hadamard.order_in, self._hadamard.order_out

    def use(self, phi: Phi) -> bool:
        self.read, self._order, _ = self._of(phi)
        return True

    def _of(self, phi: Phi) -> tuple[Array, Array, Indices]:
        if phi.fingerprint not in self._known:
            assert isinstance(phi, SbhePhi)
            places = self._place_of_row[phi.rows]
            order = np.argsort(places)
            read, order, places = map(shared, (places[order], order, places))
            self._known[phi.fingerprint] = self._array(read), self._array(order), places
        return self._known[phi.fingerprint]

    def values(self, y: Array) -> Array:
        return y[..., self._order]

    def forward(self, x: Array) -> Array:
        return self._joined(self._hadamard.forward(x), axis=-1)

    def adjoint(self, rows: Array) -> Array:
        return self._joined(self._hadamard.back(rows), axis=-1)

    def measured(self, x: Floats, *phis: Phi) -> list[Floats]:
        rows = self.forward(x)
        return [rows.take(self._of(phi)[2], mode="clip") for phi in phis]


class CompiledRows(HadamardRows):
    """The same rows by a compiled loop, which needs numba.

    Attributes
    ----------
    groups : ndarray of int64, shape (k, 3)
        Start, size and number of the blocks of each size.
    scale : ndarray of float32, shape (n,)
        1 / sqrt(size of the block) of each row.
    """

    def _transform_of(self, phi: SbhePhi) -> tuple[Indices, Indices]:
        from sparseskin.nodes.numerics.kernels import orthonormal

        ready(orthonormal)
        self._loop = orthonormal
        columns, self.groups = side_by_side(phi.sizes)
        sizes = np.repeat(phi.sizes, phi.sizes)[columns]
        self.scale: Floats = shared(np.reciprocal(np.sqrt(sizes)).astype(np.float32))
        return columns, columns

    def values(self, y: Floats) -> Floats:
        order: Indices = self._order
        return y.take(order, mode="clip")

    def forward(self, x: Floats) -> Floats:
        rows = x.copy()
        self._loop(rows, self.groups, self.scale)
        return rows

    def adjoint(self, rows: Floats) -> Floats:
        return self.forward(rows)  # W is symmetric


class WhitenedRows(Rows):
    """The rows of any Phi, made orthonormal: D^(-1/2) Q^T Phi with Phi Phi^T = Q D Q^T.

    Directions that Phi hardly measures are left out. The noise of taxels is the same in all rows
    then, whatever their length was.
    """

    def __init__(self, phi: Phi) -> None:
        self.n = phi.n
        self.taxel = np.arange(phi.n)
        self._known: dict[str, tuple[Phi, Floats | None]] = {}
        self._phi = phi
        self.use(phi)

    def use(self, phi: Phi) -> bool:
        before = self._phi.fingerprint
        if phi.fingerprint not in self._known:
            self._known[phi.fingerprint] = phi, _whitening(phi)
        self._phi, self._mix = self._known[phi.fingerprint]
        self.n_rows = phi.m if self._mix is None else len(self._mix)
        self.read = np.arange(self.n_rows)
        return phi.fingerprint == before

    def values(self, y: Floats) -> Floats:
        return y if self._mix is None else self._mix @ y

    def forward(self, x: Floats) -> Floats:
        return self.values(self._phi.forward(x))

    def adjoint(self, rows: Floats) -> Floats:
        return self._phi.adjoint(rows if self._mix is None else self._mix.T @ rows)

    def measured(self, x: Floats, *phis: Phi) -> list[Floats]:
        return [phi.forward(x) for phi in phis]


def _whitening(phi: Phi) -> Floats | None:
    """Return D^(-1/2) Q^T, float32 (n_rows, m); None for orthonormal rows."""
    dense = np.asarray(phi.dense(), dtype=np.float64)
    gram = dense @ dense.T
    if np.abs(gram - np.eye(phi.m)).max() < ORTHONORMAL:
        return None
    values, vectors = np.linalg.eigh(gram)
    kept = values > max(LEAST_PART * values[-1], TINY)
    return np.ascontiguousarray((vectors[:, kept] / np.sqrt(values[kept])).T, dtype=np.float32)


def rows_of(phi: Phi, compiled: bool = False) -> Rows:
    """Return the rows of any Phi; `compiled`: by compiled loops, for "sbhe"."""
    if not is_sbhe(phi):
        return WhitenedRows(phi)
    return CompiledRows(phi) if compiled else HadamardRows(phi)
