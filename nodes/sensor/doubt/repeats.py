"""Repeats: taxels that read the same number again and again, where noise would change it."""

import math

import numpy as np

from sparseskin.messages import Reason
from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask, mean_of_near
from sparseskin.nodes.sensor.repetition import needed_repetitions
from sparseskin.nodes.sensor.sign import Margin, some_of

SHOWN = 1 / 3
"""Least part of the readings of untouched taxels that are not 0, where noise shows. Derived: of
noise that is clipped at 0 one half is, of noise within a step of the converter none."""
LEAST_RUN = 3
"""Least number of repetitions. Chosen: a frame may be read twice."""
LEAST_RUN_AT_END = 10
"""The same at the upper end of the range, where readings repeat because they are clipped. Chosen:
one in 1000 runs of a force that is just at the end."""
MAX_CELLS = 256
"""Most stuck taxels whose cells are published: more are no single faults."""
SHARE = 0.25
"""Part of the RMS force of a frame from which on it is not trusted, if it is that of such taxels.
Derived: an error of that part is not trusted either."""


class Repeats:
    """Finds stuck taxels before their readings become sums, in which they hardly show.

    Untouched taxels show how often noise repeats a reading: p, of those pairs of readings that are
    not 0 and of which the first is no repetition itself, since a stuck taxel repeats once and for
    all. A taxel is stuck where it has repeated its reading n times with (4 p)^n <= 10^-12.

    Readings of 0 say nothing: noise below 0 is clipped there. Where untouched taxels read 0 in more
    than two of three frames, the converter hides their noise, and nothing is concluded at all.

    Attributes
    ----------
    stuck : ndarray of bool, shape (n_rows, n_cols)
        Taxels of the last frame whose readings are none: they are stuck, below the end of the range
        and while others are not. At its end, a force may be as large.
    """

    def __init__(self, skin: Skin) -> None:
        self.f_max = np.float32(skin.f_max)
        self._margin = Margin()
        self._exists = skin.exists.reshape(-1)
        self._are_all = skin.mask is None
        self._counted_exist = some_of(self._exists)
        self.stuck: Mask = np.zeros(skin.shape, np.bool_)
        self._is_any_stuck = False
        self._last: Floats = np.zeros(0, np.float32)
        #: Of the taxels that are counted, those that repeated their last reading.
        self._counted_repeated: Mask = np.zeros(0, np.bool_)
        #: Taxels that repeated their last reading, and how often in a row.
        self._repeated: Indices = np.zeros(0, np.intp)
        self._runs: Indices = np.zeros(0, np.intp)
        self._n_untouched = 0
        self._n_shown = 0
        self._n_pairs = 0
        self._n_repeated = 0

    def reason(
        self,
        forces: Floats,
        margin: float | None = None,
        missing: Mask | None = None,
    ) -> str:
        """Add a frame, float32 (n_rows, n_cols), 0 in masked cells. Returns its `Reason`, "" where
        it has none. `margin`: what noise may exceed 0 by; None: it is measured. `missing`: cells
        whose force is no reading, bool (n_rows, n_cols).
        """
        readings = forces.reshape(-1)
        if self._is_any_stuck:
            self._set_stuck(np.zeros(forces.shape, np.bool_))
        if margin is None:
            taxels = readings if self._are_all else readings[self._exists]
            margin = self._margin.of(taxels, float(self.f_max), None)

        previous = self._last
        self._last = readings.copy()
        # A force that stands for a missing reading repeats nothing: NaN equals no number.
        if missing is not None:
            self._last[missing.reshape(-1)] = np.nan
        if readings.size != previous.size:
            self._repeated = self._repeated[:0]
            self._runs = self._runs[:0]
            self._counted_repeated = self._counted_repeated[:0]
            return ""

        is_repeated = np.logical_and(self._last == previous, readings)
        self._count(some_of(previous), some_of(is_repeated), margin)

        # Hardly a taxel repeats: what follows is done for those alone.
        repeated = np.flatnonzero(is_repeated)
        self._extend_runs(repeated, readings.size)
        if not repeated.size:
            return ""
        needed = self._needed()
        if self._runs.max() < needed:
            return ""

        at_end = readings[repeated] >= self.f_max
        is_stuck = self._runs >= np.where(at_end, max(needed, LEAST_RUN_AT_END), needed)
        stuck = repeated[is_stuck]
        # All that read anything: the board hangs, and no taxel is to be filled in.
        n_nonzero = np.count_nonzero(np.nan_to_num(self._last))
        is_frozen = stuck.size == n_nonzero
        if not is_frozen:
            mask = np.zeros(forces.shape, np.bool_)
            mask.flat[repeated[is_stuck & ~at_end]] = True
            self._set_stuck(mask)

        if not self._matters(readings, stuck):
            return ""
        if is_frozen:
            return Reason.FROZEN
        if at_end[is_stuck].all():
            return Reason.CLIPPED
        return Reason.STUCK

    def _set_stuck(self, stuck: Mask) -> None:
        self.stuck = stuck
        self._is_any_stuck = bool(stuck.any())

    def _extend_runs(self, repeated: Indices, n: int) -> None:
        """Count the taxels, of n, that have repeated their reading, by number."""
        if repeated.size:
            runs = np.zeros(n, np.intp)
            runs[self._repeated] = self._runs
            self._runs = runs[repeated] + 1
        else:
            self._runs = self._runs[:0]
        self._repeated = repeated

    @property
    def cells(self) -> list[int]:
        """Flat cells of the stuck taxels, in order; of many the first `MAX_CELLS`."""
        if not self._is_any_stuck:
            return []
        return [int(cell) for cell in np.flatnonzero(self.stuck)[:MAX_CELLS]]

    def filled(self, forces: Floats) -> Floats:
        """The last frame, float32 (n_rows, n_cols), in which each stuck taxel has the mean of the
        working ones beside it, 0 where there is none.
        """
        if not self._is_any_stuck:
            return forces
        works = self._exists.reshape(forces.shape) & ~self.stuck
        return np.where(self.stuck, mean_of_near(forces, works), forces)

    def _count(self, previous: Floats, is_repeated: Mask, margin: float) -> None:
        """Add the pairs of readings of untouched taxels to the counts, by some of the taxels: their
        readings in the frame before, and whether they repeat these.
        """
        untouched = np.abs(previous) <= margin
        if not self._are_all:
            untouched &= self._counted_exist
        noisy = np.logical_and(untouched, previous)
        self._n_untouched += int(np.count_nonzero(untouched))
        self._n_shown += int(np.count_nonzero(noisy))

        # The first reading of a pair is no repetition itself.
        if self._counted_repeated.size == noisy.size:
            noisy &= ~self._counted_repeated
        self._counted_repeated = is_repeated
        self._n_pairs += int(np.count_nonzero(noisy))
        self._n_repeated += int(np.count_nonzero(noisy & is_repeated))

    def _needed(self) -> float:
        """Number of repetitions of a stuck taxel; infinite where none shows."""
        if self._n_shown < SHOWN * self._n_untouched:
            return math.inf
        return max(LEAST_RUN, needed_repetitions(self._n_repeated, self._n_pairs))

    @staticmethod
    def _matters(readings: Floats, stuck: Indices) -> bool:
        """True if these taxels, by number, have a large part of the forces of a frame."""
        energy = float(readings @ readings)
        of_stuck = readings[stuck]
        return float(of_stuck @ of_stuck) > SHARE**2 * energy
