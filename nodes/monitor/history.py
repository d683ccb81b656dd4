"""The figures of every frame of the last minute."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

SPAN_S = 60.0
COLUMNS = ("time_s", "psnr_noisy_db", "psnr_db", "latency_ms", "solve_ms", "lost")
MIN_CAPACITY = 2048
MAX_CAPACITY = 1 << 17
"""60 s at 2.2 kHz; of a faster stream less than 60 s is kept."""


class History:
    """A ring of rows, one a frame, that grows until it holds the last `SPAN_S` seconds.

    Attributes
    ----------
    n : int
        Rows added so far, those that are gone included.
    """

    def __init__(self) -> None:
        self.n = 0
        self._oldest = 0
        self._rows = np.zeros((MIN_CAPACITY, len(COLUMNS)))

    def add(self, *row: float) -> None:
        """Add one row, its values as in `COLUMNS`; time must not go back."""
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
        """Rows number `n` and on.

        Returns
        -------
        int
            Number of the first row that is returned: `n`, or more where those are gone.
        ndarray of float64, shape (k, 6)
            A copy.
        """
        capacity = len(self._rows)
        first = max(n, self._oldest, self.n - capacity)
        places = np.arange(first, self.n) % capacity
        return first, self._rows[places]
