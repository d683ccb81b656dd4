"""The vectors of a frame, and what earlier frames left in them, in plain numpy."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices

from .formula import shrink
from .gates import SHIFTS, Gates, Tiles
from .rows import Rows
from .tuning import SkinTuning

UNKNOWN = 1e34
"""Variance of a row that was not read yet, beyond that of any measurement."""

NEGLIGIBLE = 1e-3
"""Length of a change, in that of an innovation, which does not show its direction."""


class Steps(NamedTuple):
    """Steps of a frame: the last `averaged` estimates, float32 (k, n); of each step the expected
    squared error, and the mean squared residual before it, of the rows read.
    """

    estimates: Floats
    errors: list[float]
    residuals: list[float]


class Settled(NamedTuple):
    """The estimate of a frame, x: its forces, float32 (n,), and sums that tell how it fits.

    power and residual2 are the mean squares of x and of the residual; `along` is the residual along
    Phi 1, and `unpressed` the sum of what taxels within the noise read.
    """

    forces: Floats
    power: float
    residual2: float
    along: float
    unpressed: float


class FrameVectors:
    """The work on vectors of `SkinSolver`, whose docstring states the method.

    Parameters
    ----------
    rows, tiles, gates
        W; the windows of the skin; the weights of the denoiser: None for none.
    places : ndarray of intp, shape (n_rows, n_cols)
        As in `Tiles`.
    tuning : SkinTuning

    Attributes
    ----------
    x, z, predicted : ndarray of float32, shape (n,)
        The last estimate, the state of the iterations, and the prediction that they began from.
    innovation, off_target : ndarray of float32, shape (n_read,)
        What the values of the rows read exceed the prediction, and their target, by.
    innovation2 : float
        Mean square of the innovation.
    alike : float
        Correlation of the innovation with what the last measurements changed, -1 to 1.
    variance_of_read : float
        Mean variance of the targets of the rows read.
    """

    def __init__(
        self, rows: Rows, tiles: Tiles, gates: Gates | None, places: Indices, tuning: SkinTuning
    ) -> None:
        self._rows, self._tiles, self._gates, self._t = rows, tiles, gates, tuning
        self._neighbours = neighbours_of(places, rows.n)
        self._recall = np.zeros(3)
        self.forget()

    def forget(self) -> None:
        """Begin anew: nothing presses, and no row was read."""
        self.x, self.z, self.predicted = np.zeros((3, self._rows.n), dtype=np.float32)
        self._recall.fill(0)
        self.forget_rows()

    def forget_rows(self) -> None:
        """Keep the estimate alone: the rows are those of another W."""
        n = self._rows.n_rows
        #: W times the last estimate, and times the prediction.
        self._whole, self._moved = self._rows.forward(self.x), np.zeros(n, dtype=np.float32)
        #: W times what the last measurements changed.
        self._correction = np.zeros(n, dtype=np.float32)
        #: State of each row's filter: mean; variance that its measurements left; that of changes.
        self._mean, self._change = self._whole.copy(), np.zeros(n, dtype=np.float32)
        self._noise = np.full(n, UNKNOWN, dtype=np.float32)
        #: Value that each row is expected to have, and the variance of its error.
        self._target, self._variance = np.zeros((2, n), dtype=np.float32)

    def start_from(self, x: Floats) -> None:
        """Take x, float32 (n,), for the last estimate."""
        self.x = x
        self._whole = self._rows.forward(x)

    def predict(self, values: Floats, noise: float) -> None:
        """Predict the frame from the last one and the values of the rows read, float32 (n_read,),
        whose noise variance was `noise`; set z, `predicted` and `innovation`.
        """
        t, rows, x = self._t, self._rows, self.x
        after, before = x[self._neighbours]
        terms = np.stack([x, *(after - before)])
        seen = np.stack([self._whole, *map(rows.forward, terms[1:])])[:, rows.read]
        gram = (seen @ seen.T).astype(np.float64)
        right = (seen @ (values - seen[0])).astype(np.float64)
        # Even forces, of which these rows see hardly more than noise, they do not contradict.
        unseen = max(0.0, float(x @ x) * rows.read.size / rows.n - gram[0, 0])
        gram[0, 0] += unseen * noise / (noise + gram[0, 0] / rows.read.size)
        # A force grows by its own size at most: what is hardly there must not grow to anything.
        ridge = t.ridge * np.diag(gram) + t.ridge**2 * gram[0, 0] + noise
        a = np.linalg.solve(gram + np.diag(ridge), right)
        explained = max(0.0, float(a @ right))
        a *= explained / (explained + t.motion * noise)
        # What no row observes must not grow without bound, frame after frame.
        most = float(x.max()) * max(1.0, 1 + float(a[0]))
        self.predicted = np.clip(x + a.astype(np.float32) @ terms, 0, np.float32(most))
        self._moved = rows.forward(self.predicted)
        self.innovation = now = values - self._moved[rows.read]
        self.z = self.predicted.copy()
        last = self._correction[rows.read]
        self._compare(float(now @ now), float(last @ last), float(now @ last))

    def _compare(self, power: float, of_last: float, product: float) -> None:
        """Set `innovation2` and `alike`: innovation and last correction, squares and product."""
        self.innovation2 = power / self.innovation.size
        self.alike = product / math.sqrt(power * (of_last + NEGLIGIBLE**2 * power) + TINY)

    def filter_rows(
        self, values: Floats, noise: float, signal: float, error2: float, floor: float
    ) -> None:
        """Set the targets of all rows and their variances; process the values of the rows read.

        noise is the variance of a value, signal the mean squared error of the prediction, error2
        that of what no row says anything about, floor the least variance.
        """
        t, read, mean, change = self._t, self._rows.read, self._mean, self._change
        mean += self._moved - self._whole
        off, before = values - mean[read], (self._noise + change)[read]
        known = before < UNKNOWN
        changed = signal
        if 2 * np.count_nonzero(known) > read.size:
            seen = float(np.mean(np.square(off[known])))
            expected = noise + float(np.mean(before[known]))
            changed = t.surplus(seen, expected, off.size)
        np.minimum(change + np.float32(changed), UNKNOWN, out=change)
        prior = self._loosened(np.float32(max(signal, error2)), noise)
        share = prior / (prior + self._noise + self._loosened(change, noise))
        correction = share * (mean - self._moved)
        recalled = self._follow_recall(self.innovation[known], correction[read][known], noise)
        share *= recalled
        self._variance = prior * (1 - share)
        self._target = self._moved + recalled * correction
        gain = self._variance[read] / (self._variance[read] + np.float32(noise))
        self._target[read] += gain * (values - self._target[read])
        self._variance[read] = np.maximum(gain * np.float32(noise), np.float32(floor))
        before += np.float32(changed)
        gain = before / (before + np.float32(noise))
        mean[read] += gain * off
        self._noise[read] = np.maximum(gain * np.float32(noise), np.float32(floor))
        change[read] = 0
        self.off_target = values - self._target[read]
        self.variance_of_read = float(np.mean(self._variance[read]))

    def _loosened(self, variance: Floats | np.float32, noise: float) -> Floats:
        """Return the variance of errors that are not independent of each other, float32.

        It is as much larger as the errors, of mean square `variance`, exceed the noise variance.
        """
        wide = np.asarray(variance, dtype=np.float64)
        wide = self._t.prior * wide * (1 + self._t.doubt * wide / noise)
        return np.minimum(wide, UNKNOWN).astype(np.float32)

    def _follow_recall(self, innovation: Floats, correction: Floats, noise: float) -> np.float32:
        """Return the part of the correction by the rows' own filters that is used, 0 to 1.

        By regression: how much of it the rows that are read now confirm, these frames and before.
        """
        t, sums = self._t, self._recall
        sums *= t.recall_memory
        sums += np.array([innovation @ correction, correction @ correction, innovation.size])
        ridge = t.recall_ridge * noise * sums[2]
        return np.float32(min(max((sums[0] + ridge) / (sums[1] + ridge + TINY), 0.0), 1.0))

    def steps(self, first: int, floor: float, n_formula: int, n: int) -> Steps:
        """Do `n_formula` steps by the formula, then n by the weights, with the tiles of the shifts
        from the number `first` on.
        """
        found = [
            self.step((first + k) % len(SHIFTS), floor, k < n_formula) for k in range(n_formula + n)
        ]
        estimates, errors, residuals = zip(*found[n_formula:], strict=True)
        return Steps(np.stack(estimates[-self._t.averaged :]), [*errors], [*residuals])

    def step(self, shift: int, floor: float, formula: bool) -> tuple[Floats, float, float]:
        """Move z, with the tiles of a shift; floor is the least variance. `formula` is True for
        `shrink` in place of the weights, which is used where there are none, too.

        Returns
        -------
        x : ndarray of float32, shape (n,)
            The estimate of this step.
        error2 : float
            Its expected mean squared error.
        residual2 : float
            Mean squared residual of z before the step, of the rows read.
        """
        t, rows, z = self._t, self._rows, self.z
        r = self._target - rows.forward(z)
        of_read = r[rows.read]
        rho = float(np.mean(np.square(of_read)))
        residual2 = float(np.mean(np.square(of_read + self.off_target)))
        v = self.variance_of_read
        tau = max(rho - v, t.least_tau * max(rho, v)) + floor
        d = tau / (tau + self._variance)
        mean_d = float(np.sum(d)) / rows.n
        s = np.float32(math.sqrt(tau * max(1 - mean_d, 0.0) / mean_d + floor))
        u: Floats = z + rows.adjoint(d * r) / np.float32(mean_d)
        windows, back, share = self._tiles.tables(shift)
        scaled = np.zeros(rows.n + 1, dtype=np.float32)
        np.divide(u, s, out=scaled[:-1])
        denoise = shrink if formula or self._gates is None else self._gates.denoise
        tiles, error = denoise(scaled[windows], self._tiles.strictness)
        x: Floats = tiles.reshape(-1)[back] * s
        expected = float(share @ error)
        alpha = np.float32(min(expected, t.most_alpha))
        free = (x - alpha * u) / (1 - alpha)
        self.z = (z + t.damping * (free - z)).astype(np.float32, copy=False)
        return x, expected * float(s) ** 2, residual2

    def settle(
        self,
        estimates: Floats,
        part: float,
        values: Floats,
        ones: Floats,
        bias: float,
        noise_sd: float,
        least: float,
    ) -> Settled:
        """Take the mean of some estimates, float32 (k, n), and `part` of the prediction for x.

        values and ones, float32 (n_read,), are those of the rows read and Phi 1. Readings of mean
        bias + u are of the force u + bias (1 - exp(-u / bias)), which is not clipped as often;
        forces below `least` are 0. noise_sd is that of an untouched taxel.
        """
        mean = np.add.reduce(estimates, axis=0) * np.float32((1 - part) / len(estimates))
        self.start_from(mean + np.float32(part) * self.predicted)
        self._correction = self._whole - self._moved
        x, residual = self.x, values - self._whole[self._rows.read]
        near = np.minimum(x / np.float32(2 * noise_sd + math.sqrt(TINY)), 8)
        forces = x + np.float32(bias) * (1 - np.exp(-x / np.float32(bias))) if bias else x
        return Settled(
            np.where(forces < least, 0, forces),
            float(x @ x) / x.size,
            float(residual @ residual) / residual.size,
            float(ones @ residual),
            float(x @ np.exp(-near * near)),
        )


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
