"""How much of the misfit between prediction and measurements is news, and how much is noise."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats

#: Part of the noise level that is not doubted: a frame's own noise varies.
EXPECTED = 0.9
LEAST_WEIGHT = 0.05
#: Correlation of successive misfits beyond which the estimate lags behind; how fast the noise
#: level is then doubted, how fast believed again, and down to which part of it.
LAGGING = 0.3
DOUBTING, BELIEVING, LEAST_BELIEF = 0.3, 1.05, 0.05
TINY = 1e-30


class KalmanWeight:
    """The weight K of the measurements against the prediction, in [0.05, 1].

    K = P / (P + R), R the variance of the noise, P + R the mean square of the misfit. While
    nothing moves, K falls no faster than 1, 1/2, 1/3, which makes the estimate the mean of all
    frames since the last change. Where rows rotate, that counts the frames of one phase: what
    a row says is new when it is read for the first time.

    The misfits of a filter that is right are white. Where one is much like the last, the
    estimate lags behind: what was taken for noise is motion, and R is lowered until K is high
    enough. That is how a scene is followed whose frames have little to do with each other.

    Parameters
    ----------
    n_rows : int
        Length of a misfit.

    Attributes
    ----------
    weight : float
        K of the last frame.
    surprise : float
        Its misfit, in noise variances.
    noise : float
        R of the last frame, squared newtons.

    Notes
    -----
    Source: Kalman, "A new approach to linear filtering and prediction problems", J. Basic Eng.
    82, 1960; Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE
    Trans. Automatic Control 15(2), 1970, for the whiteness of misfits.
    """

    def __init__(self, n_rows: int) -> None:
        self._n_rows = n_rows
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.weight = 1.0
        self.surprise = math.inf
        self.noise = 0.0
        self._belief = 1.0
        self._phases: dict[int, _Past] = {}
        self.use(0)

    def use(self, phase: int) -> None:
        """Take misfits of this phase: what is compared are frames of the same one."""
        self._past = self._phases.setdefault(phase, _Past(self._n_rows))

    def update(self, misfit: Floats, m: int, s2: float, jumped: bool) -> None:
        """Take in a frame.

        Parameters
        ----------
        misfit : ndarray of float32, shape (n_rows,)
            What the prediction leaves of the measurements, newtons.
        m : int
            Number of measurements in it.
        s2 : float
            Noise level, squared newtons.
        jumped : bool
            Whether the prediction is worth nothing.
        """
        energy, past = float(np.dot(misfit, misfit)), self._past
        both = energy * past.energy
        if both > 0:
            alike = float(np.dot(misfit, past.misfit)) / math.sqrt(both)
            change = math.exp(DOUBTING * (LAGGING - alike)) if alike > LAGGING else BELIEVING
            self._belief = min(max(self._belief * change, LEAST_BELIEF), 1.0)
        np.copyto(past.misfit, misfit)
        past.energy = energy

        e2 = energy / m
        self.noise = s2 * self._belief
        self.surprise = e2 / (self.noise + TINY)
        news = max(0.0, self.surprise - EXPECTED)
        still = past.weight / (1 + past.weight)
        self.weight = 1.0 if jumped else max(LEAST_WEIGHT, still, news / (1 + news))
        past.weight = self.weight
        if jumped:
            for other in self._phases.values():
                other.weight = 1.0


class _Past:
    """The last misfit of one phase, and the weight it was given."""

    def __init__(self, n_rows: int) -> None:
        self.misfit = np.zeros(n_rows, dtype=np.float32)
        self.energy = 0.0
        self.weight = 1.0
