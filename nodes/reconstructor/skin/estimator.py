"""The method of the default solver, from frame to frame: of one patch, or of several at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.base import UNREAD
from sparseskin.nodes.numerics.arrays import TINY
from sparseskin.nodes.sensor.noise import NoiseModel

from .backend import ONE, Array, Backend, Number
from .gates import SHIFTS
from .rows import Rows
from .tuning import SkinTuning
from .vectors import FrameVectors, Settled, Steps

RESOLUTION = float(np.finfo(np.float32).eps)
"""Relative resolution of measurements: a noise below it does not show in them."""
CONVERGED, N_FORMULA = 8, 3
"""Steps of a frame that need no others before them; steps by the formula before fewer. Measured on
five recordings and on presses at N/3: 3 and 1 have less error than 3 alone, in less time."""
REPEATED = 1e6
"""Noise variance of a measurement that repeats exactly and was predicted, in that of others."""
SAME = 1e-6
"""Largest change of measurements, in the largest one, at which half of them counts as repeated:
above the resolution of float32, below that of any converter."""
INVISIBLE = 1e-3
"""Force that is returned as 0, in deviations of the noise: what earlier contacts leave."""
DUST = 1e-6
"""Squared length of Phi 1 a taxel up to which it is 0 but for rounding: no row of the subset sees
a bias. Derived: float32 leaves 1e-12, one row of +1 has 32 / N, above 1e-6 up to 3e7 taxels."""


class SkinEstimator:
    """Estimates frames in a constant number of steps, with the error of each.

    1. The bias b of noise that is clipped at 0 is subtracted from the measurements.
    2. The last frame x predicts this one: x_p = (1 + a0) x + a1 dx/drow + a2 dx/dcol, by ridge
       least squares on the innovation, scaled by what it explains.
    3. The noise variance R is the part of the innovation that does not repeat when the same rows
       are read again. P + R is its mean square: P, averaged over frames, is the error variance of
       the prediction.
    4. Each row has a Kalman filter of its own, of mean w and variance n + g: what the noise of its
       measurements left, and what has changed since. The mean moves as the prediction does; what
       the mean squared innovation of the rows read exceeds n + g + R by has changed in all rows.
       The prediction, of variance L = c P (1 + d P / R), and the filter give the expected value of
       each row, by their precisions; regression on the rows read gives the part of what the filter
       adds that counts. With the measurements, these are the target of each row, of variance v.
    5. Steps from z = x_p: r = target - W z; tau = mean r^2, less the mean v, of the rows read;
       D = tau / (tau + v); s^2 = tau (1 - mean D) / mean D; u = z + W^T (D r) / mean D;
       x, alpha = `Gates` of u / s, or `shrink` of it in the first steps of a frame that has few;
       z moves half the way to (x - alpha u) / (1 - alpha).
    6. The errors of z do not depend on the noise of the measurements: their mean squared residual
       less R is the error variance E of the last three x; where that is within the noise, alpha s^2
       counts. The estimate is the mean of these x and of x_p, by E and P.

    There is no branch on what was measured: patches differ in their numbers alone.

    Parameters
    ----------
    rows : Rows
        W.
    vectors : FrameVectors
        The work on vectors.
    tuning : SkinTuning
    backend : OnePatch or ManyPatches
        As of the vectors.

    Attributes
    ----------
    noise_sd : number
        Least standard deviation of the noise of a taxel that the skin states; 0: none. The caller
        sets it.
    noise_model : NoiseModel or None
        Noise of the readings; None: not stated. The caller sets it.
    noise, bias : number
        Noise variance of a measurement, and mean reading of an untouched taxel, as known so far.
    error, stated_error, trusted : number
        Estimated RMS error of a taxel of the last frame, by which the next one is predicted; the
        same for others, by the noise that is stated, if any; whether it is trusted.

    Notes
    -----
    Source: Ma, Ping, "Orthogonal AMP", IEEE Access 5, 2017; Metzler, Mousavi, Baraniuk, "Learned
    D-AMP", NeurIPS 2017, for a learned denoiser in it; Mehra, "On the identification of variances
    and adaptive Kalman filtering", IEEE Trans. Automatic Control 15(2), 1970, for the noise level.
    """

    #: Numbers that a frame leaves to the next one.
    STATE = (
        *("noise", "bias", "error", "trusted", "_least_noise", "_trust", "_signal"),
        *("_n_seen", "_n_frames", "_n_repeats", "_left2", "_silence", "_pressed"),
        "stated_error",
    )

    def __init__(
        self, rows: Rows, vectors: FrameVectors, tuning: SkinTuning, backend: Backend = ONE
    ) -> None:
        self._rows, self._vectors, self._t = rows, vectors, tuning
        self._o: Any = backend
        self.noise_sd: Number = backend.zero
        self.noise_model: NoiseModel | None = None
        #: By row subset: the last measurements and innovation, and whether there were any; Phi 1,
        #: and its squared length.
        self.last: dict[str, tuple[Array, Array, Number]] = {}
        self._ones: dict[str, tuple[Array, Number]] = {}
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        zero = self._o.zero
        self._vectors.forget()
        self.last.clear()
        self.noise = self.bias = self._least_noise = self._signal = zero
        self.error = self.stated_error = zero
        self._n_seen = self._n_frames = self._n_repeats = self._left2 = self._silence = zero
        self._pressed = zero
        self._trust = zero + 1
        self.trusted = self._o.false == self._o.false
        self.n_shifts = 0

    def start_from(self, x: Array) -> None:
        """Take x, float32 (n,), for the last estimate."""
        self._vectors.start_from(x)

    def forget_rows(self) -> None:
        """Keep the estimate alone: the rows are those of another W."""
        self._vectors.forget_rows()

    def begin(self, subset: str, y: Array) -> None:
        """Begin a frame of measurements y, float32 (m,), of the row subset that the rows are for;
        `subset` is its fingerprint.
        """
        o, t, vectors = self._o, self._t, self._vectors
        # Of this frame alone: one frame of garbage must not blind those after it.
        power = o.total(o.f64(y) ** 2) / y.shape[-1]
        self._floor = o.maximum(RESOLUTION**2 * power, o.zero + TINY)
        self._ones_now = ones, _ = self._ones_of(subset)
        self._values = values = self._rows.values(y) - o.f32(self.bias) * ones
        vectors.predict(values, o.maximum(self.noise, self._floor), self.error**2)
        e2 = vectors.innovation2
        last_y, last, known = self.last.get(subset) or (y, vectors.innovation, o.false)
        self._largest = o.largest(o.xp.abs(y))
        change = o.largest(o.xp.abs(y - last_y)) / (SAME * self._largest + TINY)
        self._repeated = known / (1 + o.minimum(change, o.zero + 1e3) ** 8)
        noise = self._follow_noise(last, known * (1 - self._repeated), e2)
        self.last[subset] = y, vectors.innovation, o.false == o.false
        now = t.surplus(e2, noise, values.shape[-1], o)
        signal = self._follow_signal(e2, noise, now)
        # Of rows that are never read, the innovation says nothing: the last estimate's own error.
        least = o.maximum(self.error**2, self._floor)
        # A measurement that repeats exactly is not another one, but where the forces have changed
        # since, and have come back.
        explained = noise / (noise + now)
        doubt = (1 + self._repeated * REPEATED * explained**2) * noise
        vectors.filter_rows(values, doubt, signal, least, self._floor)
        self._steps = Steps(vectors.predicted[None], [signal], [e2])
        # Noise grows with the forces, but not without bound: what exceeds it, no force explains.
        known = self._n_seen > 1 / t.noise_rate + 0.5
        most = o.where(known, t.louder * self._least_noise, self.noise)
        self._judged_noise, self._known_noise = o.minimum(noise, most), o.minimum(self.noise, most)

    def _ones_of(self, subset: str) -> tuple[Array, Number]:
        """Phi 1 of the row subset, float32 (n_read,), and its squared length."""
        if subset not in self._ones:
            ones = self._rows.forward(self._o.zeros(self._rows.n) + 1)[..., self._rows.read]
            self._ones[subset] = ones, self._o.dot(ones, ones)
        return self._ones[subset]

    def _follow_noise(self, last: Array, counts: Number, e2: Number) -> Number:
        """Update the noise level; return it times the trust in it.

        e2 is the mean square of the innovation, `last` the innovation when these rows were read
        before, `counts` the part of it that shows noise. Where an innovation points along the last
        correction, that was too small: what seems noise is motion.
        """
        o, t = self._o, self._t
        size = last.shape[-1]
        seen = o.maximum(o.dot(last, last - self._vectors.innovation) / size, o.zero)
        n_seen = self._n_seen + 1
        rate = o.maximum(1 / n_seen, o.zero + t.noise_rate)
        known = n_seen > 1 / t.noise_rate + 0.5  # parts of 1 that do not count add up to less
        level = self.noise + rate * (seen - self.noise)
        # What the last forces explained of their measurements was no noise.
        most = t.noise_growth * o.maximum(self.noise, self._left2)
        least, level = level, o.minimum(level, most)
        # Of an untouched taxel it is the least one so far, of which sampling errors are known.
        if size >= t.least_read:
            most = (1 + t.significant * math.sqrt(2 / size)) * self._least_noise
            most = most * (1 + t.pressed_noise * self._pressed)
            level = o.where(known, o.minimum(level, most), level)
        least = o.where(known, o.minimum(t.bias_forgotten * self._least_noise, level), least)
        self._n_seen = self._n_seen + counts
        self._least_noise = counts * least + (1 - counts) * self._least_noise
        noise = counts * o.minimum(level, e2) + (1 - counts) * self.noise
        self.noise = o.maximum(o.maximum(noise, self._floor), self.noise_sd**2)
        off = t.lagging / math.sqrt(size) - self._vectors.alike
        trust = self._trust * o.exp(o.minimum(off, o.zero + t.trust_growth))
        self._trust = o.minimum(o.maximum(trust, o.zero + t.least_trust), o.zero + 1)
        return o.maximum(self.noise * self._trust, self._floor)

    def _follow_signal(self, e2: Number, noise: Number, now: Number) -> Number:
        """Mean squared error of the prediction: the excess of e2 over the noise, averaged; `now` is
        what of it is significant.
        """
        o, n_read = self._o, self._values.shape[-1]
        signal = self._signal + self._t.signal_rate * (e2 - noise - self._signal)
        most = o.maximum(e2 - noise, o.zero) + 2 * noise * math.sqrt(2 / n_read)
        self._signal = o.maximum(o.minimum(signal, most), now / 2)
        return o.maximum(o.maximum(self._signal, now), o.zero)

    def finish(self, n: int, n_formula: int) -> Array:
        """Do `n_formula` steps by the formula and n by the weights, if any; return the forces of
        the frame, float32 (n,), in the order of the rows' taxels.
        """
        o, t, noise = self._o, self._t, self._judged_noise
        if n:
            self._steps = self._vectors.steps(self.n_shifts, self._floor, n_formula, n)
            self.n_shifts = (self.n_shifts + n_formula + n) % len(SHIFTS)
        own, residual2 = (
            _mean(numbers[-t.averaged :]) for numbers in (self._steps.errors, self._steps.residuals)
        )
        silent = self._largest == 0  # nothing presses
        some = o.f32(o.where(silent, o.zero, o.zero + 1))
        estimates = [some * one for one in self._steps.estimates]
        self._vectors.predicted = some * self._vectors.predicted
        last_error2, error2 = self.error**2, self._error2(own, residual2, noise)
        prior = t.blend * o.maximum(o.maximum(self._signal, last_error2), self._floor)
        part = error2 / (error2 + prior)
        settled = self._vectors.settle(
            *(estimates, part, self._values, self._ones_now[0], self.bias),
            *(o.sqrt(self._least_noise), INVISIBLE * o.sqrt(noise)),
        )
        power, self._pressed = settled.power, settled.pressed
        self._left2 = self._repeated * self._left2 + (1 - self._repeated) * settled.residual2
        # What the noise of measurements left in the last estimate, the same measurements leave.
        left = self._repeated * o.minimum(last_error2, noise)
        error2 = o.maximum((1 - part) * error2, left)
        self.error = o.sqrt(error2)
        stated, lacking, excess = self._known_noise, o.zero, t.unexplained
        if self.noise_model is not None:
            stated = o.total(self.noise_model.variance(settled.forces)) / self._rows.n
            stated = o.minimum(stated, self.noise)
            # Gates keep or drop: the noise that the residual lacks is in the estimate.
            lacking = stated - settled.residual2
            excess = min(excess, t.unresolved * math.sqrt(2 / self._values.shape[-1]))
        error2 = self._error2(t.optimism * own, residual2, stated, t.significant / 2)
        # Without noise, the errors are between the residuals before a fit and after it.
        fitted = o.sqrt(o.sqrt(residual2**3 * settled.residual2))
        few = (1 + 1 / math.sqrt(self._values.shape[-1])) ** 2
        error2 = few * o.minimum((1 - part) * error2, fitted)
        # Where many rows are never read, the same measurements leave the same errors: repeats lower
        # them at most as other measurements would.
        some = self._vectors.n_known < (1 - UNREAD) * self._rows.n
        again = o.where(some, self._repeated, o.zero)
        self._n_repeats = again * (self._n_repeats + 1)
        least = again * self.stated_error**2 * self._n_repeats / (self._n_repeats + 1)
        error2 = o.maximum(o.maximum(error2, left), o.maximum(lacking, least))
        self.stated_error = o.sqrt(error2)
        # Until it is known, the bias passes for forces on all taxels.
        known = self._n_frames > t.bias_known + 0.5
        most = o.where(known, o.zero + t.untouched, o.zero + t.most_bias**2)
        # Of a skin that was silent, what no force explains is hardly noise, unless it is stated.
        more = self._silence + t.noise_rate * (1 - self._silence)
        self._silence = o.where(silent, more, t.silence_kept * self._silence)
        less = o.maximum(noise * (1 - self._silence), self.noise_sd**2)
        noise = o.where(silent, noise, less)
        of_skin = noise / self._trust  # whatever passes for it in motion
        excess = o.where(known, o.zero + excess, o.zero + t.unexplained)
        untouched = (power <= most * of_skin) & (settled.residual2 <= (1 + excess) * of_skin)
        self.trusted = untouched | (error2 <= t.trusted**2 * power)
        self._follow_bias(settled)
        return settled.forces

    def _error2(
        self, own: Number, residual2: Number, noise: Number, doubtful: float = 1.0
    ) -> Number:
        """Mean squared error of the mean of the last estimates, where measurements have a noise.

        The errors of z do not depend on the noise of the measurements: their mean squared residual
        exceeds the noise by them. Where that is not significant, within `doubtful` sampling
        deviations, the expectation `own` counts.
        """
        seen = self._o.maximum(residual2 - noise, self._o.zero)
        doubt = doubtful * (seen + noise) * math.sqrt(2 / self._values.shape[-1])
        share = seen * seen / (seen * seen + doubt * doubt + TINY)
        return share * seen + (1 - share) * own

    def _follow_bias(self, settled: Settled) -> None:
        """Update the mean reading of an untouched taxel: by residual along Phi 1, and taxels."""
        o, t, n, energy = self._o, self._t, self._rows.n, self._ones_now[1]
        noise = o.sqrt(self._least_noise)
        along = o.where(energy > DUST * n, settled.along / (energy + TINY), o.zero)
        more = along + settled.unpressed / n
        n_frames = self._n_frames + 1
        rate = o.maximum(t.bias_begins / (n_frames + t.bias_begins), o.zero + t.bias_rate)
        bias = self.bias + rate * o.minimum(o.maximum(more, -noise / 2), noise / 2)
        bias = o.minimum(o.maximum(bias, o.zero), t.most_bias * noise)
        # The same measurements are no others.
        self._n_frames = n_frames - self._repeated
        bias = (1 - self._repeated) * bias + self._repeated * self.bias
        self.bias = o.where(bias < 1e-3 * noise, o.zero, bias)  # or 1 / b could overflow float32


def _mean(numbers: Sequence[Number]) -> Number:
    return sum(numbers[1:], numbers[0]) / len(numbers)
