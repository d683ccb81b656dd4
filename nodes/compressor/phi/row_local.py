"""Sums within rows of a row-column array: several columns driven at once, a conversion a row."""

import math
from typing import Any

import numpy as np

from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask

from .base import BLOCK, Phi
from .hadamard import hadamard_matrix
from .rotation import RotatingPhi, split_rows

MAX_COLS = 1024
"""Largest number of columns: B has as many rows."""


class RowLocalPhi(RotatingPhi):
    """The same patterns of columns in every row: y[t, r] = sum over c of B[t, c] x[r, c].

    A shift register drives the columns of one pattern at once, and each row is converted. Driven
    columns count 1, others 0: s_t. The pattern of all columns, s_0, is always measured, and the
    edge sends y_0 = s_0 and y_t = 2 s_t - s_0, so that B holds +1 and -1, divided by sqrt(n_cols):
    rows of a Hadamard matrix with shuffled columns; where n_cols is no power of two, the first
    n_cols columns of the next larger one.

    Measurements are numbered pattern by pattern. M = n_rows T measures T patterns in each row;
    other M measure the last pattern in some rows only.

    Until `lay_out` states the grid, it is a square of n taxels, or else one column of them.

    `patterns` are B of all patterns, float32 (n_cols, n_cols), row 0 that of all columns; `rows`
    are t n_rows + r of each measurement, intp (m,), ascending.

    Raises PhiError also if, once the grid is stated, a cell has no taxel, m is less than n_rows, or
    there are more than 1024 columns.
    """

    kind = "row_local"

    def __init__(self, n: int, m: int, seed: int, block: int = BLOCK) -> None:
        super().__init__(n, m, seed, block)
        root = math.isqrt(n)
        shape = (n, 1)
        if root * root == n:
            shape = (root, root)
        self._arrange(*shape)

    def _lay_out(self, exists: Mask) -> None:
        n_rows, n_cols = exists.shape
        if not exists.all():
            raise PhiError(
                f"row_local: allowed: a grid of n = {self.n} taxels without gaps"
            )
        if n_cols > MAX_COLS:
            raise PhiError(f"row_local: {n_cols} columns; allowed: {MAX_COLS} or fewer")
        if self.m < n_rows:
            raise PhiError(
                f"row_local: m = {self.m} is not allowed; allowed: {n_rows} or more, a "
                f"pattern of {n_rows} rows"
            )
        self._arrange(n_rows, n_cols)

    def _arrange(self, n_rows: int, n_cols: int) -> None:
        self.shape = (n_rows, n_cols)
        rng = np.random.default_rng(self.seed)
        size = 1 << (n_cols - 1).bit_length()
        # The pattern of all columns, row 0, stays the first.
        other_rows = 1 + rng.permutation(size - 1)
        row_order = np.append(0, other_rows)
        column_order = rng.permutation(n_cols)
        places = np.ix_(row_order, column_order)
        shuffled = hadamard_matrix(size)[places]
        b = _independent(shuffled) / math.sqrt(n_cols)
        self.patterns: Floats = b.astype(np.float32)
        self.patterns.setflags(write=False)

        # To four decimals: the last bits of a linear algebra library do not reach the solver.
        eigenvalues = np.linalg.eigvalsh(b @ b.T)
        largest = float(eigenvalues[-1])
        self._lipschitz = math.ceil(largest * 1e4 - 1e-2) / 1e4
        self._order = np.arange(self.n, dtype=np.intp)
        self._keep(self._order[: self.m])

    def _keep(self, rows: Indices, *_: Any) -> None:
        super()._keep(rows, 1, self.patterns)
        n_rows = self.shape[0]
        pattern = rows // n_rows
        self._used, number = np.unique(pattern, return_inverse=True)
        #: B of the patterns in use, and the place of each measurement among their sums.
        self._b = np.ascontiguousarray(self.patterns[self._used])
        self._place = number * n_rows + rows % n_rows

    def row_subsets(self) -> list[Phi]:
        """As in `RotatingPhi`; every subset has the pattern of all columns: with M = n_rows there
        is one subset.
        """
        n_rows = self.shape[0]
        if self.m == n_rows:
            return [self]
        all_columns = self._order[:n_rows]
        other_rows = self._order[n_rows:]
        parts = split_rows(other_rows, self.m - n_rows)
        subsets = [np.concatenate([all_columns, part]) for part in parts]
        return self._twins(subsets)

    @property
    def lipschitz(self) -> float:
        """Largest eigenvalue of B B^T of all patterns, rounded up: 1 for powers of two."""
        return self._lipschitz

    def _forward(self, x: Floats, out: Floats) -> None:
        # einsum adds in numpy, always in one order; the order of a matmul depends on the BLAS.
        grid = x.reshape(self.shape)
        sums = np.einsum("tc,rc->tr", self._b, grid)
        sums.reshape(-1).take(self._place, None, out, "clip")

    def _adjoint(self, y: Floats, out: Floats) -> None:
        n_rows = self.shape[0]
        n_patterns = len(self._used)
        # Rows of the last pattern may be without a measurement.
        sums = np.zeros(n_patterns * n_rows, dtype=np.float32)
        sums[self._place] = y
        by_pattern = sums.reshape(n_patterns, n_rows)
        grid = out.reshape(self.shape)
        np.einsum("tr,tc->rc", by_pattern, self._b, out=grid)


def _independent(signs: Doubles) -> Doubles:
    """Return the first n_cols rows that are linearly independent, of (size, n_cols)."""
    n_cols = signs.shape[1]
    if len(signs) == n_cols:
        return signs
    # Gram-Schmidt: a row is independent where it has a part orthogonal to those before it.
    independent: list[int] = []
    orthonormal = np.zeros((0, n_cols))
    for k, row in enumerate(signs):
        residual = row - orthonormal.T @ (orthonormal @ row)
        # Once more, for the rounding.
        residual -= orthonormal.T @ (orthonormal @ residual)
        length = float(np.linalg.norm(residual))
        if length > 1e-6:
            independent.append(k)
            direction = residual[np.newaxis] / length
            orthonormal = np.concatenate([orthonormal, direction])
    return signs[independent]
