"""The gain of the measurements against the prediction, as in an adaptive Kalman filter."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats

#: Normalised innovation squared up to which all of it is noise.
EXPECTED = 0.9
LEAST_GAIN = 0.05
#: Correlation of an innovation with the last correction beyond which the estimate lags behind.
LAGGING = 0.1
#: Rate at which the trust in the noise level then falls, its growth per frame otherwise, and its
#: least value.
DISTRUST, RECOVERY, LEAST_TRUST = 0.5, 1.05, 0.05


class AdaptiveGain:
    """The gain K of the measurements against the prediction, in [0.05, 1].

    K = P / (P + R), R the variance of the noise, P + R the mean square of the innovation. While
    nothing moves, K falls no faster than 1, 1/2, 1/3, which makes the estimate the mean of all
    frames since the last change. With rotating rows, the frames of one row subset count.

    The innovation of an optimal filter is orthogonal to its past. Where it points along the last
    correction, x - x_p, that correction was too small: apparent noise is motion, and R is
    multiplied by a trust below 1 until K is high enough. As the correction is known in all taxels,
    frames of different row subsets can be compared.

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

    def __init__(self) -> None:
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

    def update(
        self, innovation: Floats, correction: Floats, m: int, s2: float, jumped: bool
    ) -> None:
        """Process the innovation of a frame of m measurements.

        Parameters
        ----------
        innovation, correction : ndarray of float32, shape (n_rows,)
            Innovation, and Phi (x - x_p) of the frame before, newtons.
        m : int
            Number of measurements.
        s2 : float
            Noise level, squared newtons.
        jumped : bool
            True if the prediction is worth nothing.
        """
        energy = float(np.dot(innovation, innovation))
        both = energy * float(np.dot(correction, correction))
        if both > 0 and not jumped:
            alike = float(np.dot(innovation, correction)) / math.sqrt(both)
            change = math.exp(DISTRUST * (LAGGING - alike)) if alike > LAGGING else RECOVERY
            self._trust = min(max(self._trust * change, LEAST_TRUST), 1.0)

        self.noise = s2 * self._trust
        self.nis = energy / m / (self.noise + TINY)
        signal = max(0.0, self.nis - EXPECTED)
        last = self._gains[self._subset]
        still = last / (1 + last)
        self.gain = 1.0 if jumped else max(LEAST_GAIN, still, signal / (1 + signal))
        if jumped:
            self._gains = dict.fromkeys(self._gains, 1.0)
        self._gains[self._subset] = self.gain
