"""How noisy the measurements are, told from the measurements themselves."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.calls import Floats

#: Part of the way to a frame's own estimate that the level goes: it follows a contact, whose
#: taxels are noisier, within some frames.
RATE = 0.4
#: What it may grow by in a frame: a touch that begins looks like noise in the first differences.
FASTEST = 1.4
#: Misfit, in noise variances, beyond which the scene has jumped.
JUMP = 10.0


class NoiseLevel:
    """Variance of the noise on a measurement, from differences between frames.

    At a kilohertz the forces hardly change their rate of change from frame to frame, so second
    differences hold little but noise: 6 times its variance. Where nothing moves first
    differences, 2 times the variance, tell it better. Motion adds to either, so the least is
    taken, and never more than the misfit of the prediction, which is noise and more.

    Parameters
    ----------
    m : int
        Number of measurements.

    Attributes
    ----------
    s2 : float
        The estimate, squared newtons; 0 before the first frame.
    jumped : bool
        Whether the last frame's misfit was no noise: it was the first one, or more than 10
        times the level. What such a frame differs by from the others is not used.
    """

    def __init__(self, m: int) -> None:
        self._last = np.zeros(m, dtype=np.float32)
        self._step = np.zeros(m, dtype=np.float32)
        self._difference = np.zeros(m, dtype=np.float32)
        self._m = m
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.s2 = 0.0
        self.jumped = True
        self._n_differences = -1
        self._settled = False

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
        seen = e2
        if self._n_differences >= 0:
            difference = np.subtract(y, self._last, self._difference)
            seen = min(seen, float(np.dot(difference, difference)) / (2 * self._m))
            if self._n_differences > 0:
                second = np.subtract(difference, self._step, self._step)
                seen = min(seen, float(np.dot(second, second)) / (6 * self._m))
            self._step, self._difference = self._difference, self._step
        np.copyto(self._last, y)
        self.jumped = jumped or self._n_differences < 0 or e2 > JUMP * self.s2
        self._n_differences += 1
        if self._n_differences < 2 and not self._settled:
            # The first frame has only its misfit, which a contact makes far too large.
            self.s2 = seen
            self._settled = self._n_differences == 1
        else:
            self.s2 = min(self.s2 + RATE * (seen - self.s2), FASTEST * self.s2)
            if self.jumped:
                self._n_differences = 0
