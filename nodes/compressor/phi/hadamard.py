"""The block Walsh-Hadamard transform in float32: as butterflies, and as matrix products."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices
from sparseskin.nodes.numerics.compiled import ready

MOST_AT_ONCE = 64
"""Size of the largest Hadamard matrix that is one product: two smaller ones are faster than a
larger one (timed)."""

Call: TypeAlias = tuple[Callable[..., Any], tuple[Any, ...]]
"""A numpy call of a program. A transform of a few thousand numbers is a hundred of them, and to
slice their views takes as long as the arithmetic: views and buffers are made once."""


def run(program: Sequence[Call]) -> None:
    """Execute the calls of a program, in order."""
    for function, arguments in program:
        function(*arguments)


def block_sizes(n: int, block: int) -> list[int]:
    """Return the sizes of the Hadamard blocks of n taxels, in descending order; their sum is n.

    As many blocks of size `block` as fit, and smaller powers of two for the remainder: 95 taxels
    with blocks of 32 give 32, 32, 16, 8, 4, 2, 1.
    """
    sizes = [block] * (n // block)
    n_remaining = n % block
    while n_remaining:
        sizes.append(1 << (n_remaining.bit_length() - 1))
        n_remaining -= sizes[-1]
    return sizes


def hadamard_matrix(size: int) -> Doubles:
    """Return the Hadamard matrix of +1 and -1 (Sylvester's), float64, shape (size, size)."""
    matrix = np.ones((1, 1))
    while len(matrix) < size:
        upper = [matrix, matrix]
        lower = [matrix, -matrix]
        matrix = np.block([upper, lower])
    return matrix


def side_by_side(sizes: Sequence[int]) -> tuple[Indices, npt.NDArray[np.int64]]:
    """The order in which equal blocks lie side by side, all first places, all second ones: place p
    of a vector belongs to column, and after the transform to row, columns[p], intp (n,). Then
    start, size and number of the blocks of each size, int64 (k, 3).

    `sizes` are those of the blocks in their order, equal ones together.
    """
    groups = []
    columns = []
    start = 0
    for size, count in Counter(sizes).items():
        stop = start + size * count
        of_size = np.arange(start, stop, dtype=np.intp)
        of_blocks = of_size.reshape(count, size)
        columns.append(of_blocks.T.ravel())
        groups.append((start, size, count))
        start = stop
    return np.concatenate(columns), np.array(groups, dtype=np.int64)


class BlockHadamard:
    """W: block-diagonal, each block a Hadamard matrix of +1 and -1, not scaled; W W = diag(size).

    Sums and differences only, always in the same order: the same bits on every BLAS. Each stage
    takes the two halves of a vector and writes sums and differences in turn, so that every operand
    is one evenly spaced run of numbers; the order of the output differs from that of the input.

    `sizes` are those of the blocks in their order, equal ones together. Place p of the input
    belongs to column order_in[p] of W, of the output to row order_out[p], both intp (n,).

    Source: Pease, "An adaptation of the fast Fourier transform for parallel processing", J. ACM
    15(2), 1968.
    """

    def __init__(self, sizes: list[int]) -> None:
        n = sum(sizes)
        self.order_in: Indices = np.empty(n, dtype=np.intp)
        self.order_out: Indices = np.empty(n, dtype=np.intp)
        self._groups: list[tuple[slice, int]] = []  # place, and number of stages
        start = 0
        for size, count in Counter(sizes).items():
            stop = start + size * count
            group = slice(start, stop)
            # A stage moves the first bit of a place behind its last one. So the bits of an index
            # within its block, the lowest first, lie before the number of the block, then behind.
            n_high = max(size // 2, 1)
            n_low = min(size, 2)
            places = np.arange(start, stop)
            bits = places.reshape(count, n_high, n_low)
            self.order_in[group] = bits.transpose(2, 1, 0).ravel()
            self.order_out[group] = bits.transpose(0, 2, 1).ravel()

            n_stages = size.bit_length() - 1
            self._groups.append((group, n_stages))
            start = stop

    def program(self, v: Floats, scratch: Floats, back: bool = False) -> list[Call]:
        """The calls that transform v, float32 (n,) as `scratch`, in place from `order_in` to
        `order_out`; the other way round, and by W^T, if `back`.
        """
        calls: list[Call] = []
        for group, n_stages in self._groups:
            source = v[group]
            target = scratch[group]

            # The transpose of a stage reads where the stage writes.
            half = source.size // 2
            reads = slice(half), slice(half, None)
            writes = slice(0, None, 2), slice(1, None, 2)
            if back:
                reads, writes = writes, reads
            for _ in range(n_stages):
                low, high = (source[part] for part in reads)
                sums, differences = (target[part] for part in writes)
                calls.append((np.add, (low, high, sums)))
                calls.append((np.subtract, (low, high, differences)))
                source, target = target, source
            # The result of an odd number of stages is in the scratch.
            if n_stages % 2:
                calls.append((np.copyto, (target, source)))
        return calls


class CompiledHadamard:
    """The transform of `BlockHadamard`, with the same bits, by a compiled loop; needs numba.

    The loop adds along the bits of a place, the lowest first, where `BlockHadamard` adds along bit
    0 of an index, then along the highest one, and down from there: a place has the bits of its
    index in that order. Place p, before and after, belongs to column and row order[p] of W, intp
    (n,).
    """

    def __init__(self, sizes: list[int]) -> None:
        from sparseskin.nodes.numerics.kernels import orthonormal

        ready(orthonormal)
        self._loop = orthonormal
        columns, self._groups = side_by_side(sizes)
        parts = []
        for start, size, count in self._groups.tolist():
            # Side by side: row i holds the columns i of all blocks of a size.
            stop = start + size * count
            of_size = columns[start:stop].reshape(size, count)
            in_order = of_size[_bit_order(size)]
            parts.append(in_order.ravel())
        self.order: Indices = np.concatenate(parts)

    def program(self, v: Floats) -> list[Call]:
        """The calls that transform v, float32 (n,), in place."""
        # Scaled by the compressor: for the bits of `BlockHadamard`, in the order of its rows.
        unscaled = np.empty(0, dtype=np.float32)
        return [(self._loop, (v, self._groups, unscaled))]


def _bit_order(size: int) -> Indices:
    """Index of each place of a block, intp (size,): bit k of the place, from 1 on, is bit -k of the
    index, counted from its highest one; bit 0 stays.
    """
    n_bits = size.bit_length() - 1
    places = np.arange(size, dtype=np.intp)
    index = places & 1
    for k in range(1, n_bits):
        bit = places >> k & 1
        index |= bit << (n_bits - k)
    return index


class HadamardProducts:
    """The orthonormal transform W / sqrt(size) as products with small matrices.

    A matrix of up to 64 rows is one product. A larger one is two, by its factors: the Kronecker
    product of the Hadamard matrices of sizes a and b is that of size a b. Quicker than butterflies
    in numpy; its bits depend on the BLAS, which adds in an order of its own. Places as of
    `BlockHadamard`.
    """

    def __init__(self, sizes: list[int]) -> None:
        self.order_in, groups = side_by_side(sizes)
        self.order_out: Indices = self.order_in.copy()
        #: Place of the blocks of a size, and the factors of their matrix.
        self._groups: list[tuple[slice, Floats, Floats]] = []
        for start, size, count in groups.tolist():
            # About the root of the size: both factors are as small as they can be.
            b = 1
            if size > MOST_AT_ONCE:
                b = 1 << size.bit_length() // 2
            a = size // b
            part = slice(start, start + size * count)
            factors = _orthonormal(a), _orthonormal(b)
            self._groups.append((part, *factors))
            if b > 1:
                # The second product leaves the rows of b before the blocks, those of a behind.
                by_row = self.order_in[part].reshape(a, b, count)
                as_left = by_row.transpose(1, 2, 0)
                self.order_out[part] = as_left.ravel()

    def forward(self, x: Floats) -> Floats:
        """Return W x, float32 (n,), from `order_in` to `order_out`."""
        rows = [_product(x[part], a, b) for part, a, b in self._groups]
        return np.concatenate(rows)

    def back(self, rows: Floats) -> Floats:
        """Return W^T rows, float32 (n,), from `order_out` to `order_in`."""
        x = [_product_back(rows[part], a, b) for part, a, b in self._groups]
        return np.concatenate(x)


def _orthonormal(size: int) -> Floats:
    """The Hadamard matrix of a size with rows of length 1, float32."""
    matrix = hadamard_matrix(size) / np.sqrt(size)
    rows: Floats = matrix.astype(np.float32)
    return rows


def _product(x: Floats, a: Floats, b: Floats) -> Floats:
    """Return the rows of the blocks of one size, whose matrix has the factors a and b."""
    v = x.reshape(len(a), -1)
    if len(b) == 1:
        return (a @ v).reshape(-1)
    # a is symmetric: the transposed product leaves b's index first, as the next one needs it.
    by_a = v.T @ a
    by_both = b @ by_a.reshape(len(b), -1)
    return by_both.reshape(-1)


def _product_back(rows: Floats, a: Floats, b: Floats) -> Floats:
    """The transpose of `_product`."""
    by_b = rows.reshape(len(b), -1)
    if len(b) == 1:
        v = a @ by_b.reshape(len(a), -1)
    else:
        by_b = b @ by_b
        v = a @ by_b.reshape(-1, len(a)).T
    return v.reshape(-1)
