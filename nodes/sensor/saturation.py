"""Readings outside the range of a skin, which are clipped to it: counts of each end."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sparseskin.messages import Reason
from sparseskin.messages.text import printable
from sparseskin.nodes.numerics.arrays import AnyArray, Mask

from .sign import Margin, Sign

MANY = 0.01
"""Part of the readings of a frame from which on it is not trusted, if they are clipped. Chosen: of
a small skin one taxel, of a large one less than a finger."""


@dataclass
class Clipped:
    """Counts of readings that were clipped, 1 a taxel and frame."""

    n_below: int = 0  # the range; of noise that is known, by more than that
    n_above: int = 0
    lowest: float = math.inf  # of the frames that had such, before they were clipped
    highest: float = -math.inf
    #: Of the last frame, by more than its noise.
    n_now: int = field(default=0, compare=False)
    #: True where a taxel exists; None: all.
    mask: Mask | None = field(default=None, compare=False)
    sign: Sign = field(default_factory=Sign, compare=False)
    #: What the noise of the last frame, as it was measured, may exceed an end of the range by; None
    #: where it is stated.
    margin: float | None = field(default=None, compare=False)
    _margin: Margin = field(default_factory=Margin, compare=False)

    @property
    def n(self) -> int:
        """All readings that were clipped."""
        return self.n_below + self.n_above

    def add(
        self,
        readings: AnyArray,
        low: float,
        high: float,
        noise: float | None = None,
    ) -> bool:
        """Count those of a frame, (rows, cols), that are below `low` or above `high`; NaN is
        neither. `noise` is the standard deviation of an untouched taxel, None if not known.
        Returns True if a reading is to be clipped.
        """
        if self.mask is not None:
            readings = readings[self.mask]
        margin = self._margin.of(readings, high, noise)
        self.margin = margin if noise is None else None
        lowest, highest = _ends(readings)
        self.sign.update(readings, low, margin, lowest)

        # Noise that is known may lie below the range: only what exceeds it counts.
        lower_end = low if noise is None else low - margin
        is_beyond = lowest < low or highest > high
        if lower_end <= lowest and highest <= high:
            self.n_now = 0
            return is_beyond

        # Few frames have such readings: only these pay for the counts.
        self.n_below += int(np.count_nonzero(readings < lower_end))
        self.n_above += int(np.count_nonzero(readings > high))
        self.lowest = min(self.lowest, lowest)
        self.highest = max(self.highest, highest)

        # What noise alone may do is no reason to doubt a frame.
        beyond = (readings < low - margin) | (readings > high + margin)
        self.n_now = int(np.count_nonzero(beyond))
        return is_beyond

    def watch(self, readings: AnyArray, low: float, high: float) -> None:
        """Look at a frame as `add`, of readings that somebody has stated what to do with outside
        the range: they are not counted. Those below 0 show the sign, whatever the range is.
        """
        if self.mask is not None:
            readings = readings[self.mask]
        margin = self._margin.of(readings, high, None)
        self.margin = margin
        lowest, _ = _ends(readings)
        self.sign.update(readings, 0.0, margin, lowest)
        beyond = (readings < low - margin) | (readings > high + margin)
        self.n_now = int(np.count_nonzero(beyond))

    def reason(self, n_taxels: int) -> str:
        """Why the last frame of a skin of so many taxels is not to be trusted, "" if it is."""
        if self.sign.falls:
            return Reason.SIGN
        if self.n_now > MANY * n_taxels:
            return Reason.CLIPPED
        return ""

    def report(self, f_min: float, f_max: float, unit: str) -> dict[str, Any]:
        """Counts and range for a summary, as `clipped_text` reads them."""
        if not self.n:
            return {"clipped": 0}
        return {
            "clipped": self.n,
            "clipped_below": self.n_below,
            "clipped_above": self.n_above,
            "lowest": self.lowest,
            "highest": self.highest,
            "f_min": f_min,
            "f_max": f_max,
            "unit": unit,
        }


def _ends(readings: AnyArray) -> tuple[float, float]:
    """The least and the greatest reading of a frame, NaN being none."""
    lowest = float(readings.min(initial=math.inf))
    highest = float(readings.max(initial=-math.inf))
    if math.isnan(lowest):
        # Without NaN, and three times as slow.
        lowest = float(np.fmin.reduce(readings, axis=None, initial=math.inf))
        highest = float(np.fmax.reduce(readings, axis=None, initial=-math.inf))
    return lowest, highest


def clipped_text(report: Mapping[str, Any]) -> str:
    """A sensor's report in words: how many readings were above and below its range, and by how
    much.
    """
    unit = printable(report["unit"])
    n_above = report["clipped_above"]
    n_below = report["clipped_below"]
    parts = []
    if n_above:
        parts.append(
            f"{n_above} above {report['f_max']:g} {unit} (highest {report['highest']:g})"
        )
    if n_below:
        parts.append(
            f"{n_below} below {report['f_min']:g} {unit} (lowest {report['lowest']:g})"
        )
    return f"readings clipped to the range: {', '.join(parts)}"
