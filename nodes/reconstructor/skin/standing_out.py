"""What stands out of the noise in a window: a taxel, or the sum of a square of them."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices

from .tiles import Tiles

STANDS_OUT = (3.8, 3.3, 2.6, 2.0)
"""Deviations by which a taxel, a square of 3 x 3, one of 6 x 6, and the window stand out. Derived:
5 % of the windows of normal noise exceed them, four of `tiles.REFERENCE_WINDOWS`; of the other
windows the gates would let pass less than 0.005 noise variances a taxel."""
CLEARLY = 1.2
"""Factor of `STANDS_OUT` at which a window counts in full: a switch in place of a ramp would
amplify rounding. Chosen."""
N_SUMS = 22
"""Numbers of a window: its largest taxel, and the sums of 16 squares, of 4, and of all."""
_N_OF_SIZES = (1, 16, 4, 1)
"""How many of them have each of the sizes of `STANDS_OUT`."""


class Deviations(NamedTuple):
    """Deviations of the sums of windows of unit noise; windows that are alike share them.

    Attributes
    ----------
    of_kinds : ndarray of float64, shape (k, N_SUMS)
        0 where a square has no taxel.
    kinds : tuple of ndarray of intp, shape (t,)
        Row of `of_kinds` of each window, of each shift.
    """

    of_kinds: Doubles
    kinds: tuple[Indices, ...]


def standing_out(windows: Floats, scales: Floats | None = None) -> Floats:
    """Part of a window of unit noise that counts, float32 (t,): 0 where nothing stands out.

    By how far its largest taxel, or one of its sums, exceeds its limit: from there to `CLEARLY`
    times as much it grows to 1. `scales`, float32 (t, N_SUMS), are the inverse limits of each
    window: rows of `scales_of` by the kinds of the windows. By default they are those of windows
    with a taxel in each cell, of strictness 1.
    """
    if scales is None:
        scales = _scales(_full(), 1.0)
    excess = (_sums(windows) * scales).max(axis=-1) - 1
    part: Floats = (excess / (CLEARLY - 1)).clip(0, 1)
    return part


def scales_of(tiles: Tiles) -> Floats:
    """Inverse limits of the sums of each kind of window, float32 (k, N_SUMS), in the order of
    `deviations_of`; 0 where a square has no taxel.
    """
    return _scales(deviations_of(tiles).of_kinds, tiles.strictness)


def _scales(deviations: Doubles, strictness: float) -> Floats:
    limits = np.repeat(STANDS_OUT, _N_OF_SIZES) * strictness * deviations
    scales = np.zeros_like(limits)
    np.divide(1, limits, out=scales, where=limits > 0)
    return scales.astype(np.float32)


@lru_cache(maxsize=16)
def deviations_of(tiles: Tiles) -> Deviations:
    """Deviations of the sums of the windows of a skin.

    Beyond the skin there is no noise. A taxel that c cells read adds c^2 to the variance of a sum
    of all of them, since its copies are not independent. Where some of these cells lie outside of
    the square, it adds less: then this is an upper bound.
    """
    n = len(tiles.cells)
    n_cells = np.bincount(tiles.canvas.reshape(-1), minlength=n + 1)
    n_cells[n] = 0
    copies = n_cells[tiles.canvas].astype(np.float32)

    variances = [
        _variances(tiles.cut(copies, number)) for number in range(len(tiles.shares))
    ]
    of_windows = np.concatenate(variances)
    # Most windows of a large skin are full: to sort them would take seconds.
    full = np.square(_full())
    is_partial = (of_windows != full).any(axis=1)
    partial, kinds_of_partial = np.unique(
        of_windows[is_partial], axis=0, return_inverse=True
    )
    kinds = np.zeros(len(of_windows), dtype=np.intp)
    kinds[is_partial] = 1 + kinds_of_partial.reshape(-1)
    ends = np.cumsum([len(of_shift) for of_shift in variances])
    by_shift = np.split(kinds, ends[:-1])
    of_kinds = np.sqrt(np.concatenate([full, partial]))
    return Deviations(of_kinds, tuple(by_shift))


def _variances(copies: Floats) -> Floats:
    """Variances of the sums of windows, (t, N_SUMS), by the copies of the taxel of each cell."""
    variances = _sums(copies)
    # Of copies the largest is one number of unit variance, too.
    variances[:, 0] = variances[:, 0] > 0
    return variances


def _full() -> Doubles:
    """Deviations of a window with a taxel in each cell, (1, N_SUMS)."""
    sides = np.array([1, 3, 6, 12], dtype=np.float64)
    return np.repeat(sides, _N_OF_SIZES)[np.newaxis]


def _sums(windows: Floats) -> Floats:
    """Largest taxel of windows (t, 144), and the sums of their squares: (t, N_SUMS)."""
    squares_of_3, squares_of_6 = _square_sums()
    thirds = windows @ squares_of_3
    sixths = thirds @ squares_of_6
    largest = windows.max(axis=-1, keepdims=True)
    whole = sixths.sum(axis=-1, keepdims=True)
    return np.concatenate([largest, thirds, sixths, whole], axis=-1)


@cache
def _square_sums() -> tuple[Floats, Floats]:
    """Matrices that sum a window over its squares of 3 x 3, and these over squares of 2 x 2."""
    thirds = np.eye(4).repeat(3, axis=0)
    halves = np.eye(2).repeat(2, axis=0)
    return (
        np.kron(thirds, thirds).astype(np.float32),
        np.kron(halves, halves).astype(np.float32),
    )
