"""Readings outside the range of a skin, which are clipped to it: counts of each end."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.text import printable


@dataclass
class Clipped:
    """Counts of readings that were clipped, 1 a taxel and frame."""

    n_below: int = 0  # the range
    n_above: int = 0
    lowest: float = math.inf  # of the frames that had such, before they were clipped
    highest: float = -math.inf

    @property
    def n(self) -> int:
        """All readings that were clipped."""
        return self.n_below + self.n_above

    def add(self, readings: npt.NDArray[Any], low: float, high: float) -> None:
        """Count those of a frame that are below `low` or above `high`; NaN is neither."""
        lowest, highest = (float(most.reduce(readings, axis=None)) for most in (np.fmin, np.fmax))
        if low <= lowest and highest <= high:
            return
        self.n_below += int(np.count_nonzero(readings < low))
        self.n_above += int(np.count_nonzero(readings > high))
        self.lowest, self.highest = min(self.lowest, lowest), max(self.highest, highest)

    def report(self, f_min: float, f_max: float, unit: str) -> dict[str, Any]:
        """Counts and range for a summary, as `clipped_text` reads them."""
        if not self.n:
            return {"clipped": 0}
        counts = {"clipped_below": self.n_below, "clipped_above": self.n_above}
        found = {"lowest": self.lowest, "highest": self.highest}
        return {"clipped": self.n, **counts, **found, "f_min": f_min, "f_max": f_max, "unit": unit}


def clipped_text(report: Mapping[str, Any]) -> str:
    """A sensor's report in words: how many readings were above and below its range, and by how
    much.
    """
    unit, parts = printable(report["unit"]), []
    if n := report["clipped_above"]:
        parts.append(f"{n} above {report['f_max']:g} {unit} (highest {report['highest']:g})")
    if n := report["clipped_below"]:
        parts.append(f"{n} below {report['f_min']:g} {unit} (lowest {report['lowest']:g})")
    return f"readings clipped to the range: {', '.join(parts)}"
