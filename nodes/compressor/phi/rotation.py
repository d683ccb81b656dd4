"""Rotating rows: successive frames are measured by successive row subsets of one matrix W."""

from __future__ import annotations

import math
from abc import abstractmethod
from copy import copy

import numpy as np

from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import Indices

from .base import Phi

FIXED, ROTATING = "fixed", "rotating"
ROWS = (FIXED, ROTATING)
MAX_SUBSETS = 64
"""Largest number of row subsets. Chosen: a row that is measured less often than every 64 frames
adds as good as nothing."""


def m_of(n: int, ratio: float, rows: str = FIXED) -> int:
    """Number of measurements M of n taxels at a compression ratio N / M.

    Rounded down; rounded up where rows rotate: rounded down, a further subset would hold few
    rows not yet read.
    """
    return math.ceil(n / ratio) if rows == ROTATING else int(n / ratio)


def split_rows(order: Indices, m: int) -> list[Indices]:
    """Split n rows into P = ceil(n / m) subsets of m rows each, ascending.

    `order`, intp, shape (n,), are all rows, shuffled; the first subset holds its first m. The
    subsets start evenly spaced along it, taken as a circle: together they hold every row, and
    where m does not divide n some rows twice.
    """
    n = order.size
    n_subsets = -(-n // m)
    starts = [subset * n // n_subsets for subset in range(n_subsets)]
    return [np.sort(np.roll(order, -start)[:m]) for start in starts]


class RotatingPhi(Phi):
    """A Phi whose rows are m of n, and may be another subset in each frame.

    Its `__init__` sets `_order`, all n rows shuffled, and calls `_keep`.
    """

    _order: Indices

    @abstractmethod
    def _keep(self, rows: Indices) -> None:
        """Measure by these rows of W, ascending."""

    def row_subsets(self) -> list[Phi]:
        """Return one matrix a row subset, the first like this one; they share its arrays.

        P = ceil(n / m) matrices of m rows, which together hold every row.
        """
        twins: list[Phi] = []
        for rows in split_rows(self._order, self.m):
            twin = copy(self)
            twin._keep(rows)
            twins.append(twin)
        return twins


def row_subsets(phi: Phi, rows: str) -> list[Phi]:
    """Return the matrices that successive frames are measured by, `phi` or its like first.

    `rows` is "fixed": phi alone; or "rotating": P = ceil(n / m) matrices of m rows each. They
    share their work arrays: use all of them in one thread.

    Raises
    ------
    PhiError
        If the rows of phi cannot rotate, or there were more than 64 subsets.
    """
    if rows == FIXED:
        return [phi]
    check_rotates(phi, phi.kind)
    check_subsets(phi.n, phi.m)
    subsets: list[Phi] = getattr(phi, "row_subsets")()  # noqa: B009
    return subsets


def check_subsets(n: int, m: int) -> None:
    """Raise PhiError if rotating rows of m of n would have too many subsets."""
    if n > MAX_SUBSETS * m:
        raise PhiError(
            f'rows: "rotating" is not allowed for m = {m} of n = {n}; allowed: m of '
            f"{-(-n // MAX_SUBSETS)} or more (N/{MAX_SUBSETS})"
        )


def check_rotates(phi: object, kind: str) -> None:
    """Refuse a matrix, or a class of them, whose rows cannot rotate.

    Raises
    ------
    PhiError
        If it has no method `row_subsets`.
    """
    if not hasattr(phi, "row_subsets"):
        raise PhiError(
            f'rows: "rotating" is not allowed for phi "{kind}"; allowed: sbhe, subsample'
        )
