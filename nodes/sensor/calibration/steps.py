"""Presses too light to count as a touch, told from drift by how fast they begin.

A drift of the bounded rate changes a force by little in a second; a press, however light, rises
within one. Two low passes of the force, of 0.5 s and 3 s, differ by

    j(t) = h (exp(-t / 3 s) - exp(-t / 0.5 s)),    0.58 h at most,

after a step of height h, and by 2.5 s times the rate under a drift. A press is a j above 5 standard
deviations, of a taxel or of the mean of 3 x 3: the noise of a mean of nine is a third.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Mask


@dataclass(frozen=True)
class StepTuning:
    """Constants of the detection; all chosen but where stated.

    Attributes
    ----------
    fast_s, slow_s : float
        Time constants of the low passes, seconds: a press is complete within the first; the second
        leaves time to see it.
    sigmas : float
        Threshold of a step in standard deviations of j: of 10,000 taxels, noise passes it in one
        of an hour.
    least : float
        Smallest threshold, in parts of f_max: where the noise is not known.
    drifts : float
        Smallest threshold, in what the bounded drift makes of j.
    left : float
        A press is over when its force falls as it rose, or less than this part of its largest rise
        is left.
    """

    fast_s: float = 0.5
    slow_s: float = 3.0
    sigmas: float = 5.0
    least: float = 0.001
    drifts: float = 2.0
    left: float = 0.5


class Steps:
    """The taxels of one field whose force has risen by a step that is not over.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    sigma : float
        Standard deviation of the noise of a frame of the field, in the unit of the forces.
    tuning : StepTuning
        Constants.

    Attributes
    ----------
    risen : ndarray of bool, shape (rows, cols)
        True where a step is not over.
    """

    def __init__(
        self, shape: tuple[int, int], sigma: float, tuning: StepTuning = StepTuning()
    ) -> None:
        self._t, self._sigma = tuning, sigma
        self._n = 0
        self._fast: Doubles = np.zeros(shape)
        self._slow: Doubles = np.zeros(shape)
        self._base: Doubles = np.zeros(shape)
        self._rise: Doubles = np.zeros(shape)
        self.risen: Mask = np.zeros(shape, np.bool_)

    def update(self, mean: Doubles, n: int, dt_s: float, least: float) -> None:
        """Process the mean of the n frames of the last dt_s seconds; `least` is the smallest
        threshold, in the unit of the forces.
        """
        t = self._t
        self._n += 1
        # At first the mean of all: one frame would be believed for as long as the slow low pass.
        fast = max(1 - math.exp(-dt_s / t.fast_s), 1 / self._n)
        slow = max(1 - math.exp(-dt_s / t.slow_s), 1 / self._n)
        self._fast += fast * (mean - self._fast)
        self._slow += slow * (mean - self._slow)
        # Variance of a first-order low pass of white noise: a / (2 - a) of it.
        sigma = self._sigma * math.sqrt((fast / (2 - fast) + slow / (2 - slow)) / n)
        least = max(t.sigmas * sigma, least)
        step = self._fast - self._slow
        self.risen &= step > -least
        new = (step > least) & ~self.risen
        self._base[new] = self._slow[new]
        self._rise[new] = 0.0
        self.risen |= new
        rise = self._fast - self._base
        np.maximum(self._rise, rise, out=self._rise)
        self.risen &= rise >= t.left * self._rise


class LightPresses:
    """The taxels under presses that may be too light to count as a touch.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    noise : float
        Standard deviation of an untouched taxel's noise, 0 if not known.
    f_max : float
        Upper end of the range.
    tuning : StepTuning
        Constants.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        noise: float,
        f_max: float,
        tuning: StepTuning = StepTuning(),
    ) -> None:
        self._t, self._f_max = tuning, f_max
        self._own = Steps(shape, noise, tuning)
        self._around = Steps(shape, noise / 3, tuning)

    def update(self, mean: Doubles, n: int, dt_s: float, rate: float) -> Mask:
        """Process the mean of the n frames of the last dt_s seconds, of forces without drift, whose
        rate is bounded by `rate`, in parts of f_max a second; the taxels pressed, a new array.
        """
        t = self._t
        least = max(t.least, t.drifts * rate * (t.slow_s - t.fast_s)) * self._f_max
        self._own.update(mean, n, dt_s, least)
        self._around.update(mean_of_nine(mean), n, dt_s, least)
        return self._own.risen | self._around.risen


def mean_of_nine(field: Doubles) -> Doubles:
    """Means of each cell and its neighbours; beyond the edge is 0."""
    rows = field.copy()
    rows[1:] += field[:-1]
    rows[:-1] += field[1:]
    found = rows.copy()
    found[:, 1:] += rows[:, :-1]
    found[:, :-1] += rows[:, 1:]
    return found / 9
