"""Scrambled block Hadamard rows whose taxels lie in one neighbourhood: short wires."""

from __future__ import annotations

import functools
import math
from typing import ClassVar

import numpy as np

from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import Indices, Mask

from .base import SPREAD
from .sbhe import SbhePhi

MAX_SIDE = 4096
WIRED_BLOCK = 32
"""Size of the blocks of sums by wires: each block has an amplifier, where its wires meet. Chosen:
that of the paper."""


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
        self, n: int, m: int, seed: int, block: int = WIRED_BLOCK, rule: int = SPREAD
    ) -> None:
        super().__init__(n, m, seed, block, rule)
        root = math.isqrt(n)
        self._lay_out(np.ones((root, root) if root * root == n else (1, n), dtype=np.bool_))

    def _lay_out(self, exists: Mask) -> None:
        rng = np.random.default_rng(self.seed)
        self._arrange(neighbourhood_order(exists, self.side, rng))
        self._keep(np.sort(self._order[: self.m]))


def neighbourhood_order(exists: Mask, side: int, rng: np.random.Generator) -> Indices:
    """The taxels, counted row by row, intp (n,), shuffled within neighbourhoods of `side` x `side`
    cells; those at the last rows and columns are smaller.
    """
    n_rows, n_cols = exists.shape
    number = np.cumsum(exists.ravel()).reshape(exists.shape) - 1
    parts = []
    for k, top in enumerate(range(0, n_rows, side)):
        lefts = range(0, n_cols, side)
        for left in lefts if k % 2 == 0 else reversed(lefts):
            window = np.s_[top : top + side, left : left + side]
            parts.append(rng.permutation(number[window][exists[window]]))
    order: Indices = np.concatenate(parts).astype(np.intp)
    return order


@functools.cache
def local_class(text: str) -> type[LocalSbhePhi]:
    """The class of a kind "local:SIDE". Raises PhiError unless SIDE is a whole number in
    1..4096.
    """
    if not (text.isascii() and text.isdigit() and 1 <= int(text[:6]) <= MAX_SIDE):
        raise PhiError(
            f'phi "local:{text[:40]}": expected local:SIDE, the side of a neighbourhood in cells, '
            f"1..{MAX_SIDE}"
        )
    side = int(text)
    stated = {"kind": f"local:{side}", "side": side, "by_blocks": True}
    return type("LocalSbhePhi", (LocalSbhePhi,), stated)
