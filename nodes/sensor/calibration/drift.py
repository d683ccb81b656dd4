"""Slow drift of the baseline, followed only where a skin is untouched: docs/howto/calibration.md.

A constant force loses at most r t in the time t. A press loses none: above a threshold a taxel
counts as touched, and below it a press is told from drift by how fast it begins. Two low passes of
the force, of 0.5 s and 3 s, differ by

    j(t) = h (exp(-t / 3 s) - exp(-t / 0.5 s)),    0.58 h at most,

after a step of height h, and by 2.5 s times the rate under a drift. A press is a j above 5 standard
deviations, of a taxel or of the mean of 3 x 3: the noise of a mean of nine is a third. What rises
as slowly as a drift is one.
"""

import math
from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Mask, of_nine
from sparseskin.nodes.touch import touch_level

DRIFT_RATE = 1e-4
"""Largest rate of the drift that is followed, in parts of f_max a second: 0.6 % of f_max a minute.
Chosen: a force that rises unnoticed loses no more."""


@dataclass(frozen=True)
class DriftTuning:
    """Constants of the drift that is followed, and of light presses; all chosen."""

    tau_s: float = 10.0  # time constant: long against a touch, short against warming up
    max_drift: float = 0.1  # largest drift that is followed, in parts of f_max
    #: Threshold of a touch, in standard deviations of the noise; at least `CONTACT_FRACTION` of
    #: f_max. A taxel is touched where its smoothed force is above it, or one frame above twice of
    #: it: noise is not, with a drift of half the threshold either.
    sigmas: float = 4.0
    #: Time after a touch for which the drift of the taxel and of its eight neighbours is held: a
    #: reading creeps back after a press.
    hold_s: float = 5.0
    period_s: float = 0.05  # shortest time between two updates
    #: Longest time that one update stands for: a pause is not made up for.
    gap_s: float = 0.5
    #: Time of which the drift of a taxel is undone where a press is noticed, at least, and twice
    #: that at most: it began before.
    undo_s: float = 1.5
    #: Time constants of the low passes that find a step: a press is complete within the first,
    #: which is that of the smoothed force, too; the second leaves time to see it.
    fast_s: float = 0.5
    slow_s: float = 3.0
    #: Threshold of a step in standard deviations of j: of 10,000 taxels, noise passes it in one of
    #: an hour. The smallest one is in parts of f_max, where the noise is not known; and in what the
    #: bounded drift makes of j.
    step_sigmas: float = 5.0
    step_least: float = 0.001
    step_drifts: float = 2.0
    step_left: float = 0.5  # part of its largest rise below which a press is over


TUNING = DriftTuning()


