"""How noisy the measurements are, told from the measurements themselves."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats

#: Part of the way to a frame's own estimate that the level goes: it follows a contact, whose
#: taxels are noisier, within some frames.
RATE = 0.4
#: What it may grow by in a frame: a touch that begins looks like noise in the first differences.
FASTEST = 1.4
#: ... and where rows rotate, unless differences are clearly below the misfit: else what looks like
#: noise may be what is wrong with the estimate.
FASTEST_ROTATING, CLEARLY = 1.05, 0.7
#: Frames after a jump in which a lower level is believed at once: it is that of another contact.
RELEARNED = 3
#: Misfit, in noise variances, beyond which the scene has jumped.
JUMP = 5.0


class NoiseLevel:
    """Variance of the noise on a measurement, from differences between frames.

    At a kilohertz the forces hardly change their rate of change from frame to frame, so second
    differences hold little but noise: 6 times its variance. Where nothing moves first
    differences, 2 times the variance, tell it better. Motion adds to either, so the least is
    taken, and never more than the misfit of the prediction, which is noise and more.

    Where rows rotate, frames that can be compared are far apart, and at few frames a second all
    of it is motion. What the last frame could not explain of its measurements is then the better
    bound (`limit`).

    Parameters
    ----------
    m : int
        Number of measurements.

    Attributes
    ----------
    s2 : float
        The estimate, squared newtons; 0 before the first frame.
    jumped : bool
        Whether the last frame's misfit was no noise: it was the first one, or more than 5
        times the level. What such a frame differs by from the others is not used.
    since_jump : int
        How many frames ago that was; 0 for a frame that jumped.
    """

    def __init__(self, m: int) -> None:
        self._difference = np.zeros(m, dtype=np.float32)
        self._m = m
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.s2 = 0.0
        self.jumped = True
        self.since_jump = 0
        self._settled = self._begun = False
        self._limit = math.inf
        self._phases: dict[int, _Past] = {}
        self.use(0)

    def use(self, phase: int) -> None:
        """Take measurements of this phase: what is compared are frames of the same one."""
        self._past = self._phases.setdefault(phase, _Past(self._m))

    def limit(self, s2: float) -> None:
        """Take it that the next frame's noise is no more than this, in squared newtons."""
        self._limit = s2

    def update(self, y: Floats, e2: float, jumped: bool = False) -> None:
        """Take in a frame.

        Parameters
        ----------
        y : ndarray of float32, shape (m,)
            Measurements, newtons.
        e2 : float
            Mean square of what the prediction leaves of them, squared newtons.
        jumped : bool
            Whether it is known already that the scene has jumped.
        """
        seen, past = min(e2, self._limit), self._past
        self._limit = math.inf
        if past.n_differences >= 0:
            difference = np.subtract(y, past.y, self._difference)
            seen = min(seen, float(np.dot(difference, difference)) / (2 * self._m))
            if past.n_differences > 0:
                second = np.subtract(difference, past.step, past.step)
                seen = min(seen, float(np.dot(second, second)) / (6 * self._m))
            past.step, self._difference = self._difference, past.step
        np.copyto(past.y, y)
        self.jumped = jumped or not self._begun or e2 > JUMP * self.s2
        self.since_jump = 0 if self.jumped else self.since_jump + 1
        self._begun = True
        past.n_differences += 1
        if not self._settled:
            # The first frames have only their misfit, which a contact makes far too large.
            self.s2 = seen
            self._settled = past.n_differences == 1
            return
        doubtful = len(self._phases) > 1 and seen >= CLEARLY * e2
        learning = 0 < self.since_jump <= RELEARNED and seen < self.s2
        nearer = seen if learning else self.s2 + RATE * (seen - self.s2)
        self.s2 = min(nearer, (FASTEST_ROTATING if doubtful else FASTEST) * self.s2)
        if self.jumped:
            for other in self._phases.values():
                other.n_differences = -1
            past.n_differences = 0


class _Past:
    """The last measurements of one phase, and what they differed by from those before."""

    def __init__(self, m: int) -> None:
        self.y = np.zeros(m, dtype=np.float32)
        self.step = np.zeros(m, dtype=np.float32)
        self.n_differences = -1
