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

    Sums and differences only, always in the same order: the same bits on every BLAS. numpy is
    quick where operands are one evenly spaced run of numbers, so the buffers are kept in orders
    that make every step such a run; the order of the output differs from that of the input.

    Attributes
    ----------
    sizes : list of int
        Sizes of the blocks, in order.
    order_in : ndarray of intp, shape (n,)
        Place p of the input buffer belongs to column order_in[p] of W.
    order_out : ndarray of intp, shape (n,)
        Place p of the output buffer belongs to row order_out[p] of W.
    size_at : ndarray of float32, shape (n,)
        Size of the block that place p of the output belongs to.
    """

    def __init__(self, n: int, block: int) -> None:
        self.sizes = block_sizes(n, block)
        self._groups: list[tuple[int, int, int]] = []  # start, stop, log2 of the block size
        self.order_in: Indices = np.empty(n, dtype=np.intp)
        self.order_out: Indices = np.empty(n, dtype=np.intp)
        self.size_at: Floats = np.empty(n, dtype=np.float32)
        start = 0
        for size in dict.fromkeys(self.sizes):
            count = self.sizes.count(size)
            stop = start + size * count
            order_in, order_out = _orders(size, count)
            self.order_in[start:stop] = start + order_in
            self.order_out[start:stop] = start + order_out
            self.size_at[start:stop] = size
            self._groups.append((start, stop, size.bit_length() - 1))
            start = stop

    def program(self, a: Floats, b: Floats) -> tuple[list[Call], Floats]:
        """Return the calls that transform buffer a, and the buffer of the result, a or b.

        Parameters
        ----------
        a, b : ndarray of float32, shape (n,) or longer, contiguous
            Input and scratch, both overwritten; places beyond n are left alone.
        """
        calls: list[Call] = []
        moves = self._moves(self._groups[0])
        for group in self._groups:
            start, stop, stages = group
            here, there = a[start:stop], b[start:stop]
            change = self._moves(group) % 2 != moves % 2
            if stages == 0:
                if change:
                    calls.append((np.copyto, (there, here)))
                continue
            # Neighbours as one complex number: (p + iq)(1 + i) = (p - q) + i(p + q).
            target = there if change else here
            calls.append((np.multiply, (_pairs(here), _ONE_PLUS_I, _pairs(target))))
            if change:
                here, there = there, here
            for _ in range(stages - 2):
                low, high = np.split(_pairs(here), 2)
                calls.append((np.add, (low, high, _pairs(there)[0::2])))
                calls.append((np.subtract, (low, high, _pairs(there)[1::2])))
                here, there = there, here
            if stages > 1:
                calls += _halves(here, there)
        return calls, (b if moves % 2 else a)

    def transposed(self, a: Floats, b: Floats) -> list[Call]:
        """Return the calls of the transposed transform, from `order_out` back to `order_in`.

        With the buffers of `program`, they start in the one that holds its result, and leave
        theirs in a.
        """
        calls: list[Call] = []
        moves = self._moves(self._groups[0])
        for group in self._groups:
            start, stop, stages = group
            here, there = a[start:stop], b[start:stop]
            if moves % 2:
                here, there = there, here
            change = self._moves(group) % 2 != moves % 2
            if stages == 0:
                if change:
                    calls.append((np.copyto, (there, here)))
                continue
            if stages > 1:
                calls += _halves(here, there)
                here, there = there, here
            for _ in range(stages - 2):
                low, high = np.split(_pairs(there), 2)
                calls.append((np.add, (_pairs(here)[0::2], _pairs(here)[1::2], low)))
                calls.append((np.subtract, (_pairs(here)[0::2], _pairs(here)[1::2], high)))
                here, there = there, here
            # (d + is)(1 - i) = (s + d) + i(s - d).
            target = there if change else here
            calls.append((np.multiply, (_pairs(here), _ONE_MINUS_I, _pairs(target))))
        return calls

    @staticmethod
    def _moves(group: tuple[int, int, int]) -> int:
        """Return how often a group changes buffers; its first stage is done in place."""
        return max(group[2] - 1, 0)


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
    order_in, order_out, size_at
        As in `BlockHadamard`.
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
        """As `BlockHadamard.program`; the input is left in a."""
        return self._calls(a, b, back=False), b

    def transposed(self, a: Floats, b: Floats) -> list[Call]:
        """As `BlockHadamard.transposed`."""
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


_ONE_PLUS_I = np.array(1 + 1j, dtype=np.complex64)
_ONE_MINUS_I = np.array(1 - 1j, dtype=np.complex64)


def _pairs(run: Floats) -> npt.NDArray[np.complex64]:
    pairs: npt.NDArray[np.complex64] = run.view(np.complex64)
    return pairs


def _halves(source: Floats, target: Floats) -> list[Call]:
    half = source.size // 2
    low, high = source[:half], source[half:]
    return [
        (np.add, (low, high, target[:half])),
        (np.subtract, (low, high, target[half:])),
    ]


def _orders(size: int, count: int) -> tuple[Indices, Indices]:
    """Return the orders of input and output of `count` blocks of one size."""
    index = np.arange(size * count, dtype=np.intp).reshape(count, size)
    if size == 1:
        return index.ravel(), index.ravel()
    # Neighbours are the last bit of the index within a block; the others come before the block.
    order_in: Indices = index.reshape(count, size // 2, 2).transpose(1, 0, 2).reshape(-1, 2)
    order_out = order_in
    for _ in range(size.bit_length() - 3):
        order_out = np.stack(np.split(order_out, 2), axis=1).reshape(-1, 2)
    return order_in.ravel(), order_out[:, ::-1].ravel()
