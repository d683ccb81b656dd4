"""Rotating rows: frames take turns among matrices that together read every row of W."""

from __future__ import annotations

from abc import abstractmethod
from copy import copy

import numpy as np

from sparseskin.nodes.compressor.calls import Indices
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.errors import PhiError

FIXED, ROTATING = "fixed", "rotating"
ROWS = (FIXED, ROTATING)
MAX_PHASES = 64
"""A row that is read more seldom than every 64 frames is as good as not read."""


def turns(order: Indices, m: int) -> list[Indices]:
    """Which rows are read in each of P = ceil(n / m) turns, m in each, ascending.

    The turns begin evenly spaced along `order`, as on a circle: every row is read in P frames,
    and where m does not divide n some are read twice.

    Parameters
    ----------
    order : ndarray of intp, shape (n,)
        All rows, shuffled. The first turn reads the first m of them.
    m : int
        Rows of a turn, 1..n.
    """
    n = order.size
    n_turns = -(-n // m)
    starts = [turn * n // n_turns for turn in range(n_turns)]
    return [np.sort(np.roll(order, -start)[:m]) for start in starts]


class RotatingPhi(Phi):
    """A Phi whose rows are a choice among n, and may be another choice in each frame.

    Its `__init__` sets `_order`, all rows as they are chosen, and calls `_keep`.
    """

    _order: Indices

    @abstractmethod
    def _keep(self, rows: Indices) -> None:
        """Measure by these rows, ascending."""

    def phases(self) -> list[Phi]:
        """Return the matrices of rotating rows, the first like this one; they share its arrays.

        P = ceil(n / m) of them, m rows each, which together read every row.
        """
        twins: list[Phi] = []
        for rows in turns(self._order, self.m):
            twin = copy(self)
            twin._keep(rows)
            twins.append(twin)
        return twins


def phases_of(phi: Phi, rows: str) -> list[Phi]:
    """Return the matrices that frames take turns among, the first of them `phi` itself.

    They share their work arrays: use all of them in one thread.

    Parameters
    ----------
    phi : Phi
    rows : str
        "fixed": phi alone. "rotating": P = ceil(n / m) matrices of m rows each.

    Raises
    ------
    PhiError
        If its rows cannot rotate, or there were more than 64 turns.
    """
    if rows == FIXED:
        return [phi]
    check_rotates(phi, phi.kind)
    if phi.n > MAX_PHASES * phi.m:
        raise PhiError(
            f'rows: "rotating" is not allowed for m = {phi.m} of n = {phi.n}; allowed: m of '
            f"{-(-phi.n // MAX_PHASES)} or more (N/{MAX_PHASES})"
        )
    phases: list[Phi] = getattr(phi, "phases")()  # noqa: B009
    return phases


def check_rotates(phi: object, kind: str) -> None:
    """Refuse a matrix, or a class of them, whose rows cannot rotate: that has no `phases`.

    Raises
    ------
    PhiError
        If it is one.
    """
    if not hasattr(phi, "phases"):
        raise PhiError(
            f'rows: "rotating" is not allowed for phi "{kind}"; allowed: sbhe, subsample'
        )
