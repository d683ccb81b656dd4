"""Rest: what an untouched skin reads where nothing takes its baseline away."""

import math

import numpy as np

from sparseskin.messages import Reason
from sparseskin.messages.skin import Skin
from sparseskin.messages.text import printable
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.sensor.calibration.chain import TARE_FRAMES
from sparseskin.nodes.sensor.layout.checks import ADD
from sparseskin.nodes.touch import MeasuredNoise, touch_level

DEAD = 0.04
"""Part of the taxels that a level at rest may leave out, rounded up. Chosen: a skin has fewer dead
taxels, and a load that is there from the first frame on leaves more of them untouched."""
EVEN = 0.2
"""Least level of these in that of the median taxel. Chosen: the readings of untouched taxels are of
one kind; noise of one sign, and loads, have readings near 0."""
SIGMAS = 1.0
"""Least level in standard deviations of the noise of one frame: noise that is clipped at 0 has a
mean of 0.4 of them."""


class Rest:
    """Notices a level at rest: in the mean of the first frames nearly all taxels read a level of
    one kind, above the noise and the least contact.

    The frames have the reason `Reason.REST` from the first one on. `TARE_FRAMES` later the level is
    named in a line. The reason ends where most taxels read 0 in the mean of so many frames: what
    they read at first was a load.
    """

    def __init__(self, skin: Skin) -> None:
        self.skin = skin
        self._noise = MeasuredNoise()
        self._sum: Doubles = np.zeros(skin.shape)
        self._n_frames = 0  # of the sum
        #: Of the taxels at first, while they are lifted.
        self._levels: Doubles = np.zeros(0)
        self._is_first = True  # the first frames pass
        self.is_settled = False

    @property
    def reason(self) -> str:
        """Why the last frame is not to be trusted: `Reason.REST`, or ""."""
        if self.is_settled or not self._levels.size:
            return ""
        return Reason.REST

    @property
    def line(self) -> str:
        """What was found, and the settings that answer it, behind `ADD`; "" if nothing was."""
        if not self.reason:
            return ""
        lowest = self._levels.min()
        highest = self._levels.max()
        levels = f"{lowest:.2g} to {highest:.2g} {printable(self.skin.unit)}"
        part = f"{self._levels.size} of {self.skin.n_taxels}"
        observation = f"{part} taxels read {levels} at first, and may do so at rest"
        answers = (
            f"tare={TARE_FRAMES} if nothing touched them, tare=0 if these are forces"
        )
        return f"{observation}{ADD}{answers}"

    def update(self, forces: Floats) -> bool:
        """Add a frame, float32 (rows, cols); return True once, where a line is to be logged."""
        if self.is_settled:
            return False
        self._sum += forces
        self._n_frames += 1
        is_last = self._n_frames == TARE_FRAMES

        if self._is_first:
            # A copy: a program may fill one array with frame after frame.
            self._noise.update(forces.copy())
            self._look()
            self.is_settled |= is_last and not self._levels.size
        elif is_last:
            means = self._sum[self.skin.exists] / TARE_FRAMES
            self.is_settled = float(np.median(means)) <= self._least()
        if not is_last:
            return False

        # The sum begins anew; a line is due once, after the first frames.
        is_new = self._is_first and not self.is_settled
        self._is_first = False
        self._sum[:] = 0.0
        self._n_frames = 0
        return is_new

    def _look(self) -> None:
        """Find whether the mean of the frames so far is a level."""
        means = self._sum[self.skin.exists] / self._n_frames
        # Dead taxels read 0, and are no sign of rest.
        n_below = math.ceil(DEAD * means.size)
        if n_below >= means.size:
            return

        ordered = np.partition(means, (n_below, means.size // 2))
        lowest = ordered[n_below]
        median = ordered[means.size // 2]
        threshold = self._least()

        # Of one kind: the lowest of nearly all taxels is near the median.
        is_lifted = lowest > max(threshold, EVEN * median)
        self._levels = means[means > threshold] if is_lifted else means[:0]
        # Most taxels read 0: no level, and what comes later is a load.
        self.is_settled = median <= threshold

    def _least(self) -> float:
        """Least level, in the unit of the forces."""
        return touch_level(self._noise.sigma, self.skin.f_max, SIGMAS)
