"""The default solver in plain numpy: the specification, to be read beside docs/method.md."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Indices, Mask
from sparseskin.nodes.reconstructor.bases.haar import haar_matrix
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS, TILE

from .clip_bias import DUST
from .noise_level import MOST, RESOLUTION, VISIBLE
from .tuning import TUNING, SkinTuning

N_SHIFTS = 4093
"""Number of shifts that are drawn; they are used over and over."""


class ReferenceSolver:
    """What `SkinSolver` computes, in float64, with all matrices dense, one frame a call of `solve`.

    Vectors of taxels x have shape (n,), in row-major order. W, (n_rows, n), holds the rows of all
    row subsets, each row once; Phi are those of the frame. Squares are means of a measurement, in
    squared newtons.

    Parameters
    ----------
    subsets : sequence of Phi
        The Phi of fixed rows, or the row subsets of rotating ones ("sbhe").
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    iterations, max_iterations, seed
        As in `SkinSolver`.
    tuning : SkinTuning
        The constants.
    noise_sd : float
        Least standard deviation of the noise of a taxel that the skin states; 0: none stated.

    Attributes
    ----------
    model, error, trusted
        Of the last frame, as in `SkinSolver`.
    """

    def __init__(
        self,
        subsets: Sequence[Phi],
        mask: Mask,
        *,
        iterations: int | None = None,
        max_iterations: int = 30,
        seed: int = 0,
        tuning: SkinTuning = TUNING,
        noise_sd: float = 0.0,
    ) -> None:
        self.t, self.mask, self.noise_sd = tuning, mask, noise_sd
        phi = subsets[0]
        self.n, self.m, self.step = phi.n, phi.m, 1 / phi.lipschitz
        self.ratio = self.n / self.m
        dense = np.concatenate([subset.dense() for subset in subsets])
        self.w, numbers = np.unique(dense, axis=0, return_inverse=True)
        self.rows = numbers.reshape(len(subsets), self.m)
        self.iterations = 2 + round(self.ratio / 4) if iterations is None else iterations
        self.max_iterations = max(max_iterations, self.iterations)
        shifts = np.random.default_rng(seed).integers(len(SHIFTS), size=N_SHIFTS)
        self.shifts, self.n_shifted = [SHIFTS[number] for number in shifts], 0

        # A few measurements cannot be spared: each is predicted from all others.
        self.one_by_one = self.m < self.t.comparable and self.n <= self.t.most_direct
        spared = min(max(1, self.m // self.t.held_one_of), self.t.held_most)
        self.n_held = 0 if self.one_by_one or self.m == self.n else spared
        self.compares = self.n_held > 0 and self.m >= self.t.comparable

        places = np.argwhere(mask)
        distance2 = np.square(places[:, None] - places).sum(axis=2)
        bells = [np.exp(-0.5 * distance2 / length**2) for length in (*self.t.lengths, self.t.blur)]
        self.correlation = np.mean(bells[:-1], axis=0)
        self.blur = bells[-1] / bells[-1].sum(axis=1, keepdims=True)
        self.slopes = [neighbour(mask, axis, 1) - neighbour(mask, axis, -1) for axis in (0, 1)]

        # The last frame.
        self.x = self.correction = np.zeros(self.n)
        self.frame, self.first_subset, self.rotating = 0, 0, False
        # Clip bias; noise level: last measurements and difference of each row subset, and number
        # of differences since a jump; gain.
        self.b, self.least_s2, self.n_biases = 0.0, math.inf, 0
        self.s2, self.since_jump, self.settled, self.known = 0.0, 0, False, False
        self.floor, self.hangs, self.again = 0.0, False, False
        self.last_read: dict[int, Doubles] = {}
        self.last_step: dict[int, Doubles] = {}
        self.n_steps = dict.fromkeys(range(len(subsets)), -1)
        self.trust, self.gains = 1.0, dict.fromkeys(range(len(subsets)), 1.0)
        # Row memory: last measurement of each row, and the frame that each row subset was read in.
        self.values, self.drift = np.zeros(len(self.w)), 0.0
        self.read_in: dict[int, int] = {}
        # Running means of the squared errors of both models; frames to a comparison, and frames
        # left of it; last estimates while it lasts.
        self.model = "haar" if self.m >= self.t.comparable else "smooth"
        self.errors: dict[str, float] = {}
        self.wait, self.period, self.left, self.exceeds_noise = 0, self.t.often, 0, True
        # If the last error is large beside the touch; bound of the noise by held-out residuals.
        self.coarse, self.most_noise = False, math.inf
        self.last: dict[str, Doubles] = {}
        self.error: float | None = None
        self.trusted = True

    def solve(self, measurements: Floats, subset: int = 0) -> Doubles:
        """Return the forces, float64 of the mask's shape, from (m,) numbers by a row subset."""
        t, m, phi = self.t, self.m, self.w[self.rows[subset]]
        if self.frame == 0:
            self.first_subset = subset
        self.rotating = self.rotating or subset != self.first_subset
        read, ones = measurements.astype(np.float64), phi.sum(axis=1)
        y = read - self.b * ones
        changed2 = mean_square(read - self.last_read.get(subset, math.inf))
        x_p, failed = self.predict(phi, y, changed2)
        e = y - phi @ x_p
        e2 = mean_square(e)
        if read.any():
            self.floor = RESOLUTION**2 * mean_square(read)
        jumped = self.follow_noise(read, subset, e2, changed2, failed)
        if read.any():
            self.s2 = min(self.s2, MOST * mean_square(read))
        self.s2 = max(self.s2, self.floor, mean_square(phi) * self.n * self.noise_sd**2)
        settling = self.since_jump <= t.settling
        gain, nis, r2 = self.follow_gain(e, phi @ self.correction, subset, settling)
        noise = r2 if self.known else 0.0
        cold = failed or self.frame == 0

        # What is known of W x: values, with weights for Haar and variances for the smooth model.
        weights, age, m_counted = self.remember(y, subset, x_p, e2, noise, failed, settling)
        held = self.rows[subset][held_out(subset, m, self.n_held)]
        weights[held] = 0

        # While both models are compared, each starts from its own last estimate.
        touch = mean_square(read) - noise
        last2 = 0.0 if self.error is None else self.error**2 + gain * noise
        self.coarse = self.rotating and gain >= t.coarse_gain and touch > t.untouched * noise
        self.coarse = self.coarse and last2 > t.trusted**2 * touch
        models = self.models_to_compute(cold)
        start = {model: x_p if cold else self.last.get(model, x_p) for model in models}
        start[self.model] = x_p
        estimates, residuals = {}, {}
        if "haar" in models:
            count = self.iterations + int(t.iterations_per_nis * max(0, nis - t.expected_nis))
            threshold = min(t.threshold, t.cold_threshold / math.sqrt(self.ratio))
            least = 0.0
            if not jumped:
                threshold = t.threshold
                share = t.held_rotating if self.rotating else t.held_threshold
                least = max(t.least_threshold * math.sqrt(gain * r2), share * gain * math.sqrt(e2))
            target = self.w @ x_p + gain * (self.values - self.w @ x_p)
            limits = threshold / math.sqrt(m_counted), least
            count = self.max_iterations if settling else min(count, self.max_iterations)
            estimates["haar"] = self.haar(start["haar"], target, weights, limits, count)
            residuals["haar"] = (self.values - self.w @ estimates["haar"])[held]
        needed = "haar" not in models or self.coarse
        needed = needed or exceeds(residuals["haar"], min(noise, self.most_noise))
        if "smooth" in models and needed:
            used = np.setdiff1d(np.flatnonzero(age < math.inf), held)
            least_noise = noise + t.least_noise * mean_square(y)
            variance = least_noise + t.memory_doubt * self.drift * age[used]
            power = max((mean_square(y) if cold else e2) - least_noise, TINY)
            found, left_out = self.smooth(start["smooth"], used, variance, power, cold)
            estimates["smooth"] = found
            residuals["smooth"] = (self.values - self.w @ found)[held]
            if self.one_by_one:
                residuals["smooth"] = left_out[np.isin(used, self.rows[subset])]

        before, beyond = self.model, self.choose(residuals, noise, cold, gain)
        if (before, self.model) == ("smooth", "haar"):
            # The gain has fallen meanwhile, without the noise of the smooth model.
            self.since_jump = 0
        self.last = estimates if len(estimates) > 1 else {}
        x = estimates[self.model]
        if self.known or m >= t.comparable:
            self.follow_bias(ones, y - phi @ x, x, residuals[self.model])
        self.judge(x, beyond, noise, gain, mean_square(read))
        self.correction, self.x, self.frame = x - x_p, x, self.frame + 1
        forces = np.zeros(self.mask.shape)
        forces[self.mask] = x + self.b * -np.expm1(-x / max(self.b, TINY))
        return forces

    def predict(self, phi: Doubles, y: Doubles, changed2: float) -> tuple[Doubles, bool]:
        """Return x_p, the last frame moved by least squares (0 if it failed), and if it failed.

        Where measurements changed less since they were read last (changed2, mean square) than a
        motion leaves unexplained, nothing has moved, and nothing has vanished.
        """
        t, x = self.t, self.x
        e = y - phi @ x
        if not x.any():
            return x, False
        most = min(mean_square(e), changed2)
        if mean_square(e) > t.motion_still * self.s2:
            terms = np.array([x, *(slope @ x for slope in self.slopes)])
            rows = phi @ terms.T
            gram, right = rows.T @ rows, rows.T @ e
            found = np.linalg.solve(gram + (1e-6 * gram.max() + TINY) * np.eye(3), right)
            explained, left = found @ right, max(0.0, e @ e - found @ right)
            clear = explained * max(0, self.m - 3) / 3 > left
            if clear and explained > t.motion_significant * self.s2:
                moved = np.clip(x + found @ terms, 0, x.max() * max(1, 1 + found[0]))
                if mean_square(y - phi @ moved) < most:
                    x, e = moved, y - phi @ moved
        e2 = min(mean_square(e), changed2)
        failed = e2 > t.failed_part * mean_square(y) and e2 > t.failed_noise * self.s2
        return (0 * x if failed else x), failed

    def follow_noise(
        self, y: Doubles, subset: int, e2: float, changed2: float, failed: bool
    ) -> bool:
        """Set the noise level s2 from differences of frames; return whether the scene jumped."""
        t, seen = self.t, min(e2, changed2 / 2)
        jumped = failed or self.frame == 0 or seen > t.jump * self.s2
        self.since_jump = 0 if jumped else self.since_jump + 1
        was_hung, self.hangs = self.hangs and bool(y.any()), changed2 == 0 and bool(y.any())
        self.again = was_hung and jumped and self.s2 <= VISIBLE * self.floor
        if self.again:  # a board hung, and works again
            self.settled = self.known = False
            self.n_steps = dict.fromkeys(self.n_steps, -1)
        if subset in self.last_read:
            step = y - self.last_read[subset]
            if self.n_steps[subset] > 0:
                seen = min(seen, mean_square(step - self.last_step[subset]) / 6)
            self.last_step[subset] = step
        self.last_read[subset] = y
        self.n_steps[subset] += 1
        self.known = self.known or self.n_steps[subset] > 1
        if not self.settled:
            self.s2, self.settled = seen, self.n_steps[subset] == 1
            return jumped
        relearned = 0 < self.since_jump <= t.noise_relearned and seen < self.s2
        near = seen if relearned else self.s2 + t.noise_rate * (seen - self.s2)
        doubtful = self.rotating and seen >= t.noise_clearly * e2
        growth = t.noise_growth_rotating if doubtful else t.noise_growth
        self.s2 = min(near, growth * self.s2)
        if jumped:
            self.n_steps = dict.fromkeys(self.n_steps, -1)
            self.n_steps[subset] = 0
        return jumped

    def follow_gain(
        self, e: Doubles, correction: Doubles, subset: int, settling: bool
    ) -> tuple[float, float, float]:
        """Return the gain K, the normalised innovation squared, and the noise variance R."""
        t = self.t
        if settling:
            self.gains = dict.fromkeys(self.gains, 1.0)
        elif e.any() and correction.any():
            rho = e @ correction / math.sqrt((e @ e) * (correction @ correction))
            change = math.exp(t.trust_fall * (t.lagging - rho))
            self.trust *= change if rho > t.lagging else t.trust_growth
            self.trust = min(max(self.trust, t.trust_least), 1.0)
        r2 = self.s2 * self.trust
        nis = mean_square(e) / (r2 + TINY)
        signal, last = max(0.0, nis - t.gain_expected), self.gains[subset]
        gain = 1.0 if settling else max(t.gain_least, last / (1 + last), signal / (1 + signal))
        self.gains[subset] = gain
        return gain, nis, r2

    def remember(
        self,
        y: Doubles,
        subset: int,
        x_p: Doubles,
        e2: float,
        noise: float,
        failed: bool,
        settling: bool,
    ) -> tuple[Doubles, Doubles, float]:
        """Set the values of all rows; return weights, ages in frames, and the sum of weights^2.

        A row that is not known has the weight 0 and an infinite age.
        """
        t, rows = self.t, self.rows[subset]
        if failed:
            self.read_in.clear()
            self.drift = 0.0
        self.values += self.w @ (x_p - self.x)
        change, since = e2 - noise, 1
        if subset in self.read_in:
            change = mean_square(y - self.values[rows]) - 2 * noise
            since = self.frame - self.read_in.pop(subset)
        self.values[rows] = y
        change = max(0.0, change)
        self.drift = max(change / since, t.drift_decay * self.drift)
        self.read_in[subset] = self.frame
        age = np.full(len(self.w), math.inf)
        for other, frame in self.read_in.items():
            age[self.rows[other]] = self.frame - frame
        decayed = t.memory_weight / math.sqrt(1 + t.memory_decay * change / (noise + TINY))
        weight = 0.0 if settling else decayed
        weights = np.where(age < math.inf, weight, 0.0)
        weights[rows] = 1
        return weights, age, self.m * (1 + weight**2 * (len(self.read_in) - 1))

    def haar(
        self,
        x_p: Doubles,
        target: Doubles,
        weights: Doubles,
        limits: tuple[float, float],
        count: int,
    ) -> Doubles:
        """Return the mean of the last of `count` iterations from x_p.

        The threshold is limits[0] times the length of the residual, at least limits[1].
        """
        t, x, z = self.t, x_p, x_p
        last: list[Doubles] = []
        used = weights > 0
        a, b = weights[used, None] * self.w[used], (weights * target)[used]
        for _ in range(count):
            r = b - a @ z
            threshold = self.step * max(limits[0] * float(np.linalg.norm(r)), limits[1])
            shift = self.shifts[self.n_shifted % N_SHIFTS]
            self.n_shifted += 1
            before, x = x, np.maximum(0, self.shrink(z + self.step * (a.T @ r), shift, threshold))
            z = x + t.momentum * (x - before)
            last = [*last, x][-t.averaged :]
        mean: Doubles = np.mean(last, axis=0)
        return mean

    def shrink(self, x: Doubles, shift: tuple[int, int], threshold: float) -> Doubles:
        """Return x with its Haar coefficients, on tiles at a shift, shrunk by the garrote."""
        n_rows, n_cols = (-(-side // TILE) * TILE for side in self.mask.shape)
        canvas = np.zeros((n_rows, n_cols))
        image = canvas[: self.mask.shape[0], : self.mask.shape[1]]
        image[self.mask] = x
        tiled = n_rows // TILE, TILE, n_cols // TILE, TILE
        tiles = np.roll(canvas, shift, axis=(0, 1)).reshape(tiled).swapaxes(1, 2)
        c = tiles.reshape(-1, TILE * TILE) @ HAAR.T
        c *= np.maximum(0, 1 - (threshold**2 + TINY) / np.maximum(c * c, TINY))
        tiles = (c @ HAAR).reshape(tiles.shape)
        canvas = tiles.swapaxes(1, 2).reshape(canvas.shape)
        canvas = np.roll(canvas, (-shift[0], -shift[1]), axis=(0, 1))
        shrunk: Doubles = canvas[: self.mask.shape[0], : self.mask.shape[1]][self.mask]
        return shrunk

    def smooth(
        self, x_p: Doubles, used: Indices, variance: Doubles, power: float, cold: bool
    ) -> tuple[Doubles, Doubles]:
        """Return the estimate, and the residuals that the used rows would have if left out."""
        t, w, y = self.t, self.w[used], self.values[used]
        kept = t.kept_rotating if self.rotating else t.kept_fixed
        start = 0 * x_p if cold else kept * x_p
        b = y - w @ start
        d = np.ones(self.n) if cold else self.deviation(x_p)
        for _ in range(t.cold_rounds if cold else t.rounds):
            mean = mean_square(d)
            scale = mean_square(b) / mean + TINY
            across = d[:, None] * (self.correlation @ (w * d).T)
            system = w @ across + np.diag(variance / scale + t.model_error * mean + TINY)
            inverse = np.linalg.inv(system)
            found = inverse @ b
            left_out = found / np.diag(inverse) * math.sqrt(1 + t.fitted / len(used))
            x = np.maximum(0, start + across @ found)
            d = self.deviation(x)
        residual = power / (power + variance + TINY) * (y - w @ x)
        return np.maximum(0, x + self.step * (w.T @ residual)), left_out

    def deviation(self, x: Doubles) -> Doubles:
        """Return the standard deviations d that follow from an estimate."""
        blurred = self.blur @ x
        return blurred / blurred.max() + self.t.deviation_floor if x.any() else np.ones(self.n)

    def models_to_compute(self, cold: bool) -> tuple[str, ...]:
        """Return the models that this frame is to be estimated by."""
        t, self.wait = self.t, self.wait - 1
        doubted = self.exceeds_noise or self.coarse or self.model == "smooth"
        due = self.wait <= 0 and doubted
        if self.compares and (cold or (due and not self.left)):
            self.left = t.trial
        return ("haar", "smooth") if self.left else (self.model,)

    def choose(self, residuals: dict[str, Any], noise: float, cold: bool, gain: float) -> float:
        """Set the model of the frame; return its mean squared error beyond the noise."""
        t, now = self.t, {model: mean_square(r) for model, r in residuals.items()}
        bound = min(noise, self.most_noise)
        for model, error in now.items():
            begins = len(now) == 2 and self.left == t.trial and model != self.model
            last = error if cold or begins else self.errors.get(model, error)
            last = min(last, t.error_fading * error + bound)
            self.errors[model] = t.error_memory * last + (1 - t.error_memory) * error
            if len(now) == 1 and error > t.worse * last:
                self.wait = 0
        # A residual is noise and error: it bounds the noise, which motion makes seem too large.
        if self.n_held:
            slack = 1 + 2 * math.sqrt(2 / (self.n_held * t.error_frames))
            self.most_noise = min(self.most_noise, slack * min(self.errors[one] for one in now))
        bound = min(noise, self.most_noise)
        self.most_noise *= t.noise_growth_rotating
        if len(now) < 2:
            (self.model,) = now
        self.left = self.left - 1 if len(now) == 2 else 0
        if len(now) == 2 and (cold or not self.left):
            haar, smooth = self.errors["haar"], self.errors["smooth"]
            clearly = 1 + 2 * t.margin / math.sqrt(self.n_held * t.error_frames)
            # What Haar averages out in time does not show so soon.
            averaged = min((1 - gain * self.rotating) * bound, smooth)
            better = "smooth" if haar > clearly * smooth + averaged else "haar"
            if better != self.model or self.coarse:
                self.period = t.often
            elif not self.left:
                self.period = min(2 * self.period, t.seldom)
            self.model, self.wait = better, self.period
        count = max(1, len(residuals[self.model]))
        means = (now[self.model], count), (self.errors[self.model], count * t.error_frames)
        self.exceeds_noise = any(excess(mean, bound, number) > 0 for mean, number in means)
        return max(0.0, *(excess(mean, noise, number) for mean, number in means))

    def follow_bias(
        self, ones: Doubles, residual: Doubles, x: Doubles, held_residual: Doubles
    ) -> None:
        """Set the clip bias b from the residual along Phi 1 and the median of the taxels.

        It is bounded by the noise; before that is known, by the residual of held-out rows, too.
        """
        t, energy = self.t, float(ones @ ones)
        if self.again:
            self.n_biases, self.least_s2 = 0, math.inf
        # No row of the frame may see a bias: Phi 1 is 0 then, but for rounding.
        more = float(ones @ residual) / energy if energy > DUST * self.n else 0.0
        self.n_biases += 1
        first = max(t.median_first, t.median_rounds * len(self.rows))
        if self.n_biases <= first or self.n_biases % t.median_every == 0:
            more += float(np.median(x))
        self.least_s2 = min(t.bias_forgotten * self.least_s2, self.s2)
        bound = self.least_s2
        if len(held_residual) and not self.known:
            bound = min(bound, t.bias_bound * mean_square(held_residual))
        noise = math.sqrt(bound)
        rate = max(t.bias_slowest, t.bias_begins / (self.n_biases + t.bias_begins))
        b = self.b + rate * min(max(more, -noise / 2), noise / 2)
        b = min(max(b, 0.0), t.bias_largest * noise)
        self.b = b if b >= TINY else 0.0

    def judge(self, x: Doubles, beyond: float, noise: float, gain: float, read2: float) -> None:
        """Set the error of the estimate x, and whether it is trusted."""
        t, power = self.t, mean_square(x)
        if self.m == self.n or not (self.one_by_one or self.n_held):
            return
        kept = noise * (gain if self.model == "haar" else 1)
        error2 = max(beyond, t.filtered_error * math.sqrt(np.count_nonzero(x) / self.n) * kept)
        untouched = max(power, min(beyond, read2 - noise)) <= t.untouched * noise
        self.error = math.sqrt(error2)
        self.trusted = bool(untouched or error2 <= t.trusted**2 * power)


HAAR = haar_matrix((TILE, TILE))
"""Orthonormal Haar coefficients of a tile, three levels; float64 (64, 64)."""


def mean_square(v: Any) -> float:
    return float(np.mean(np.square(v, dtype=np.float64))) if len(v) else 0.0


def excess(mean: float, noise: float, count: float) -> float:
    """Return a mean of `count` squared residuals less what noise explains."""
    return mean - noise * (1 + 2 * math.sqrt(2 / count))


def exceeds(residual: Doubles, noise: float) -> bool:
    return excess(mean_square(residual), noise, max(1, len(residual))) > 0


def held_out(subset: int, m: int, count: int) -> Indices:
    """Return the measurements of a row subset that are held out of the estimates."""
    found: Indices = np.random.default_rng(subset).choice(m, size=count, replace=False)
    return found


def neighbour(mask: Mask, axis: int, step: int) -> Doubles:
    """Return the matrix that takes the neighbour of each taxel; itself where there is none."""
    n = int(np.count_nonzero(mask))
    number = np.full((mask.shape[0] + 2, mask.shape[1] + 2), -1)
    number[1:-1, 1:-1][mask] = np.arange(n)
    other = np.roll(number, -step, axis)[1:-1, 1:-1][mask]
    return np.eye(n)[np.where(other < 0, np.arange(n), other)]
