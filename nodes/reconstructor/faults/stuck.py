"""Stuck taxels: they are pressed, and lack the noise of the skin."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Indices, Mask, of_nine

LEAST_BACKGROUND = 0.05
"""Least variance of a stuck taxel's change, in that of a working one: all of it is known where all
taxels are read. Chosen."""
ENOUGH = 10.0
"""Logarithm of the odds at which taxels are stuck, and at which stuck ones work again. Chosen: by
chance it is exceeded in one of e^10 frames at most."""
MEMBER = 0.95
"""Least probability of a taxel to be one of those that are stuck, by the part of these. Chosen."""
FORGOTTEN = 2.0
"""Largest evidence that a taxel works, which a taxel that gets stuck has to outweigh."""
FOLLOWED = np.float32(0.2)
"""Rate per frame of the mean force of a taxel."""
SETTLED = 40
"""Frames of doubt after which the taxels that are stuck by then are left out, and frames without
evidence after which the doubt ends. Chosen."""
HELD = 0.2
"""Part by which the force of a stuck taxel may change in the estimate."""
N_ROUNDS = 4
"""Rounds that find the part of stuck taxels. Chosen."""
PRESSED = 5.0
"""Least force of a pressed taxel, in deviations of the noise of an untouched one."""


class Evidence(NamedTuple):
    """What a frame shows of each watched taxel; vectors of these, in their order."""

    projected: Floats  # what is new in the measurements, projected back to the taxels
    background: Doubles  # its variance by the noise of the other taxels
    noise: Doubles  # its further variance by the noise of the taxel


class NewChanges:
    """What is new in the changes that measurements show since the last estimate.

    What forces do not explain repeats whenever the same rows are read; noise does not. So what is
    expected of a change is its mean so far, or the last one where that is nearer: the load moved.
    """

    def __init__(self) -> None:
        self._last: dict[str, Floats] = {}
        self._means: dict[str, Floats] = {}

    def forget(self) -> None:
        """Begin anew: taxels are pressed for the first time, or others are subtracted."""
        self._last.clear()
        self._means.clear()

    def look(self, subset: str, change: Floats) -> Floats | None:
        """Process the change of a row subset, float32 (m,); return what is new in it, of the
        variance of the noise, or None in the first frame. `subset` is the fingerprint of its Phi.
        """
        last = self._last.get(subset)
        self._last[subset] = change.copy()
        if last is None:
            self._means[subset] = self._last[subset]
            return None

        # Means of the last changes by 1/2, 1/4 ... have a third of the variance of one.
        since_last: Floats = np.float32(math.sqrt(1 / 2)) * (change - last)
        mean = self._means[subset]
        new: Floats = np.float32(math.sqrt(3 / 4)) * (change - mean)
        if since_last @ since_last < new @ new:
            mean = last
            new = since_last
        self._means[subset] = np.float32(1 / 2) * (mean + change)
        return new


class StuckTaxels:
    """Finds stuck taxels of any number and shape.

    What is new in a frame, projected back to a taxel, has two parts: its own noise, which a working
    one never lacks, and the background of the others. The logarithm of the likelihood ratio of both
    hypotheses adds up over frames (Page, "Continuous inspection schemes", Biometrika 41, 1954), and
    over taxels: those whose forces are in any range, as a fault gives all of them one reading.

    Parameters
    ----------
    exists : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.

    Attributes
    ----------
    is_doubted : bool
        True while some of the pressed taxels are stuck, it is not clear which.
    is_any_stuck : bool
    is_stuck : ndarray of bool, shape (n,)
    value : ndarray of float32, shape (n,)
        Readings of stuck taxels; 0 elsewhere. Another array where one of them changes.
    """

    def __init__(self, exists: Mask) -> None:
        n = int(np.count_nonzero(exists))
        self._odds = np.zeros(n)  # 0 where a taxel is not watched
        self._watched: Indices = np.zeros(0, dtype=np.intp)
        self._reference = np.zeros(n, dtype=np.float32)
        self._n_doubted = 0  # frames of doubt in a row
        self._n_clear = SETTLED  # frames without evidence in a row
        self.is_doubted = False
        self.is_any_stuck = False
        self.is_stuck: Mask = np.zeros(n, dtype=np.bool_)
        self.value = np.zeros(n, dtype=np.float32)

    def seem_to_work(self) -> Mask:
        """True for each watched taxel of the last frame of which nothing shows that it is stuck."""
        return (self._odds[self._watched] <= 0) & ~self.is_stuck[self._watched]

    def watched(self, forces: Floats, least_force: float) -> Indices:
        """Begin a frame; return the taxels to look at, by number: those that are stuck, and the
        pressed ones. `least_force` is that of a pressed taxel.
        """
        is_watched = forces > least_force
        if self.is_any_stuck:
            is_watched |= self.is_stuck
        watched = np.flatnonzero(is_watched)

        odds = self._odds[watched]
        self._odds[self._watched] = 0.0
        self._odds[watched] = odds
        self._watched = watched
        self._n_clear += 1
        self.is_doubted = self._n_clear < SETTLED
        return watched

    def look(self, watched: Indices, forces: Floats, evidence: Evidence) -> Indices:
        """Process what a frame shows of the watched taxels; return those that are stuck from now
        on, by number, and use those again that show noise.
        """
        self._update(watched, forces[watched], evidence)
        if not self.is_any_stuck:
            return self._new(watched)
        works_again = watched[self.is_stuck[watched] & (self._odds[watched] < -ENOUGH)]
        if works_again.size:
            self.mark(works_again, is_stuck=False, values=np.float32(0))
        return self._new(watched[~self.is_stuck[watched]])

    def mark(self, taxels: Indices, *, is_stuck: bool, values: Floats | np.float32) -> None:
        """Note that taxels, by number, are stuck from now on, at some values, or work again."""
        self.is_stuck[taxels] = is_stuck
        self.is_any_stuck = bool(self.is_stuck.any())
        self.value = self.value.copy()
        self.value[taxels] = values

    def _update(self, watched: Indices, forces: Floats, evidence: Evidence) -> None:
        """Add what a frame shows to the odds of the watched taxels."""
        shown2 = np.square(evidence.projected, dtype=np.float64)
        noise = evidence.noise
        stuck2 = np.maximum(evidence.background, LEAST_BACKGROUND * noise) + TINY
        works2 = stuck2 + noise
        change = 0.5 * (np.log(works2 / stuck2) - shown2 * (1 / stuck2 - 1 / works2))
        odds = self._odds[watched] + change

        # A force that changes is no stuck one, until now.
        reference = self._reference[watched]
        difference = forces - reference
        has_moved = np.abs(difference) > HELD * reference
        # A stuck taxel is used again when the evidence that it works is large. What one of many
        # thousand taxels shows is enough by itself.
        lower_bound: Doubles | float = -FORGOTTEN
        if self.is_any_stuck:
            is_stuck = self.is_stuck[watched]
            has_moved &= ~is_stuck
            lower_bound = np.where(is_stuck, -np.inf, -FORGOTTEN)
        reference = np.where(has_moved, forces, reference + FOLLOWED * difference)
        self._reference[watched] = reference
        odds[has_moved] = 0.0

        self._odds[watched] = np.minimum(np.maximum(odds, lower_bound), 3 * ENOUGH)

    def _new(self, watched: Indices) -> Indices:
        """Return the watched taxels that are stuck, by the odds of all."""
        odds = self._odds[watched]
        # No choice of taxels has larger odds than those that are above 0.
        if odds[odds > 0].sum() - _lost_by_choice(len(odds)) < ENOUGH:
            return self._none()
        order = np.argsort(self._reference[watched])
        group = most_likely_range(odds[order])
        if group.odds < ENOUGH:
            return self._none()

        self._n_clear = 0
        self.is_doubted = True
        self._n_doubted += 1
        if self._n_doubted < SETTLED:
            return watched[:0]
        inside = order[group.start : group.stop]
        members = watched[inside[probability_of(odds[inside]) > MEMBER]]
        self.mark(members, is_stuck=True, values=self._reference[members])
        self._odds[members] = 0.0
        self._n_doubted = 0
        return members

    def _none(self) -> Indices:
        """No taxels, in a frame without evidence."""
        self._n_doubted = self._n_doubted + 1 if self.is_doubted else 0
        return np.empty(0, dtype=np.intp)

    def filled(self, image: Floats, exists: Mask) -> Floats:
        """Return forces, float32 (n_rows, n_cols), with stuck taxels as the mean of the working
        ones beside them.
        """
        works = self._working(exists)
        n_working = of_nine(works.astype(np.float32), np.add)
        means = of_nine(np.where(works, image, 0), np.add) / np.maximum(n_working, 1)
        filled: Floats = np.where(exists & ~works, means, image)
        return filled

    def is_blind(self, exists: Mask) -> bool:
        """True if a stuck taxel has no working one beside it."""
        if not self.is_any_stuck:
            return False
        has_working = of_nine(self._working(exists), np.logical_or)
        return bool((exists & ~has_working).any())

    def _working(self, exists: Mask) -> Mask:
        """True where a taxel exists and is not stuck, bool (n_rows, n_cols)."""
        works = exists.copy()
        works[exists] = ~self.is_stuck
        return works


class Range(NamedTuple):
    """Taxels, numbered in the order of their forces, that seem to be stuck."""

    odds: float  # logarithm of their likelihood, beside that of working ones
    start: int
    stop: int


def most_likely_range(odds: Doubles) -> Range:
    """Return the range of forces whose taxels are stuck most likely; `odds` are the logarithms of
    their likelihood ratios, float64 (n,), in the order of their forces. The choice of the range
    lowers its odds.
    """
    sums = np.concatenate([[0.0], np.cumsum(odds)])
    excess = sums - np.minimum.accumulate(sums)
    stop = int(excess.argmax())
    start = int(sums[: stop + 1].argmin())
    return Range(float(excess[stop]) - _lost_by_choice(len(odds)), start, stop)


def _lost_by_choice(n: int) -> float:
    """Logarithm of the number of ranges of n taxels, about."""
    return 2 * math.log(max(n, 1))


def probability_of(odds: Doubles) -> Doubles:
    """Return the probability of each taxel of a group to be stuck, float64 (n,), by the most likely
    part of stuck ones; `odds` as in `most_likely_range`.
    """
    ratios = np.exp(odds)
    part = 0.5
    for _ in range(N_ROUNDS):
        probability = part * ratios / (1 - part + part * ratios)
        part = float(probability.mean())  # expectation maximisation
    return probability
