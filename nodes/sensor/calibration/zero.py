"""Detection of noise around 0, half of which a range that begins at 0 clips away."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import CONTACT_FRACTION

WATCHED_FRAMES = 100
"""Frames that are looked at, chosen: one second at 100 Hz."""
BELOW_SHARE = 0.25
"""Share of untouched readings below 0 from which noise lies around 0: half of them do where it is
centred; chosen with a margin for a baseline that is not quite 0."""
ZERO_SHARE = 0.3, 0.7
"""Share of untouched readings that are 0 where a source clips noise centred on 0: half of them; all
are where it has a dead band, none where it has an offset. Chosen around one half."""
KEPT_SIGMAS = 4.0
"""Standard deviations of noise that a lower end of the range keeps; chosen: all but 3e-5."""


class ZeroWatch:
    """Looks at the first frames of a source that delivers readings.

    Parameters
    ----------
    f_max : float
        Upper end of the range.
    noise : float
        Standard deviation of an untouched taxel's noise, 0 if not known, in the same unit.
    """

    def __init__(self, f_max: float, noise: float = 0.0) -> None:
        self._touched = max(6 * noise, 10 * CONTACT_FRACTION * f_max)
        self._n_frames = self._n = self._n_below = self._n_zero = 0
        self._squares = 0.0

    @property
    def done(self) -> bool:
        """True once `WATCHED_FRAMES` frames were added."""
        return self._n_frames >= WATCHED_FRAMES

    def add(self, readings: npt.NDArray[Any]) -> str:
        """Add a frame of readings of existing taxels, not clipped by this program; return a notice
        with the remedy at the last one, if any, or "".
        """
        if self.done:
            return ""
        self._n_frames += 1
        untouched = readings[np.abs(readings) < self._touched]
        below = untouched[untouched < 0]
        self._n += untouched.size
        self._n_below += below.size
        self._n_zero += int(np.count_nonzero(untouched == 0))
        self._squares += float(np.dot(below, below))
        return self._notice() if self.done else ""

    def _notice(self) -> str:
        if self._n and self._n_below >= BELOW_SHARE * self._n:
            keep = lower_end(math.sqrt(self._squares / self._n_below))
            return (
                f"noise around 0: {100 * self._n_below / self._n:.0f} % of the untouched readings "
                f"are below 0 and are clipped; f_min = {keep:g} keeps them, f_min = 0 clips them "
                "without this line"
            )
        low, high = ZERO_SHARE
        if self._n and low <= self._n_zero / self._n <= high:
            return (
                f"noise around 0: {100 * self._n_zero / self._n:.0f} % of the untouched readings "
                "are 0, the source clips them; let it add an offset first, which tare = 30 "
                "subtracts again"
            )
        return ""


def lower_end(noise: float) -> float:
    """Lower end of a range, in two digits, that keeps noise of a standard deviation; at most 0."""
    return -float(f"{KEPT_SIGMAS * noise:.1e}")
