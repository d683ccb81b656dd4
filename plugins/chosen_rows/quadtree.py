"""An orthonormal basis of a skin as rows of W: sums of square tiles, and details of their parts."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Bytes, Doubles, Indices, Mask

LEAST_DEPTH = 3
"""Levels of the tree where there are measurements enough: tiles of 8 x 8 taxels. Fitted: on five
recordings of real skins, tiles of 4 x 4 are worse at N/8, and 16 x 16 at N/3 and N/4."""
COARSE_PART = 0.25
"""Largest part of the measurements that the sums of all tiles take. Chosen."""
N_PARTS = 4
N_DETAILS = 3
_HAAR = np.array([[1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]]) / 2


@dataclass(frozen=True)
class Level:
    """Nodes of one size."""

    #: Number of its first node, and of its nodes.
    first: int
    size: int
    #: (size, 4): place of each quarter among the nodes of the next level, or the taxels on the last
    #: one; their number where there is no taxel.
    parts: Indices
    #: (size, 4): normalised sum of a node from those of its quarters, the first row of an
    #: orthonormal matrix.
    weights: Doubles
    #: (size, 3, 4): the other rows; 0 where there are fewer quarters.
    details: Doubles


class _Squares(NamedTuple):
    """Quarters of the squares of one size that hold a taxel: their numbers, -1 where there is
    none, and their numbers of taxels, intp (size, 4) each.
    """

    parts: Indices
    taxels: Indices


class Quadtree:
    """W x: normalised sums of tiles, and for each node of a quad tree what its quarters differ by.

    Where all four quarters of a node exist in equal number the three details are those of the
    two-dimensional Haar wavelet; elsewhere they complete its normalised sum to an orthonormal
    matrix (docs/explanation/adaptive.md). Rows of W: the sums of the tiles, then the details of all
    nodes, from the largest to the smallest.

    Taxels are where `exists`, bool (n_rows, n_cols), is True; tiles are so large that their sums
    are at most a quarter of the m measurements.

    `n`, `n_tiles`, `n_nodes` are the numbers of taxels, of the largest nodes, and of all nodes;
    `levels` go from the largest nodes to those whose quarters are taxels.

    Source: Haar wavelets on four quarters; Averbuch, Dekel, Deutsch, "Adaptive compressed image
    sensing using dictionaries", SIAM J. Imaging Sciences 5(1), 2012, for reading a tree of them
    from its root.
    """

    def __init__(self, exists: Mask, m: int) -> None:
        self.n = int(np.count_nonzero(exists))
        squares = list(_squares(exists, COARSE_PART * m))

        # From the tiles to the taxels; the quarters of the last nodes are taxels.
        self.levels: list[Level] = []
        self.n_nodes = 0
        sizes_below = [self.n, *(len(level.parts) for level in squares)]
        pairs = [*zip(sizes_below, squares, strict=False)]
        for n_below, (parts, taxels) in reversed(pairs):
            weights, details = _orthonormal(taxels)
            # The place behind the last one stands for quarters that do not exist.
            places = np.where(parts >= 0, parts, n_below)
            level = Level(self.n_nodes, len(parts), places, weights, details)
            self.levels.append(level)
            self.n_nodes += level.size

        # A grid of one taxel has no node.
        self.n_tiles = 1
        self.n_taxels = np.ones(1, dtype=np.intp)
        taxels_of_quarters = np.zeros((0, N_PARTS), dtype=np.intp)
        if squares:
            self.n_tiles = self.levels[0].size
            taxels_of_nodes = [level.taxels for level in reversed(squares)]
            taxels_of_quarters = np.concatenate(taxels_of_nodes)
            self.n_taxels = taxels_of_quarters.sum(axis=1)

        # A node has one detail less than it has quarters, 0..3.
        self.n_details = np.maximum(np.count_nonzero(taxels_of_quarters, axis=1) - 1, 0)
        is_used = np.arange(N_DETAILS) < self.n_details[:, None]
        places = np.flatnonzero(is_used)
        tiles = np.arange(self.n_tiles)
        # Node of each row, and its place in a flat array of three details a node; those of a tile's
        # sum are the tile and -1.
        self.node_of_row = np.concatenate([tiles, places // N_DETAILS])
        self.place_of_row = np.concatenate([np.full_like(tiles, -1), places])

    def analysis(self, x: npt.NDArray[np.floating]) -> Doubles:
        """Return W x, float64 (n,), of forces (n,)."""
        sums = np.asarray(x, dtype=np.float64)
        details = np.zeros((self.n_nodes, N_DETAILS))
        for level in reversed(self.levels):
            # Quarters that do not exist take the 0 at the end.
            parts = np.append(sums, 0.0)[level.parts]
            sums = (level.weights * parts).sum(axis=1)

            nodes = slice(level.first, level.first + level.size)
            details[nodes] = (level.details @ parts[:, :, None])[:, :, 0]
        rows_of_details = details.reshape(-1)[self.place_of_row[self.n_tiles :]]
        return np.concatenate([sums, rows_of_details])

    def descend(self, tiles: Doubles) -> Iterator[tuple[Level, Doubles, Doubles]]:
        """Yield each level with the normalised sums of its nodes, from those of the tiles.

        The third is an array, float64 (size, 3), which the caller fills with their details before
        it asks for the next level; `forces` then has those of the taxels.
        """
        sums = tiles
        for k, level in enumerate(self.levels):
            details = np.zeros((level.size, N_DETAILS))
            yield level, sums, details
            parts = sums[:, None] * level.weights
            parts += (details[:, None, :] @ level.details)[:, 0, :]

            n_below = self.n
            if level is not self.levels[-1]:
                n_below = self.levels[k + 1].size
            # A last place takes the quarters that do not exist.
            below = np.zeros(n_below + 1)
            below[level.parts] = parts
            sums = below[:n_below]
        self.forces = sums

    def synthesis(self, rows: npt.NDArray[np.floating]) -> Doubles:
        """Return W^T rows, float64 (n,), of rows (n,)."""
        flat = np.zeros(self.n_nodes * N_DETAILS)
        flat[self.place_of_row[self.n_tiles :]] = rows[self.n_tiles :]
        read_details = flat.reshape(-1, N_DETAILS)
        tiles = np.asarray(rows[: self.n_tiles], dtype=np.float64)
        for level, _, details in self.descend(tiles):
            details[:] = read_details[level.first : level.first + level.size]
        return self.forces

    def coded(self, chosen: Mask) -> Bytes:
        """Return which nodes are chosen, bool (n_nodes,), in few bits: uint8.

        Level by level: a bit for each node of which all larger ones hold a chosen one, set where it
        or a smaller one within it is chosen; then, but for the last level, a bit for each of the
        nodes so marked, set where it is chosen itself.
        """
        # A node is marked if it or a smaller one within it is chosen.
        marked = chosen.copy()
        for lower, upper in pairwise(reversed(self.levels)):
            below = marked[lower.first : lower.first + lower.size]
            # Quarters that do not exist are not marked.
            in_quarters = np.append(below, False)[upper.parts].any(axis=1)
            marked[upper.first : upper.first + upper.size] |= in_quarters

        bits: list[Mask] = []
        for level, visited in self._visits(marked):
            bits.append(marked[visited])
            if level is not self.levels[-1]:
                inside = visited[marked[visited]]
                bits.append(chosen[inside])
        if not bits:
            return np.zeros(1, dtype=np.uint8)
        return np.packbits(np.concatenate(bits))

    def decoded(self, code: Bytes) -> Mask:
        """Return the nodes that `coded` stated, bool (n_nodes,); ValueError if it stated none."""
        bits = np.unpackbits(code).astype(np.bool_)
        is_chosen = np.zeros(self.n_nodes, dtype=np.bool_)
        marked = np.zeros(self.n_nodes, dtype=np.bool_)
        n_taken = 0

        def take(nodes: Indices) -> Mask:
            nonlocal n_taken
            if n_taken + nodes.size > bits.size:
                raise ValueError("too short")
            n_taken += nodes.size
            return bits[n_taken - nodes.size : n_taken]

        for level, visited in self._visits(marked):
            marked[visited] = take(visited)
            inside = visited[marked[visited]]
            if level is self.levels[-1]:
                is_chosen[inside] = True
            else:
                is_chosen[inside] = take(inside)

        # Every choice has one code: spare bits and needless marks are faults.
        if not np.array_equal(self.coded(is_chosen), code):
            raise ValueError("not as it is coded")
        return is_chosen

    def most_code_bytes(self, n_rows: int) -> int:
        """Bytes that `coded` takes at most where nodes have three details, `n_rows` in all."""
        # On each level no more nodes are marked than are chosen in all.
        n_chosen = -(-n_rows // N_DETAILS)
        n_marked = sum(min(level.size, n_chosen) for level in self.levels[:-1])
        return -(-(self.n_tiles + (1 + N_PARTS) * n_marked) // 8)

    def _visits(self, marked: Mask) -> Iterator[tuple[Level, Indices]]:
        """Yield each level with its nodes whose larger one is marked, which the caller may mark."""
        nodes = np.arange(self.n_tiles if self.levels else 0)
        for k, level in enumerate(self.levels):
            yield level, nodes
            if k + 1 < len(self.levels):
                within = level.parts[nodes[marked[nodes]] - level.first]
                next_level = self.levels[k + 1]
                nodes = next_level.first + np.sort(within[within < next_level.size])


def _squares(exists: Mask, most_tiles: float) -> Iterator[_Squares]:
    """Yield squares of 2 x 2 taxels, of 4 x 4 ..., until so few of them hold a taxel."""
    counts = exists.astype(np.intp)
    numbers = _numbered(exists)
    depth = 0
    while numbers.size > 1:
        if depth >= LEAST_DEPTH and np.count_nonzero(counts) <= max(1, most_tiles):
            break
        parts = _quarters(numbers, -1)
        taxels = _quarters(counts, 0)
        counts = taxels.sum(axis=2)
        has_taxel = counts > 0
        yield _Squares(parts[has_taxel], taxels[has_taxel])
        numbers = _numbered(has_taxel)
        depth += 1


def _numbered(exists: Mask) -> Indices:
    """Return the number of each cell among those that exist, -1 elsewhere."""
    numbers = np.full(exists.shape, -1, dtype=np.intp)
    numbers[exists] = np.arange(np.count_nonzero(exists))
    return numbers


def _quarters(grid: Indices, outside: int) -> Indices:
    """Return the four cells of each square of 2 x 2, (rows, columns, 4)."""
    # A grid of odd sides ends with squares that are cut off.
    n_rows, n_cols = grid.shape
    padding = ((0, n_rows % 2), (0, n_cols % 2))
    padded = np.pad(grid, padding, constant_values=outside)
    return np.stack([padded[i::2, j::2] for i in (0, 1) for j in (0, 1)], axis=-1)


def _orthonormal(taxels: Indices) -> tuple[Doubles, Doubles]:
    """Return weights and details of nodes whose quarters have so many taxels, (size, 4)."""
    weights = np.sqrt(taxels / taxels.sum(axis=1, keepdims=True))
    details = np.zeros((len(taxels), N_DETAILS, N_PARTS))
    are_equal = (taxels == taxels[:, :1]).all(axis=1)
    details[are_equal] = _HAAR

    for node in np.flatnonzero(~are_equal):
        quarters = np.flatnonzero(taxels[node])
        reflection = _reflection(weights[node, quarters])
        details[node, : quarters.size - 1, quarters] = reflection[1:].T
    return weights, details


def _reflection(unit: Doubles) -> Doubles:
    """An orthonormal matrix whose first row is minus a unit vector (Householder)."""
    normal = unit.copy()
    normal[0] += 1
    projection = 2 * np.outer(normal, normal) / (normal @ normal)
    return np.eye(unit.size) - projection
