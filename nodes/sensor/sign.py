"""Sign: whether readings rise with force, or fall below those at rest."""

import math
from collections import deque

import numpy as np

from sparseskin.nodes.numerics.arrays import AnyArray, Doubles, Mask
from sparseskin.nodes.touch import DIFFERENCE, touch_level

SIGMAS = 6.0
"""Standard deviations of noise that no reading of an untouched taxel falls below. Chosen: one in
10^9 does."""
UNKNOWN = 0.01
"""Least fall in parts of f_max where the noise is not known. Chosen: a count of a converter of 7
bits, whose noise may hide between its steps."""
WHOLE = 2.5
MOST_WHOLE = 0.03
"""The same of readings that are whole numbers, in these, and the most in parts of f_max. Chosen:
noise of less than a step of the converter moves a reading by 2."""
N_SPREADS = 9
"""Frames whose median shows the noise. Chosen: longer than the onset of a load."""
EVERY = 4
"""Once there are as many, one frame of this number is measured. Chosen: noise changes slowly, and
the medians cost as much as all that is asked of a frame besides."""
N_SHOWN = 256
"""Least number of taxels of a large skin that show the noise. Chosen: 6 % of error."""
MAD_TO_SD = 1.4826
"""Standard deviation of normal noise in its median absolute deviation. Derived."""
FALLS = 4
"""Falls of taxels from which on all frames are in doubt. Chosen: a press of a finger, and more than
the broken taxels of a skin that nothing has touched."""
FALLS_PER_RISE = 3.0
"""Falls for each rise from which on readings fall. Chosen: after a press, readings may swing below
those at rest for a while, but each of them has risen before."""


class Sign:
    """Notices readings that fall below 0, the reading at rest, where hardly any rises above it.

    A fall is the first frame of a taxel below 0 by more than noise, a rise is one above it. Frames
    are in doubt where a taxel is below, and all once there were `FALLS`, as long as there is not a
    rise for each `FALLS_PER_RISE` falls: one broken taxel falls once.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all frames, as where the reading at rest is another."""
        self.n_falls = 0
        self.n_rises = 0
        self.lowest = 0.0  # reading of a fall
        self._n_below = 0  # taxels of the last frame
        #: Taxels that were below in the last frame; None: none was.
        self._below: Mask | None = None
        self._above: Mask = np.zeros(0, np.bool_)

    @property
    def falls(self) -> bool:
        """True if the last frame is in doubt."""
        if self.n_falls <= FALLS_PER_RISE * self.n_rises:
            return False
        return self._n_below > 0 or self.is_found

    @property
    def is_found(self) -> bool:
        """True if all frames are in doubt."""
        return self.n_falls >= max(FALLS, FALLS_PER_RISE * self.n_rises + 1)

    def update(
        self, readings: AnyArray, low: float, margin: float, lowest: float
    ) -> None:
        """Add a frame, (rows, cols), NaN where a reading is missing; `low` is the lower end of the
        range, 0 or less, `margin` what noise may exceed, `lowest` the least of the readings.
        """
        above = readings > margin
        if self._above.shape != above.shape:
            self._below = None
            self._above = np.zeros_like(above)
        # True is more than False: those that were not before.
        self.n_rises += int(np.count_nonzero(above > self._above))
        self._above = above

        # Hardly a frame has a reading as low.
        if lowest >= low - margin:
            self._n_below = 0
            self._below = None
            return
        below = readings < low - margin
        self._n_below = int(np.count_nonzero(below))
        falls = below
        if self._below is not None:
            falls = below > self._below
        self.n_falls += int(np.count_nonzero(falls))
        self.lowest = min(self.lowest, lowest)
        self._below = below


class Margin:
    """What the noise of readings may exceed an end of the range by."""

    def __init__(self) -> None:
        self._n_frames = 0
        self._previous: Doubles | None = None
        self._spreads: deque[float] = deque(maxlen=N_SPREADS)
        self._floor = 0.0
        self._margin = 0.0

    def of(self, readings: AnyArray, f_max: float, noise: float | None) -> float:
        """Margin of a frame, in its unit; `noise` is its standard deviation, None if not known:
        then it is the median of what some taxels show in some of the last frames.
        """
        if noise is not None:
            return touch_level(noise, f_max, SIGMAS)

        # Another floor means another range: what was measured was in parts of the old one.
        floor = UNKNOWN * f_max
        is_known = len(self._spreads) == N_SPREADS and floor == self._floor
        phase = self._n_frames % EVERY
        self._n_frames += 1
        # A change since the frame before takes two frames in a row.
        if is_known and phase < EVERY - 2:
            return self._margin

        values = some_of(readings).astype(np.float64)
        previous = self._previous
        self._previous = values
        if is_known and phase == EVERY - 2:
            return self._margin
        self._floor = floor
        self._margin = self._measured(values, previous, f_max)
        return self._margin

    def _measured(
        self, values: Doubles, previous: Doubles | None, f_max: float
    ) -> float:
        """Margin by the values of some taxels, and those of the frame before where it is known."""
        floor = self._floor
        # The sum of squares is finite if all values are, unless they are huge.
        energy = float(np.vdot(values, values))
        if not math.isfinite(energy):
            is_number = np.isfinite(values)
            values = values[is_number]
            if not is_number.all():
                previous = None  # its values are of other taxels
        if not values.size:
            return floor

        # The lower one of two: noise that is taken for too large hides falls.
        self._spreads.append(_spread(values, previous))
        spreads = sorted(self._spreads)
        median_spread = spreads[(len(spreads) - 1) // 2]

        # The steps of a converter hide the noise. Squares of whole numbers have a whole sum.
        is_whole = energy.is_integer() or not math.isfinite(energy)
        if is_whole and (values == np.rint(values)).all():
            floor = max(floor, min(WHOLE, MOST_WHOLE * f_max))
        return max(SIGMAS * median_spread, floor)


def some_of(readings: AnyArray) -> AnyArray:
    """Readings of `N_SHOWN` to some more taxels of a frame, spread over it; all of a small one."""
    # Odd, as rows often have an even number.
    step = max(readings.size // N_SHOWN, 1) | 1
    return readings.reshape(-1)[::step]


def _spread(values: Doubles, previous: Doubles | None) -> float:
    """Standard deviation of noise as a frame shows it: the less of that over its taxels, which a
    load raises, and of that since the frame before, which a motion raises.
    """
    deviations = np.abs(values - _middle(values.copy()))
    over_taxels = MAD_TO_SD * _middle(deviations)
    if previous is None or previous.size != values.size:
        return over_taxels
    change = _middle(np.abs(values - previous)) / DIFFERENCE
    if math.isnan(change):
        return over_taxels
    return min(over_taxels, change)


def _middle(values: Doubles) -> float:
    """Median of values, the upper one of two; their order changes."""
    # np.median takes more than ten times as long of so few.
    middle = values.size // 2
    values.partition(middle)
    return float(values[middle])
