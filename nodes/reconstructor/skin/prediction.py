"""The prediction of a frame by the last one: the motion between them, and its error."""

from __future__ import annotations

import math
from typing import NamedTuple

from .tuning import SkinTuning


class MotionSums(NamedTuple):
    """Sums over the rows read, of W times three terms: a, the last estimate x; b and c, its slopes
    along rows and columns.
    """

    aa: float  # products of the terms
    ab: float
    ac: float
    bb: float
    bc: float
    cc: float
    a_change: float  # of each term and what the values exceed W x by
    b_change: float
    c_change: float
    energy: float  # sum of squares of x
    largest: float  # largest force of x
    n_read: int  # rows read
    n: int  # taxels


class Motion(NamedTuple):
    """The prediction x_p = (1 + growth) x + down dx/drow + across dx/dcol, within 0 to bound."""

    growth: float
    down: float
    across: float
    bound: float


def motion_of(
    sums: MotionSums, noise: float, error2: float, tuning: SkinTuning
) -> Motion:
    """Return the motion of a frame, by ridge least squares scaled by what it explains.

    noise is the variance of a measurement, error2 the mean squared error of the last estimate.
    """
    # Forces of which these rows see no more than noise or error, they do not contradict.
    unseen = max(sums.energy * sums.n_read / sums.n - sums.aa, 0.0)
    doubt = max(noise, error2)
    energy = sums.aa + unseen * doubt / (doubt + sums.aa / sums.n_read)

    growth, down, across = _regression(sums, energy, noise, tuning.ridge)
    explained = growth * sums.a_change + down * sums.b_change + across * sums.c_change
    explained = max(explained, 0.0)

    # Three parameters explain a part of the noise, too.
    part = explained / (explained + tuning.motion * noise)
    if sums.n_read < tuning.least_read:
        part = 0.0

    # What these rows hardly observe must not grow without bound, and frame after frame.
    growth = min(growth * part, 1.0)
    bound = sums.largest * max(1 + growth, 1.0)
    return Motion(growth, down * part, across * part, bound)


def _regression(
    sums: MotionSums, energy: float, noise: float, ridge: float
) -> tuple[float, float, float]:
    """Return the coefficients of the terms a, of an energy, b and c, by ridge least squares: three
    equations, solved by elimination.
    """
    ab = sums.ab
    ac = sums.ac
    added = ridge**2 * energy + noise
    aa = (1 + ridge) * energy + added
    bb = (1 + ridge) * sums.bb + added
    cc = (1 + ridge) * sums.cc + added

    # Equations of b and c without a.
    factor = ab / aa
    bb = bb - factor * ab
    bc = sums.bc - factor * ac
    b_change = sums.b_change - factor * sums.a_change
    factor = ac / aa
    cb = sums.bc - factor * ab
    cc = cc - factor * ac
    c_change = sums.c_change - factor * sums.a_change

    # That of c alone, and back.
    factor = cb / bb
    across = (c_change - factor * b_change) / (cc - factor * bc)
    down = (b_change - bc * across) / bb
    growth = (sums.a_change - (ab * down + ac * across)) / aa
    return growth, down, across


class PredictionError:
    """Mean squared error P of the prediction: the excess of the squared innovation over the noise,
    averaged over frames.

    Attributes
    ----------
    variance : float
        The average, at least half of what is significant in the last frame.
    significant : float
        The significant excess of the last frame.
    """

    def __init__(self, tuning: SkinTuning) -> None:
        self._tuning = tuning
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.variance = 0.0
        self.significant = 0.0

    def follow(self, e2: float, noise: float, n_read: int) -> float:
        """Return the mean squared error of the prediction of a frame, of mean squared innovation
        e2.
        """
        tuning = self._tuning
        self.significant = tuning.surplus(e2, noise, n_read)

        excess = e2 - noise
        average = self.variance + tuning.signal_rate * (excess - self.variance)
        # Two standard deviations of a mean square of noise.
        sampling_error = 2 * noise * math.sqrt(2 / n_read)
        bound = max(excess, 0.0) + sampling_error
        self.variance = max(min(average, bound), self.significant / 2)
        return max(max(self.variance, self.significant), 0.0)
