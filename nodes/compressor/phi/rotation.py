"""Rotating rows: successive frames are measured by successive row subsets of one matrix W."""

import math
from collections.abc import Sequence
from copy import copy
from typing import Any, ClassVar

import numpy as np

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.numerics.arrays import AnyArray, Indices

from .base import MAX_SUBSETS, STORED, Phi, fingerprint_of, make_phi

FIXED = "fixed"
ROTATING = "rotating"
ROWS = (FIXED, ROTATING)
PAPER = "paper"
PAPER_BLOCK = 32
"""Size of the Hadamard blocks. Source: paper, section IV-B."""
RATIO = 3.0
"""Compression ratio N / M where none is stated."""


def m_of(n: int, ratio: float, rows: str = FIXED) -> int:
    """Number of measurements M of n taxels at a compression ratio N / M.

    Rounded down; rounded up where rows rotate: rounded down, a further subset would hold few
    rows not yet read.
    """
    if rows == ROTATING:
        return math.ceil(n / ratio)
    return int(n / ratio)


def default_rows(phi: object, kind: str, n: int, m: int) -> str:
    """Rows of a matrix, or of a class of them, where none are stated: rotating where they can and M
    is in N / 64 .. N - 1, and for a file with a stack of matrices; else fixed.
    """
    if not can_rotate(phi):
        return FIXED
    # A file that can rotate is one with several matrices, of whatever size.
    if kind.startswith(STORED) or m < n <= MAX_SUBSETS * m:
        return ROTATING
    return FIXED


def split_rows(order: Indices, m: int) -> list[Indices]:
    """Split n rows into P = ceil(n / m) subsets of m rows each, ascending.

    `order`, intp, shape (n,), are all rows, shuffled; the first subset holds its first m. The
    subsets start evenly spaced along it, taken as a circle: together they hold every row, and
    where m does not divide n some rows twice.
    """
    n = order.size
    n_subsets = math.ceil(n / m)
    # In whole numbers, so that the starts are the same on every machine.
    starts = [subset * n // n_subsets for subset in range(n_subsets)]
    # Twice the order: a subset that reaches beyond its end goes on at its start.
    circle = np.concatenate([order, order])
    return [np.sort(circle[start : start + m]) for start in starts]


def split_evenly(order: Indices, m: int, n_subsets: int | None = None) -> list[Indices]:
    """Split n rows into P systematic samples of m rows each, ascending; by default ceil(n / m).

    `order`, intp, shape (n,), are all rows. Of any k that follow one another, each sample holds
    k m / n, to less than one. Together they hold P m rows, or all and some of them twice.
    """
    n = order.size
    n_subsets = n_subsets or math.ceil(n / m)
    # In whole numbers, which no rounding shifts: a sample takes a row where its count of rows
    # among the first 0, 1, .. n of the order grows.
    steps = np.arange(n + 1, dtype=np.int64) * m * n_subsets
    samples = []
    for subset in range(n_subsets):
        counts = (steps + subset * n) // (n * n_subsets)
        is_taken = np.diff(counts) > 0
        samples.append(np.sort(order[is_taken]))
    return samples


class RotatingPhi(Phi):
    """A Phi whose rows are m of n, and may be another subset in each frame.

    Its `__init__` sets `_order`, all n rows shuffled, and calls `_keep`.
    """

    #: False for a subclass whose rows change in another way.
    can_rotate: ClassVar[bool] = True
    _order: Indices

    def _keep(self, rows: Indices, block: int = 1, *w: AnyArray) -> None:
        """Measure by these rows, ascending, of W, which block and arrays state."""
        rows.setflags(write=False)
        self.rows: Indices = rows
        self.fingerprint = fingerprint_of(self.kind, self.n, self.m, block, *w, rows)

    def row_subsets(self) -> list[Phi]:
        """P = ceil(n / m) matrices of m rows, which together hold every row, the first like this
        one; they share its arrays. A subclass may have more.
        """
        return self._twins(split_rows(self._order, self.m))

    def _twins(self, subsets: Sequence[Indices]) -> list[Phi]:
        """Return a matrix of each row subset; it shares the arrays of this one."""
        # Copies share permutation and work arrays: of many subsets each would take as much again.
        twins = [copy(self) for _ in subsets]
        for twin, rows in zip(twins, subsets, strict=True):
            twin._keep(rows)
        return list(twins)


def row_subsets(phi: Phi, rows: str | None) -> list[Phi]:
    """The matrices that successive frames are measured by.

    `rows` is "fixed": phi alone; or "rotating": its `row_subsets`, of m rows each, about n / m, or
    those of a file; or None: as of `default_rows`. They share their work
    arrays: use all of them in one thread. Raises PhiError if `rows` is neither, the rows of phi
    cannot rotate, or there were more than 64 subsets.
    """
    # A matrix of a user's own that cannot rotate need have no kind.
    if rows is None and not can_rotate(phi):
        rows = FIXED
    if rows is None:
        rows = default_rows(phi, phi.kind, phi.n, phi.m)
    if rows == FIXED:
        return [phi]
    if rows != ROTATING:
        raise PhiError(f"rows: {rows!r} is not allowed; allowed: {', '.join(ROWS)}")
    check_rotates(phi, phi.kind)
    check_subsets(phi.n, phi.m)
    # Not `RotatingPhi`: that of a file, or of a user's own, has the method too.
    subsets: list[Phi] = getattr(phi, "row_subsets")()  # noqa: B009
    return subsets


def phis_for(
    skin: Skin, sigma_end: float, clips_noise: bool, rows: str | None, **parameters: Any
) -> list[Phi]:
    """The matrices that measure the frames of a skin in turn, laid out. `sigma_end` and
    `clips_noise` are as in `SkinState`, `rows` as in `row_subsets`, parameters those of `make_phi`
    but n, as is PhiError.
    """
    phi = make_phi(n=skin.n_taxels, **parameters)
    # A class of a user's own need not have these methods.
    if isinstance(phi, Phi):
        phi.lay_out(skin.exists)
        phi.state_noise(sigma_end, skin.f_max, clips_noise)
    return row_subsets(phi, rows)


def check_subsets(n: int, m: int) -> None:
    """Raise PhiError if rotating rows of m of n would have too many subsets."""
    if n > MAX_SUBSETS * m:
        allowed = f"m of {-(-n // MAX_SUBSETS)} or more (N/{MAX_SUBSETS})"
        fault = f'rows: "rotating" is not allowed for m = {m} of n = {n}'
        raise PhiError(f"{fault}; allowed: {allowed}")


def can_rotate(phi: object) -> bool:
    """Return True if the rows of a matrix, or of a class of them, can rotate.

    They can if it has a method `row_subsets`, and no attribute `can_rotate` that is False.
    """
    return hasattr(phi, "row_subsets") and bool(getattr(phi, "can_rotate", True))


def check_rotates(phi: object, kind: str) -> None:
    """Raise PhiError for a matrix, or a class of them, whose rows cannot rotate."""
    if not can_rotate(phi):
        fault = f'"rotating" is not allowed for phi "{kind}"'
        raise PhiError(f"rows: {fault}; allowed: sbhe, subsample")
