"""Rest: what an untouched skin reads where nothing takes its baseline away."""

from __future__ import annotations

import numpy as np

from sparseskin.messages.text import printable
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.touch import MeasuredNoise, touch_level

from .calibration.chain import TARE_FRAMES
from .source import Skin

SHARE = 0.9
"""Part of the taxels that a level at rest lifts. Chosen: of an insole that is stood on, the arch
and the rim read nothing."""


class Rest:
    """Notices a level at rest: in the mean of the first `TARE_FRAMES` frames nearly all taxels read
    more than the noise of one frame, and more than the least contact. Clipped noise has a mean of
    0.4 deviations. `line` states what was found, and its remedy; it is empty where there is none.
    """

    def __init__(self, skin: Skin) -> None:
        self.line, self._skin, self._noise = "", skin, MeasuredNoise()
        self._sum: Doubles = np.zeros(skin.shape)
        self._n_left = TARE_FRAMES

    def update(self, forces: Floats) -> bool:
        """Add a frame, float32 (rows, cols); return True once, where a level is found."""
        if not self._n_left:
            return False
        self._n_left -= 1
        self._sum += forces
        noise, skin = self._noise.update(forces), self._skin
        if self._n_left:
            return False
        means = self._sum[skin.exists] / TARE_FRAMES
        n_lifted = np.count_nonzero(means > touch_level(noise, skin.f_max, sigmas=1.0))
        if n_lifted < SHARE * means.size:
            return False
        levels = f"{means.min():.2g} to {means.max():.2g} {printable(skin.unit)}"
        remedy = f"if nothing touched them, sensor.tare={TARE_FRAMES} subtracts it"
        self.line = f"{n_lifted} of {means.size} taxels read {levels} at first; {remedy}"
        return True
