"""The method of the default solver, from frame to frame: all that is decided by numbers."""

from __future__ import annotations

import math

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel

from .bias import Bias
from .noise_level import NoiseLevel
from .prediction import PredictionError, motion_of
from .row_subset import FrameNumbers, Level, RowSubset
from .rows import Rows
from .tiles import SHIFTS
from .trust import CommonError, Fit, StatedError, TaxelNoise, Trust, estimate_error2
from .tuning import SkinTuning
from .vectors import (
    N_FORMULA,
    UNKNOWN,
    Blend,
    Innovation,
    RowVariances,
    Settled,
    StepPlan,
    Steps,
    StepTimes,
    Vectors,
)

REPEATED = 1e6
"""Noise variance of a measurement that repeats exactly and was predicted, in units of that of
others."""
INVISIBLE = 1e-3
"""Force that is returned as 0, in deviations of the noise: what earlier contacts leave."""


class SkinEstimator:
    """Estimates frames in a constant number of steps, with the error of each.

    1. The bias b of noise that is clipped at 0 is subtracted from the measurements (`Bias`).
    2. The last frame x predicts this one: x_p = (1 + a0) x + a1 dx/drow + a2 dx/dcol, by ridge
       least squares on the innovation, scaled by what it explains (`motion_of`).
    3. The noise variance R is the part of the innovation that does not repeat when the same rows
       are read again, and that no change of the prediction explains (`NoiseLevel`). P + R is its
       mean square: P, averaged over frames, is the error variance of the prediction
       (`PredictionError`).
    4. Each row has a Kalman filter of its own, of mean w and variance n + g: what the noise of its
       measurements left, and what has changed since. The mean moves as the prediction does, in the
       part that the innovations of the filters confirm. What the mean squared innovation of the
       rows read exceeds n + g + R by has changed in all rows.
    5. The prediction, of variance L = c P (1 + d P / R), and the filter give the expected value of
       each row, by their precisions. Regression on the rows read gives the part h of what the
       filter adds that counts. The variance is L^(1-h) C^h, with C of both together. With the
       measurements, these are the target of each row, of variance v.
    6. Steps k = 1, 2 ... from z = x_p: r = target - W z; tau = mean r^2, less the mean v, of the
       rows read; D = tau / (tau + v), its mean over all rows; s^2 = tau (1 - mean D) / mean D;
       u = z + W^T (D r) / mean D; x, alpha = `Gates` of u / s, or `shrink` of it in the first steps
       of a frame that has few; z moves by min(1, 8 / k) / 2 of the way to
       (x - alpha u) / (1 - alpha).
    7. The errors of z do not depend on the noise of the measurements: their mean squared residual
       less R is the error variance E of the mean of all x. Its weights rise with k, and are divided
       by the square of that residual. Where E is within the noise, alpha s^2 counts. The estimate
       is the mean of this mean and of x_p, by E and P.

    A measurement that no force explains has a larger variance than R: its part p that is doubted
    (`Vectors.begin`) adds p e^2 / (1 - p), with its change e since the last frame. It is never
    replaced by another value.

    Numbers are decided here and in the classes named above; `Vectors` does the work on vectors.

    Parameters
    ----------
    rows : Rows
        W.
    vectors : Vectors
        The work on vectors.
    tuning : SkinTuning

    Attributes
    ----------
    noise_sd : float
        Least standard deviation of the noise of a taxel that the skin states, by which the noise
        level is bounded; 0: none. The caller sets it.
    noise_model : NoiseModel or None
        Noise of a reading by its force, by which the published error is judged; None: not stated,
        the noise level counts. The caller sets it.
    times : StepTimes
        What the steps of a frame may take, where it chooses their number. The caller sets it.
    steps : Steps
        Those of the last frame.
    vectors, noise_level, prediction_error, bias, stated_error, common_error, trust
        The state from frame to frame.
    error : float
        Estimated RMS error of a taxel of the last frame, by which the next one is predicted.

    Notes
    -----
    Source: Ma, Ping, "Orthogonal AMP", IEEE Access 5, 2017; Metzler, Mousavi, Baraniuk, "Learned
    D-AMP", NeurIPS 2017, for a learned denoiser in it.
    """

    def __init__(self, rows: Rows, vectors: Vectors, tuning: SkinTuning) -> None:
        self._rows = rows
        self._tuning = tuning
        self._subsets: dict[str, RowSubset] = {}
        self.vectors = vectors
        self.noise_level = NoiseLevel(tuning)
        self.prediction_error = PredictionError(tuning)
        self.bias = Bias(tuning)
        self.stated_error = StatedError(tuning)
        self.common_error = CommonError(tuning)
        self.trust = Trust(tuning)
        self.noise_sd = 0.0
        self.noise_model: NoiseModel | None = None
        self.times = StepTimes()
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.vectors.forget()
        for subset in self._subsets.values():
            subset.was_read = False
        self.noise_level.forget()
        self.prediction_error.forget()
        self.bias.forget()
        self.stated_error.forget()
        self.common_error.forget()
        self.trust.forget()
        self.error = 0.0
        self._last_subset: RowSubset | None = None
        self._level = Level()
        self._n_shifts = 0

    def begin(self, fingerprint: str, y: Floats, faulty: Floats | None = None) -> None:
        """Begin a frame of measurements y, float32 (m,), of the row subset that the rows are for,
        which has this fingerprint: predict it, and set the targets of its rows.

        `faulty`, float32 (n_read,), is 1 for a row read whose value is not to count; None: all do.
        """
        if fingerprint not in self._subsets:
            self._subsets[fingerprint] = RowSubset(self._rows, len(y))
        subset = self._subsets[fingerprint]
        is_first = self._last_subset is None
        self._is_new = not is_first and subset is not self._last_subset
        self._last_subset = subset
        subset.faulty[:] = 0 if faulty is None else faulty
        last_noise = self.noise_level.variance
        comparison, sums = self.vectors.begin(y, subset, self.bias.value, last_noise)
        frame = subset.numbers(comparison, self._level)
        self._subset = subset
        self._frame = frame

        noise_before = max(last_noise, frame.floor)
        motion = motion_of(sums, noise_before, self.error**2, self._tuning)
        innovation = self.vectors.predict(motion)
        self._innovation2 = innovation.mean_square
        noise = self._follow_noise(innovation, frame)
        subset.keep(y, self.vectors.innovation, self.vectors.predicted)
        error2 = self.prediction_error.follow(
            innovation.mean_square, noise, frame.n_read
        )
        self._filtered = self.vectors.filter_rows(
            self._row_variances(innovation, noise, error2, frame)
        )

        # The error of the estimate is judged by no more noise than the skin has shown.
        self._bounded_noise = self.noise_level.bounded(noise)
        # Those of the prediction, should the frame have no step.
        self.steps = Steps(expected2=error2, residual2=innovation.mean_square)

    def _follow_noise(self, innovation: Innovation, frame: FrameNumbers) -> float:
        """Update the noise level; return the noise variance of the frame: the level times the trust
        in it.
        """
        level = self.noise_level
        if self._subset.was_read:
            level.follow(innovation, frame)
        level.keep_above(frame.floor, self.noise_sd)
        level.follow_trust(innovation.correlation, frame.n_read)
        return max(level.variance * level.trust, frame.floor)

    def _row_variances(
        self, innovation: Innovation, noise: float, error2: float, frame: FrameNumbers
    ) -> RowVariances:
        """Return the variances of the rows, by the noise variance of a measurement and the mean
        squared error of the prediction.
        """
        tuning = self._tuning
        # A measurement that repeats exactly is not another one, but where the forces have changed
        # since, and have come back.
        noise_share = noise / (noise + self.prediction_error.significant)
        read_noise = (1 + frame.repeated * REPEATED * noise_share**2) * noise

        # Of rows that are never read, the innovation shows nothing: the last estimate's own error.
        prediction2 = max(error2, self.error**2, frame.floor)

        # What the filters of the rows read had not expected has changed in all rows.
        change = error2
        if 2 * innovation.n_known > frame.n_read:
            n_known = innovation.n_known
            expected = read_noise + innovation.filter_variances / n_known
            change = tuning.surplus(
                innovation.filter_squares / n_known, expected, frame.n_read
            )

        prediction = min(tuning.of_dependent(prediction2, read_noise), UNKNOWN)
        return RowVariances(read_noise, prediction, change, frame.floor)

    def finish(self, n: int, n_formula: int) -> Floats:
        """Do `n_formula` steps by the formula and n by the weights, if any, or as many of these as
        `times` allows; return the forces of the frame, float32 (n,), in the order of the rows'
        taxels.
        """
        if n:
            self._iterate(n, n_formula)
        self.vectors.fade(self._frame.silent)
        fit = self._settle(self.steps, self._frame)
        self._judge(fit, self._frame)
        self.bias.follow(
            fit.settled,
            self._subset,
            self._rows.n,
            self.noise_level.least,
            self._frame.repeated,
        )
        return fit.settled.forces

    def _iterate(self, n: int, n_formula: int) -> None:
        """Do the steps of the frame."""
        counts = self.times.frame > 0
        plan = StepPlan(
            n_formula=N_FORMULA if counts else n_formula,
            n=1 if counts else n,
            first_shift=self._n_shifts,
            frame_tiles=self.times.frame,
            step_tiles=self.times.step,
            most=n,
            target_variance=self._filtered.target_variance,
            floor=self._frame.floor,
        )
        self.steps = self.vectors.steps(plan)
        self._n_shifts = (self._n_shifts + self.steps.n_formula + self.steps.n) % len(
            SHIFTS
        )

    def _settle(self, steps: Steps, frame: FrameNumbers) -> Fit:
        """Make the estimate of the steps and the prediction, by the error of each."""
        last_error2 = self.error**2
        error2 = estimate_error2(steps, self._bounded_noise, frame.n_read)
        prediction2 = max(self.prediction_error.variance, last_error2, frame.floor)
        part = error2 / (error2 + self._tuning.blend * prediction2)

        blend = Blend(
            part=part,
            bias=self.bias.value,
            noise_sd=math.sqrt(self.noise_level.least),
            least_force=INVISIBLE * math.sqrt(self._bounded_noise),
        )
        settled = self.vectors.settle(blend, self._subset.ones)
        self.noise_level.learn(settled, frame.repeated)

        # What the noise of measurements left in the last estimate, the same measurements leave.
        inherited2 = frame.repeated * min(last_error2, self._bounded_noise)
        self.error = math.sqrt(max((1 - part) * error2, inherited2))
        known = self._filtered.n_known / self._rows.n
        return Fit(
            steps,
            settled,
            part,
            inherited2,
            known,
            read=frame.read,
            innovation2=self._innovation2,
            is_new=self._is_new,
        )

    def _judge(self, fit: Fit, frame: FrameNumbers) -> None:
        """Set the stated error, and whether the estimate is trusted."""
        noise = self._taxel_noise(fit.settled)
        error2 = self.stated_error.follow(fit, noise, frame)
        self.common_error.follow(fit.settled)
        self.trust.follow_silence(frame.silent)

        level = self.noise_level
        of_skin = self.trust.noise_of_skin(
            self._bounded_noise, level, frame, self.noise_sd
        )
        excess = self.trust.excess(noise, frame.n_read, self.bias.is_known)
        self.trust.judge(fit.settled, error2, of_skin, excess, self.bias.is_known)

    def _taxel_noise(self, settled: Settled) -> TaxelNoise:
        """Noise of the readings of the frame."""
        level = self.noise_level
        if self.noise_model is None:
            variance = level.bounded(level.variance)
            return TaxelNoise(variance, missing=0.0, is_stated=False, trust=level.trust)
        stated = self.vectors.mean_variance(settled.forces, self.noise_model)
        variance = min(stated, level.variance)
        # Gates keep or drop: the noise that the residual lacks is in the estimate.
        return TaxelNoise(
            variance, missing=variance - settled.residual2, is_stated=True
        )
