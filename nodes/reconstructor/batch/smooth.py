"""The smooth model of a batch: pressure whose variance and correlation length are known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY
from sparseskin.nodes.reconstructor.skin.tuning import TUNING

from .backend import Array
from .tables import Tables


class Known(NamedTuple):
    """What the smooth model is given of b patches.

    Attributes
    ----------
    x : float32 (b, n)
        Prediction, newtons.
    values, variance, used : float32 (b, n)
        Measurements of the rows of W, their variances, and 1 for those that are used.
    power, kept : float64 (b,)
        Mean square of the measurements that is not noise; part of the prediction that is kept.
    """

    x: Array
    values: Array
    variance: Array
    used: Array
    power: Array
    kept: Array


class SmoothBatch:
    """Estimates frames as `SmoothModel` does, of many patches at once.

    Correlations are full matrices also on grids beyond 256, where `SmoothModel` sets those of 4
    lengths and more to 0. There is no estimate of measurements left out one by one.
    """

    def __init__(self, t: Tables) -> None:
        self.t = t
        be = t.be

        def gaussians(side: int, lengths: tuple[float, ...]) -> Array:
            distance = np.abs(np.subtract.outer(np.arange(side), np.arange(side)))
            found = [np.exp(-0.5 * (distance / length) ** 2) for length in lengths]
            return be.array(np.array(found, dtype=np.float32))

        n_rows, n_cols = t.shape
        self.left = gaussians(n_rows, TUNING.lengths)
        self.right = gaussians(n_cols, TUNING.lengths) * (1 / len(TUNING.lengths))
        self.blur = gaussians(n_rows, (TUNING.blur,)), gaussians(n_cols, (TUNING.blur,))
        self.neighbours = self._blurred(t.exists[None, :, :]) + TINY

    def estimate_some(self, given: Known, needed: Array, cold: Array) -> Array:
        """Return the estimates of the patches that need one, float32 (B, n), of others 0.

        The host waits for the flags needed and cold, bool (B,).
        """
        be, xp = self.t.be, self.t.be.xp
        needs, is_cold = be.numpy(needed), be.numpy(cold)
        found, order = [], []
        for kind in (False, True):
            chosen = np.flatnonzero(needs & (is_cold == kind))
            if chosen.size:
                places = be.array(chosen.astype(np.int64))
                part = {name: xp.take(a, places, axis=0) for name, a in given._asdict().items()}
                found.append(self.estimate(Known(**part), kind))
                order.append(chosen)
        if not found:
            return xp.zeros_like(given.x)
        places = np.zeros(needs.size, dtype=np.int64)
        places[np.concatenate(order)] = np.arange(needs.sum())
        x = xp.take(xp.concat(found, axis=0), be.array(places), axis=0)
        return be.choose(needed, x, xp.zeros_like(x))

    def estimate(self, given: Known, cold: bool) -> Array:
        """Return the estimate, float32 (b, n); `cold` if the predictions are worth nothing."""
        t, be, xp = self.t, self.t.be, self.t.be.xp
        n_rounds = TUNING.cold_rounds if cold else TUNING.rounds
        x = given.x * 0 if cold else given.x
        start = x * be.column(given.kept)
        known = given.used * (given.values - t.transform(start))
        n_used = be.dot(given.used, given.used)
        for number in range(n_rounds):
            if cold and not number:
                deviation = t.exists[None, :, :] + xp.zeros_like(t.image(x))
            else:
                deviation = self._deviation_of(x)
            mean = xp.sum(deviation * deviation, axis=(1, 2), dtype=be.f64) / t.n
            scale = be.dot(known, known) / be.at_least(n_used * mean, TINY)
            variance = given.variance * be.column(1 / be.at_least(scale, TINY))
            field = self._descend(known, deviation, mean, variance, given.used, cold)
            x = be.positive(start + field)
        power = be.column(given.power)
        gain = power / (power + given.variance + TINY) * given.used
        return be.positive(x + t.transform(gain * (given.values - t.transform(x))))

    def _descend(
        self,
        known: Array,
        deviation: Array,
        mean: Array,
        variance: Array,
        used: Array,
        cold: bool,
    ) -> Array:
        """Return C W^T (W C W^T + V)^-1 of the known rows, by conjugate gradients."""
        t, be, xp = self.t, self.t.be, self.t.be.xp
        added = variance + be.column(TUNING.model_error * mean)
        added = xp.where(used > 0, added, xp.ones_like(added))
        inverse = 1 / (added + be.column(mean))
        found, residual = xp.zeros_like(known), known
        direction = scaled = inverse * residual
        slope = be.dot(residual, scaled)
        enough = TUNING.precise * be.dot(known, known)
        active = enough >= 0
        for _ in range(TUNING.cold_gradients if cold else TUNING.gradients):
            active = active & (be.dot(residual, residual) > enough)
            if not be.any(active):
                break
            image = t.transform(self._correlated(direction, deviation)) * used + added * direction
            curvature = be.dot(direction, image)
            active = active & (curvature > 0) & (slope > 0)
            step = be.double(active) * slope / be.choose(active, curvature, curvature * 0 + 1)
            found = found + be.column(step) * direction
            residual = residual - be.column(step) * image
            scaled = inverse * residual
            new = be.dot(residual, scaled)
            ratio = new / be.choose(active, slope, slope * 0 + 1)
            direction = be.choose(active, scaled + be.column(ratio) * direction, direction)
            slope = be.choose(active, new, slope)
        return self._correlated(found, deviation)

    def _correlated(self, rows: Array, deviation: Array) -> Array:
        """Return C W^T rows, float32 (b, n)."""
        t, xp = self.t, self.t.be.xp
        image = t.image(t.transform(rows)) * deviation
        total = xp.sum(self.left @ image[:, None, :, :] @ self.right, axis=1)
        return t.vector(total * deviation)

    def _deviation_of(self, x: Array) -> Array:
        """Return the deviation of each taxel, float32 (b, n_rows, n_cols), by an estimate."""
        t, be, xp = self.t, self.t.be, self.t.be.xp
        blurred = t.exists * self._blurred(t.image(be.positive(x))) / self.neighbours
        largest = xp.max(blurred, axis=(1, 2), keepdims=True)
        some = largest > 0
        relative = blurred / xp.where(some, largest, xp.ones_like(largest)) + TUNING.deviation_floor
        return t.exists * xp.where(some, relative, xp.ones_like(relative))

    def _blurred(self, image: Array) -> Array:
        left, right = self.blur
        return left @ image @ right
