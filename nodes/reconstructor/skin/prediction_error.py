"""The error of a prediction of the default solver."""

from __future__ import annotations

import math

from .tuning import SkinTuning


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

        average = self.variance + tuning.signal_rate * (e2 - noise - self.variance)
        bound = max(e2 - noise, 0.0) + 2 * noise * math.sqrt(2 / n_read)
        self.variance = max(min(average, bound), self.significant / 2)
        return max(max(self.variance, self.significant), 0.0)
