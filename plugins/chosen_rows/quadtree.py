"""An orthonormal basis of a skin as rows of W: sums of square tiles, and details of their parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Doubles, Indices, Mask

LEAST_DEPTH = 3
"""Levels of the tree where there are measurements enough: tiles of 8 x 8 taxels. Fitted: on five
recordings of real skins, tiles of 4 x 4 are worse at N/8, and 16 x 16 at N/3 and N/4."""
COARSE_PART = 0.25
"""Largest part of the measurements that the sums of all tiles take. Chosen."""
N_PARTS = 4
N_DETAILS = 3
_HAAR = 0.5 * np.array([[1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]], dtype=np.float64)


@dataclass(frozen=True)
class Level:
    """Nodes of one size."""

    first: int  # number of its first node
    size: int  # number of its nodes
    #: (size, 4): place of each quarter among the nodes of the next level, or the taxels on the last
    #: one; their number where there is no taxel.
    parts: Indices
    #: (size, 4): normalised sum of a node from those of its quarters, the first row of an
    #: orthonormal matrix.
    weights: Doubles
    details: Doubles  # (size, 3, 4): the other rows; 0 where there are fewer quarters


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
        numbers = np.full(exists.shape, -1, dtype=np.intp)
        numbers[exists] = np.arange(self.n)
        counts = exists.astype(np.intp)
        found: list[tuple[Indices, Indices]] = []
        while numbers.size > 1 and (
            len(found) < LEAST_DEPTH or np.count_nonzero(counts) > max(1, COARSE_PART * m)
        ):
            parts = _quarters(numbers, -1)
            taxels = _quarters(counts, 0)
            counts = taxels.sum(axis=2)
            some = counts > 0
            found.append((parts[some], taxels[some]))
            numbers = np.full(some.shape, -1, dtype=np.intp)
            numbers[some] = np.arange(np.count_nonzero(some))
        self.levels: list[Level] = []
        first = 0
        for k in range(len(found) - 1, -1, -1):
            parts, taxels = found[k]
            end = len(found[k - 1][0]) if k else self.n
            weights, details = _orthonormal(taxels)
            places = np.where(parts >= 0, parts, end)
            self.levels.append(Level(first, len(parts), places, weights, details))
            first += len(parts)
        self.n_nodes = first
        self.n_tiles = self.levels[0].size if self.levels else 1
        each = [taxels for _, taxels in reversed(found)]
        stacked = np.concatenate(each) if each else np.zeros((0, N_PARTS), dtype=np.intp)
        # Numbers of details, 0..3, one less than it has quarters, and of taxels of each node.
        self.n_details = np.maximum(np.count_nonzero(stacked, axis=1) - 1, 0)
        self.n_taxels = stacked.sum(axis=1) if each else np.ones(1, dtype=np.intp)
        used = np.arange(N_DETAILS) < self.n_details[:, None]
        places = np.flatnonzero(used)
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
            parts = np.append(sums, 0.0)[level.parts]
            sums = (level.weights * parts).sum(axis=1)
            own = slice(level.first, level.first + level.size)
            details[own] = (level.details @ parts[:, :, None])[:, :, 0]
        return np.concatenate([sums, details.reshape(-1)[self.place_of_row[self.n_tiles :]]])

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
            last = k == len(self.levels) - 1
            end = self.n if last else self.levels[k + 1].size
            below = np.zeros(end + 1)
            below[level.parts] = parts
            sums = below[:end]
        self.forces = sums

    def synthesis(self, rows: npt.NDArray[np.floating]) -> Doubles:
        """Return W^T rows, float64 (n,), of rows (n,)."""
        flat = np.zeros(self.n_nodes * N_DETAILS)
        flat[self.place_of_row[self.n_tiles :]] = rows[self.n_tiles :]
        given = flat.reshape(-1, N_DETAILS)
        for level, _, details in self.descend(np.asarray(rows[: self.n_tiles], dtype=np.float64)):
            details[:] = given[level.first : level.first + level.size]
        return self.forces

    def coded(self, chosen: Mask) -> npt.NDArray[np.uint8]:
        """Return which nodes are chosen, bool (n_nodes,), in few bits: uint8.

        Level by level: a bit for each node of which all larger ones hold a chosen one, set where it
        or a smaller one within it is chosen; then, but for the last level, a bit for each of the
        nodes so marked, set where it is chosen itself.
        """
        some = chosen.copy()
        for upper, lower in zip(self.levels[-2::-1], self.levels[:0:-1], strict=True):
            below = np.append(some[lower.first : lower.first + lower.size], False)
            some[upper.first : upper.first + upper.size] |= below[upper.parts].any(axis=1)
        bits: list[Mask] = []
        for level, visited in self._visits(some):
            bits.append(some[visited])
            if level is not self.levels[-1]:
                bits.append(chosen[visited[some[visited]]])
        return np.packbits(np.concatenate(bits)) if bits else np.zeros(1, dtype=np.uint8)

    def decoded(self, code: npt.NDArray[np.uint8]) -> Mask:
        """Return the nodes that `coded` stated, bool (n_nodes,); ValueError if it stated none."""
        bits = np.unpackbits(code).astype(np.bool_)
        at = 0
        chosen, some = np.zeros((2, self.n_nodes), dtype=np.bool_)

        def taken(nodes: Indices) -> Mask:
            nonlocal at
            if at + nodes.size > bits.size:
                raise ValueError("too short")
            at += nodes.size
            return bits[at - nodes.size : at]

        for level, visited in self._visits(some):
            some[visited] = taken(visited)
            inside = visited[some[visited]]
            chosen[inside] = True if level is self.levels[-1] else taken(inside)
        if not np.array_equal(self.coded(chosen), code):
            raise ValueError("not as it is coded")
        return chosen

    def most_code_bytes(self, n_rows: int) -> int:
        """Bytes that `coded` takes at most where nodes have three details, `n_rows` in all."""
        n_chosen = -(-n_rows // N_DETAILS)
        marked = sum(min(level.size, n_chosen) for level in self.levels[:-1])
        return -(-(self.n_tiles + (1 + N_PARTS) * marked) // 8)

    def _visits(self, marked: Mask) -> Iterator[tuple[Level, Indices]]:
        """Yield each level with its nodes whose larger one is marked, which the caller may mark."""
        nodes = np.arange(self.n_tiles if self.levels else 0)
        for k, level in enumerate(self.levels):
            yield level, nodes
            if k + 1 < len(self.levels):
                within = level.parts[nodes[marked[nodes]] - level.first]
                below = self.levels[k + 1]
                nodes = below.first + np.sort(within[within < below.size])


def _quarters(grid: Indices, outside: int) -> Indices:
    """Return the four cells of each square of 2 x 2, (rows, columns, 4)."""
    n_rows, n_cols = grid.shape
    edges = ((0, n_rows % 2), (0, n_cols % 2))
    even = np.pad(grid, edges, constant_values=outside)
    return np.stack([even[i::2, j::2] for i in (0, 1) for j in (0, 1)], axis=-1)


def _orthonormal(taxels: Indices) -> tuple[Doubles, Doubles]:
    """Return weights and details of nodes whose quarters have so many taxels, (size, 4)."""
    weights = np.sqrt(taxels / taxels.sum(axis=1, keepdims=True))
    details = np.zeros((len(taxels), N_DETAILS, N_PARTS))
    details[(taxels == taxels[:, :1]).all(axis=1)] = _HAAR
    for node in np.flatnonzero((taxels != taxels[:, :1]).any(axis=1)):
        inside = np.flatnonzero(taxels[node])
        # A reflection that takes the weights to the first axis (Householder).
        normal = weights[node, inside].copy()
        normal[0] += 1
        reflection = np.eye(inside.size) - 2 * np.outer(normal, normal) / (normal @ normal)
        details[node, : inside.size - 1, inside] = reflection[1:].T
    return weights, details
