"""Slow drift of the baseline, followed only where a skin is untouched.

The drift w of a taxel, in newtons, is subtracted from its force. While the taxel is untouched, w
follows the smoothed force f that is left, with the time constant tau and at most the rate r:

    dw/dt = clip(f / tau, -r, r),    |w| <= w_max,

so that a constant force loses at most r t in the time t. A press loses none: above a threshold a
taxel counts as touched, and below it a press is told from drift by how fast it begins (module
`steps`). What rises as slowly as a drift is one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.numerics.arrays import Doubles, Mask

from .steps import LightPresses

DRIFT_RATE = 1e-4
"""Largest rate of the drift that is followed, in parts of f_max a second: 0.6 % of f_max a minute.
Chosen: a force that rises unnoticed loses no more."""


@dataclass(frozen=True)
class DriftTuning:
    """Constants of the drift that is followed; all chosen.

    Attributes
    ----------
    tau_s : float
        Time constant, seconds: long against a touch, short against warming up.
    most : float
        Largest drift that is followed, in parts of f_max.
    sigmas : float
        Threshold of a touch, in standard deviations of the noise; at least `CONTACT_FRACTION` of
        f_max. A taxel is touched where its smoothed force is above it, or one frame above twice
        of it: noise is not, with a drift of half the threshold either.
    smooth_s : float
        Time constant of the smoothed force, seconds.
    hold_s : float
        Time after a touch for which the drift of the taxel and of its eight neighbours is held,
        seconds: a reading creeps back after a press.
    period_s : float
        Shortest time between two updates, seconds.
    gap_s : float
        Longest time that one update stands for, seconds: a pause is not made up for.
    undo_s : float
        Time of which the drift of a taxel is undone where a press is noticed, seconds at least,
        and twice that at most: it began before.
    """

    tau_s: float = 10.0
    most: float = 0.1
    sigmas: float = 4.0
    smooth_s: float = 0.5
    hold_s: float = 5.0
    period_s: float = 0.05
    gap_s: float = 0.5
    undo_s: float = 1.5


class Drift:
    """The drift of each taxel, in the unit of the forces.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    f_max, noise : float
        Upper end of the range, and standard deviation of an untouched taxel's noise, 0 if not
        known.
    rate : float
        Largest rate that is followed, in parts of f_max a second; 0: none is.

    Attributes
    ----------
    value : ndarray of float64, shape (rows, cols)
        The drift, to be subtracted from forces.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        f_max: float,
        noise: float,
        rate: float = DRIFT_RATE,
        tuning: DriftTuning = DriftTuning(),
    ) -> None:
        self._t = tuning
        self.rate = rate
        self._f_max = f_max
        self._most = tuning.most * f_max
        self.threshold = max(tuning.sigmas * noise, CONTACT_FRACTION * f_max)
        self.value: Doubles = np.zeros(shape)
        self._touched_ns: Doubles = np.full(shape, -np.inf)
        self._noise = noise
        self._last_ns: int | None = None
        self._forget()

    def _forget(self) -> None:
        """Begin anew with the next frame."""
        self._smooth: Doubles | None = None
        self._light = LightPresses(self.value.shape, self._noise, self._f_max)
        self._held: Mask = np.zeros(self.value.shape, np.bool_)
        self._sum: Doubles = np.zeros(self.value.shape)
        self._n = 0
        self._before, self._earlier = self.value.copy(), self.value.copy()
        self._since_s = 0.0

    def reset(self) -> None:
        """Forget the drift, as after a tare."""
        self.value[:] = 0.0
        self._touched_ns[:] = -np.inf
        self._forget()

    def update(self, forces: Doubles, stamp_ns: int) -> None:
        """Follow the drift by one frame.

        Parameters
        ----------
        forces : ndarray of float64, shape (rows, cols)
            Forces that are left after subtraction of the drift, not clipped.
        stamp_ns : int
            Time of the frame, nanoseconds; of frames within `period_s` the mean counts.
        """
        if not self.rate:
            return
        if self._last_ns is None or stamp_ns < self._last_ns:
            self._last_ns = stamp_ns
        dt_s = (stamp_ns - self._last_ns) / 1e9
        self._sum += forces
        self._n += 1
        if 0 < dt_s < self._t.period_s:
            return
        self._last_ns = stamp_ns
        mean, n = self._sum / self._n, self._n
        self._sum, self._n = np.zeros_like(mean), 0
        if self._smooth is None:
            self._smooth = mean.copy()
        self._smooth += (1 - math.exp(-dt_s / self._t.smooth_s)) * (mean - self._smooth)
        light = spread(self._light.update(mean, n, dt_s, self.rate))
        touched = spread((self._smooth > self.threshold) | (forces > 2 * self.threshold)) | light
        self._undo(touched & ~self._held, dt_s)
        self._held = touched
        self._touched_ns[touched] = stamp_ns
        dt_s = min(dt_s, self._t.gap_s)
        most = self.rate * self._f_max * dt_s
        step = np.clip(self._smooth * (dt_s / self._t.tau_s), -most, most)
        step[stamp_ns - self._touched_ns < self._t.hold_s * 1e9] = 0.0
        self.value += step
        np.clip(self.value, -self._most, self._most, out=self.value)

    def _undo(self, new: Mask, dt_s: float) -> None:
        """Take back what was followed of presses that are noticed now."""
        self.value[new] = np.minimum(self.value, self._earlier)[new]
        self._since_s += dt_s
        if self._since_s >= self._t.undo_s:
            self._since_s = 0.0
            self._before, self._earlier = self.value.copy(), self._before


def spread(touched: Mask) -> Mask:
    """A mask and the eight neighbours of each of its cells."""
    grown = touched.copy()
    grown[1:] |= touched[:-1]
    grown[:-1] |= touched[1:]
    across = grown.copy()
    grown[:, 1:] |= across[:, :-1]
    grown[:, :-1] |= across[:, 1:]
    return grown
