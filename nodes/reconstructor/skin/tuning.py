"""The constants of the default solver: values, units and origins."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SkinTuning:
    """All constants of `SkinSolver` that were derived, fitted or chosen.

    An ablation is `dataclasses.replace(SkinTuning(), momentum=0.0)`, handed to the solver as
    `tuning`. Noise variances and RMS are the frame's own, so no value is in newtons.

    In brackets is the origin of a value. Derived: from the reason stated. Scenes: chosen on the
    simulated scenes, with frames 0.1 to 1 ms apart. Recordings: fitted on five recordings of real
    skins. Presses: fitted on presses on 16 to 300 taxels. Chosen: by reasoning or a few trials.
    """

    # Clip bias.

    #: Largest bias, in standard deviations of the noise. [Derived: normal noise of deviation sigma,
    #: clipped at 0, has mean 0.399 sigma and deviation 0.584 sigma, a ratio of 0.68; the rest is
    #: room for the error of the estimate.] 0: no bias is subtracted.
    bias_largest: float = 0.75
    #: Growth per frame of the least noise variance so far, which bounds the bias: it is that of an
    #: untouched skin. With the noise of a contact, a badly reconstructed scene could pass for bias.
    #: [Chosen]
    bias_forgotten: float = 1.002
    #: Rate of the bias in frame k, a frame: this / (k + this), and the least rate. More than 1:
    #: the first frames, whose estimate takes a part of the bias for forces, count less than later
    #: ones. [Chosen: after 8 untouched frames a hundredth of the bias is left]
    bias_begins: float = 3.0
    bias_slowest: float = 0.05
    #: Largest noise variance before it is known, in mean squared residuals of held-out rows.
    #: [Chosen]
    bias_bound: float = 4.0
    #: First frames that use the median of the taxels, and every how many frames later. [Chosen]
    median_first: int = 8
    #: Rounds of rotating rows that these first frames are at least. [Chosen]
    median_rounds: int = 2
    median_every: int = 32

    # Prediction.

    #: Least reduction of the squared innovation by three free parameters, in noise variances.
    #: [Derived: noise alone gives 3 on average, and 12 in less than one frame of a hundred
    #: (chi-square).] Infinite: no motion is predicted.
    motion_significant: float = 12.0
    #: Mean squared innovation, in noise variances, up to which no motion is estimated. [Chosen]
    motion_still: float = 0.95
    #: A prediction has failed if the innovation has this part of the measurements' energy, and
    #: this many noise variances. [Chosen]
    failed_part: float = 0.5
    failed_noise: float = 2.0

    # Noise level.

    #: Rate of the estimate, a frame: it follows a contact, whose taxels are noisier, within some
    #: frames. [Chosen]
    noise_rate: float = 0.4
    #: Largest growth in a frame: the begin of a touch looks like noise in the first differences.
    #: [Chosen]
    noise_growth: float = 1.4
    #: The same under rotating rows, unless the level seen is below this part of the mean squared
    #: innovation: else apparent noise may be motion. Without it, a person who moves in bed, at
    #: N/8, comes out with an error of 27 instead of 16 %. [Recordings; the part: chosen]
    noise_growth_rotating: float = 1.05
    noise_clearly: float = 0.7
    #: Frames after a jump in which a lower level is adopted at once: it is that of another contact.
    #: [Chosen]
    noise_relearned: int = 3
    #: Mean squared innovation, in noise variances, beyond which the scene has jumped. [Chosen]
    jump: float = 5.0

    # Gain.

    #: Normalised innovation squared up to which all of it is noise. [Chosen]
    gain_expected: float = 0.9
    #: Least gain. [Chosen] 1: the measurements replace the prediction.
    gain_least: float = 0.05
    #: Correlation of an innovation with the last correction beyond which the estimate lags behind.
    #: [Chosen]
    lagging: float = 0.1
    #: Rate at which the trust in the noise level then falls, a unit of correlation; its growth a
    #: frame otherwise, and its least value. [Chosen] A least value of 1: it is always trusted.
    trust_fall: float = 0.5
    trust_growth: float = 1.05
    trust_least: float = 0.05

    # Row memory.

    #: Largest weight of a row of earlier frames in the Haar model; a row of this frame has 1. With
    #: more, the noise of earlier frames, which the estimate has averaged out, returns. [Chosen]
    #: 0: the Haar model uses the rows of the frame alone.
    memory_weight: float = 0.3
    #: Decay of that weight with the change since a row was read, per noise variance. [Chosen]
    memory_decay: float = 10.0
    #: Growth of the variance of a remembered row for the smooth model, in its mean squared change:
    #: changes have a structure, and independent rows that agree on it would prove it. [Chosen]
    memory_doubt: float = 10.0
    #: Part of the drift that is left a frame later: a change is followed by others. [Chosen]
    drift_decay: float = 0.5

    # Haar model.

    #: Threshold, in RMS residuals. [Scenes]
    threshold: float = 1.4
    #: Least threshold, in standard deviations of the noise of a filtered frame. [Scenes]
    least_threshold: float = 0.5
    #: Least threshold, in RMS innovations, with fixed rows and with rotating ones. A threshold that
    #: falls with the residual would not hold against a wrong estimate that fits the measurements;
    #: rotating rows contradict such an estimate in the next frame. [Scenes]
    held_threshold: float = 0.8
    held_rotating: float = 0.3
    #: Threshold of a frame that starts from 0, in standard deviations of the interference of the
    #: other taxels in its first gradient step. With few measurements `threshold` would be far
    #: above that and suppress a contact. [Scenes]
    cold_threshold: float = 2.4
    #: Frames after a jump that have all iterations, too: errors that no measurement observes would
    #: be kept otherwise. [Scenes]
    settling: int = 2
    #: Part of the last step of an iteration that is added to the next. [Scenes]
    momentum: float = 0.7
    #: The estimate is the mean of this many last iterates, each with its own shift. [Scenes]
    averaged: int = 3
    #: Normalised innovation squared beyond which iterations are added, and how many per unit.
    #: [Scenes]
    expected_nis: float = 1.05
    iterations_per_nis: float = 20.0

    # Smooth model.

    #: Standard deviations of the Gaussians whose mean is the correlation of two taxels, in taxels:
    #: from one taxel to a fingertip. [Chosen]
    lengths: tuple[float, ...] = (0.5, 1.0, 2.0)
    #: Blur of an estimate before it becomes the deviation of the next, in taxels; and the deviation
    #: of a taxel without contact, as a part of the largest. [Recordings]
    blur: float = 1.0
    deviation_floor: float = 0.07
    #: Part of the mean variance that is added to each measurement: the model is never exact.
    #: [Chosen]
    model_error: float = 1e-3
    #: Least noise variance of a measurement, as a part of their mean square. [Chosen]
    least_noise: float = 1e-6
    #: Part of the prediction that is kept, with fixed rows, where what no row measures would stay
    #: for ever, and with rotating ones. [Chosen]
    kept_fixed: float = 0.5
    kept_rotating: float = 0.9
    #: Rounds of a frame, each with the deviation of the last, and of one that starts from nothing.
    #: [Chosen]
    rounds: int = 2
    cold_rounds: int = 5
    #: Conjugate gradients of a round, likewise. [Chosen]
    gradients: int = 20
    cold_gradients: int = 30
    #: Part of the squared right side at which conjugate gradients end. [Chosen]
    precise: float = 1e-6
    #: Measurements by which the fitted deviation makes the error of a left-out one too small: its
    #: square is multiplied by 1 + this / their number. [Presses]
    fitted: float = 32.0
    #: Taxels up to which a system can be factored, which costs their number cubed.
    #: [Chosen]
    most_direct: int = 512

    # Held-out measurements, choice of the model, error and trust.

    #: One measurement of this many is held out, and at most so many. [Chosen]
    held_one_of: int = 16
    held_most: int = 32
    #: Measurements with which two models can be compared: with fewer, the smooth one is used.
    #: [Chosen]
    comparable: int = 96
    #: Weight of the past in the running mean of squared errors. [Chosen]
    error_memory: float = 0.7
    #: Largest past error, in those of the frame. [Chosen]
    error_fading: float = 4.0
    #: Advantage that the smooth model needs, in standard deviations of the compared means. [Chosen]
    margin: float = 1.0
    #: Frames of a comparison: in the first, the other model starts from the estimate of the model
    #: in use, and takes some to differ. [Recordings]
    trial: int = 8
    #: Frames between comparisons, at least and at most: their number doubles while the same is
    #: better. [Chosen]
    often: int = 4
    seldom: int = 64
    #: Least gain at which a large error asks for comparisons. [Recordings: 0.3, 0.5 are as good.]
    #: Below it, the Haar model averages most of the noise out.
    coarse_gain: float = 0.4
    #: Growth of an error that asks for a comparison. [Chosen]
    worse: float = 2.0
    #: Mean squared error of an estimate whose held-out rows show noise alone, in K R and the root
    #: of the part of the taxels that are touched. [Scenes]
    filtered_error: float = 2.2
    #: Largest error that is trusted, as a part of the forces (both RMS); and the power of the
    #: measurements beyond their noise, or of forces and errors, in noise variances, up to which
    #: nothing touches the skin. [Scenes]
    trusted: float = 0.25
    untouched: float = 0.5

    @property
    def error_frames(self) -> float:
        """Frames that a running mean of squared errors is of, in independent residuals."""
        return (1 + self.error_memory) / (1 - self.error_memory)


TUNING = SkinTuning()
"""The constants that every solver has unless others are handed in."""
