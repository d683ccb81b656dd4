"""The scrambled block Hadamard ensemble, the paper's measurement matrix, and its local form."""

import functools
import heapq
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask

from .base import BLOCK, MAX_SUBSETS, RANDOM, SUMS, UNREAD, BlockLayout, Phi
from .hadamard import BlockHadamard, CompiledHadamard, block_sizes, hadamard_matrix, run
from .rotation import RotatingPhi, split_evenly

IDENTIFIED = 32
PART = 4
LEAST_M = 32
"""Largest size of a block whose identifying rows frames hold, in which part of M, and the least M;
twice as many where rows rotate (of fewer, each row waits longer for the others). Chosen on skins of
25 to 900 taxels: without them a single force on a taxel of a small block may be put on another."""
WIRED_BLOCK = 32
"""Size of the blocks of sums by wires: each block has an amplifier, where its wires meet. Chosen:
that of the paper."""


class SbhePhi(RotatingPhi):
    """Phi = Q_M W P_N with orthonormal rows.

    P_N is a random permutation of the taxels, W is block-diagonal with Hadamard blocks of size B
    divided by sqrt(B), Q_M keeps m of its rows. Where B does not divide n, the remainder gets
    smaller blocks (16 + 8 + 4 + 2 + 1).

    By rule 3, Q_M keeps the sum of each block, the largest blocks first where m is too small for
    all, rows that identify the taxels of small blocks (`least_m`), and other rows, in number
    proportional to those of the blocks. Row subsets of rotating rows (`row_subsets`) are those of
    `split_with_sums`. By rule 1, the paper's, rows and row subsets are drawn at random from all.
    With one seed and rule, a smaller m keeps a subset of the rows of a larger one.

    Column j of W sees taxel `permutation[j]`, intp (n,); measurement i is its row `rows[i]`, intp
    (m,), ascending, of a block whose 1 / sqrt(B) is `scale[i]`, float32 (m,). `sizes` are those of
    the blocks of W, in their order.

    Source: the paper, section IV-B; Gan, Do, Tran, "Fast compressive imaging using scrambled
    block Hadamard ensemble", EUSIPCO 2008. The paper's rows hold plain +1 and -1: they are
    sqrt(B) times as long. Row subsets are systematic samples: Cochran, "Sampling Techniques",
    Wiley, 1977, chapter 8.
    """

    kind = "sbhe"
    has_rules = True
    by_blocks = True  # of this class itself; a subclass has to state it anew
    _compiled: CompiledHadamard | None = None

    def __init__(
        self, n: int, m: int, seed: int, block: int = BLOCK, rule: int = SUMS
    ) -> None:
        super().__init__(n, m, seed, block)
        self.rule = rule
        self.sizes = block_sizes(n, block)
        self._hadamard = BlockHadamard(self.sizes)

        # The order of the draws is that of the fingerprints.
        rng = np.random.default_rng(seed)
        permutation = rng.permutation(n).astype(np.intp)
        if rule == RANDOM:
            self._order: Indices = rng.permutation(n).astype(np.intp)
        else:
            self._order, self._by_block = spread_order(self.sizes, rng)
        self._arrange(permutation)

        # A line of the cache apart: of a power of two both would compete for the same places.
        work = np.zeros((2, n + 16), dtype=np.float32)
        self._v, scratch = work[:, :n]
        self._transform = self._hadamard.program(self._v, scratch)
        self._transposed = self._hadamard.program(self._v, scratch, back=True)
        self._keep(np.sort(self._order[:m]))

    def compile_loops(self) -> None:
        self._compiled = CompiledHadamard(self.sizes)
        self._transform = self._compiled.program(self._v)
        self._lay_forward()

    def _arrange(self, permutation: Indices) -> None:
        """Set P_N, intp, shape (n,)."""
        permutation.setflags(write=False)
        self.permutation: Indices = permutation
        # Taxel of each place of the vector that is transformed.
        self._deal: Indices = permutation[self._hadamard.order_in]

    def _keep(self, rows: Indices, *_: Any) -> None:
        super()._keep(rows, self.block, self.permutation)
        # The transform leaves row order_out[p] at place p.
        self._places: Indices = np.argsort(self._hadamard.order_out)[rows]
        self._lay_forward()
        size_of_row = np.repeat(self.sizes, self.sizes)
        sizes = size_of_row[rows].astype(np.float32)
        self.scale: Floats = np.reciprocal(np.sqrt(sizes))

    def _lay_forward(self) -> None:
        """Set where `_forward` reads taxels and finds measurements."""
        self._deal_forward = self._deal
        self._places_forward = self._places
        if self._compiled is not None:
            order = self._compiled.order
            self._deal_forward = self.permutation[order]
            self._places_forward = np.argsort(order)[self.rows]

    def block_layout(self) -> BlockLayout | None:
        """As in `Phi`: of a class that states `by_blocks` itself."""
        if vars(type(self)).get("by_blocks", False) is not True:
            return None
        return BlockLayout(self.sizes, self.permutation, self.rows, self.block_of_row)

    @property
    def block_of_row(self) -> Indices:
        """Number of the block of taxels that each row sums, int64 (m,)."""
        ends = np.cumsum(self.sizes)
        return np.searchsorted(ends, self.rows, side="right")

    def row_subsets(self) -> list[Phi]:
        """As in `RotatingPhi`; but by rule 1, the first one is not this matrix."""
        if self.rule == RANDOM:
            return super().row_subsets()
        subsets = split_with_sums(self.sizes, self._by_block, self.m)
        return self._twins(subsets)

    def dense(self) -> Doubles:
        """Return the explicit matrix, float64, shape (m, n), built from its definition."""
        matrix = np.zeros((self.m, self.n))
        start = 0
        for size in self.sizes:
            stop = start + size
            taxels = self.permutation[start:stop]
            is_of_block = (self.rows >= start) & (self.rows < stop)
            rows_in_block = self.rows[is_of_block] - start
            block = hadamard_matrix(size) / np.sqrt(size)
            matrix[np.ix_(is_of_block, taxels)] = block[rows_in_block]
            start = stop
        return matrix

    def _forward(self, x: Floats, out: Floats) -> None:
        x.take(self._deal_forward, None, self._v, "clip")
        run(self._transform)
        self._v.take(self._places_forward, None, out, "clip")
        np.multiply(out, self.scale, out)

    def _adjoint(self, y: Floats, out: Floats) -> None:
        self._v.fill(0)
        self._v[self._places] = y * self.scale
        run(self._transposed)
        out[self._deal] = self._v


