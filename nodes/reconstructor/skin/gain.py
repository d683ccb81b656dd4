"""The gain of the measurements against the prediction, as in an adaptive Kalman filter."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats

#: Normalised innovation squared up to which all of it is noise.
EXPECTED = 0.9
LEAST_GAIN = 0.05
#: Correlation of successive innovations beyond which the estimate lags behind.
LAGGING = 0.3
#: Rate at which the trust in the noise level then falls, its growth per frame otherwise, and its
#: least value.
DISTRUST, RECOVERY, LEAST_TRUST = 0.3, 1.05, 0.05


class AdaptiveGain:
    """The gain K of the measurements against the prediction, in [0.05, 1].

    K = P / (P + R), R the variance of the noise, P + R the mean square of the innovation. While
    nothing moves, K falls no faster than 1, 1/2, 1/3, which makes the estimate the mean of all
    frames since the last change. With rotating rows, the frames of one row subset count.

    The innovations of an optimal filter are white. Where successive ones are correlated, the
    estimate lags behind: apparent noise is motion, and R is multiplied by a trust below 1 until K
    is high enough. So scenes are followed whose frames have little in common.

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

    def __init__(self, n_rows: int) -> None:
        self._n_rows = n_rows
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.gain, self.nis, self.noise, self._trust = 1.0, math.inf, 0.0, 1.0
        self._subsets: dict[int, _Past] = {}
        self.use(0)

    def use(self, subset: int) -> None:
        """Expect innovations of this row subset; only frames of the same one are compared."""
        self._past = self._subsets.setdefault(subset, _Past(self._n_rows))

    def update(self, innovation: Floats, m: int, s2: float, jumped: bool) -> None:
        """Process the innovation of a frame, float32 (n_rows,), newtons, of m measurements.

        s2 is the noise level, squared newtons; `jumped` if the prediction is worth nothing.
        """
        energy, past = float(np.dot(innovation, innovation)), self._past
        both = energy * past.energy
        if both > 0:
            alike = float(np.dot(innovation, past.innovation)) / math.sqrt(both)
            change = math.exp(DISTRUST * (LAGGING - alike)) if alike > LAGGING else RECOVERY
            self._trust = min(max(self._trust * change, LEAST_TRUST), 1.0)
        np.copyto(past.innovation, innovation)
        past.energy = energy

        e2 = energy / m
        self.noise = s2 * self._trust
        self.nis = e2 / (self.noise + TINY)
        signal = max(0.0, self.nis - EXPECTED)
        still = past.gain / (1 + past.gain)
        self.gain = 1.0 if jumped else max(LEAST_GAIN, still, signal / (1 + signal))
        past.gain = self.gain
        if jumped:
            for other in self._subsets.values():
                other.gain = 1.0


class _Past:
    """The last innovation of one row subset, and its gain."""

    def __init__(self, n_rows: int) -> None:
        self.innovation = np.zeros(n_rows, dtype=np.float32)
        self.energy = 0.0
        self.gain = 1.0
