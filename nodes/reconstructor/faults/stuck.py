"""Stuck taxels: they are pressed, and lack the noise of the skin."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Indices, Mask, of_nine

WORKS = 0.7
"""Noise variance of a working taxel, in that of pressed ones by the stated noise: one of a third
and more shows that it works by and by, one of less that it is stuck. Chosen: skins state it to a
factor of two."""
FIRST_SCALE, SCALE_RATE = 0.3, 0.05
"""Noise variance of pressed taxels, in the stated one, before any was measured, and the rate per
frame at which it is followed. Chosen."""
LEAST_BACKGROUND = 0.05
"""Least variance of a stuck taxel's change, in that of a working one: all of it is known where all
taxels are read. Chosen."""
ENOUGH = 10.0
"""Logarithm of the odds at which taxels are stuck. Derived: no chance of a year at 100 Hz."""
MEMBER = 0.95
"""Least probability of a taxel to be one of those that are stuck, by the part of these. Chosen."""
FORGOTTEN = 2.0
"""Largest evidence that a taxel works, which a taxel that gets stuck has to outweigh."""
CLEARED = 10.0
"""Evidence after which a stuck taxel is used again."""
SUDDEN = 3.0
"""Largest evidence of one frame that a taxel works: a motion is no noise."""
FOLLOWED = np.float32(0.2)
"""Rate per frame of the mean force of a taxel."""
SETTLED = 40
"""Frames of doubt after which the taxels that are stuck by then are left out, and frames without
evidence after which the doubt ends. Chosen: of stuck ones that show a third of what the background
does, one in ten is not found by then."""
HELD = 0.2
"""Part by which the force of a stuck taxel may change in the estimate."""
N_ROUNDS = 4
"""Rounds that find the part of stuck taxels. Chosen."""
PRESSED = 5.0
"""Least force of a pressed taxel, in deviations of the noise of an untouched one."""


class Evidence(NamedTuple):
    """What a frame shows of each taxel; vectors (n,), of the taxels in row-major order."""

    forces: Floats
    projected: Floats  # change since the last estimate, projected back to the taxels
    background: Doubles  # its variance by the noise of the other taxels
    #: Its further variance by the noise of some taxels, if that is as stated; by their numbers.
    noise: Callable[[Indices], Doubles]


class StuckTaxels:
    """Finds stuck taxels of any number and shape.

    The change of a frame, projected back to a taxel, has two parts: its own error, of which the
    noise of a working one is never absent, and the background of the others. The logarithm of the
    likelihood ratio of both hypotheses adds up over frames (Wald, "Sequential analysis", 1947), and
    over taxels: those beside each other that are pressed alike, and all of them, of which any part
    may be stuck (`mixture_of`).

    Parameters
    ----------
    exists : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.

    Attributes
    ----------
    is_doubted : bool
        True while some of the pressed taxels are stuck, it is not clear which.
    is_stuck : ndarray of bool, shape (n,)
    value : ndarray of float32, shape (n,)
        Readings of stuck taxels; 0 elsewhere.
    """

    def __init__(self, exists: Mask) -> None:
        n = int(np.count_nonzero(exists))
        self._beside = beside(exists)
        self._odds = np.zeros(n)
        self._reference = np.zeros(n, dtype=np.float32)
        self._scale = FIRST_SCALE
        self._n_doubted = 0  # frames of doubt in a row
        self._n_clear = SETTLED  # frames without evidence in a row
        self.is_doubted = False
        self.is_stuck: Mask = np.zeros(n, dtype=np.bool_)
        self.value = np.zeros(n, dtype=np.float32)

    def look(self, evidence: Evidence, least_force: float) -> Indices:
        """Process a frame; return the taxels that are stuck from now on, by number, and use those
        again that show noise. `least_force` is that of a pressed taxel.
        """
        forces = evidence.forces
        watched = np.flatnonzero((forces > least_force) | self.is_stuck)
        is_idle = np.ones(len(forces), dtype=np.bool_)
        is_idle[watched] = False
        self._odds[is_idle] = 0.0
        self._update(watched, evidence)

        works_again = watched[self.is_stuck[watched] & (self._odds[watched] < -CLEARED)]
        self.is_stuck[works_again] = False
        self.value[works_again] = 0.0
        return self._new(watched[~self.is_stuck[watched]])

    def _update(self, watched: Indices, evidence: Evidence) -> None:
        """Add what a frame shows to the odds of the watched taxels."""
        background = evidence.background[watched]
        shown2 = np.square(evidence.projected[watched], dtype=np.float64)
        stated_noise = evidence.noise(watched)
        if not self.is_doubted:
            works = ~self.is_stuck[watched] & (self._odds[watched] <= 0)
            self._follow_scale((shown2 - background)[works], stated_noise[works])

        noise = WORKS * self._scale * stated_noise
        stuck2 = np.maximum(background, LEAST_BACKGROUND * noise) + TINY
        works2 = stuck2 + noise
        change = 0.5 * (np.log(works2 / stuck2) - shown2 * (1 / stuck2 - 1 / works2))
        odds = self._odds[watched] + np.maximum(change, -SUDDEN)

        # A force that changes is no stuck one, until now.
        forces = evidence.forces[watched]
        reference = self._reference[watched]
        has_moved = np.abs(forces - reference) > HELD * reference
        has_moved &= ~self.is_stuck[watched]
        reference = np.where(has_moved, forces, reference + FOLLOWED * (forces - reference))
        self._reference[watched] = reference
        odds[has_moved] = 0.0

        # A stuck taxel is used again when the evidence that it works is large.
        lower_bound = np.where(self.is_stuck[watched], -np.inf, -FORGOTTEN)
        self._odds[watched] = np.clip(odds, lower_bound, 2 * ENOUGH)

    def _follow_scale(self, own2: Doubles, stated: Doubles) -> None:
        """Follow the noise of pressed taxels that seem to work, in what is stated: skins may state
        too much.
        """
        total = float(stated.sum())
        if total > 0:
            scale = min(max(float(own2.sum()) / total, 0.0), 1.0)
            self._scale += SCALE_RATE * (scale - self._scale)

    def _new(self, watched: Indices) -> Indices:
        """Return the watched taxels that are stuck, by the odds of all."""
        self._n_clear += 1
        mixture = None
        odds = self._odds[watched]
        # No choice of taxels has larger odds than those that are above 0.
        if odds[odds > 0].sum() > ENOUGH:
            mixture = mixture_of(odds)
            if max(mixture.odds, self._odds_of_group(watched)) > ENOUGH:
                self._n_clear = 0
        self.is_doubted = self._n_clear < SETTLED
        self._n_doubted = self._n_doubted + 1 if self.is_doubted else 0
        if mixture is None or self._n_clear > 0 or self._n_doubted < SETTLED:
            return watched[:0]
        members = self._members(watched, mixture)
        self.is_stuck[members] = True
        self.value[members] = self._reference[members]
        self._odds[members] = 0.0
        self._n_doubted = 0
        return members

    def _odds_of_group(self, watched: Indices) -> float:
        """Largest odds of a taxel and those beside it that are pressed alike, less that of its
        choice.
        """
        suspects = watched[self._odds[watched] > 0]
        if len(suspects) == 0:
            return 0.0
        odds = self._group_odds(suspects)
        return float(odds.max()) - math.log(len(self._odds))

    def _group_odds(self, suspects: Indices) -> Doubles:
        """Odds of each suspect and the watched taxels beside it that are pressed alike."""
        places = self._beside[suspects]
        reference = np.append(self._reference, np.float32(0))
        difference = np.abs(reference[places] - self._reference[suspects, None])
        is_alike = difference < HELD * self._reference[suspects, None]
        odds: Doubles = (np.append(self._odds, 0.0)[places] * is_alike).sum(axis=1)
        return odds

    def _members(self, watched: Indices, mixture: Mixture) -> Indices:
        """The watched taxels that are stuck: by themselves, or with those beside them."""
        is_member = mixture.posterior > MEMBER
        is_member &= mixture.odds > ENOUGH
        suspects = np.flatnonzero(self._odds[watched] > 0)
        group = self._group_odds(watched[suspects]) - math.log(len(self._odds))
        is_member[suspects] |= group > ENOUGH
        return watched[is_member]

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
        if not self.is_stuck.any():
            return False
        has_working = of_nine(self._working(exists), np.logical_or)
        return bool((exists & ~has_working).any())

    def _working(self, exists: Mask) -> Mask:
        """True where a taxel exists and is not stuck, bool (n_rows, n_cols)."""
        works = exists.copy()
        works[exists] = ~self.is_stuck
        return works


def beside(exists: Mask) -> Indices:
    """Numbers of the taxels within two rows and columns of each, itself included, intp (n, 25); n
    where there is none.
    """
    n = int(np.count_nonzero(exists))
    number = np.full((exists.shape[0] + 4, exists.shape[1] + 4), n)
    number[2:-2, 2:-2][exists] = np.arange(n)
    windows = np.lib.stride_tricks.sliding_window_view(number, (5, 5))
    return windows[exists].reshape(n, 25)


class Mixture(NamedTuple):
    """A mixture of stuck and working taxels."""

    odds: float  # logarithm of its likelihood, beside that of working ones alone
    posterior: Doubles  # probability of each taxel to be stuck


def mixture_of(odds: Doubles) -> Mixture:
    """Return the most likely mixture of taxels, of which `odds` are the logarithms of the
    likelihood ratio. The choice of the part of stuck ones lowers its odds.
    """
    ratios = np.exp(np.minimum(odds, 2 * ENOUGH))
    part = 0.5
    for _ in range(N_ROUNDS):
        likelihood = 1 - part + part * ratios
        posterior = part * ratios / likelihood
        best = float(np.log(likelihood).sum())
        part = float(posterior.mean())  # expectation maximisation
    return Mixture(best - math.log(len(odds) + 1), posterior)
