"""The constants of the default solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from sparseskin.nodes.numerics.arrays import TINY, Doubles

Variance = TypeVar("Variance", float, Doubles)


@dataclass(frozen=True)
class SkinTuning:
    """Constants of `SkinSolver`: chosen on five recordings and on moving presses, but those with
    a reason stated.
    """

    #: Part of a step towards the divergence-free estimate: 1 diverges at M <= N/3. From this number
    #: of steps on it falls, as their number rises: without that, dense loads diverge at N/8.
    damping: float = 0.5
    damped_from: int = 8
    #: Weights of the estimates of a frame in their mean, each with a shift of its own: the power of
    #: the mean squared residual that divides them, and that of a rise, which ends so many steps
    #: before the last one. By larger powers of residuals, steps amplify rounding.
    residual_power: float = 2.0
    rise_power: float = 4.0
    fully_averaged: int = 3
    #: Least error variance of z, as a multiple of the mean squared residual.
    least_tau: float = 0.05
    #: Largest squared error expected of the denoiser, as a multiple of the noise variance:
    #: 1 / (1 - alpha) stays bounded.
    most_alpha: float = 0.9
    #: Reduction of the squared innovation, as a multiple of the noise variance, at which half of a
    #: motion is used.
    #: Derived: three free parameters explain 3 of noise, and 12 in one frame of a hundred.
    motion: float = 12.0
    #: Least number of measurements of a frame that show a motion, which has three parameters.
    least_read: int = 16
    #: Ridge of the motion, as a part of each energy.
    ridge: float = 1e-3
    #: Rate of the noise level per frame, and its largest growth.
    noise_rate: float = 0.2
    noise_growth: float = 1.4
    #: Power of the share of the rows read by which the noise may grow at once. Chosen: 0.004 at
    #: N/2, where a residual shows noise; 0.2 at N/1.2, where an untouched skin had ghost forces.
    all_read: float = 8.0
    #: Deviations of a mean square at which half of what it exceeds its expectation by counts.
    #: Derived: noise alone exceeds it by as much in one frame of 700.
    significant: float = 3.0
    #: Rate per frame at which the mean squared error of a prediction is averaged.
    signal_rate: float = 0.3
    #: Errors of a prediction are not independent of each other: c and d of their variance
    #: c P (1 + d P / R), P their mean square.
    prior: float = 4.0
    doubt: float = 1.0
    #: Regression of innovations on what the rows' filters correct: weight of the past frames, and
    #: ridge in noise variances, which draws it to 1.
    recall_memory: float = 0.8
    recall_ridge: float = 0.3
    #: The same weight in the regressions of what the rows' filters had not expected on the motion.
    motion_memory: float = 0.8
    #: Largest part of a correction by the rows' filters, and of a motion of their means, that these
    #: regressions find; 0 switches the filters, or their motion, off.
    most_recalled: float = 1.0
    most_confirmed: float = 1.0
    #: Squared change of a measurement, as a multiple of the mean of its block, at which half of it
    #: is doubted.
    #: Derived: signs of rows are random: 8 deviations occur in one of 10^15 measurements.
    outlying: float = 64.0
    #: Weight of the prediction in the estimate, E / (E + b P) by the error variances of both, whose
    #: errors are not independent: b.
    blend: float = 2.0
    #: Correlation of an innovation with the last correction beyond which the estimate lags behind,
    #: in its deviations 1 / sqrt(M). Derived: noise alone is beyond it in one frame of 40. What it
    #: is beyond it by, the logarithm of the trust in the noise level falls by; the largest growth
    #: of that logarithm per frame, and the least trust.
    lagging: float = 2.0
    trust_growth: float = 0.05
    least_trust: float = 0.05
    #: Largest bias, in deviations of the noise. Derived: normal noise clipped at 0 has a mean of
    #: 0.68 of its deviation.
    most_bias: float = 0.75
    #: First and least rate of the bias per frame.
    bias_begins: float = 3.0
    bias_rate: float = 0.05
    #: Frames after which a hundredth of the bias is left.
    bias_known: int = 8
    #: Growth per frame of the least noise variance so far, which bounds the bias.
    bias_forgotten: float = 1.002
    #: Mean squared error of an estimate, as a multiple of what the gates expect. Fitted on presses
    #: on 8 x 8 to 48 x 64 taxels, N/2 to N/8.
    optimism: float = 2.0
    #: Rate per frame of the part of the squared distance from the readings that is error of forces.
    share_rate: float = 0.5
    #: Belief in a stated squared error, beside that in rows which confirm it: the inverse of its
    #: relative variance. Chosen on drawn worlds, presses and scenes.
    belief: float = 15.0
    #: Largest noise variance, as a multiple of the least one so far: of measurements; and of a
    #: pressed taxel.
    #: Derived: the second is 58 by the noise of the paper, clipped at 0.
    louder: float = 4.0
    pressed_noise: float = 60.0
    #: Weight per frame of an earlier silence, after which a noise that is not stated is hardly one.
    #: Chosen: a board that begins with zeros is doubted for 60 frames.
    silence_kept: float = 0.98
    #: Part by which the mean squared residual of an untouched skin exceeds the noise variance at
    #: most; and where the skin states its noise, in deviations of the mean square. Derived: noise
    #: alone exceeds 6, of 86 measurements and more, in one frame of a million.
    unexplained: float = 1.0
    unresolved: float = 6.0
    #: Mean squared force, as a multiple of the noise variance, up to which nothing touches the
    #: skin.
    untouched: float = 0.05
    #: Largest error that is trusted, as a part of the forces, both RMS.
    trusted: float = 0.25

    def surplus(self, mean_square: float, expected: float, count: int) -> float:
        """What a mean square of `count` numbers exceeds its expectation by, where significant."""
        excess = max(mean_square - expected, 0.0)
        # Squared excess in variances of the mean square, which is 2 expected^2 / count.
        z2 = excess * excess * count / (2 * expected * expected + TINY)
        return excess * z2 / (z2 + self.significant**2)

    def of_dependent(self, variance: Variance, noise: float) -> Variance:
        """Variance of errors that are not independent of each other: it is as much larger as the
        errors, of mean square `variance`, exceed the noise variance.
        """
        return self.prior * variance * (1 + self.doubt * variance / noise)
