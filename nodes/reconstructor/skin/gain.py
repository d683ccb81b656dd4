"""The gain of the measurements against the prediction, as in an adaptive Kalman filter."""

from __future__ import annotations

import math

from sparseskin.nodes.numerics.arrays import TINY

from .tuning import TUNING, SkinTuning


class AdaptiveGain:
    """The gain K of the measurements against the prediction, in [`gain_least`, 1].

    K = P / (P + R), R the variance of the noise, P + R the mean square of the innovation. While
    nothing moves, K falls no faster than 1, 1/2, 1/3, which makes the estimate the mean of all
    frames since the last change. With rotating rows, the frames of one row subset count.

    The innovation of an optimal filter is orthogonal to its past. Where it points along the last
    correction, x - x_p, that correction was too small: apparent noise is motion, and R is
    multiplied by a trust below 1 until K is high enough. As the correction is known in all taxels,
    frames of different row subsets can be compared.

    Parameters
    ----------
    tuning : SkinTuning
        The constants.

    Attributes
    ----------
    gain, nis, noise : float
        Of the last frame: K; the normalised innovation squared, mean squared innovation / R; and
        R, squared newtons.

    Notes
    -----
    Source: Kalman, "A new approach to linear filtering and prediction problems", J. Basic Eng.
    82, 1960; Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE
    Trans. Automatic Control 15(2), 1970, for the whiteness of innovations.
    """

    def __init__(self, tuning: SkinTuning = TUNING) -> None:
        self._t = tuning
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.gain, self.nis, self.noise, self._trust = 1.0, math.inf, 0.0, 1.0
        self._gains: dict[int, float] = {}
        self.use(0)

    def use(self, subset: int) -> None:
        """Expect innovations of this row subset."""
        self._subset = subset
        self._gains.setdefault(subset, 1.0)

    def follow(
        self, energy: float, along: float, correction2: float, m: int, s2: float, jumped: bool
    ) -> None:
        """Process a frame.

        Parameters
        ----------
        energy, along, correction2 : float
            Squared length of the innovation, its product with the correction Phi (x - x_p) of the
            frame before, and the squared length of that correction, squared newtons.
        m : int
            Number of measurements.
        s2 : float
            Noise level, squared newtons.
        jumped : bool
            True if the prediction is worth nothing.
        """
        both = energy * correction2
        if both > 0 and not jumped:
            alike = along / math.sqrt(both)
            change = (
                math.exp(self._t.trust_fall * (self._t.lagging - alike))
                if alike > self._t.lagging
                else self._t.trust_growth
            )
            self._trust = min(max(self._trust * change, self._t.trust_least), 1.0)

        self.noise = s2 * self._trust
        self.nis = energy / m / (self.noise + TINY)
        signal = max(0.0, self.nis - self._t.gain_expected)
        last = self._gains[self._subset]
        still = last / (1 + last)
        self.gain = 1.0 if jumped else max(self._t.gain_least, still, signal / (1 + signal))
        if jumped:
            self._gains = dict.fromkeys(self._gains, 1.0)
        self._gains[self._subset] = self.gain