class Drift:
    """The drift of each taxel, `value`, float64 (rows, cols), to be subtracted from forces, in
    their unit; a taxel is touched above `threshold`.

    `noise` is the standard deviation of an untouched taxel, 0 if not known; `rate` the largest one
    that is followed, in parts of f_max a second; 0: none is.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        f_max: float,
        noise: float,
        rate: float = DRIFT_RATE,
    ) -> None:
        self.rate = rate
        self._f_max = f_max
        self.threshold = touch_level(noise, f_max, TUNING.sigmas)
        # Of each taxel, and of the mean of it and its eight neighbours.
        self._sigma: Doubles = noise * np.array([1, 1 / 3]).reshape(2, 1, 1)
        self.value: Doubles = np.zeros(shape)
        self._last_ns: int | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the drift, as after a tare."""
        shape = self.value.shape
        self.value[:] = 0.0
        self._touched_ns: Doubles = np.full(shape, -np.inf)
        self._was_touched: Mask = np.zeros(shape, np.bool_)

        # Forces of the frames since the last update.
        self._sum: Doubles = np.zeros(shape)
        self._n = 0
        self._n_updates = 0

        # The drift at the last two times that it was kept, to return to where a press is noticed.
        self._kept_value: Doubles = np.zeros(shape)
        self._earlier_value: Doubles = np.zeros(shape)
        self._since_s = 0.0

        # Of each taxel, and of the mean of it and its eight neighbours: the two low passes; force
        # before a press, and largest rise since; True while pressed.
        self._fast: Doubles = np.zeros((2, *shape))
        self._slow: Doubles = np.zeros((2, *shape))
        self._base: Doubles = np.zeros((2, *shape))
        self._rise: Doubles = np.zeros((2, *shape))
        self._risen: Mask = np.zeros((2, *shape), np.bool_)

    def update(self, forces: Doubles, stamp_ns: int) -> None:
        """Follow the drift by a frame of the time `stamp_ns`: forces that are left after
        subtraction of the drift, not clipped. Of frames within `period_s` the mean counts.
        """
        if not self.rate:
            return
        # A recording that begins again has earlier stamps.
        if self._last_ns is None or stamp_ns < self._last_ns:
            self._last_ns = stamp_ns
        dt_s = (stamp_ns - self._last_ns) / 1e9
        self._sum += forces
        self._n += 1
        if 0 < dt_s < TUNING.period_s:
            return

        self._last_ns = stamp_ns
        pressed = self._lightly_pressed(self._sum / self._n, dt_s)
        self._sum = np.zeros_like(forces)
        self._n = 0

        touched = pressed | (forces > 2 * self.threshold)
        touched |= self._fast[0] > self.threshold
        # The neighbours of a touched taxel carry a part of the load.
        touched = of_nine(touched, np.logical_or)

        # What was followed since shortly before a touch was its onset.
        newly_touched = touched & ~self._was_touched
        undone = np.minimum(self.value, self._earlier_value)
        self.value[newly_touched] = undone[newly_touched]

        self._since_s += dt_s
        if self._since_s >= TUNING.undo_s:
            self._since_s = 0.0
            self._earlier_value = self._kept_value
            self._kept_value = self.value.copy()
        self._was_touched = touched

        self._touched_ns[touched] = stamp_ns
        self._follow(min(dt_s, TUNING.gap_s), stamp_ns)

    def _follow(self, dt_s: float, stamp_ns: int) -> None:
        """Add what the smoothed force shows of the drift in `dt_s`, where nothing touches."""
        max_step = self.rate * self._f_max * dt_s
        step = self._fast[0] * (dt_s / TUNING.tau_s)
        np.clip(step, -max_step, max_step, out=step)
        since_touch_ns = stamp_ns - self._touched_ns
        step[since_touch_ns < TUNING.hold_s * 1e9] = 0.0
        self.value += step

        max_value = TUNING.max_drift * self._f_max
        np.clip(self.value, -max_value, max_value, out=self.value)

    def _lightly_pressed(self, mean: Doubles, dt_s: float) -> Mask:
        """Taxels under presses too light for a touch, by the mean of the last dt_s seconds."""
        self._n_updates += 1
        means = np.stack([mean, of_nine(mean, np.add) / 9])

        # At first the mean of all: one frame would be believed for as long as the slow low pass.
        fast = max(1 - math.exp(-dt_s / TUNING.fast_s), 1 / self._n_updates)
        slow = max(1 - math.exp(-dt_s / TUNING.slow_s), 1 / self._n_updates)
        self._fast += fast * (means - self._fast)
        self._slow += slow * (means - self._slow)

        # A fall of the same size ends a press, too.
        step = self._fast - self._slow
        threshold = self._step_threshold(fast, slow)
        self._risen &= step > -threshold
        begins = (step > threshold) & ~self._risen
        self._base[begins] = self._slow[begins]
        self._rise[begins] = 0.0
        self._risen |= begins

        # A press is over once most of its rise is gone.
        rise = self._fast - self._base
        np.maximum(self._rise, rise, out=self._rise)
        self._risen &= rise >= TUNING.step_left * self._rise

        pressed: Mask = np.logical_or(*self._risen)
        return pressed

    def _step_threshold(self, fast: float, slow: float) -> Doubles:
        """Difference of the low passes, with these coefficients, that neither noise nor drift has:
        of a taxel, and of a mean of nine, (2, 1, 1).
        """
        # Variance of a first-order low pass of white noise: a / (2 - a) of it.
        variance = fast / (2 - fast) + slow / (2 - slow)
        sigma = self._sigma * math.sqrt(variance / self._n)

        # The difference under the largest drift: see the module.
        drift = TUNING.step_drifts * self.rate * (TUNING.slow_s - TUNING.fast_s)
        smallest = max(TUNING.step_least, drift) * self._f_max
        return np.maximum(TUNING.step_sigmas * sigma, smallest)
