"""The noise level of the default solver."""

from __future__ import annotations

import math

from .row_subset import FrameNumbers
from .tuning import SkinTuning
from .vectors import Innovation, Settled


class NoiseLevel:
    """Noise variance R of a measurement, and the trust in it.

    R is the part of the innovation that does not repeat when the same rows are read again, and that
    no change of the prediction explains: an estimate that converges is no noise. Where an
    innovation points along the last correction, that was too small: what seems noise is motion, and
    the trust falls.

    Attributes
    ----------
    variance : float
        R, at least the resolution of the measurements and the stated noise.
    least : float
        That of an untouched taxel: the least one so far.
    trust : float
        Part of R that counts as noise, above 0 to 1.

    Notes
    -----
    Source: Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE Trans.
    Automatic Control 15(2), 1970; it holds for a stationary prediction.
    """

    def __init__(self, tuning: SkinTuning) -> None:
        self._tuning = tuning
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.variance = 0.0
        self.least = 0.0
        self.trust = 1.0
        self._n_seen = 0.0  # frames that showed noise
        self._residual2 = 0.0  # mean squared residual of the last estimate
        self._pressed = 0.0  # part of the taxels that was pressed

    @property
    def is_known(self) -> bool:
        """True once the first frames, which are averaged alike, are over."""
        return self._is_known(self._n_seen)

    def _is_known(self, n_seen: float) -> bool:
        # Parts of 1 that do not count add up to less.
        return n_seen > 1 / self._tuning.noise_rate + 0.5

    def follow(self, innovation: Innovation, frame: FrameNumbers) -> None:
        """Update the level by the innovation of a frame whose rows were read before."""
        measured = max(innovation.noise_squares / frame.n_read, 0.0)

        # What repeats exactly shows no noise.
        new = 1 - frame.repeated
        level, least = self._updated(measured, frame)
        self._n_seen = self._n_seen + new
        self.least = new * least + (1 - new) * self.least
        level = min(level, innovation.mean_square)
        self.variance = new * level + (1 - new) * self.variance

    def _updated(self, measured: float, frame: FrameNumbers) -> tuple[float, float]:
        """Return level and least level after a noise variance was measured."""
        tuning = self._tuning
        n_seen = self._n_seen + 1
        rate = max(1 / n_seen, tuning.noise_rate)
        average = self.variance + rate * (measured - self.variance)

        # What the last forces explained of their measurements was no noise. Where nearly all rows
        # are read, they explain any noise.
        unbounded = frame.read**tuning.all_read * average
        bound = tuning.noise_growth * max(self.variance, self._residual2, unbounded)
        level = min(average, bound)
        if not self._is_known(n_seen):
            return level, average

        # Of an untouched taxel it is the least one so far, of which sampling errors are known.
        if frame.n_read >= tuning.least_read:
            sampling_error = tuning.significant * math.sqrt(2 / frame.n_read)
            bound = (1 + sampling_error) * self.least
            # Pressed taxels may have more of it.
            bound = bound * (1 + tuning.pressed_noise * self._pressed)
            level = min(level, bound)
        return level, min(tuning.bias_forgotten * self.least, level)

    def keep_above(self, floor: float, stated_sd: float) -> None:
        """Bound the level by the resolution of a frame, and by the noise that the skin states."""
        self.variance = max(max(self.variance, floor), stated_sd**2)

    def follow_trust(self, correlation: float, n_read: int) -> None:
        """Update the trust by the correlation of an innovation with the last correction."""
        tuning = self._tuning
        growth = tuning.lagging / math.sqrt(n_read) - correlation
        trust = self.trust * math.exp(min(growth, tuning.trust_growth))
        self.trust = min(max(trust, tuning.least_trust), 1.0)

    def bounded(self, noise: float) -> float:
        """A noise variance, bounded: it grows with the forces, but what exceeds the bound, no force
        explains.
        """
        bound = self.variance
        if self.is_known:
            bound = self._tuning.louder * self.least
        return min(noise, bound)

    def learn(self, settled: Settled, repeated: float) -> None:
        """Learn from the estimate of a frame."""
        self._residual2 = (
            repeated * self._residual2 + (1 - repeated) * settled.residual2
        )
        self._pressed = settled.pressed
