"""Bases that are a matrix along each axis at each level, and the Haar basis, the first of them."""

from collections.abc import Callable

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Floats

from .base import Basis


class SeparableBasis(Basis):
    """A matrix along each axis, at each level on the approximation of the last one.

    Coefficients are laid out as a pyramid: at each level the approximation top left, details along
    the columns' direction (axis 1) to its right, along the rows' (axis 0) below it, along both
    diagonally.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels.
    matrix : callable
        Returns the orthonormal matrix of a level along a side of n, shape (n, n), approximations
        first.
    n_levels : int, optional
        Number of levels; None: until one approximation is left.

    Raises
    ------
    SolverError
        If the grid is empty.
    """

    def __init__(
        self,
        n_rows: int,
        n_cols: int,
        matrix: Callable[[int], Doubles],
        n_levels: int | None = None,
    ) -> None:
        super().__init__(n_rows, n_cols)
        self._levels: list[tuple[Floats, Floats, Floats]] = []
        for rows, cols in level_sizes(self.n_rows, self.n_cols)[:n_levels]:
            # Those of Haar become 1 and 1/2, which float32 does not round.
            scale = 1.0
            if rows > 1 and cols > 1:
                scale = np.sqrt(2)
            along_rows = (matrix(rows) * scale).astype(np.float32)
            along_cols = (matrix(cols) / scale).astype(np.float32)
            half = np.zeros((rows, cols), dtype=np.float32)
            self._levels.append((along_rows, along_cols, half))

    def _analysis(self, image: Floats, out: Floats) -> None:
        pyramid = out.reshape(self.n_rows, self.n_cols)
        np.copyto(out, image)
        for along_rows, along_cols, half in self._levels:
            part = pyramid[: len(along_rows), : len(along_cols)]
            np.matmul(along_rows, part, half)
            np.matmul(half, along_cols.T, part)

    def _synthesis(self, coefficients: Floats, out: Floats) -> None:
        pyramid = out.reshape(self.n_rows, self.n_cols)
        np.copyto(out, coefficients)
        for along_rows, along_cols, half in reversed(self._levels):
            part = pyramid[: len(along_rows), : len(along_cols)]
            np.matmul(along_rows.T, part, half)
            np.matmul(half, along_cols, part)


class HaarBasis(SeparableBasis):
    """Psi = the orthonormal 2-D Haar (Daubechies D2) basis, full depth, any size.

    At each level neighbours are paired along both axes: (a + b) / sqrt(2) goes on to the next
    level, (a - b) / sqrt(2) is a detail. The last sample of an odd side goes on unchanged. A
    side of 1 is done while the other goes on. Laid out as in `SeparableBasis`.

    Parameters
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels.

    Raises
    ------
    SolverError
        If the grid is empty.

    Notes
    -----
    Source: the paper, section IV-A.
    """

    def __init__(self, n_rows: int, n_cols: int) -> None:
        super().__init__(n_rows, n_cols, level_matrix)


def level_matrix(n: int) -> Doubles:
    """Return one level along a side of n: approximations first, float64 (n, n), orthonormal."""
    half = n // 2
    level = np.zeros((n, n))
    sums = np.arange(half)
    details = sums + n - half
    even = 2 * sums
    odd = even + 1
    # Rows of length 1.
    level[sums, even] = np.sqrt(0.5)
    level[sums, odd] = np.sqrt(0.5)
    level[details, even] = np.sqrt(0.5)
    level[details, odd] = -np.sqrt(0.5)
    # A sample without a partner goes on as it is.
    if n % 2:
        level[half, n - 1] = 1
    return level


def level_sizes(rows: int, cols: int) -> list[tuple[int, int]]:
    """Return the size of the approximation that each level begins with."""
    sizes = []
    while rows > 1 or cols > 1:
        sizes.append((rows, cols))
        rows = (rows + 1) // 2
        cols = (cols + 1) // 2
    return sizes
