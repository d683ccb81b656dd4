"""The noise level of the measurements, estimated from the measurements themselves."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats

from .tuning import TUNING, SkinTuning

RESOLUTION = float(np.finfo(np.float32).eps)
"""Relative resolution of measurements: a noise below it does not show in them."""
VISIBLE = 1e4
"""Variance of the noise of a sensor, in that of the resolution. Derived: its steps are of 2^-16 of
the range or more, 100 times the resolution."""

MOST = 10.0
"""Largest variance of the noise, in the mean square of the measurements, of which it is a part; far
beyond what that differs by from frame to frame. Chosen: a single frame of garbage, however large,
is forgotten with the next one."""


def row_power(phi: Phi) -> float:
    """Mean squared length of the rows of phi: 1 where they are orthonormal, else an estimate of the
    trace of Phi Phi^T / m by one random vector of signs.
    """
    if phi.lipschitz == 1:
        return 1.0
    signs = np.random.default_rng(0).choice(np.array([-1, 1], dtype=np.float32), phi.m)
    return float(np.sum(np.square(phi.adjoint(signs), dtype=np.float64))) / phi.m


class NoiseLevel:
    """Variance of the noise on a measurement, from differences between frames.

    At a kilohertz the rate of change of the forces is nearly constant from frame to frame, so the
    second differences of measurements are noise of 6 times the variance. If nothing moves, the
    first differences, of 2 times the variance, are more accurate. Motion adds to either, so the
    least is used, and at most the mean squared innovation.

    With rotating rows, comparable frames are far apart, and at few frames a second their
    differences are all motion: the level is then too high, which `AdaptiveGain` notices.

    Parameters
    ----------
    m : int
        Number of measurements.
    tuning : SkinTuning
        The constants.

    Attributes
    ----------
    s2 : float
        The estimate, squared newtons; 0 before the first frame.
    floor : float
        The least it can be, at the resolution of the measurements, squared newtons.
    stated : float
        Least variance that the skin states, squared newtons; 0 where it states none.
    jumped : bool
        True if the last frame was the first one, or its mean squared innovation was more than 5
        times the level. Its differences to other frames are not used.
    known : bool
        True once the level is of second differences; before, it is an upper bound.
    again : bool
        True in the frame that ends a run of exactly equal ones, other than 0: a board hung, and
        works again.
    since_jump : int
        Frames since the last jump; 0 for a frame that jumped.
    """

    def __init__(self, m: int, tuning: SkinTuning = TUNING) -> None:
        self._t = tuning
        self._difference = np.zeros(m, dtype=np.float32)
        self._m = m
        self.stated = 0.0
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.s2 = self.floor = 0.0
        self.jumped = True
        self.since_jump = 0
        self.known = self._settled = self._begun = self._hangs = self.again = False
        self._subsets: dict[int, Past] = {}
        self.use(0)

    def use(self, subset: int) -> None:
        """Expect measurements of this row subset; only frames of the same one are compared."""
        self._past = self._subsets.setdefault(subset, Past(self._m))

    @property
    def past(self) -> Past:
        """The last measurements of the row subset in use."""
        return self._past

    def changes(self, y: Floats) -> tuple[float, float]:
        """Compare measurements, float32 (m,), with the last of their subset, and keep them.

        Return the squared length of their change, and of the change of that; infinite if there is
        none to compare with.
        """
        past, difference = self._past, self._difference
        changed2 = second2 = math.inf
        if past.begun:
            np.subtract(y, past.y, difference)
            changed2 = float(np.dot(difference, difference))
            if past.n_differences > 0:
                second = np.subtract(difference, past.step, past.step)
                second2 = float(np.dot(second, second))
            np.copyto(past.step, difference)
        np.copyto(past.y, y)
        return changed2, second2

    def follow(
        self, e2: float, changed2: float, second2: float, jumped: bool, power: float = 0.0
    ) -> None:
        """Update the level.

        e2 is the mean squared innovation; changed2 and second2 are as `changes` returned them;
        `jumped` if the scene is known to have jumped. `power` is the mean square of y, which bounds
        the level from above, and its resolution in float32 from below, as the stated noise does:
        exactly equal frames would halve it without end, and no later frame would be believed.
        Frames of zeros leave both bounds of the measurements as they are.
        """
        if power > 0:
            self.floor = RESOLUTION**2 * power
        was_hung, self._hangs = self._hangs and power > 0, changed2 == 0 < power
        self._follow(e2, changed2, second2, jumped, was_hung)
        if power > 0:
            self.s2 = min(self.s2, MOST * power)
        self.s2 = max(self.s2, self.floor, self.stated)

    def _follow(
        self, e2: float, changed2: float, second2: float, jumped: bool, was_hung: bool
    ) -> None:
        past = self._past
        changed = changed2 / (2 * self._m)
        seen = min(e2, changed)
        if past.n_differences > 0:
            seen = min(seen, second2 / (6 * self._m))
        self.jumped = jumped or not self._begun or min(e2, changed) > self._t.jump * self.s2
        self.since_jump = 0 if self.jumped else self.since_jump + 1
        self._begun = True
        self.again = was_hung and self.jumped and self.s2 <= VISIBLE * self.floor
        if self.again:
            # Its noise is learnt as that of a first frame.
            self._settled = self.known = False
            for other in self._subsets.values():
                other.n_differences = -1
            seen = min(e2, changed)
        past.begun = True
        past.n_differences += 1
        self.known = self.known or past.n_differences > 1
        if not self._settled:
            # The first frames have only the innovation, which a contact makes far too large.
            self.s2 = seen
            self._settled = past.n_differences == 1
            return
        doubtful = len(self._subsets) > 1 and seen >= self._t.noise_clearly * e2
        learning = 0 < self.since_jump <= self._t.noise_relearned and seen < self.s2
        nearer = seen if learning else self.s2 + self._t.noise_rate * (seen - self.s2)
        self.s2 = min(
            nearer, (self._t.noise_growth_rotating if doubtful else self._t.noise_growth) * self.s2
        )
        if self.jumped:
            for other in self._subsets.values():
                other.n_differences = -1
            past.n_differences = 0


class Past:
    """The last measurements of one row subset, and their difference to those before.

    Attributes
    ----------
    values : ndarray of float32, shape (2, m)
        Those measurements, newtons, and that difference.
    begun : bool
        True if there was a frame.
    """

    def __init__(self, m: int) -> None:
        self.values = np.zeros((2, m), dtype=np.float32)
        self.y, self.step = self.values
        self.begun = False
        #: Differences since the last jump; -1 before the first frame after it.
        self.n_differences = -1
