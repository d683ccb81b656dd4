"""The block Walsh-Hadamard transform in float32: as butterflies, and as matrix products."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.programs import Call

MOST_AT_ONCE = 64
"""Size of the largest Hadamard matrix that is one product: two smaller ones are faster than a
larger one (timed)."""


def block_sizes(n: int, block: int) -> list[int]:
    """Return the sizes of the Hadamard blocks of n taxels, in descending order; their sum is n.

    As many blocks of size `block` as fit, and smaller powers of two for the remainder: 95 taxels
    with blocks of 32 give 32, 32, 16, 8, 4, 2, 1.
    """
    sizes = [block] * (n // block)
    rest = n % block
    while rest:
        sizes.append(1 << (rest.bit_length() - 1))
        rest -= sizes[-1]
    return sizes


def hadamard_matrix(size: int) -> npt.NDArray[np.float64]:
    """Return the Hadamard matrix of +1 and -1 (Sylvester's), float64, shape (size, size)."""
    matrix = np.ones((1, 1))
    while len(matrix) < size:
        matrix = np.block([[matrix, matrix], [matrix, -matrix]])
    return matrix


def side_by_side(sizes: Sequence[int]) -> tuple[Indices, npt.NDArray[np.int64]]:
    """Return the order in which equal blocks lie side by side: all first places, all second ones.

    `sizes` are those of the blocks in their order, equal ones together.

    Returns
    -------
    columns : ndarray of intp, shape (n,)
        Place p of a vector belongs to column, and after the transform to row, columns[p].
    groups : ndarray of int64, shape (k, 3)
        Start, size and number of the blocks of each size.
    """
    groups, columns, start = [], [], 0
    for size in dict.fromkeys(sizes):
        count = list(sizes).count(size)
        index = np.arange(start, start + size * count, dtype=np.intp)
        columns.append(index.reshape(count, size).T.ravel())
        groups.append((start, size, count))
        start += size * count
    return np.concatenate(columns), np.array(groups, dtype=np.int64)


class BlockHadamard:
    """W: block-diagonal, each block a Hadamard matrix of +1 and -1, not scaled; W W = diag(size).

    Sums and differences only, always in the same order: the same bits on every BLAS. Vectors lie
    in the order of `side_by_side`, so that each step adds and subtracts long runs.

    Attributes
    ----------
    sizes : list of int
        Sizes of the blocks, in order.
    order : ndarray of intp, shape (n,)
        Place p of a vector belongs to column, and after the transform to row, order[p] of W.
    groups : ndarray of int64, shape (k, 3)
        Start, size and number of the blocks of each size.
    """

    def __init__(self, n: int, block: int) -> None:
        self.sizes = block_sizes(n, block)
        self.order, self.groups = side_by_side(self.sizes)

    def program(self, v: Floats, scratch: Floats, transposed: bool = False) -> list[Call]:
        """Return the calls that transform v in place, contiguous float32, shape (n,), by W or W^T.

        `scratch` is overwritten; it has the shape of v.
        """
        calls: list[Call] = []
        for start, size, count in self.groups.tolist():
            part = slice(start, start + size * count)
            here, there = v[part], scratch[part]
            # Places of a block whose sum and difference a step takes are 1 apart in the first step,
            # then size / 2, ... 4, 2.
            apart = [1 << k for k in range(size.bit_length() - 1)]
            apart = apart[:1] + apart[:0:-1]
            for step in reversed(apart) if transposed else apart:
                low, high = here.reshape(-1, 2, step * count).swapaxes(0, 1)
                sums, differences = there.reshape(-1, 2, step * count).swapaxes(0, 1)
                calls += [(np.add, (low, high, sums)), (np.subtract, (low, high, differences))]
                here, there = there, here
            if len(apart) % 2:
                calls.append((np.copyto, (there, here)))
        return calls


class HadamardProducts:
    """The transform of `BlockHadamard` as products with small matrices.

    A matrix of up to 64 rows is one product. A larger one is two, by its factors: the Kronecker
    product of the Hadamard matrices of sizes a and b is that of size a b. Quicker than butterflies
    in numpy; its bits depend on the BLAS, which adds in an order of its own.

    Parameters
    ----------
    sizes : list of int
        Sizes of the blocks, in their order.
    orthonormal : bool
        True: divide each block by the root of its size, so that W^T is the inverse.

    Attributes
    ----------
    order_in, order_out : ndarray of intp, shape (n,)
        Place p of a vector belongs to column order_in[p] of W, after the transform to row
        order_out[p].
    size_at : ndarray of float32, shape (n,)
        Size of the block that place p belongs to.
    """

    def __init__(self, sizes: list[int], orthonormal: bool = False) -> None:
        self.order_in, groups = side_by_side(sizes)
        self.order_out: Indices = self.order_in.copy()
        self.size_at: Floats = np.array(sizes, dtype=np.float32).repeat(sizes)
        #: First place, number of blocks, and the factors of their matrix.
        self._groups: list[tuple[int, int, Floats, Floats]] = []
        for start, size, count in groups.tolist():
            b = 1 if size <= MOST_AT_ONCE else 1 << size.bit_length() // 2
            scaled = np.sqrt(size) if orthonormal else 1.0
            first = (hadamard_matrix(size // b) / scaled).astype(np.float32)
            self._groups.append((start, count, first, hadamard_matrix(b).astype(np.float32)))
            if b > 1:
                part = slice(start, start + size * count)
                by_row = self.order_in[part].reshape(size // b, b, count)
                self.order_out[part] = by_row.transpose(1, 2, 0).ravel()
        self._scratch: Floats = np.empty(sum(sizes), dtype=np.float32)

    def program(self, a: Floats, b: Floats) -> tuple[list[Call], Floats]:
        """Return the calls that transform a to b by W, and b; float32, shape (n,) or longer."""
        return self._calls(a, b, back=False), b

    def transposed(self, a: Floats, b: Floats) -> list[Call]:
        """Return the calls that transform b to a by W^T."""
        return self._calls(b, a, back=True)

    def _calls(self, source: Floats, target: Floats, back: bool) -> list[Call]:
        calls: list[Call] = []
        for start, count, a, b in self._groups:
            part = slice(start, start + count * len(a) * len(b))
            given, result, between = source[part], target[part], self._scratch[part]
            steps: list[tuple[Floats, Floats, Floats]]
            if len(b) == 1:
                steps = [(a, _rows(given, a), _rows(result, a))]
            elif back:
                half = between.reshape(-1, len(a)).T
                steps = [(b, _rows(given, b), _rows(between, b)), (a, half, _rows(result, a))]
            else:
                half = between.reshape(-1, len(a))
                steps = [(_rows(given, a).T, a, half), (b, _rows(between, b), _rows(result, b))]
            calls += [(np.dot, step) for step in steps]
        return calls


def _rows(vector: Floats, matrix: Floats) -> Floats:
    """Return a vector as the columns that a matrix multiplies."""
    return vector.reshape(len(matrix), -1)
