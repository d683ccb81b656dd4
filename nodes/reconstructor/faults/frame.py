"""Faults of single frames: measurements that contradict the others, forces that no skin has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.messages.quantised import step_of
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask

from .frozen import LEAST_NOISE
from .rows import HEAVY, LEAST_MIXED, blocks_of, mixed_taxels

LEAST_EQUAL = 40
"""Least number of measurements that are not equal by chance: noise of half a step of the quantiser
gives two equal ones in half of the cases."""
OUTLYING = 64.0
"""Squared innovation of a measurement, in the mean of its block, that only a fault reaches.
Derived: the signs of rows are random, so that 8 deviations occur in one of 10^15 measurements."""
LEAST_PEERS = 16
"""Least number of other measurements of a block that one is compared with."""
MOST_OUTLYING = 0.1
"""Largest part of the measurements that are replaced: if more are odd, something else is wrong."""
COMMON = 0.5
"""Part of the energy of the innovation that a change common to all measurements has at least."""
SIGNIFICANT = 6.0
"""Deviations of the noise that a common change has at least."""
MOST_LIKE = 0.3
"""Part of the energy of any taxel's press that a common change may explain: on skins of less than
four blocks, the press of one taxel looks like an offset of all measurements."""
LEVEL = 2.0
"""Force that nine of ten taxels reach if they have risen together, in deviations of the noise."""
ALIKE = 2.0
"""Largest difference of the lowest tenth of the taxels and of their median then, in the same."""
LEAST_UNIFORM = 256
"""Least number of taxels of a skin that no flat body covers evenly."""
BEYOND = 0.1
"""Part of f_max by which the error of a reconstruction may exceed it: such forces are f_max."""


@dataclass
class _Rows:
    """What does not change of a row subset: the block of each measurement, and where blocks start;
    the bound of each squared innovation, in the mean of its block; the part of a single taxel's
    energy that a common change explains at most.
    """

    block: Indices
    starts: Indices
    bound: Floats
    like: float


class FrameWatch:
    """Compares the measurements of a frame with the last estimate, and its forces with the range.

    It serves skins that state their noise, and any Phi whose measurements sum several taxels.

    Parameters
    ----------
    state : SkinState
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.

    Attributes
    ----------
    offset : float
        What is subtracted from all measurements, in the unit of the forces.
    n_outlying : int
        Number of measurements of the last frame that were replaced by their expectation.
    """

    def __init__(self, state: SkinState, mask: Mask) -> None:
        self._least_sd = state.least_sd
        self._noise2 = max(state.sigma_mid, state.sigma_end) ** 2
        self._sd = state.sigma_end
        self._f_max = np.float32(state.f_max)
        self._mask = mask
        self._n_taxels = int(np.count_nonzero(mask))
        self._rows: dict[str, _Rows | None] = {}
        self.offset = 0.0
        self.n_outlying = 0

    def is_constant(self, y: Floats) -> bool:
        """True if all measurements, float32 (m,), are equal, on a skin with noise: those of a link
        or converter that delivers nothing.
        """
        if y.size < LEAST_EQUAL or self._least_sd <= LEAST_NOISE * step_of(y):
            return False
        return bool(y[0] == y[-1] and np.all(y == y[0]))

    def cleaned(self, phi: Phi, y: Floats, expected: Floats) -> tuple[Floats, Floats]:
        """Return y without the offset, and the same with outliers replaced by their expectation.

        All are float32 (m,); `expected` is Phi times the last estimate. y is not modified.
        """
        self.n_outlying = 0
        rows = self._rows_of(phi)
        if rows is None or not self._sd:
            return y, y
        innovation = np.asarray(y - expected)
        energy, total = float(innovation @ innovation), float(innovation.sum())
        self._follow_offset(rows, innovation.size, energy, total)
        given = y
        if self.offset:
            given = np.asarray(y - np.float32(self.offset))
            innovation = given - expected
            energy = float(innovation @ innovation)
        largest2 = max(float(innovation.max()), -float(innovation.min())) ** 2
        noise2 = self._noise2 + step_of(y) ** 2 / 12
        if largest2 <= OUTLYING * max(noise2, energy / innovation.size / 4):
            return given, given
        outlying = _outlying(rows, np.square(innovation), noise2)
        count = int(np.count_nonzero(outlying))
        if not 0 < count <= max(1, MOST_OUTLYING * y.size):
            return given, given
        self.n_outlying = count
        return given, np.where(outlying, expected, given).astype(np.float32)

    def _follow_offset(self, rows: _Rows, m: int, energy: float, total: float) -> None:
        """Update the offset by the sum and the sum of squares of an innovation of m values."""
        if rows.like > MOST_LIKE:
            return
        change = total / m - self.offset
        # The energy without the offset so far.
        without = energy - 2 * self.offset * total + m * self.offset**2
        least = SIGNIFICANT**2 * self._noise2
        if m * change**2 > max(least, COMMON * without):
            self.offset += change
            if m * self.offset**2 < least:
                self.offset = 0.0

    def _rows_of(self, phi: Phi) -> _Rows | None:
        """What is known of a row subset; None if its measurements cannot be compared."""
        key = phi.fingerprint
        if key not in self._rows:
            if mixed_taxels(phi) < LEAST_MIXED:
                self._rows[key] = None
                return None
            kept, starts, block = np.unique(blocks_of(phi), return_index=True, return_inverse=True)
            most = np.full(phi.m, 2 * phi.n, dtype=np.float32)
            if is_sbhe(phi):  # all rows but the sums of blocks have random signs
                most = 2 * np.array(phi.sizes, dtype=np.float32)[kept][block]
                ones = np.abs(phi.forward(np.ones(phi.n, dtype=np.float32)))
                most[ones <= HEAVY * ones.max()] = OUTLYING
            sums = phi.adjoint(np.ones(phi.m, dtype=np.float32))
            like = phi.n / phi.m**2 * float(np.square(sums).max())
            self._rows[key] = _Rows(block, starts, most, like)
        return self._rows[key]

    def checked(self, forces: Floats) -> tuple[Floats, str]:
        """Return the forces within the range, and why they cannot be right; "" if they can.

        `forces` and the result are float32 (n_rows, n_cols), in the unit of the skin. "range": a
        force exceeds f_max by more than a tenth. "uniform": all taxels have risen together.
        """
        largest = forces.max()
        if largest > self._f_max:
            if largest > (1 + BEYOND) * self._f_max:
                return forces, "range"
            forces = np.minimum(forces, self._f_max)
        if not self._sd or self._n_taxels < LEAST_UNIFORM:
            return forces, ""
        level = LEVEL * self._sd
        if float(forces.sum()) < 0.9 * level * self._n_taxels:
            return forces, ""
        low, middle = np.quantile(forces[self._mask], (0.1, 0.5))
        return forces, "uniform" if low > level and middle - low < ALIKE * self._sd else ""


def _outlying(rows: _Rows, squared: Floats, noise2: float) -> Mask:
    """Return the measurements whose squared innovation no force explains beside those of others."""
    block, starts = rows.block, rows.starts
    largest = np.maximum.reduceat(squared, starts)[block]
    is_largest = squared == largest
    second = np.maximum.reduceat(np.where(is_largest, 0, squared), starts)[block]
    # The mean of the others but the largest, which may be faulty, too.
    others = np.add.reduceat(squared, starts)[block] - squared
    others -= np.where(is_largest, second, largest)
    n_others = np.bincount(block)[block] - 2
    mean = others / np.maximum(n_others, 1)
    return (n_others >= LEAST_PEERS) & (squared > rows.bound * np.maximum(mean, noise2))
