"""Touch: what tells a force from noise, of a taxel and of a frame."""

import numpy as np

from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.numerics.arrays import Floats

SIGMAS = 5.0
"""Standard deviations of noise above which a frame is in contact. Chosen: of 4096 untouched taxels,
one exceeds them in one of 850 frames."""
DIFFERENCE = 0.954
"""Median difference of two readings of normal noise over its deviation. Derived."""
CLIPPED = 0.392
"""The same of readings that are clipped at 0. Derived."""
SMOOTHING = 0.1
"""Part of a frame in the running mean of the noise. Chosen."""
SAMPLE = 512
"""Number of taxels beyond which the median is that of a part of them. Chosen: the running mean then
has a deviation of 1.3 %, and the median of 4096 takes as long as all else of a frame in a monitor.
An odd number of taxels apart, so that they are not of the same few columns."""
FALL = 0.98
RISE = 1.001
"""Factors by which a measured noise follows lower and higher frames: it is that of the 5 % of
frames with the least. Chosen: 35 frames halve it, and a touch of 400 raises it by half."""


def touch_level(noise: float, f_max: float, sigmas: float = SIGMAS) -> float:
    """Force above which a taxel is touched, in the unit of the arguments: so many standard
    deviations of the noise of an untouched one, 0 if not known, and `CONTACT_FRACTION` of the
    range at least.
    """
    return max(sigmas * noise, CONTACT_FRACTION * f_max)


def in_contact(forces: Floats, f_max: float, noise: float = 0.0) -> bool:
    """True if a frame is in contact: a force of it, any shape, is above `touch_level`. `noise` is
    that of these forces, 0 for true ones.
    """
    return float(forces.max()) > touch_level(noise, f_max)


class MeasuredNoise:
    """Noise of untouched taxels where none is stated, from the differences of successive frames:
    `sigma` is its standard deviation before clipping, 0 before the second frame, and where most
    readings do not change.

    A median over the taxels, a running mean, then a minimum over time, as in Martin, "Noise power
    spectral density estimation based on optimal smoothing and minimum statistics", 2001.
    """

    def __init__(self) -> None:
        self.sigma = 0.0
        self._mean: float | None = None
        self._last: Floats | None = None

    def update(self, forces: Floats) -> float:
        """Add a frame, float32 (n,), which is kept and must not be written to; return `sigma`."""
        previous = self._last
        self._last = forces
        if previous is None or previous.shape != forces.shape:
            return self.sigma
        part = np.s_[:: forces.size // SAMPLE | 1]
        change = np.abs(forces[part] - previous[part])
        # Equal frames may be the same one, read twice.
        if not change.any() and np.array_equal(previous, forces):
            return self.sigma

        # Clipped noise leaves half of the untouched taxels at 0.
        median_per_sd = DIFFERENCE
        if np.count_nonzero(forces) < 0.75 * forces.size:
            median_per_sd = CLIPPED
        of_frame = _median(change) / median_per_sd

        if self._mean is None:
            self._mean = of_frame
            self.sigma = of_frame
        self._mean += SMOOTHING * (of_frame - self._mean)
        self.sigma *= FALL if self._mean < self.sigma else RISE
        return self.sigma


def _median(values: Floats) -> float:
    """Median of values, 1 at least, whose order changes; a fifth of the time of NumPy's."""
    values = values.reshape(-1)
    middle = values.size // 2
    if values.size % 2:
        values.partition(middle)
        return float(values[middle])
    values.partition((middle - 1, middle))
    two_in_the_middle = values[middle - 1 : middle + 1]
    return float(two_in_the_middle.mean())
