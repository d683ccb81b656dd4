"""A row subset of the default solver: its last measurements, compared with those of a frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, shared

from .rows import Rows

RESOLUTION = float(np.finfo(np.float32).eps)
"""Relative resolution of measurements: a noise below it does not show in them."""
HEAVY = 0.25
"""Share of the largest |Phi 1| beyond which a row has few signs of one kind. The sum of a block of
32 beside blocks of 256 has 0.35. Derived."""
LEAST_PEERS = 16
"""Least number of rows of a block that are compared. Chosen: with 13, as blocks of 256 have at
N/16, 42 measurements of 240 frames of lift_box_40 were faulty."""
SAME = 1e-6
"""Largest change of measurements, as a part of the largest one, at which half counts as repeated:
above the resolution of float32, below that of any converter."""
CLEAR_CHANGE = 1e3
"""The same in `SAME`, beyond which a larger change does not count: its power stays finite."""
LEVEL_KEPT = 0.5
"""Part of the level of measurements that a frame keeps. Chosen."""
SILENCE_KEPT = 0.98
"""The same of a silent frame. Chosen: steps of a walk are silent for 20 frames."""


class Comparison(NamedTuple):
    """Measurements of a frame, and the last ones of its row subset."""

    power: float  # mean square
    largest: float  # largest absolute value
    change: float  # largest absolute change

    def without_largest(self, m: int) -> float:
        """RMS of the m measurements but the largest."""
        squares = max(m * self.power - self.largest**2, 0.0)
        return math.sqrt(squares / max(m - 1, 1))


class FrameNumbers(NamedTuple):
    """Numbers of the measurements of a frame."""

    n_read: int  # rows read
    read: float  # their number, as a part of that of all rows
    floor: float  # least variance: the resolution of the measurements
    repeated: float  # part of the measurements that repeats the last ones of this subset, 0 to 1
    silent: float
    """Part by which they are 0 beside those before: 1 where nothing presses."""


class Level:
    """Magnitude of the measurements so far, beside which others are 0.

    It is the RMS of a frame without its largest measurement, which may be faulty, and not more than
    that of the next frame: one frame may be garbage. It falls by a half per frame, and slowly while
    the skin is silent.

    Attributes
    ----------
    value : float
        The level.
    last : float
        RMS of the last frame.
    """

    def __init__(self) -> None:
        self.value = 0.0
        self.last = 0.0

    def follow(self, rms: float, silent: float) -> None:
        """Update the level by a frame."""
        part = silent * SILENCE_KEPT + (1 - silent) * LEVEL_KEPT
        # The lesser of two frames: one of them may be garbage.
        of_frames = min(rms, self.last)
        self.value = max(of_frames, part * self.value)
        self.last = rms


class RowSubset:
    """The last measurements of a row subset and their innovation, and Phi 1.

    Parameters
    ----------
    rows : Rows
        W, which reads this row subset now.

    Attributes
    ----------
    ones : ndarray of float32, shape (n_read,)
        Phi 1, in the order of the rows read.
    ones_energy : float
        Its squared length.
    block : ndarray of int64, shape (n_read,)
        Number of the block of taxels that each row sums with random signs; -1 for a row that sums
        them with few, and of a block that too few others read.
    n_blocks : int
    y : ndarray of float32, shape (m,)
        The last measurements of this subset.
    innovation, predicted : ndarray of float32, shape (n_read,)
        Of its last frame: innovation, and what had been predicted.
    faulty : ndarray of float32, shape (n_read,)
        1 for a measurement that is not to count, else 0.
    was_read : bool
        True if there was a frame of this subset; the other ones are 0 else.
    """

    def __init__(self, rows: Rows, m: int) -> None:
        self._n_taxels = rows.n
        all_ones = np.ones(rows.n, dtype=np.float32)
        of_all_rows = rows.forward(all_ones)
        self.ones = shared(of_all_rows[rows.read])
        self.ones_energy = float(self.ones @ self.ones)
        self.block = _comparable(rows.blocks, self.ones)
        self.n_blocks = int(self.block.max(initial=-1)) + 1
        n_read = len(self.ones)
        self.y = np.zeros(m, dtype=np.float32)
        self.innovation = np.zeros(n_read, dtype=np.float32)
        self.predicted = np.zeros(n_read, dtype=np.float32)
        self.faulty = np.zeros(n_read, dtype=np.float32)
        self.was_read = False

    def keep(self, y: Floats, innovation: Floats, predicted: Floats) -> None:
        """Keep measurements, innovation and prediction of a frame."""
        self.y[:] = y
        self.innovation = innovation
        self.predicted = predicted
        self.was_read = True

    def numbers(self, comparison: Comparison, level: Level) -> FrameNumbers:
        """Return the numbers of a frame by its comparison with the last one; update the level."""
        repeated = 0.0
        if self.was_read:
            repeated = _nothing_of(comparison.change, comparison.largest)
        silent = _nothing_of(comparison.largest, level.value)
        # The state has the rounding of the last frame.
        power = comparison.power + level.value**2 + level.last**2
        floor = max(RESOLUTION**2 * power, TINY)

        n_read = len(self.ones)
        level.follow(comparison.without_largest(n_read), silent)
        return FrameNumbers(n_read, n_read / self._n_taxels, floor, repeated, silent)


def _comparable(blocks: Indices | None, ones: Floats) -> Indices:
    """Return `block` of `RowSubset`; `blocks` of the rows read, None where rows are no blocks."""
    if blocks is None:
        return np.full(len(ones), -1)
    block = blocks.copy()
    # The sum of a block alone sees what all its taxels share.
    size = np.abs(ones)
    block[size > HEAVY * size.max()] = -1
    for number in range(block.max(initial=-1) + 1):
        peers = block == number
        if np.count_nonzero(peers) < LEAST_PEERS:
            block[peers] = -1
    return block


def _nothing_of(value: float, scale: float) -> float:
    """Part by which a value is nothing beside a scale, 0 to 1, without a threshold."""
    ratio = value / (SAME * scale + TINY)
    return 1 / (1 + min(ratio, CLEAR_CHANGE) ** 8)
