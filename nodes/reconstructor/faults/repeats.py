"""Measurements without noise, on a skin with noise: equal, clipped or repeated ones."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Reason
from sparseskin.messages.quantised import step_of
from sparseskin.nodes.numerics.arrays import Floats, Mask

LEAST_NOISE = 0.5
"""Least deviation of the noise, in steps of the quantiser, at which measurements cannot repeat by
themselves."""
LIVELY = 0.98
LEARNING = 10
"""Part of the measurements that change from frame to frame, and the number of frames that show it,
from which on a skin that states no noise has some. Chosen: of recordings whose untouched taxels
read 0 some measurements repeat."""
LIVELY_RATE = 0.05
"""Rate per frame of that part."""
TIED = 0.17
TIED_DEVIATIONS = 3.4
"""Number of measurements that share an extreme value of a quantiser, in m and in its root, which
chance exceeds in one of 10^9 frames. Computed for steps of up to twice the noise and m of 128 and
more; of fewer, more frames do."""
MOST_LIKELY = 0.75
"""Largest probability of a value of a quantiser. Derived: a step of twice the noise has 0.68."""
CHANCE = 1e-9
"""Probability of a chance event that passes for a fault."""
RARE = 1e-3
"""Least probability that a measurement repeats by chance: with it, 3 repeats are a fault."""
FRAMES = 4
"""Least number of frames in a row that repeat exactly. Chosen: a link or a driver that delivers a
frame twice is no fault."""


@dataclass
class _Subset:
    """State of the rows of a subset."""

    y: Floats  # last measurements
    #: How often each measurement repeated, in a row; None: none did.
    n_repeats: npt.NDArray[np.int64] | None = None


class RepeatWatch:
    """Finds frames and measurements that lack the noise of the skin.

    Noise makes all measurements of a frame differ, and each of them differ from frame to frame. A
    frame of equal ones is "constant", one in which many share an extreme value "clipped"; frames
    that repeat are "frozen". A single measurement that repeats is faulty.

    Parameters
    ----------
    least_sd : float
        Least standard deviation of the noise of a taxel that the skin states, in the unit of the
        forces; 0 where it states none: then the measurements show whether there is noise.

    Attributes
    ----------
    faulty : ndarray of bool, shape (m,), or None
        Measurements of the last frame that repeat alone; None: there are none.
    """

    def __init__(self, least_sd: float) -> None:
        self._least_sd = least_sd
        self._subsets: dict[str, _Subset] = {}
        self._last_y: Floats | None = None
        self._lively = 0.0
        self._n_compared = 0
        self._n_frozen = 0
        self.faulty: Mask | None = None

    @property
    def is_lively(self) -> bool:
        """True if nearly all measurements so far changed from frame to frame."""
        return self._n_compared >= LEARNING and self._lively >= LIVELY

    def look(self, subset: str, y: Floats) -> Reason | None:
        """Process measurements of a row subset as received, float32 (m,); return why the frame
        cannot be right, if so. y is kept, not copied; `subset` is the fingerprint of its Phi.
        """
        self.faulty = None
        state = self._subsets.get(subset)

        # A hung board repeats whole frames: whatever rows these claim to be of, and where it still
        # takes turns, those of the same rows.
        earlier = [self._last_y]
        if state is not None:
            earlier.append(state.y)
        is_repeated = any(_are_equal(last_y, y) for last_y in earlier)
        self._n_frozen = self._n_frozen + 1 if is_repeated else 0
        self._last_y = y

        # Without noise, equal measurements may be right.
        has_noise = self._has_noise(y)
        reason = None
        if has_noise:
            reason = self._reason(y)
        if state is None:
            self._subsets[subset] = _Subset(y)
        elif reason is None and not is_repeated:
            self._compare(state, y, has_noise)
        return reason

    def _has_noise(self, y: Floats) -> bool:
        if self._least_sd > 0:
            return self._least_sd > LEAST_NOISE * step_of(y)
        return self.is_lively

    def _reason(self, y: Floats) -> Reason | None:
        n_least = least_ties(y.size, step_of(y) > 0)
        n_lowest = int(np.count_nonzero(y == y.min()))
        if n_lowest == y.size and y.size >= n_least:
            return Reason.CONSTANT
        # Of a few quantised measurements, all may repeat by chance: each with one half at most.
        chance = 0.5 ** (self._n_frozen * y.size)
        if self._n_frozen >= FRAMES and chance < CHANCE:
            return Reason.FROZEN
        n_highest = int(np.count_nonzero(y == y.max()))
        if max(n_lowest, n_highest) >= n_least:
            return Reason.CLIPPED
        return None

    def _compare(self, state: _Subset, y: Floats, has_noise: bool) -> None:
        """Compare the measurements with the last ones of their subset."""
        repeats = state.y == y
        state.y = y
        n_equal = int(np.count_nonzero(repeats))
        if n_equal:
            if state.n_repeats is None:
                state.n_repeats = np.zeros(y.size, dtype=np.int64)
            state.n_repeats += 1
            state.n_repeats[~repeats] = 0
            if has_noise:
                self._mark(state.n_repeats, step_of(y) > 0)
        else:
            state.n_repeats = None

        self._n_compared += 1
        rate = max(LIVELY_RATE, 1 / self._n_compared)
        changed = 1 - n_equal / y.size
        self._lively += rate * (changed - self._lively)

    def _mark(self, n_repeats: npt.NDArray[np.int64], is_quantised: bool) -> None:
        """Mark measurements that repeated too often for noise, by their numbers of repeats."""
        chance = max(1 - self._lively, RARE)
        if is_quantised:
            # The mean probability to repeat is at least the square of the largest one.
            chance = math.sqrt(chance)
        # After so many repeats no chance is left.
        chance = min(chance, MOST_LIKELY)
        n_needed = math.ceil(math.log(CHANCE) / math.log(chance))
        faulty = n_repeats >= n_needed
        if faulty.any():
            self.faulty = faulty


def least_ties(m: int, is_quantised: bool) -> int:
    """Least number of the m measurements of a frame that share an extreme value not by chance.

    Two float32 numbers of noise are hardly ever equal. Steps of a quantiser, of twice the noise at
    most, hold half of the measurements of an untouched skin, but hardly at an end.
    """
    if is_quantised:
        return math.ceil(TIED * m + TIED_DEVIATIONS * math.sqrt(m))
    return 4


def _are_equal(last_y: Floats | None, y: Floats) -> bool:
    if last_y is None or last_y.size != y.size:
        return False
    # The first ones differ in nearly all frames.
    if last_y[0] != y[0]:
        return False
    return np.array_equal(last_y, y)
