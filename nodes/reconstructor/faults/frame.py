"""Faults of frames: repeated ones, measurements that contradict others, impossible forces."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.messages.quantised import step_of
from sparseskin.nodes.compressor.phi.adaptive import AdaptivePhi
from sparseskin.nodes.compressor.phi.quadtree import N_DETAILS
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask

from .rows import OUTLYING, Subset
from .taxels import LEAST_SEEN, alone

FRAMES, MEASUREMENTS = 4, 60
"""Least number of frames that repeat exactly, and of the measurements in them, after which a board
hangs. Chosen: noise of half a step of the quantiser repeats 60 of them in one of 10^18 cases."""
LEAST_NOISE = 0.5
"""Least deviation of the stated noise, in steps of the quantiser, at which measurements cannot
repeat by themselves."""
LEAST_EQUAL = 40
"""Least number of measurements that are not equal by chance: noise of half a step of the quantiser
gives two equal ones in half of the cases."""
LEAST_PEERS = 16
"""Least number of other measurements of a block that one is compared with. Chosen: with 13, as
blocks of 256 have at N/16, 42 measurements of 240 frames of lift_box_40 were replaced.
"""
MOST_OUTLYING = 0.1
"""Largest part of the measurements that are replaced: if more are odd, something else is wrong."""
SIGNIFICANT, UNLIKE = 6.0, 4.0
"""Deviations of its mean that a common change has at least, and by which the mean of a block may
differ from it; of innovations whose own mean is subtracted in each block."""
OF_MEDIAN, NORMAL_MEDIAN = 1.25, 0.67
"""Deviation of the median of many normal numbers, in that of their mean; median of their
magnitude, in their deviation."""
MOST_LIKE = 0.3
"""Part of the energy of any taxel's press that a common change may explain: on skins of less than
four blocks, the press of one taxel looks like an offset of all measurements."""
LEVEL = 0.5
"""Force that nine of ten taxels reach if they have risen together, in deviations of the noise.
Measured: of 8,600 trusted frames of scenes and presses, N/3 to N/16, none does."""
ALIKE = 2.0
"""Largest difference of the lowest tenth of the taxels and of their median then, in the same; a
tenth above it is no error of the solver."""
SWINGS = 20
"""Frames for which readings are not right after all taxels have risen together: hum lowers them in
the other half of its period, which has 20 frames of 1 ms at 50 Hz."""
LEAST_SUMS, MOST_SUMS = 3, 0.5
"""Least number of sums of blocks, and least part of them, that contradict their blocks if all
taxels rise together. Chosen: a body is in some blocks, and changes the other measurements there."""
LEAST_UNIFORM = 256
"""Least number of taxels of a skin that no flat body covers evenly, nor one taxel where an offset
looks like it."""
BEYOND = 0.1
"""Part of f_max by which the error of a reconstruction may exceed it: such forces are f_max."""


class FrozenWatch:
    """Finds frames that repeat those before bit by bit, on a skin that states a noise.

    A frame is compared with the last one of its own row subset.

    Parameters
    ----------
    sigma : float
        Least standard deviation of a taxel's noise, in the unit of the forces; 0 where it is not
        stated: nothing is frozen then.

    Attributes
    ----------
    frozen : bool
        True from the 4th repeated frame on, until one differs.
    """

    def __init__(self, sigma: float) -> None:
        self._sigma = sigma
        self._last: dict[str, Floats] = {}
        self._n_equal = 0
        self.frozen = False

    def update(self, subset: str, y: Floats) -> bool:
        """Process the measurements of a row subset, float32 (m,), which are kept, not copied;
        return True if `frozen` changes. `subset` is the fingerprint of its Phi.
        """
        if not self._sigma:
            return False
        last, before = self._last.get(subset), self.frozen
        if last is None or last[0] != y[0] or not np.array_equal(last, y):
            self._last[subset] = y
            self._n_equal, self.frozen = 0, False
        else:
            counts = self._sigma > LEAST_NOISE * step_of(y)
            self._n_equal = self._n_equal + 1 if counts else 0
            self.frozen = self._n_equal >= max(FRAMES, MEASUREMENTS / y.size)
        return self.frozen != before


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
    contradicted : bool
        True if so many measurements of the last frame were beyond what forces can have that none
        was replaced; of rows chosen at the edge alone.
    """

    def __init__(self, state: SkinState, mask: Mask) -> None:
        self._least_sd = state.least_sd
        self._noise2 = max(state.sigma_mid, state.sigma_end) ** 2
        self._sd = state.sigma_end
        self._f_max = np.float32(state.f_max)
        self._mask = mask
        self._n_taxels = int(np.count_nonzero(mask))
        self._since_uniform = SWINGS
        self._rows: Subset | None = None
        self.offset = 0.0
        self.n_outlying = 0
        self.contradicted = False

    def is_constant(self, y: Floats) -> bool:
        """True if all measurements, float32 (m,), are equal, on a skin with noise: those of a link
        or converter that delivers nothing.
        """
        if y[0] != y[-1] or y.size < LEAST_EQUAL or self._least_sd <= LEAST_NOISE * step_of(y):
            return False
        return bool(np.all(y == y[0]))

    def cleaned(self, rows: Subset, y: Floats, expected: Floats) -> tuple[Floats, Floats]:
        """Return y without the offset, and the same with outliers replaced by their expectation.

        All are float32 (m,); `expected` is Phi times the last estimate. y is not modified.
        """
        self.n_outlying = 0
        self._rows = rows
        if not rows.comparable or not self._sd:
            return y, y
        innovation, given = np.asarray(y - expected), y
        step = step_of(y)
        self._follow_offset(rows, innovation, step)
        if self.offset:
            given = np.asarray(y - np.float32(self.offset))
            innovation = given - expected
        energy = float(innovation @ innovation)
        largest2 = max(float(innovation.max()), -float(innovation.min())) ** 2
        noise2 = self._noise2 + step**2 / 12
        if largest2 <= OUTLYING * max(noise2, energy / innovation.size / 4):
            return given, given
        outlying = _outlying(rows, np.square(innovation), noise2)
        count = int(np.count_nonzero(outlying))
        if not 0 < count <= max(1, MOST_OUTLYING * y.size):
            return given, given
        self.n_outlying = count
        n_sums = int(np.count_nonzero(outlying[rows.heavy]))
        if n_sums >= max(LEAST_SUMS, MOST_SUMS * rows.heavy.size):
            self._since_uniform = -1
        return given, np.where(outlying, expected, given).astype(np.float32)

    def cleaned_of_choice(self, phi: AdaptivePhi, y: Floats, expected: Floats) -> Floats:
        """As `cleaned`, for rows that the edge chose: return y without the offset, and with
        measurements that no forces have replaced.

        The offset is the least of the medians by which the sums of tiles and each of three kinds of
        details differ from the expectation: motion changes these in several directions.
        """
        self.offset = self._common(phi, y - expected) if self._sd else 0.0
        given = np.asarray(y - np.float32(self.offset)) if self.offset else y
        outlying = np.abs(given) > phi.largest(given)
        self.n_outlying = int(np.count_nonzero(outlying))
        self.contradicted = self.n_outlying > max(1, MOST_OUTLYING * y.size)
        if not self.n_outlying or self.contradicted:
            self.n_outlying = 0
            return given
        return np.where(outlying, expected, given).astype(np.float32)

    def _common(self, phi: AdaptivePhi, innovation: Floats) -> float:
        """Return the change common to all kinds of rows, 0 if it is not significant."""
        tree, rows = phi.tree, phi.rows
        kinds = np.where(rows < tree.n_tiles, N_DETAILS, tree.place_of_row[rows] % N_DETAILS)
        least = math.inf
        for kind in range(N_DETAILS + 1):
            some = innovation[kinds == kind]
            if some.size < LEAST_PEERS:
                return 0.0
            change = float(np.median(some))
            deviation = max(float(np.median(np.abs(some - change))) / NORMAL_MEDIAN, self._sd)
            if abs(change) < SIGNIFICANT * OF_MEDIAN * deviation / math.sqrt(some.size):
                return 0.0
            if not math.isinf(least) and least * change < 0:
                return 0.0
            least = min(least, change, key=abs)
        return least

    def _follow_offset(self, rows: Subset, innovation: Floats, step: float) -> None:
        """Update the offset: a change that is significant, and the same in all blocks."""
        m, offset = innovation.size, np.float32(self.offset)
        if rows.like > MOST_LIKE:
            return
        change = float(np.add.reduce(innovation)) / m - self.offset
        if m * change**2 <= (SIGNIFICANT * self._sd) ** 2 / 2:
            return
        # The sums of blocks show any contact more than an offset.
        left = np.where(rows.light, innovation - offset, 0)
        means = np.add.reduceat(left, rows.starts) / rows.n_light
        found = float(left.sum() / rows.n_light.sum())
        within = rows.light * (left - means[rows.block])
        variance = max(float(within @ within) / m, self._sd**2 + step**2 / 12)
        total = m / variance
        apart = rows.n_light * np.square(means - found) / variance
        if total * found**2 > SIGNIFICANT**2 and apart.max() < UNLIKE**2:
            self.offset += found
            if total * self.offset**2 < SIGNIFICANT**2:
                self.offset = 0.0

    def checked(self, forces: Floats, left: Doubles, error: float) -> tuple[Floats, str]:
        """Return the forces within the range, and why they cannot be right; "" if they can.

        `forces` and the result are float32 (n_rows, n_cols), in the unit of the skin; `left`,
        float64 (m,), is the residual; `error` the estimated RMS error of a taxel, infinite where
        the solver doubts the frame. "range": a force exceeds f_max by more than a tenth. "uniform":
        all taxels have risen together, now or in one of the last frames. "offset": all measurements
        share one, or those taxels alone are pressed that it would look like.
        """
        largest = forces.max()
        if largest > self._f_max:
            if largest > (1 + BEYOND) * self._f_max:
                return forces, "range"
            forces = np.minimum(forces, self._f_max)
        risen = self._is_uniform(forces, error)
        self._since_uniform = 0 if risen else self._since_uniform + 1
        if self._since_uniform < SWINGS:
            return forces, "uniform"
        return forces, "offset" if self._is_offset(forces, left, error) else ""

    def _is_offset(self, forces: Floats, left: Doubles, error: float) -> bool:
        """True if all measurements of a skin of few blocks have an offset, so far as it shows."""
        rows, m = self._rows, left.size
        if rows is None or not (rows.comparable and self._sd) or rows.like <= MOST_LIKE:
            return False
        few = self._n_taxels < LEAST_UNIFORM or m < LEAST_SEEN * self._n_taxels
        if few or math.isinf(error):
            return False
        # Forces cannot be negative: what is below them is in the residual.
        if left.mean() * math.sqrt(m) < -SIGNIFICANT * max(self._sd, float(left.std())):
            return True
        lone = alone(forces, self._mask, SIGNIFICANT * self._sd)
        return bool(lone[self._mask][rows.offset_like].all())

    def _is_uniform(self, forces: Floats, error: float) -> bool:
        """True if all taxels have risen together, by more than the error or clearly."""
        level = LEVEL * self._sd
        if not self._sd or self._n_taxels < LEAST_UNIFORM:
            return False
        if np.count_nonzero(forces > np.float32(level)) < 0.9 * self._n_taxels:
            return False  # so are most frames, and a quantile takes a sort
        low, middle = np.quantile(forces[self._mask], (0.1, 0.5))
        risen = middle > error or low > ALIKE * self._sd
        return bool(risen and middle - low < ALIKE * self._sd)


def _outlying(rows: Subset, squared: Floats, noise2: float) -> Mask:
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
