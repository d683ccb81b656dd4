"""Statistics of unbounded streams in bounded memory: extents, quantiles, the last minute."""

import math
from collections import deque
from dataclasses import dataclass
from itertools import islice

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles

SPAN_S = 60.0
"""Time that the charts of a page show."""
COLUMNS = ("time_s", "psnr_noisy_db", "psnr_db", "latency_ms", "solve_ms", "lost")
MIN_CAPACITY = 2048
"""Rows that stay however old they are: a chart of a slow stream is not to be nearly empty."""
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

    @property
    def mean(self) -> float:
        return self.total / self.count

    def summary(self) -> dict[str, float] | None:
        """{mean, min, max}; None without numbers."""
        if not self.count:
            return None
        return {
            "mean": self.mean,
            "min": self.low,
            "max": self.high,
        }


class Quantiles:
    """Quantiles of positive durations, from a histogram with logarithmic bins.

    From 1 us to 1000 s each bin is 0.5 % wide, so a quantile has a relative error of at most
    0.25 %; shorter and longer durations count in the first and last bin.
    """

    _LOW_NS = 1e3
    _HIGH_NS = 1e12
    _WIDTH = math.log(1.005)

    def __init__(self) -> None:
        # 4155 bins are 33 kB: every patch has two histograms.
        span = math.log(self._HIGH_NS / self._LOW_NS)
        n_bins = math.ceil(span / self._WIDTH)
        self._bins = np.zeros(n_bins, np.int64)

    def add(self, duration_ns: float) -> None:
        # Shorter durations count in the first bin, longer ones in the last.
        bounded_ns = max(duration_ns, self._LOW_NS)
        n_widths = math.log(bounded_ns / self._LOW_NS) / self._WIDTH
        k_last = len(self._bins) - 1
        k = min(int(n_widths), k_last)
        self._bins[k] += 1

    def quantile_ms(self, q: float) -> float:
        """The smallest duration in ms that at least the fraction q of all do not exceed."""
        cumulative = np.cumsum(self._bins)
        rank = q * cumulative[-1]
        k = int(np.searchsorted(cumulative, rank, side="left"))
        # The middle of the bin, on the logarithmic scale.
        n_widths = k + 0.5
        middle_ns = self._LOW_NS * math.exp(n_widths * self._WIDTH)
        return middle_ns / 1e6

    def summary(self) -> dict[str, float] | None:
        """{p50, p99} in ms; None without durations."""
        if not self._bins.any():
            return None
        return {
            "p50": self.quantile_ms(0.5),
            "p99": self.quantile_ms(0.99),
        }


class History:
    """Rows of the last `SPAN_S` seconds, and `MIN_CAPACITY` ones at least; the first column is the
    time in seconds, `n` the number of rows added so far, the removed ones included.
    """

    def __init__(self, columns: tuple[str, ...] = COLUMNS) -> None:
        self.columns = columns
        self.n = 0
        self._rows: deque[tuple[float, ...]] = deque(maxlen=MAX_CAPACITY)

    def add(self, *row: float) -> None:
        """Add one row with the values of the columns; time must not decrease."""
        rows = self._rows
        # The first row goes once those behind it span enough time; of a slow stream old ones stay.
        begin_s = row[0] - SPAN_S
        while len(rows) >= MIN_CAPACITY and rows[1][0] <= begin_s:
            rows.popleft()
        rows.append(row)
        self.n += 1

    def since(self, n: int) -> tuple[int, Doubles]:
        """The rows from number `n`, or a later one if that is removed: the number of the first, and
        a copy of them, float64 (k, n_columns).
        """
        n_first = max(n, self.n - len(self._rows))
        n_rows = max(0, self.n - n_first)
        # From the end: a page asks for the newest few of many.
        newest = list(islice(reversed(self._rows), n_rows))
        table = np.array(newest[::-1], dtype=np.float64)
        return n_first, table.reshape(n_rows, len(self.columns))
