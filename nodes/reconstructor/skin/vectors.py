"""The vectors of a frame, and what earlier frames left in them: of one patch, or of several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Indices

from .backend import ONE, Array, Backend, Number
from .formula import shrink
from .gates import SHIFTS, Gates, Tiles, TilesOfDevice
from .rows import Rows
from .tuning import SkinTuning

UNKNOWN = 1e34
"""Variance of a row that was not read yet, beyond that of any measurement."""

NEGLIGIBLE = 1e-3
"""Length of a change, in that of an innovation, which does not show its direction."""


class Steps(NamedTuple):
    """Steps of a frame: the last `averaged` estimates, float32 (n,), in a sequence or as one array;
    of each step the expected squared error, and the mean squared residual before it, of the rows
    read.
    """

    estimates: Array
    errors: Sequence[Number]
    residuals: Sequence[Number]


class Settled(NamedTuple):
    """The estimate of a frame, x: its forces, float32 (n,), and sums that tell how it fits.

    power and residual2 are the mean squares of x and of the residual; `along` is the residual along
    Phi 1, `unpressed` the sum of what taxels within the noise read, and `pressed` the part of the
    taxels beyond it.
    """

    forces: Array
    power: Number
    residual2: Number
    along: Number
    unpressed: Number
    pressed: Number


class FrameVectors:
    """The work on vectors of `SkinEstimator`, whose docstring states the method.

    Vectors are float32 (n,), or of several patches (p, n), and numbers as in `backend`.

    Parameters
    ----------
    rows, tiles, gates
        W; the windows of the skin; the weights of the denoiser: None for none.
    tuning : SkinTuning
    backend : OnePatch or ManyPatches
        Where vectors and numbers, rows, tiles and weights are.

    Attributes
    ----------
    x, z, predicted : array of float32, shape (n,)
        The last estimate, the state of the iterations, and the prediction that they began from.
    innovation, off_target : array of float32, shape (n_read,)
        What the values of the rows read exceed the prediction, and their target, by.
    innovation2 : number
        Mean square of the innovation.
    alike : number
        Correlation of the innovation with what the last measurements changed, -1 to 1.
    variance_of_read : number
        Mean variance of the targets of the rows read.
    n_known : number
        Number of the rows that were read so far.
    """

    #: What a frame leaves to the next one.
    STATE = ("x", "_whole", "_correction", "_mean", "_change", "_noise", "_recall")

    def __init__(
        self,
        rows: Rows,
        tiles: Tiles | TilesOfDevice,
        gates: Gates | None,
        tuning: SkinTuning,
        backend: Backend = ONE,
    ) -> None:
        self._rows, self._tiles, self._gates, self._t = rows, tiles, gates, tuning
        self._o: Any = backend
        self._neighbours = backend.array(neighbours_of(tiles.places, rows.n))
        self._nothing = backend.zeros(1)
        self.forget()

    def forget(self) -> None:
        """Begin anew: nothing presses, and no row was read."""
        self.x = self.z = self.predicted = self._o.zeros(self._rows.n)
        #: Sums of a regression: products, squares, number.
        self._recall = self._o.f64(self._o.zeros(3))
        self.forget_rows()

    def forget_rows(self) -> None:
        """Keep the estimate alone: the rows are those of another W."""
        n = self._rows.n_rows
        #: W times the last estimate, and times the prediction.
        self._whole, self._moved = self._rows.forward(self.x), self._o.zeros(n)
        #: W times what the last measurements changed.
        self._correction = self._o.zeros(n)
        #: State of each row's filter: mean; variance that its measurements left; that of changes.
        self._mean, self._change = self._whole * 1, self._o.zeros(n)
        self._noise = self._o.zeros(n) + UNKNOWN
        #: Value that each row is expected to have, and the variance of its error.
        self._target, self._variance = self._o.zeros(n), self._o.zeros(n)

    def start_from(self, x: Array) -> None:
        """Take x, float32 (n,), for the last estimate."""
        self.x = x
        self._whole = self._rows.forward(x)

    def predict(self, values: Array, noise: Number, error2: Number) -> None:
        """Predict the frame from the last one, of error variance error2, and the values of the rows
        read, float32 (n_read,), whose noise variance was `noise`; set z, `predicted`, `innovation`.
        """
        o, t, rows, x = self._o, self._t, self._rows, self.x
        size = values.shape[-1]
        around = x[..., self._neighbours]
        slopes = around[..., 0, :, :] - around[..., 1, :, :]
        terms = [x, slopes[..., 0, :], slopes[..., 1, :]]
        wholes = [self._whole, *map(rows.forward, terms[1:])]
        seen = [whole[..., rows.read] for whole in wholes]
        off = values - seen[0]
        gram = [[o.dot(one, other) for other in seen] for one in seen]
        right = [o.dot(one, off) for one in seen]
        # Forces of which these rows see no more than noise or error, they do not contradict.
        unseen = o.maximum(o.dot(x, x) * size / rows.n - gram[0][0], o.zero)
        doubt = o.maximum(noise, error2)
        gram[0][0] = gram[0][0] + unseen * doubt / (doubt + gram[0][0] / size)
        least = t.ridge**2 * gram[0][0] + noise
        for k in range(3):
            gram[k][k] = (1 + t.ridge) * gram[k][k] + least
        a = solved(gram, right)
        explained = o.maximum(sum(one * r for one, r in zip(a, right, strict=True)), o.zero)
        used = explained / (explained + t.motion * noise) if size >= t.least_read else o.zero
        # What these rows hardly observe must not grow without bound, and frame after frame.
        a = [o.minimum(a[0] * used, o.zero + 1), *(one * used for one in a[1:])]
        most = o.f32(o.largest(x) * o.maximum(1 + a[0], o.zero + 1))
        moved = x + sum(o.f32(one) * term for one, term in zip(a, terms, strict=True))
        self.z = self.predicted = o.xp.minimum(moved.clip(0, None), most)
        self._moved = rows.forward(self.predicted)
        self.innovation = now = values - self._moved[..., rows.read]
        last = self._correction[..., rows.read]
        power, of_last = o.dot(now, now), o.dot(last, last)
        self.innovation2 = power / size
        self.alike = o.dot(now, last) / o.sqrt(power * (of_last + NEGLIGIBLE**2 * power) + TINY)

    def filter_rows(
        self, values: Array, noise: Number, signal: Number, error2: Number, floor: Number
    ) -> None:
        """Set the targets of all rows and their variances; process the values of the rows read.

        noise is the variance of a value, signal the mean squared error of the prediction, error2
        that of what no row says anything about, floor the least variance.
        """
        o, t, read, size = self._o, self._t, self._rows.read, values.shape[-1]
        noise_32, floor_32, largest = o.f32(noise), o.f32(floor), o.xp.maximum
        mean = self._mean + (self._moved - self._whole)
        off, before = values - mean[..., read], (self._noise + self._change)[..., read]
        known = before < UNKNOWN
        n_known = o.total(known)
        seen = o.total(off * off * known) / o.maximum(n_known, o.zero + 1)
        expected = noise + o.total(before * known) / o.maximum(n_known, o.zero + 1)
        more = t.surplus(seen, expected, size, o)
        changed = o.f32(o.where(2 * n_known > size, more, signal))
        change = (self._change + changed).clip(None, UNKNOWN)
        prior = self._loosened(o.maximum(signal, error2), noise)
        share = prior / (prior + self._noise + self._loosened(change, noise))
        correction = share * (mean - self._moved)
        recalled = self._follow_recall(
            self.innovation * known, correction[..., read] * known, n_known, noise
        )
        self._variance = prior * (1 - recalled * share)
        self._target = self._moved + recalled * correction
        variance, target = self._variance[..., read], self._target[..., read]
        gain = variance / (variance + noise_32)
        self._target[..., read] = target + gain * (values - target)
        self._variance[..., read] = variance = largest(gain * noise_32, floor_32)
        before = before + changed
        gain = before / (before + noise_32)
        mean[..., read] += gain * off
        left = self._noise * 1
        left[..., read] = largest(gain * noise_32, floor_32)
        change[..., read] *= 0
        self._mean, self._noise, self._change = mean, left, change
        self.n_known = o.total(left < UNKNOWN)
        self.off_target = values - self._target[..., read]
        self.variance_of_read = o.total(variance) / size

    def _loosened(self, variance: Array | Number, noise: Number) -> Array:
        """Return the variance of errors that are not independent of each other, float32.

        It is as much larger as the errors, of mean square `variance`, exceed the noise variance.
        """
        wide = self._o.f64(variance)
        wide = self._t.prior * wide * (1 + self._t.doubt * wide / noise)
        return self._o.f32(wide.clip(None, UNKNOWN))

    def _follow_recall(
        self, innovation: Array, correction: Array, count: Number, noise: Number
    ) -> Array:
        """Return the part of the correction by the rows' own filters that is used, 0 to 1.

        By regression: how much of it the rows that are read now confirm, these frames and before.
        """
        o, t = self._o, self._t
        sums = o.dot(innovation, correction), o.dot(correction, correction), count
        now = o.xp.stack([o.f64(one).reshape(-1) for one in sums], axis=-1)
        self._recall = t.recall_memory * self._recall + now.reshape(self._recall.shape)
        product, square, n_values = (self._recall[..., k : k + 1] for k in range(3))
        ridge = t.recall_ridge * noise * n_values
        return o.f32(((product + ridge) / (square + ridge + TINY)).clip(0, 1))

    def steps(self, first: int, floor: Number, n_formula: int, n: int) -> Steps:
        """Do `n_formula` steps by the formula, then n by the weights, with the tiles of the shifts
        from the number `first` on.
        """
        found = [
            self.step((first + k) % len(SHIFTS), floor, k < n_formula) for k in range(n_formula + n)
        ]
        estimates, errors, residuals = zip(*found[n_formula:], strict=True)
        return Steps(estimates[-self._t.averaged :], errors, residuals)

    def step(self, shift: int, floor: Number, formula: bool) -> tuple[Array, Number, Number]:
        """Move z, with the tiles of a shift; floor is the least variance. `formula` is True for
        `shrink` in place of the weights, which is used where there are none, too.

        Returns
        -------
        x : array of float32, shape (n,)
            The estimate of this step.
        error2 : number
            Its expected mean squared error.
        residual2 : number
            Mean squared residual of z before the step, of the rows read.
        """
        o, t, rows, z = self._o, self._t, self._rows, self.z
        r = self._target - rows.forward(z)
        of_read = r[..., rows.read]
        size = of_read.shape[-1]
        rho = o.dot(of_read, of_read) / size
        residual = of_read + self.off_target
        residual2 = o.dot(residual, residual) / size
        v = self.variance_of_read
        tau = o.maximum(rho - v, t.least_tau * o.maximum(rho, v)) + floor
        d = o.f32(tau) / (o.f32(tau) + self._variance)
        mean_d = o.total(d) / rows.n
        s = o.f32(o.sqrt(tau * o.maximum(1 - mean_d, o.zero) / mean_d + floor))
        u = z + rows.adjoint(d * r) / o.f32(mean_d)
        windows = self._tiles.windows(o.xp.concatenate([u / s, self._nothing], axis=-1), shift)
        denoise = shrink if formula or self._gates is None else self._gates.denoise
        tiles, error = denoise(windows, self._tiles.strictness, o)
        x = self._tiles.taxels(tiles, shift) * s
        expected = o.dot(error, self._tiles.shares[shift])
        alpha = o.f32(o.minimum(expected, o.zero + t.most_alpha))
        self.z = z + t.damping * ((x - alpha * u) / (1 - alpha) - z)
        return x, expected * o.f64(s) ** 2, residual2

    def settle(
        self,
        estimates: Array,
        part: Number,
        values: Array,
        ones: Array,
        bias: Number,
        noise_sd: Number,
        least: Number,
    ) -> Settled:
        """Take the mean of some estimates, float32 (n,), and `part` of the prediction for x.

        values and ones, float32 (n_read,), are those of the rows read and Phi 1. Readings of mean
        bias + u are of the force u + bias (1 - exp(-u / bias)), which is not clipped as often;
        forces below `least` are 0. noise_sd is that of an untouched taxel.
        """
        o = self._o
        mean = sum(estimates[1:], estimates[0]) * o.f32((1 - part) / len(estimates))
        self.start_from(mean + o.f32(part) * self.predicted)
        self._correction = self._whole - self._moved
        x, residual = self.x, values - self._whole[..., self._rows.read]
        near = (x / o.f32(2 * noise_sd + math.sqrt(TINY))).clip(None, 8)
        weak = o.xp.exp(-near * near)
        curve = o.f32(o.where(bias > 0, bias, o.zero + 1))
        forces = x + o.f32(bias) * (1 - o.xp.exp(-x / curve))
        return Settled(
            forces * (forces >= o.f32(least)),
            o.dot(x, x) / x.shape[-1],
            o.dot(residual, residual) / residual.shape[-1],
            o.dot(ones, residual),
            o.dot(x, weak),
            o.total((1 - weak) ** 2) / x.shape[-1],
        )


def solved(matrix: list[list[Number]], right: Sequence[Number]) -> list[Number]:
    """Solve a small system of equations by elimination: entries are numbers; matrix is spent."""
    a, n = list(right), len(right)
    for j in range(n):
        for k in range(j + 1, n):
            factor = matrix[k][j] / matrix[j][j]
            matrix[k] = [matrix[k][i] - factor * matrix[j][i] for i in range(n)]
            a[k] = a[k] - factor * a[j]
    for j in reversed(range(n)):
        rest = sum(matrix[j][k] * a[k] for k in range(j + 1, n))
        a[j] = (a[j] - rest) / matrix[j][j]
    return a


def neighbours_of(places: Indices, n: int) -> Indices:
    """Return the places of the next and the last neighbour of each taxel along rows and columns.

    The result is intp (next or last, rows or columns, n); a missing neighbour is the taxel itself.
    places and n are as in `Tiles`.
    """
    found = np.empty((2, 2, n), dtype=np.intp)
    exists = places < n
    edged = np.pad(places, 1, constant_values=n)
    sides = ((edged[2:, 1:-1], edged[1:-1, 2:]), (edged[:-2, 1:-1], edged[1:-1, :-2]))
    for which, axis in np.ndindex(2, 2):
        other = np.where(sides[which][axis] < n, sides[which][axis], places)
        found[which, axis, places[exists]] = other[exists]
    return found
