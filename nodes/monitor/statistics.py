"""Statistics of unbounded streams in bounded memory: extents, quantiles, the last minute."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

SPAN_S = 60.0
COLUMNS = ("time_s", "psnr_noisy_db", "psnr_db", "latency_ms", "solve_ms", "lost")
MIN_CAPACITY = 2048
MAX_CAPACITY = 1 << 17
"""60 s at 2.2 kHz; of a faster stream less than 60 s is kept."""


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
        """{mean, min, max}; None without numbers."""
        if not self.count:
            return None
        return {"mean": self.total / self.count, "min": self.low, "max": self.high}


class Quantiles:
    """Quantiles of positive durations, from a histogram with logarithmic bins.

    From 1 us to 1000 s each bin is 0.5 % wide, so a quantile has a relative error of at most
    0.25 %; shorter and longer durations count in the first and last bin.
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
        """The smallest duration in ms that at least the fraction q of all do not exceed."""
        cumulative = np.cumsum(self._bins)
        k = int(np.searchsorted(cumulative, q * cumulative[-1], side="left"))
        return self._LOW_NS * math.exp((k + 0.5) * self._WIDTH) / 1e6

    def summary(self) -> dict[str, float] | None:
        """{p50, p99} in ms; None without durations."""
        if not self._bins.any():
            return None
        return {"p50": self.quantile_ms(0.5), "p99": self.quantile_ms(0.99)}


class History:
    """A ring of rows, one a frame, that grows until it holds the last `SPAN_S` seconds.

    Attributes
    ----------
    n : int
        Number of rows added so far, the overwritten ones included.
    """

    def __init__(self) -> None:
        self.n = 0
        self._oldest = 0
        self._rows = np.zeros((MIN_CAPACITY, len(COLUMNS)))

    def add(self, *row: float) -> None:
        """Add one row with the values of `COLUMNS`; time must not decrease."""
        capacity = len(self._rows)
        k = self.n % capacity
        full = self.n >= capacity
        if full and capacity < MAX_CAPACITY and row[0] - self._rows[k, 0] < SPAN_S:
            self._oldest, kept = self.since(0)
            self._rows = np.zeros((2 * capacity, len(COLUMNS)))
            self._rows[np.arange(self._oldest, self.n) % len(self._rows)] = kept
            k = self.n % len(self._rows)
        self._rows[k] = row
        self.n += 1

    def since(self, n: int) -> tuple[int, npt.NDArray[np.float64]]:
        """Rows from number `n` on.

        Returns
        -------
        first : int
            Number of the first returned row: `n`, or more if that is overwritten.
        rows : ndarray of float64, shape (k, 6)
            A copy.
        """
        capacity = len(self._rows)
        first = max(n, self._oldest, self.n - capacity)
        return first, self._rows[np.arange(first, self.n) % capacity]