def spread_order(
    sizes: Sequence[int], rng: np.random.Generator
) -> tuple[Indices, Indices]:
    """All rows of W in two orders, intp (n,): spread over the blocks (first the sums of the blocks,
    those of the largest first; then the other rows, of which the first k are divided among the
    blocks in proportion to their rows, but that those of `least_m` come earlier); and block by
    block, shuffled within each.

    `sizes` are those of the blocks, in order.
    """
    block_of_row = np.repeat(np.arange(len(sizes)), sizes)
    n = block_of_row.size
    lots = rng.random(n)
    by_block = np.lexsort((lots, block_of_row)).astype(np.intp)

    # The sum is the first row of its block. Blocks of one size come in a random order.
    all_sizes = np.array(sizes)
    shuffled = rng.permutation(len(sizes))
    largest_first = np.argsort(-all_sizes[shuffled], kind="stable")
    blocks = shuffled[largest_first]
    first_rows = np.cumsum(sizes) - sizes
    sums = first_rows[blocks].astype(np.intp)

    # The other rows block by block, with those that identify taxels first.
    required_m = least_m(sizes)
    not_sums = by_block[~np.isin(by_block, sums)]
    identifying_first = np.lexsort((required_m[not_sums], block_of_row[not_sums]))
    not_sums = not_sums[identifying_first]

    # The blocks take turns in proportion to their rows. A row that is needed at a smaller M comes
    # earlier than at its turn; then a part of M is left to the rows before it.
    n_not_sums = all_sizes[blocks] - 1
    turns = blocks[in_proportion(n_not_sums.tolist())]
    turn = sums.size + np.argsort(turns, kind="stable")
    is_required = required_m <= n
    needed_at = np.where(is_required, required_m - required_m // PART, required_m)
    places = np.minimum(turn, needed_at[not_sums])
    not_sums = not_sums[np.argsort(places, kind="stable")]
    spread = np.concatenate([sums, not_sums])
    return spread, by_block


def least_m(sizes: Sequence[int]) -> Indices:
    """Least M at which frames hold each row of W for its block, intp (n,): above n for most rows.

    The sum and the rows 1, 2, 4 .. B/2 of a block of B taxels have another pattern of signs for
    each taxel: they identify a single force. Those of blocks of 32 and fewer, but for the largest,
    are held where they, and those of smaller blocks, are at most M/4, and M is 32 or more. Those of
    other blocks up to 64, of which few rows may be held, come first: n + 1, other rows n + 2.
    """
    n = sum(sizes)
    required_m = np.full(n, n + 2)
    begin = n
    n_identifying = 0
    for size in reversed(sizes):  # the smallest first
        begin -= size
        n_bits = size.bit_length()
        n_identifying += n_bits
        if size > 2 * IDENTIFIED:
            continue
        # 0, 1, 2, 4 .. B/2: the sum, and a row for each bit of a taxel's number.
        rows = begin + (1 << np.arange(n_bits) >> 1)
        required_m[rows] = n + 1
        if size <= IDENTIFIED and size < sizes[0]:
            m = max(PART * n_identifying, LEAST_M)
            required_m[rows] = min(m, n + 1)
    return required_m


def split_with_sums(sizes: Sequence[int], by_block: Indices, m: int) -> list[Indices]:
    """Split the rows of W into subsets of m rows each, ascending, so that each holds the sum of one
    of the largest blocks: a random part of the skin, where it is seen what all taxels share.

    Blocks of `sizes` have the rows `by_block`, intp (n,), block after block. All subsets hold the
    rows that identify taxels (`least_m`), where M is 64 or more. Of the other rows each holds as
    many of each block, to less than one, and together they hold every row. Where sums are too few
    for the ceil(n / m) subsets, some are in several, and up to `UNREAD` of the other rows in none,
    or else there are more subsets; where these were more than 64, some have no sum. Rows in two
    subsets are half the subsets apart.
    """
    n = by_block.size
    first_rows = np.cumsum(sizes) - sizes
    sums = first_rows[np.equal(sizes, max(sizes))]
    always = by_block[:0]
    if m >= 2 * LEAST_M:
        always = by_block[least_m(sizes)[by_block] <= m]
    is_placed = np.isin(by_block, np.concatenate([sums, always]))
    in_turn = by_block[~is_placed]

    m_in_turn = m - always.size
    n_beside_sum = m_in_turn - 1
    has_few_sums = sums.size * m_in_turn < n - always.size
    if has_few_sums and in_turn.size <= MAX_SUBSETS * n_beside_sum:
        n_read = (1 - UNREAD) * in_turn.size
        n_subsets = max(n / m, n_read / n_beside_sum)
        parts = split_evenly(in_turn, n_beside_sum, math.ceil(n_subsets))
        # One sum in each subset, and the same one again where there are fewer sums than subsets.
        for k, part in enumerate(parts):
            parts[k] = np.append(part, sums[k % sums.size])
    else:
        parts = split_evenly(np.concatenate([sums, in_turn]), m_in_turn)
    complete = [np.concatenate([part, always]) for part in parts]
    subsets = [np.sort(rows) for rows in complete]

    # Samples that share rows are neighbours: in this order they are half the subsets apart.
    return subsets[::2] + subsets[1::2]


def in_proportion(numbers: Sequence[int]) -> Indices:
    """Return numbers[b] times each b, so that any first ones hold each b in proportion.

    Of the first k of n, numbers[b] k / n are b, to less than one: each has an earliest and a latest
    place, and of those that may come next the one that has to come first does.

    Source: such places exist: Baruah, Cohen, Plaxton, Varvel, "Proportionate progress: a notion of
    fairness in resource allocation", Algorithmica 15, 1996.
    """
    n = sum(numbers)
    # Earliest place, one beyond the latest, and b, of each of the numbers[b] times.
    spans: list[tuple[int, int, int]] = []
    for b, number in enumerate(numbers):
        for k in range(number):
            latest = -((k + 1) * n // -number)
            spans.append((k * n // number, latest, b))
    spans.sort()

    order = np.empty(n, dtype=np.intp)
    # Those that may come next, by their latest place.
    ready: list[tuple[int, int]] = []
    n_begun = 0
    for place in range(n):
        while n_begun < n and spans[n_begun][0] <= place:
            heapq.heappush(ready, spans[n_begun][1:])
            n_begun += 1
        order[place] = heapq.heappop(ready)[1]
    return order


class LocalSbhePhi(SbhePhi):
    """Phi = Q_M W P_N, with a permutation P_N within neighbourhoods of `side` x `side` cells.

    The taxels of a neighbourhood are shuffled among themselves, and neighbourhoods follow one
    another row by row, to and fro, so that each touches the one before it. Where the block size
    does not divide the taxels of a neighbourhood, a block takes the rest from the next one. One
    neighbourhood as large as the skin is `SbhePhi`.

    Until `lay_out` states the grid, it is a square of n taxels, or else one row of them.
    """

    by_blocks = True
    default_block = WIRED_BLOCK
    side: ClassVar[int] = MAX_SIDE

    def __init__(
        self, n: int, m: int, seed: int, block: int = WIRED_BLOCK, rule: int = SUMS
    ) -> None:
        super().__init__(n, m, seed, block, rule)
        root = math.isqrt(n)
        shape = (1, n)
        if root * root == n:
            shape = (root, root)
        self._lay_out(np.ones(shape, dtype=np.bool_))

    def _lay_out(self, exists: Mask) -> None:
        rng = np.random.default_rng(self.seed)
        self._arrange(neighbourhood_order(exists, self.side, rng))
        self._keep(np.sort(self._order[: self.m]))


def neighbourhood_order(exists: Mask, side: int, rng: np.random.Generator) -> Indices:
    """The taxels, counted row by row, intp (n,), shuffled within neighbourhoods of `side` x `side`
    cells; those at the last rows and columns are smaller.
    """
    n_rows, n_cols = exists.shape
    counts = np.cumsum(exists.ravel())
    number = counts.reshape(exists.shape) - 1
    parts = []
    first_cols = list(range(0, n_cols, side))
    for row in range(0, n_rows, side):
        rows = slice(row, row + side)
        for col in first_cols:
            window = rows, slice(col, col + side)
            taxels = number[window][exists[window]]
            parts.append(rng.permutation(taxels))
        # To and fro: a block that goes on in the next neighbourhood stays in one piece of skin.
        first_cols.reverse()
    return np.concatenate(parts).astype(np.intp)


@functools.cache
def local_class(text: str) -> type[LocalSbhePhi]:
    """The class of a kind "local:SIDE". Raises PhiError unless SIDE is a whole number in
    1..4096.
    """
    # Six digits tell that the number is too large: int() takes long of thousands.
    is_number = text.isascii() and text.isdigit()
    if not is_number or not 1 <= int(text[:6]) <= MAX_SIDE:
        expected = f"local:SIDE, the side of a neighbourhood in cells, 1..{MAX_SIDE}"
        raise PhiError(f'phi "local:{text[:40]}": expected {expected}')
    side = int(text)
    attributes = {"kind": f"local:{side}", "side": side, "by_blocks": True}
    return type("LocalSbhePhi", (LocalSbhePhi,), attributes)
