"""The work on vectors of the default solver in numpy, for the rows of any Phi."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Mask
from sparseskin.nodes.sensor.noise import NoiseModel

from .formula import shrink
from .gates import Gates
from .prediction import Motion, MotionSums
from .row_subset import Comparison, RowSubset
from .rows import Rows
from .standing_out import deviations_of, scales_of, standing_out
from .tiles import SHIFTS, Tiles, neighbours_of
from .tuning import SkinTuning
from .vectors import (
    CERTAIN,
    CLEAR_RATIO,
    FORMULA_SHARE,
    UNKNOWN,
    Blend,
    Filtered,
    Innovation,
    RowVariances,
    Settled,
    StepPlan,
    Steps,
    Vectors,
    steps_for,
)

NOTHING = np.zeros(1, dtype=np.float32)
"""What cells without a taxel read."""


class Step(NamedTuple):
    """A step of a frame."""

    x: Floats  # its estimate, (n,)
    error2: float  # the mean squared error that is expected of it
    residual2: float  # mean squared residual of z before it, of the rows read
    plan: StepPlan  # the plan of the frame, which the first step chooses
    n_busy: int  # tiles in which something stands out of the noise
    own: Floats  # what each row read has added to its own value in x, (n_read,)


class FrameVectors(Vectors):
    """The readable form of `Vectors`.

    What a method of a frame hands on to those after it:

    - `begin`: values of the rows read; of each the part that is certain, and the variance that its
      doubt adds; innovation and prediction of the last frame of these rows; slopes of x;
    - `predict`: the prediction, in taxels and rows; of the rows read the variances that their
      filters expect, those that are known, and what the values exceed the means by;
    - `filter_rows`: targets of all rows, their variances, and what the values exceed them by;
    - `steps`: the mean of the estimates, and what each row read added to its own value in it.

    Parameters
    ----------
    rows, tiles, gates
        W; the windows of the skin; the weights of the denoiser: None for none.
    tuning : SkinTuning
    """

    def __init__(
        self, rows: Rows, tiles: Tiles, gates: Gates | None, tuning: SkinTuning
    ) -> None:
        self._rows = rows
        self._tiles = tiles
        self._scales = scales_of(tiles)
        self._kinds = deviations_of(tiles).kinds
        self._gates = gates
        self._tuning = tuning
        self._neighbours = neighbours_of(tiles)
        self.forget()

    def forget(self) -> None:
        self.x = np.zeros(self._rows.n, dtype=np.float32)
        self._predicted = self.x
        self._recall = Recall()
        self._growth = ConfirmedMotion()
        self._translation = ConfirmedMotion()
        self.forget_rows()

    def forget_rows(self) -> None:
        nothing = np.zeros(self._rows.n_rows, dtype=np.float32)
        #: W times the last estimate, and times the prediction.
        self.x_rows = self._rows.forward(self.x)
        self._predicted_rows = nothing
        #: W times what the last measurements changed.
        self._correction = nothing
        #: State of each row's filter: mean; variance that its measurements left; that of changes.
        self._mean = self.x_rows.copy()
        self._variance = nothing + np.float32(UNKNOWN)
        self._change = nothing
        #: Value that each row is expected to have, and the variance of its error.
        self._target = nothing
        self._target_variance = nothing

    def start_from(self, x: Floats) -> None:
        self.x = x
        self.x_rows = self._rows.forward(x)

    def begin(
        self, y: Floats, subset: RowSubset, bias: float, noise: float
    ) -> tuple[Comparison, MotionSums]:
        self._values = self._rows.values(y) - np.float32(bias) * subset.ones
        self._last_innovation = subset.innovation
        self._last_predicted = subset.predicted
        self._doubt_values(subset, noise)
        comparison = Comparison(
            power=_total(np.square(y, dtype=np.float64)) / len(y),
            largest=float(np.abs(y).max()),
            change=float(np.abs(y - subset.y).max()),
        )
        return comparison, self._motion_sums()

    def _doubt_values(self, subset: RowSubset, noise: float) -> None:
        """Set the part of each value that is doubted, and the variance that it adds."""
        read = self._rows.read
        change = self._values - self.x_rows[read]
        squares = np.square(change, dtype=np.float64)

        # What a row has read before is no garbage, though the estimate does not explain it.
        off_mean = np.square(self._values - self._mean[read], dtype=np.float64)
        smaller = np.minimum(squares, off_mean)
        unexplained = np.where(self._variance[read] < UNKNOWN, smaller, squares)

        self.doubt = np.zeros(len(squares), dtype=np.float32)
        for number in range(subset.n_blocks):
            peers = np.flatnonzero(subset.block == number)
            if len(peers) == 0:
                continue
            of_peers = squares[peers]
            second, largest = np.partition(of_peers, -2)[-2:]
            largest_other = np.where(of_peers == largest, second, largest)
            # A second outlier must not excuse the first.
            sum_of_others = of_peers.sum() - of_peers - largest_other
            expected = sum_of_others / (len(peers) - 2) + noise
            ratio = unexplained[peers] / (self._tuning.outlying * expected + TINY)
            power = np.minimum(ratio, CLEAR_RATIO) ** 4
            self.doubt[peers] = power / (1 + power)
        self.doubt = np.maximum(self.doubt, subset.faulty)
        self._certain: Any = np.float32(1) - self.doubt
        excess = self.doubt * unexplained / (self._certain + CERTAIN)
        self._excess = excess.astype(np.float32)

    def _motion_sums(self) -> MotionSums:
        read = self._rows.read
        following, previous = self.x[self._neighbours]
        self._slopes = following - previous
        down, across = map(self._rows.forward, self._slopes)
        a = self.x_rows[read]
        b = down[read]
        c = across[read]
        change = self._certain * (self._values - a)
        return MotionSums(
            aa=_dot(a, a),
            ab=_dot(a, b),
            ac=_dot(a, c),
            bb=_dot(b, b),
            bc=_dot(b, c),
            cc=_dot(c, c),
            a_change=_dot(a, change),
            b_change=_dot(b, change),
            c_change=_dot(c, change),
            energy=_dot(self.x, self.x),
            largest=float(self.x.max()),
            n_read=len(read),
            n=self._rows.n,
        )

    def predict(self, motion: Motion) -> Innovation:
        read = self._rows.read
        growth, down, across = (np.float32(weight) for weight in motion[:3])
        down_slope, across_slope = self._slopes
        change = growth * self.x + down * down_slope + across * across_slope
        moved = (self.x + change).clip(0, None)
        self._predicted = np.minimum(moved, np.float32(motion.bound))
        self._predicted_rows = self._rows.forward(self._predicted)
        self.predicted = self._predicted_rows[read]
        self.innovation = self._certain * (self._values - self.predicted)
        self._estimate = self._predicted
        self._own = np.zeros_like(self.innovation)

        self._expected = (self._variance + self._change)[read]
        self._is_known: Mask = self._expected < UNKNOWN
        self._move_means(growth)
        self._off_mean = self._values - self._mean[read]
        unexpected = self._certain * self._off_mean * self._is_known

        correction = self._correction[read]
        squares = _dot(self.innovation, self.innovation)
        return Innovation(
            squares=squares,
            correction_squares=_dot(correction, correction),
            products=_dot(self.innovation, correction),
            noise_squares=noise_squares(
                self.innovation,
                self._last_innovation,
                self.predicted - self._last_predicted,
                squares,
            ),
            n_read=len(read),
            n_known=int(np.count_nonzero(self._is_known)),
            filter_squares=_total(unexpected * unexpected),
            filter_variances=_total(self._expected * self._is_known),
        )

    def _move_means(self, growth: np.float32) -> None:
        """Move the means of the filters as the prediction moves, so far as their rows confirm it:
        in an estimate that has not converged, an error passes for a motion.
        """
        read = self._rows.read
        grown = growth * self.x_rows
        translated = (self._predicted_rows - self.x_rows) - grown
        off_mean = self._values - self._mean[read]
        unexpected = self._certain * off_mean * self._is_known

        of_growth = grown[read] * self._is_known
        of_translation = translated[read] * self._is_known
        growth_part: Any = self._growth.follow(of_growth, unexpected, self._tuning)
        part: Any = self._translation.follow(of_translation, unexpected, self._tuning)
        self._mean = self._mean + (growth_part * grown + part * translated)

    def filter_rows(self, variances: RowVariances) -> Filtered:
        self._set_targets(variances)
        self._read_values(variances)
        target_variance = self._target_variance[self._rows.read]
        return Filtered(
            target_variance=_total(target_variance) / len(target_variance),
            n_known=int(np.count_nonzero(self._variance < UNKNOWN)),
        )

    def _set_targets(self, variances: RowVariances) -> None:
        """Combine the prediction and the filter of each row, by their precisions."""
        grown = self._change + np.float32(variances.change)
        self._change = grown.clip(None, UNKNOWN)
        change = self._tuning.of_dependent(
            self._change.astype(np.float64), variances.noise
        )
        change_32 = change.clip(None, UNKNOWN).astype(np.float32)
        prior: Any = np.float32(variances.prediction)
        of_filter = self._variance + change_32
        total = prior + of_filter
        share = prior / total
        correction = share * (self._mean - self._predicted_rows)

        recalled: Any = self._recall.follow(
            self.innovation * self._is_known,
            correction[self._rows.read] * self._is_known,
            int(np.count_nonzero(self._is_known)),
            variances.noise,
            self._tuning,
        )
        self._target = self._predicted_rows + recalled * correction
        # Between the variances without the filter and with it, by their logarithms: the mean of the
        # variances would be that of the prediction as soon as a part of it counts, so that an
        # estimate that has not converged never would.
        self._target_variance = prior * (of_filter / total) ** recalled

    def _read_values(self, variances: RowVariances) -> None:
        """Update the targets and the filters of the rows read by their values."""
        read = self._rows.read
        noise = np.float32(variances.noise) + self._excess
        floor = np.float32(variances.floor)

        target = self._target[read]
        variance = self._target_variance[read]
        gain = variance / (variance + noise)
        self._target[read] = target + gain * (self._values - target)
        self._target_variance[read] = np.maximum(gain * noise, floor)
        self._off_target = self._certain * (self._values - self._target[read])

        expected = self._expected + np.float32(variances.change)
        gain = expected / (expected + noise)
        self._mean[read] += gain * self._off_mean
        self._variance = self._variance.copy()
        self._variance[read] = np.maximum(gain * noise, floor)
        self._change[read] = 0

    def steps(self, plan: StepPlan) -> Steps:
        self._z = self._predicted
        estimates = []
        own = []
        expected2 = []
        residual2 = []
        # The first step may raise the numbers of the plan: more than this only within its time.
        least = plan.n_formula + plan.n
        k = 0
        n_busy = 0
        n_tiles = 0
        while k < plan.n_formula + plan.n:
            # Forces of a sudden contact stand out step by step: what it takes is counted, and the
            # next step is to take as long as the last one by the weights would.
            spent = (k + 1) * plan.step_tiles + n_tiles + n_busy
            if k >= least and spent > plan.frame_tiles:
                break
            step = self._step(k, plan)
            plan = step.plan
            n_busy = step.n_busy
            # A step by the formula takes a part of the time of the weights.
            if k < plan.n_formula:
                n_tiles += n_busy // FORMULA_SHARE
            else:
                n_tiles += n_busy
                estimates.append(step.x)
                own.append(step.own)
                expected2.append(step.error2)
                residual2.append(step.residual2)
            k += 1

        # Errors of steps with other tiles differ: their mean has less.
        weights = self._weights_of(np.array(residual2), plan)
        self._estimate = np.zeros_like(self._z)
        of_steps = zip(weights.astype(np.float32), estimates, own, strict=True)
        for weight, x, added in of_steps:
            self._estimate += weight * x
            self._own += weight * added
        numbers = plan.n_formula, k - plan.n_formula, n_tiles
        return Steps(float(weights @ expected2), float(weights @ residual2), *numbers)

    def _weights_of(self, residual2: Doubles, plan: StepPlan) -> Doubles:
        """Return the weights of the estimates of steps in their mean, by the residual before each:
        of an iteration that diverges, the steps before it does count.
        """
        tuning = self._tuning
        n_rising = max(1, plan.n + 1 - tuning.fully_averaged)
        rising = np.arange(1, len(residual2) + 1) / n_rising
        weights: Doubles = np.minimum(rising, 1) ** tuning.rise_power
        weights /= (residual2 + plan.floor) ** tuning.residual_power
        weights /= weights.sum()
        return weights

    def _step(self, k: int, plan: StepPlan) -> Step:
        """Move z, in step k; by `shrink` in place of the weights where the plan says so, and where
        there are none.
        """
        tuning = self._tuning
        shift = (plan.first_shift + k) % len(SHIFTS)
        z = self._z
        off = self._target - self._rows.forward(z)
        off_read = off[self._rows.read]
        residual = off_read + self._off_target
        residual2 = _dot(residual, residual) / len(residual)

        # Error variance of z, seen by the rows read.
        off2 = _dot(off_read, off_read) / len(off_read)
        least_tau = tuning.least_tau * max(off2, plan.target_variance)
        tau = max(off2 - plan.target_variance, least_tau) + plan.floor

        # u is the truth and noise of deviation s.
        tau_32 = np.float32(tau)
        weight = tau_32 / (tau_32 + self._target_variance)
        mean_weight = _total(weight) / self._rows.n
        s2 = tau * max(1 - mean_weight, 0.0) / mean_weight + plan.floor
        s = np.float32(math.sqrt(s2))
        weighted: Any = weight * off
        u = z + self._rows.adjoint(weighted) / np.float32(mean_weight)

        # The last place is read where there is no taxel.
        taxels = np.concatenate([u / s, NOTHING])
        windows = self._tiles.windows(taxels, shift)
        part = standing_out(windows, self._scales[self._kinds[shift]])
        n_busy = int(np.count_nonzero(part))
        if k == 0:
            plan = steps_for(plan, n_busy)
        by_formula = k < plan.n_formula
        denoise = shrink if by_formula or self._gates is None else self._gates.denoise
        tiles, tile_error = denoise(windows, part)
        x = self._tiles.taxels(tiles, shift) * s
        expected = _dot(tile_error, self._tiles.shares[shift])

        # Towards the estimate whose errors are not correlated with those of u.
        alpha: Any = np.float32(min(expected, tuning.most_alpha))
        free = (x - alpha * u) / (1 - alpha)
        damping = tuning.damping * min(1.0, tuning.damped_from / (k + 1))
        self._z = z + np.float32(damping) * (free - z)
        own = alpha / np.float32(mean_weight) * weighted[self._rows.read]
        return Step(x, expected * float(s) ** 2, residual2, plan, n_busy, own)

    def fade(self, part: float) -> None:
        self._predicted = np.float32(1 - part) * self._predicted
        self._estimate = np.float32(1 - part) * self._estimate

    def settle(self, blend: Blend, ones: Floats) -> Settled:
        part: Any = np.float32(blend.part)
        x = (1 - part) * self._estimate + part * self._predicted
        self.start_from(x)
        self._correction = self.x_rows - self._predicted_rows
        self.residual = self._certain * (self._values - self.x_rows[self._rows.read])

        # Residual of the steps in their part of x, without what each row added to its own value.
        own = (1 - part) * (self._certain * self._own)
        left_out = self.residual - part * self.innovation + own
        x_read = self.x_rows[self._rows.read]

        # A taxel within the noise counts as unpressed.
        within = np.float32(2 * blend.noise_sd + math.sqrt(TINY))
        near = (x / within).clip(None, 8)
        unpressed = np.exp(-near * near)
        return Settled(
            forces=_unclipped(x, blend),
            power=_dot(x, x) / len(x),
            residual2=_dot(self.residual, self.residual) / len(self.residual),
            left_out2=_dot(left_out, left_out) / len(left_out),
            along_x=_dot(x_read, self.residual + own),
            read2=_dot(x_read, x_read),
            along_ones=_dot(ones, self.residual),
            unpressed=_dot(x, unpressed),
            pressed=_total((1 - unpressed) ** 2) / len(x),
        )

    def mean_variance(self, forces: Floats, model: NoiseModel) -> float:
        return _total(model.variance(forces)) / len(forces)


def noise_squares(
    innovation: Floats, last: Floats, change: Floats, squares: float
) -> float:
    """Return `Innovation.noise_squares`, by the innovation of a frame, the last one of the same
    rows, the change of their prediction between the two, and the squared length of the first.
    """
    # What fell in proportion to the change of the prediction was no noise.
    fall = last - innovation
    part = _dot(fall, change) / (_dot(change, change) + TINY)
    part_32 = np.float32(min(max(part, 0.0), 1.0))
    fall = fall - part_32 * change

    # Each of the innovations shows the noise of its own, the less precisely the larger it is.
    last_squares = _dot(last, last)
    products = squares * _dot(last, fall) - last_squares * _dot(innovation, fall)
    return products / (squares + last_squares + TINY)


class Recall:
    """Part of the correction by the rows' own filters that is used, 0 to 1.

    By regression: how much of it the rows that are read now confirm, in this frame and before.
    """

    def __init__(self) -> None:
        self._products = 0.0  # of innovation and correction
        self._squares = 0.0  # of the correction
        self._count = 0.0  # of values

    def follow(
        self,
        innovation: Floats,
        correction: Floats,
        count: int,
        noise: float,
        tuning: SkinTuning,
    ) -> np.float32:
        """Return the part, after innovation and correction of the rows read, 0 where unknown."""
        memory = tuning.recall_memory
        self._products = memory * self._products + _dot(innovation, correction)
        self._squares = memory * self._squares + _dot(correction, correction)
        self._count = memory * self._count + count

        ridge = tuning.recall_ridge * noise * self._count
        part = (self._products + ridge) / (self._squares + ridge + TINY)
        return np.float32(min(max(part, 0.0), tuning.most_recalled))


class ConfirmedMotion:
    """Part of a motion of the rows' means that their own values confirm, 0 to 1.

    By regression of what the filters had not expected on the motion, in this frame and before. A
    row counts less the more it moves beyond the others: the few sums of blocks are wrong together.
    """

    def __init__(self) -> None:
        self._products = 0.0
        self._squares = 0.0

    def follow(
        self, motion: Floats, unexpected: Floats, tuning: SkinTuning
    ) -> np.float32:
        """Return the part, after the motion of the rows read and what they exceed the means of
        their filters by; both are 0 where a row is unknown.
        """
        memory = tuning.motion_memory
        squares = np.square(motion)
        mean: Any = np.float32(_total(squares) / len(motion) + TINY)
        weights: Any = mean / (mean + squares)
        self._products = memory * self._products + _dot(unexpected * weights, motion)
        self._squares = memory * self._squares + _dot(motion * weights, motion)
        part = self._products / (self._squares + TINY)
        return np.float32(min(max(part, 0.0), tuning.most_confirmed))


def _unclipped(x: Floats, blend: Blend) -> Floats:
    """Forces whose readings, clipped at 0, exceed the bias by x."""
    forces = x
    if blend.bias > 0:
        bias = np.float32(blend.bias)
        forces = x + bias * (1 - np.exp(-x / bias))
    return forces * (forces >= np.float32(blend.least_force))


def _dot(a: Floats, b: Floats) -> float:
    return float(a @ b)


def _total(a: Floats | Doubles) -> float:
    return float(a.sum(dtype=np.float64))
