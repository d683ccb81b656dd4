"""The block Walsh-Hadamard transform in float32: as butterflies, and as matrix products."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Floats, Indices
from sparseskin.nodes.numerics.programs import Call


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

    Sums and differences only, always in the same order: the same bits on every BLAS. All stages
    are alike: sums and differences of the halves of a buffer, one beside the other. numpy is quick
    with such evenly spaced runs; the order of the output differs from that of the input.

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
        self.size_at: Floats = np.array(self.sizes, dtype=np.float32).repeat(self.sizes)
        self._parts: list[tuple[slice, int]] = []  # blocks of one size, and their stages
        orders = []
        for size in dict.fromkeys(self.sizes):
            columns = np.flatnonzero(self.size_at == size)
            self._parts.append((slice(columns[0], columns[-1] + 1), size.bit_length() - 1))
            # The stages are those of the last bit of the index within a block, then the first ...
            index = columns.reshape(-1, max(1, size // 2), min(2, size))
            orders.append((index.transpose(2, 1, 0).ravel(), index.transpose(0, 2, 1).ravel()))
        self.order_in, self.order_out = map(np.concatenate, zip(*orders, strict=True))

    def program(self, a: Floats, b: Floats) -> tuple[list[Call], Floats]:
        """Return the calls that transform buffer a, and the buffer of the result, a or b.

        Parameters
        ----------
        a, b : ndarray of float32, shape (n,) or longer, contiguous
            Input and scratch, both overwritten; places beyond n are left alone.
        """
        calls: list[Call] = []
        moves = self._parts[0][1]
        for part, stages in self._parts:
            here, there = a[part], b[part]
            for _ in range(stages):
                low, high = np.split(here, 2)
                calls.append((np.add, (low, high, there[0::2])))
                calls.append((np.subtract, (low, high, there[1::2])))
                here, there = there, here
            if stages % 2 != moves % 2:
                calls.append((np.copyto, (there, here)))
        return calls, (b if moves % 2 else a)

    def transposed(self, a: Floats, b: Floats) -> list[Call]:
        """Return the calls of the transposed transform, from `order_out` back to `order_in`.

        With the buffers of `program`, they start in the one that holds its result, and leave
        theirs in a.
        """
        calls: list[Call] = []
        moves = self._parts[0][1]
        for part, stages in self._parts:
            here, there = (b[part], a[part]) if moves % 2 else (a[part], b[part])
            if stages % 2 != moves % 2:
                calls.append((np.copyto, (there, here)))
                here, there = there, here
            for _ in range(stages):
                low, high = np.split(there, 2)
                calls.append((np.add, (here[0::2], here[1::2], low)))
                calls.append((np.subtract, (here[0::2], here[1::2], high)))
                here, there = there, here
        return calls


class HadamardProducts:
    """The transform of `BlockHadamard` as a product with the matrix of each size of block.

    Quicker for small blocks; its bits depend on the BLAS, which adds in an order of its own.

    Attributes
    ----------
    order_in, order_out, size_at
        As in `BlockHadamard`; input and output have the same order here.
    """

    def __init__(self, sizes: list[int]) -> None:
        self.order_in, self._groups = side_by_side(sizes)
        self.order_out = self.order_in
        self.size_at: Floats = np.array(sizes, dtype=np.float32).repeat(sizes)

    def program(self, a: Floats, b: Floats) -> tuple[list[Call], Floats]:
        """As `BlockHadamard.program`; the input is left in a."""
        return self._calls(a, b), b

    def transposed(self, a: Floats, b: Floats) -> list[Call]:
        """As `BlockHadamard.transposed`; W is symmetric."""
        return self._calls(b, a)

    def _calls(self, source: Floats, target: Floats) -> list[Call]:
        calls: list[Call] = []
        for start, size, count in self._groups:
            part = slice(start, start + size * count)
            given, result = (buffer[part].reshape(size, count) for buffer in (source, target))
            calls.append((np.dot, (hadamard_matrix(size).astype(np.float32), given, result)))
        return calls
