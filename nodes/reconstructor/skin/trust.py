"""The error of an estimate that is published, and whether the estimate is trusted."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.compressor.phi.base import UNREAD
from sparseskin.nodes.numerics.arrays import TINY, Floats

from .noise_level import NoiseLevel
from .row_subset import FrameNumbers
from .tuning import SkinTuning
from .vectors import Settled, Steps


class Fit(NamedTuple):
    """The estimate of a frame and how it fits the measurements."""

    steps: Steps
    settled: Settled
    part: float  # weight of the prediction in the estimate
    inherited2: float  # squared error that repeated measurements leave as it was
    known: float  # part of the rows that was ever read
    read: float  # part of the rows that this frame has read
    innovation2: float = 0.0  # mean squared innovation of the rows read
    is_new: bool = False  # True if the last frame has not read these rows

    @property
    def distance2(self) -> float:
        """Mean squared distance of the estimate of the steps from what all rows would read.

        It is known in the rows read; in the others it is that of the rows read, each left out.
        """
        left_out2 = self.settled.left_out2 / max((1 - self.part) ** 2, TINY)
        return self.read * self.settled.residual2 + (1 - self.read) * left_out2


class TaxelNoise(NamedTuple):
    """Noise of a frame, as far as the skin states it."""

    variance: float  # mean variance of a reading
    missing: float  # what the residual lacks of it
    is_stated: bool
    trust: float = 1.0  # part of a variance that is not stated which counts as noise

    @property
    def at_least(self) -> float:
        """The part of the variance that is no motion."""
        return self.variance if self.is_stated else self.trust * self.variance


def estimate_error2(
    steps: Steps,
    noise: float,
    n_read: int,
    doubtful: float = 1.0,
    optimism: float = 1.0,
) -> float:
    """Return the mean squared error of the mean of the estimates of steps.

    The errors of z do not depend on the noise of the measurements: their mean squared residual
    exceeds the noise by them. Where that is not significant, within `doubtful` sampling deviations,
    `optimism` times the expectation of the denoiser counts.
    """
    excess = max(steps.residual2 - noise, 0.0)
    deviation = doubtful * (excess + noise) * math.sqrt(2 / n_read)
    share = excess * excess / (excess * excess + deviation * deviation + TINY)
    return share * excess + (1 - share) * (optimism * steps.expected2)


class Confirmation:
    """Part of a stated squared error that rows confirm which took no part in it, 0 to 1.

    Rows that the last frame has not read are the only measurements that the last estimate does not
    know. Their squared innovation less the noise is its squared error and that of the motion since:
    it shows an error that is stated too large, never one that is too small. The part follows by
    ridge regression; frames count by the inverse variance of their mean square.

    Notes
    -----
    Source: an online recalibration of intervals by their own residuals, as in Gibbs, Candes,
    "Adaptive conformal inference under distribution shift", NeurIPS 2021 (arXiv 2106.00170); by
    least squares in place of counts, which show nothing of errors far below the noise.
    """

    def __init__(self, tuning: SkinTuning) -> None:
        self._tuning = tuning
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.part = 1.0
        self._products = 0.0
        self._squares = 0.0

    def follow(
        self, stated2: float, innovation2: float, noise: float, n_read: int
    ) -> None:
        """Update the part by n_read new rows: the squared error that was stated of such a row, the
        mean square of their innovation, and the noise variance.
        """
        shown2 = max(innovation2 - noise, 0.0)
        memory = 1 - self._tuning.share_rate
        # A mean square of n numbers of variance v has the variance 2 v^2 / n.
        weight = n_read / 2 / ((stated2 + noise) ** 2 + TINY)
        self._products = memory * self._products + weight * shown2 * stated2
        self._squares = memory * self._squares + weight * stated2 * stated2
        ridge = self._tuning.belief
        self.part = min((self._products + ridge) / (self._squares + ridge), 1.0)


class StatedError:
    """Estimated RMS error of a taxel, for those who use the forces.

    Attributes
    ----------
    value : float
        That of the last frame, so far as it is confirmed.
    """

    def __init__(self, tuning: SkinTuning) -> None:
        self._tuning = tuning
        self._confirmation = Confirmation(tuning)
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.value = 0.0
        self._last2 = 0.0  # square of the last error, before it is confirmed
        self._share = 1.0  # of errors in the squared distance from the readings
        self._n_repeats = 0.0
        self._confirmation.forget()

    def follow(self, fit: Fit, noise: TaxelNoise, frame: FrameNumbers) -> float:
        """Update the error; return its square before it is confirmed."""
        if fit.is_new:
            # All of the last error was in rows that its frame had not read.
            of_row2 = self._last2 / max(1 - fit.read, TINY)
            self._confirmation.follow(
                of_row2, fit.innovation2, noise.at_least, frame.n_read
            )

        error2 = self._unconfirmed(fit, noise, frame)
        self._last2 = error2
        self.value = math.sqrt(self._confirmation.part * error2)
        return error2

    def _unconfirmed(self, fit: Fit, noise: TaxelNoise, frame: FrameNumbers) -> float:
        """The squared error by the rows of the frame alone."""
        tuning = self._tuning
        error2 = estimate_error2(
            fit.steps,
            noise.variance,
            frame.n_read,
            tuning.significant / 2,
            tuning.optimism,
        )
        # The errors of the prediction are others in the rows that were read alone.
        error2 = (1 - fit.known * fit.part) * error2

        # What is no error in the distance from the readings is their noise.
        distance2 = fit.distance2
        share = min(error2, distance2) / (distance2 + TINY)
        self._share += tuning.share_rate * (share - self._share)
        # The mean of 1 / s^2 is larger by 2 / M, s^2 a mean square of M numbers.
        error2 = (1 + 2 / frame.n_read) * self._share * distance2

        # Where many rows are never read, the same measurements leave the same errors: repeats lower
        # them at most as other measurements would.
        again = 0.0
        if fit.known < 1 - UNREAD:
            again = frame.repeated
        self._n_repeats = again * (self._n_repeats + 1)
        least = again * self._last2 * self._n_repeats / (self._n_repeats + 1)
        return max(error2, fit.inherited2, noise.missing, least)


class CommonError:
    """RMS relative error that all forces of a frame share: a loss or gain of the total.

    It is the regression of the residuals on W x, each row left out of its own value, over the rows
    read.

    Attributes
    ----------
    value : float
        Its RMS over the last frames; those with more force count more.
    """

    def __init__(self, tuning: SkinTuning) -> None:
        self._tuning = tuning
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.value = 0.0
        self._products2 = 0.0
        self._squares2 = 0.0

    def follow(self, settled: Settled) -> None:
        """Update the error."""
        kept = 1 - self._tuning.signal_rate
        self._products2 = kept * self._products2 + settled.along_x**2
        self._squares2 = kept * self._squares2 + settled.read2**2
        self.value = math.sqrt(self._products2 / (self._squares2 + TINY))


class Trust:
    """Whether an estimate is trusted: the skin is untouched, or the error is small.

    Attributes
    ----------
    holds : bool
        True if the last estimate is trusted.
    """

    def __init__(self, tuning: SkinTuning) -> None:
        self._tuning = tuning
        self.forget()

    def forget(self) -> None:
        """Begin anew, as if no frame had been measured."""
        self.holds = True
        self._silence = 0.0  # average of the frames without any measurement but 0

    def follow_silence(self, silent: float) -> None:
        """Update the silence by the part by which a frame was silent."""
        tuning = self._tuning
        rising = self._silence + tuning.noise_rate * (1 - self._silence)
        falling = tuning.silence_kept * self._silence
        self._silence = silent * rising + (1 - silent) * falling

    def noise_of_skin(
        self, noise: float, level: NoiseLevel, frame: FrameNumbers, stated_sd: float
    ) -> float:
        """Return the noise variance of the skin, whatever passes for it in motion."""
        # Of a skin that was silent, what no force explains is hardly noise, unless it is stated.
        heard = (1 - frame.silent) * self._silence
        noise = max(noise * (1 - heard), min(noise, stated_sd**2))
        return noise / level.trust

    def judge(
        self,
        settled: Settled,
        error2: float,
        of_skin: float,
        excess: float,
        bias_is_known: bool,
    ) -> None:
        """Decide by squared error and noise variance of the skin; `excess` is the part by which the
        squared residual of an untouched skin exceeds the noise at most.
        """
        tuning = self._tuning
        # Until it is known, the bias passes for forces on all taxels.
        bound = tuning.untouched if bias_is_known else tuning.most_bias**2
        is_weak = settled.power <= bound * of_skin
        is_explained = settled.residual2 <= (1 + excess) * of_skin
        is_accurate = error2 <= tuning.trusted**2 * settled.power
        self.holds = (is_weak and is_explained) or is_accurate

    def excess(self, noise: TaxelNoise, n_read: int, bias_is_known: bool) -> float:
        """Return `excess` of `judge`."""
        tuning = self._tuning
        if noise.is_stated and bias_is_known:
            return min(tuning.unexplained, tuning.unresolved * math.sqrt(2 / n_read))
        return tuning.unexplained


def explains_samples(
    residual: Floats, forces: Floats, noise2: float, tuning: SkinTuning
) -> bool:
    """Whether forces explain the readings of single taxels but for noise, of variance `noise2`, and
    an error that is trusted: what lies between these taxels, nothing shows.

    `residual` is float32 (m,), of the taxels read, `forces` float32 (n,), of all.
    """
    residual2 = float(np.mean(np.square(residual)))
    power = float(np.mean(np.square(forces)))
    explained2 = (1 + tuning.unexplained) * noise2 + tuning.trusted**2 * power
    return residual2 <= explained2
