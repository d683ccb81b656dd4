"""Statistics of streams without end: memory does not grow with the number of frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass
class Extent:
    """Mean, minimum and maximum of the numbers added so far."""

    count: int = 0
    total: float = 0.0
    low: float = math.inf
    high: float = -math.inf

    def add(self, value: float) -> None:
        self.count += 1
        self.total += value
        self.low = min(self.low, value)
        self.high = max(self.high, value)

    def summary(self) -> dict[str, float] | None:
        """{mean, min, max}; None where nothing was added."""
        if not self.count:
            return None
        return {"mean": self.total / self.count, "min": self.low, "max": self.high}


class Quantiles:
    """Quantiles of positive durations from a histogram with logarithmic bins.

    From 1 us to 1000 s each bin is 0.5 % wide, so that a quantile is right within 0.25 %;
    what lies outside counts in the first or last bin.
    """

    _LOW_NS = 1e3
    _HIGH_NS = 1e12
    _WIDTH = math.log(1.005)

    def __init__(self) -> None:
        n_bins = math.ceil(math.log(self._HIGH_NS / self._LOW_NS) / self._WIDTH)
        self._bins = np.zeros(n_bins, np.int64)

    def add(self, duration_ns: float) -> None:
        k = int(math.log(max(duration_ns, self._LOW_NS) / self._LOW_NS) / self._WIDTH)
        self._bins[min(k, len(self._bins) - 1)] += 1

    def quantile_ms(self, q: float) -> float:
        """The value in ms below which the fraction q of the durations lies."""
        cumulative = np.cumsum(self._bins)
        k = int(np.searchsorted(cumulative, q * cumulative[-1], side="left"))
        return self._LOW_NS * math.exp((k + 0.5) * self._WIDTH) / 1e6

    def summary(self) -> dict[str, Any] | None:
        """{p50, p99} in ms; None where nothing was added."""
        if not self._bins.any():
            return None
        return {"p50": self.quantile_ms(0.5), "p99": self.quantile_ms(0.99)}
