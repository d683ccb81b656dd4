"""An offset that all measurements share, as of a converter that drifts."""

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi, block_layout
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask, shared

SIGNIFICANT = 6.0
"""Deviations of its mean that a common change has at least. Derived: of normal innovations one of
10^9 has it."""
UNLIKE = 4.0
"""Deviations by which the mean of a block may differ from a common change. Derived: of 100 blocks
one differs by it in one of 150 frames."""
HEAVY = 0.25
"""Share of the largest |Phi 1| beyond which a row shows any contact more than an offset."""
MOST_ALIKE = 0.3
"""Part of the energy of any taxel's press that a common change may explain: on skins of less than
four blocks the press of one taxel looks like an offset."""


class OffsetRows:
    """What does not change of the rows of a Phi.

    Attributes
    ----------
    is_told_apart : bool
        True if no taxel's press looks like an offset.
    block, starts : ndarray of intp, shape (m,), (n_blocks,)
        Block of each row, and the first row of each block.
    light : ndarray of bool, shape (m,)
        Rows that sum taxels with random signs.
    n_light : ndarray of float32, shape (n_blocks,)
        Number of those of each block, 1 if there is none.
    """

    def __init__(self, phi: Phi) -> None:
        # Squared cosine of a taxel's press and an offset; a row has a length of about 1.
        sums = phi.adjoint(np.ones(phi.m, dtype=np.float32))
        largest = float(np.square(sums).max())
        alike = phi.n / phi.m**2 * largest
        self.is_told_apart = alike <= MOST_ALIKE

        of_even_press = phi.forward(np.ones(phi.n, dtype=np.float32))
        size = np.abs(of_even_press)
        self.light: Mask = shared(size <= HEAVY * size.max())
        # Rows ascend: those of a block follow one another.
        is_first = np.diff(_blocks_of(phi), prepend=-1) > 0
        self.starts = np.flatnonzero(is_first)
        self.block = shared(np.cumsum(is_first) - 1)
        ones = self.light.astype(np.float32)
        n_light = np.add.reduceat(ones, self.starts)
        self.n_light: Floats = np.maximum(n_light, 1)


def _blocks_of(phi: Phi) -> Indices:
    """Number of the block of taxels that each row sums; 0 if there are no blocks."""
    layout = block_layout(phi)
    if layout is None or layout.blocks is None:
        return np.zeros(phi.m, dtype=np.intp)
    return layout.blocks


class OffsetWatch:
    """Follows an offset of all measurements: a significant change that is the same in all blocks.

    Forces change the measurements of blocks in different ways. Where a skin has few blocks the two
    cannot be told apart, and no offset is subtracted.

    Parameters
    ----------
    noise_sd : float
        Least standard deviation of a measurement, in the unit of the forces, above 0.

    Attributes
    ----------
    value : float
        The offset now, in the unit of the forces.
    """

    def __init__(self, noise_sd: float) -> None:
        self._noise_sd = noise_sd
        self._rows: dict[str, OffsetRows] = {}
        self.value = 0.0

    def rows_of(self, phi: Phi) -> OffsetRows:
        """What does not change of the rows of a Phi."""
        if phi.fingerprint not in self._rows:
            self._rows[phi.fingerprint] = OffsetRows(phi)
        return self._rows[phi.fingerprint]

    def look(self, phi: Phi, innovation: Floats) -> float:
        """Update the offset by what measurements exceed their expectation by, float32 (m,); return
        it.
        """
        rows = self.rows_of(phi)
        if not rows.is_told_apart:
            return 0.0
        # Half of the time of `mean`, which looks for axes and types.
        mean = np.add.reduce(innovation) / innovation.size
        change = float(mean) - self.value
        # As in nearly all frames: far from significant.
        significant = SIGNIFICANT * self._noise_sd
        if innovation.size * change**2 <= significant**2 / 2:
            return self.value

        # The variance within blocks: a contact that presses some of them is none of it.
        changes = innovation - np.float32(self.value)
        light = np.where(rows.light, changes, 0)
        sums = np.add.reduceat(light, rows.starts)
        means = sums / rows.n_light
        within = rows.light * (light - means[rows.block])
        mean_square = float(within @ within) / innovation.size
        variance = max(mean_square, self._noise_sd**2)

        # The offset changes where the common change is significant, and no block contradicts it.
        common = float(light.sum() / rows.n_light.sum())
        weight = innovation.size / variance
        is_significant = weight * common**2 > SIGNIFICANT**2
        z2_of_blocks = rows.n_light * np.square(means - common) / variance
        if is_significant and z2_of_blocks.max() < UNLIKE**2:
            self.value += common
            # One that has gone leaves no rest behind.
            if weight * self.value**2 < SIGNIFICANT**2:
                self.value = 0.0
        return self.value
