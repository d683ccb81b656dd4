"""Orthogonal approximate message passing with learned gates, filtered over time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import TINY, Floats, Mask
from sparseskin.nodes.numerics.compiled import use_compiled
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.skin.clip_bias import DUST
from sparseskin.nodes.reconstructor.skin.noise_level import RESOLUTION
from sparseskin.nodes.reconstructor.skin.prediction import neighbours_of
from sparseskin.nodes.reconstructor.solvers.base import Solver, whole_number

from .gates import SHIFTS, Gates, Tiles, stored_gates
from .rows import HadamardRows, rows_of

if TYPE_CHECKING:
    from .compiled import CompiledStep

UNKNOWN = 1e34
"""Variance of a row that was not read yet, beyond that of any measurement."""


@dataclass(frozen=True)
class OampTuning:
    """Constants of `OampSolver`: chosen on five recordings and on moving presses, but those with
    a reason stated.
    """

    #: Part of a step towards the divergence-free estimate: 1 diverges at M <= N/3.
    damping: float = 0.5
    #: Estimates of a frame that are averaged, each with a shift of its own.
    averaged: int = 3
    #: Least error variance of z, in mean squared residuals.
    least_tau: float = 0.05
    #: Largest expected error of the denoiser, in noise variances: 1 / (1 - alpha) stays bounded.
    most_alpha: float = 0.9
    #: Reduction of the squared innovation, in noise variances, at which half of a motion is used.
    #: Derived: three free parameters explain 3 of noise, and 12 in one frame of a hundred.
    motion: float = 12.0
    #: Ridge of the motion, as a part of each energy.
    ridge: float = 1e-3
    #: Rate of the noise level per frame, and its largest growth.
    noise_rate: float = 0.2
    noise_growth: float = 1.4
    #: Deviations of a mean square at which half of what it exceeds its expectation by counts, and
    #: the least number of squares that these are taken of.
    significant: float = 3.0
    least_count: int = 300
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
    #: Weight of the prediction in the estimate, E / (E + b P) by the error variances of both, whose
    #: errors are not independent: b; and its largest value.
    blend: float = 2.0
    most_predicted: float = 0.9
    #: Correlation of an innovation with the last correction beyond which the estimate lags behind;
    #: rates at which the trust in the noise level falls and grows per frame; its least value.
    lagging: float = 0.2
    trust_fall: float = 0.5
    trust_growth: float = 0.05
    least_trust: float = 0.05
    #: Largest bias, in deviations of the noise. Derived: normal noise clipped at 0 has a mean of
    #: 0.68 of its deviation.
    most_bias: float = 0.75
    #: First and least rate of the bias per frame.
    bias_begins: float = 3.0
    bias_rate: float = 0.05
    #: Growth per frame of the least noise variance so far, which bounds the bias.
    bias_forgotten: float = 1.002
    #: Error of the residuals' own estimate of the error, in their sampling deviations.
    doubtful: float = 1.0
    #: Largest noise variance, in the least one so far.
    louder: float = 4.0
    #: Mean squared residual, in noise variances, beyond which a skin is not untouched.
    unexplained: float = 2.0
    #: Mean squared force, in noise variances, up to which nothing touches the skin.
    untouched: float = 0.05
    #: Largest error that is trusted, as a part of the forces, both RMS.
    trusted: float = 0.25

    def surplus(self, seen: float, expected: float, count: int) -> float:
        """What a mean square of `count` numbers exceeds its expectation by, where significant."""
        more = max(0.0, seen - expected)
        z2 = more * more * max(count, self.least_count) / (2 * expected * expected + TINY)
        return more * z2 / (z2 + self.significant**2)


class OampSolver(Solver):
    """Reconstructs frames in a constant number of steps, with the estimated error of each.

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
       x, alpha = `Gates` of u / s; z moves half the way to (x - alpha u) / (1 - alpha).
    6. The errors of z do not depend on the noise of the measurements: their mean squared residual
       less R is the error variance E of the last three x; where that is within the noise, alpha s^2
       counts. The estimate is the mean of these x and of x_p, by E and P.

    One solver serves all row subsets of rotating rows. Any Phi will do: its rows are made
    orthonormal first, whatever their length. Each frame takes the same number of steps.

    Parameters
    ----------
    phi, mask
        As in `Solver`.
    basis : Basis
        Gives the size of the grid; the gates are learned.
    iterations : int
        Steps of a frame, 1..1000. Fewer than 5 have not converged where a contact begins.
    fast : str
        Use of compiled loops, for "sbhe": "auto" (where numba is installed), "on" or "off".
    gates : Gates, optional
        Weights of the denoiser; None: those of the package.
    tuning : OampTuning
        The constants of the method; another one is an ablation.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.

    Notes
    -----
    Source: Ma, Ping, "Orthogonal AMP", IEEE Access 5, 2017; Metzler, Mousavi, Baraniuk, "Learned
    D-AMP", NeurIPS 2017, for a learned denoiser in it; Mehra, "On the identification of variances
    and adaptive Kalman filtering", IEEE Trans. Automatic Control 15(2), 1970, for the noise level.
    """

    name = "oamp"
    rotates = True
    #: The sum of squares of larger ones could overflow float32.
    y_max = 1e14

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 8,
        fast: str = "auto",
        gates: Gates | None = None,
        tuning: OampTuning | None = None,
    ) -> None:
        super().__init__(phi, basis, mask)
        self.n_steps = self.iterations = whole_number(self.name, "iterations", iterations, 1, 1000)
        for key, value, kind in (("gates", gates, Gates), ("tuning", tuning, OampTuning)):
            if value is not None and not isinstance(value, kind):
                raise SolverError(
                    f"{self.name}: {key} = {value!r} is not allowed; "
                    f"allowed: {kind.__name__}, from Python only"
                )
        self._t = tuning or OampTuning()
        self._gates = gates or stored_gates()
        compiled = use_compiled(fast) and is_sbhe(phi)
        self._rows = rows_of(phi, compiled)
        self._cells = self.taxels[self._rows.taxel]
        flat = np.full(self.mask.size, phi.n, dtype=np.intp)
        flat[self._cells] = np.arange(phi.n)
        places = flat.reshape(self.mask.shape)
        self._tiles = Tiles(self.mask, places, phi.n)
        self._neighbours = neighbours_of(places, phi.n)
        #: A step in a compiled loop; None: in numpy.
        self._compiled: CompiledStep | None = None
        if compiled:
            from .compiled import CompiledStep  # needs numba

            assert isinstance(self._rows, HadamardRows)
            t = self._t
            constants = t.least_tau, t.most_alpha, t.damping
            self._compiled = CompiledStep(self._rows, self._tiles, self._gates, constants)
        #: By row subset: Phi 1; the last innovation.
        self._ones: dict[str, Floats] = {}
        self._innovations: dict[str, Floats] = {}
        self.reset()

    def reset(self) -> None:
        self._x = np.zeros(self.phi.n, dtype=np.float32)
        self._correction = np.zeros_like(self._x)
        self._innovations.clear()
        n_rows = self._rows.n_rows
        self._whole, self._rows_mean, self._row_change = np.zeros((3, n_rows), dtype=np.float32)
        self._row_noise = np.full(n_rows, UNKNOWN, dtype=np.float32)
        self._noise = self._least_noise = self._floor = self._bias = 0.0
        self._n_frames = self._n_seen = self._n_shifts = self._steps_left = 0
        self._trust = 1.0
        self._last_error2 = 0.0
        self._signal = 0.0
        self._recall = np.zeros(3)
        self.error, self.trusted = None, True

    def use(self, phi: Phi) -> None:
        if (phi.n, phi.m) != (self.phi.n, self.phi.m):
            raise SolverError(
                f"{self.name}: phi {phi.fingerprint} is {phi.m} x {phi.n}; "
                f"allowed: {self.phi.m} x {self.phi.n}"
            )
        super().use(phi)
        self.phi = phi
        self._rows.use(phi)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._shaped_y(y)
        power = self._power_of(y) / y.size
        if warm is not None:
            self._x = np.maximum(self._checked_warm(warm).reshape(-1)[self._cells], 0)
            self._whole = self._rows.forward(self._x)
        rows, key = self._rows, self.phi.fingerprint
        read = rows.read
        if key not in self._ones:
            self._ones[key] = rows.forward(np.ones(rows.n, dtype=np.float32))[read]
        # Of this frame alone: one frame of garbage must not blind those after it.
        self._floor = max(RESOLUTION**2 * power, TINY)
        values = rows.values(y) - np.float32(self._bias) * self._ones[key]
        self._z, whole = self._predict(values)
        innovation = values - whole[read]
        e2 = float(np.mean(np.square(innovation)))
        noise = self._follow_noise(key, innovation, e2)
        self._filter_rows(values, whole, innovation, noise, self._follow_signal(e2, noise))
        self._read_noise = float(np.mean(self._variance[read]))
        self._values, self._predicted = values, self._z.copy()
        self._estimates: list[Floats] = []
        self._errors: list[float] = []
        self._residuals: list[float] = []
        self._off_target = values - self._target[read]
        # Noise grows with the forces, but not without bound: what exceeds it, no force explains.
        known = self._n_seen > 1 / self._t.noise_rate
        self._judged_noise = min(noise, self._t.louder * self._least_noise) if known else noise
        self._steps_left = self.n_steps

    def _follow_signal(self, e2: float, noise: float) -> float:
        """Return the mean squared error of the prediction: what the innovation's, e2, exceeds the
        noise by, averaged over frames.
        """
        now = self._t.surplus(e2, noise, self._rows.read.size)
        self._signal += self._t.signal_rate * (e2 - noise - self._signal)
        most = max(0.0, e2 - noise) + 2 * noise * math.sqrt(2 / self._rows.read.size)
        self._signal = max(min(self._signal, most), now / 2)
        return max(0.0, self._signal, now)

    def _filter_rows(
        self, values: Floats, whole: Floats, innovation: Floats, noise: float, signal: float
    ) -> None:
        """Set the target of each row and its variance; process the values of the rows read.

        whole is W times the prediction, innovation what the values exceed it by.
        """
        t, read, mean, change = self._t, self._rows.read, self._rows_mean, self._row_change
        mean += whole - self._whole
        off, before = values - mean[read], (self._row_noise + change)[read]
        known = before < UNKNOWN
        changed = signal
        if 2 * np.count_nonzero(known) > read.size:
            seen = float(np.mean(np.square(off[known])))
            expected = noise + float(np.mean(before[known]))
            changed = t.surplus(seen, expected, off.size)
        np.minimum(change + np.float32(changed), UNKNOWN, out=change)
        # Of rows that are never read, the innovation says nothing: the last estimate's own error.
        predicted = np.float32(max(signal, self._last_error2, self._floor))
        prior = loosened(predicted, noise, t)
        share = prior / (prior + self._row_noise + loosened(change, noise, t))
        correction = share * (mean - whole)
        recalled = self._follow_recall(innovation[known], correction[read][known], noise)
        share *= recalled
        self._variance = prior * (1 - share)
        self._target = whole + recalled * correction
        gain = self._variance[read] / (self._variance[read] + np.float32(noise))
        self._target[read] += gain * (values - self._target[read])
        self._variance[read] = np.maximum(gain * np.float32(noise), np.float32(self._floor))
        before += np.float32(changed)
        gain = before / (before + np.float32(noise))
        mean[read] += gain * off
        self._row_noise[read] = np.maximum(gain * np.float32(noise), np.float32(self._floor))
        change[read] = 0

    def _follow_recall(self, innovation: Floats, correction: Floats, noise: float) -> np.float32:
        """Return the part of the correction by the rows' own filters that is used, 0 to 1.

        By regression: how much of it the rows that are read now confirm, these frames and before.
        """
        t, sums = self._t, self._recall
        sums *= t.recall_memory
        sums += np.array([innovation @ correction, correction @ correction, innovation.size])
        ridge = t.recall_ridge * noise * sums[2]
        return np.float32(min(max((sums[0] + ridge) / (sums[1] + ridge + TINY), 0.0), 1.0))

    def _predict(self, values: Floats) -> tuple[Floats, Floats]:
        """Return the prediction of the frame, float32 (n,), and W times it."""
        t, rows, x = self._t, self._rows, self._x
        after, before = x[self._neighbours[0]], x[self._neighbours[1]]
        terms = np.stack([x, *(after - before)])
        of_terms = (self._whole, *map(rows.forward, terms[1:]))
        seen = np.stack([whole[rows.read] for whole in of_terms])
        gram = (seen @ seen.T).astype(np.float64)
        right = (seen @ (values - seen[0])).astype(np.float64)
        noise = max(self._noise, self._floor)
        # A force grows by its own size at most: what is hardly there must not grow to anything.
        ridge = t.ridge * np.diag(gram) + t.ridge**2 * gram[0, 0] + noise
        a = np.linalg.solve(gram + np.diag(ridge), right)
        explained = max(0.0, float(a @ right))
        a *= explained / (explained + t.motion * noise)
        # What no row observes must not grow without bound, frame after frame.
        most = float(x.max()) * max(1.0, 1 + float(a[0]))
        moved = np.clip(x + a.astype(np.float32) @ terms, 0, np.float32(most))
        return moved, rows.forward(moved)

    def _follow_noise(self, key: str, innovation: Floats, e2: float) -> float:
        """Update the noise level; return it times the trust in it.

        Where an innovation points along the last correction, that was too small: what seems noise
        is motion.
        """
        t = self._t
        if (last := self._innovations.get(key)) is not None:
            seen = max(0.0, float(np.mean(last * (last - innovation))))
            self._n_seen += 1
            level = self._noise + max(t.noise_rate, 1 / self._n_seen) * (seen - self._noise)
            if self._n_seen > 1 / t.noise_rate:
                level = min(level, t.noise_growth * self._noise)
                self._least_noise = min(t.bias_forgotten * self._least_noise, level)
            else:
                self._least_noise = level
            self._noise = min(level, e2)
        self._noise = max(self._noise, self._floor, self.noise_sd**2)
        self._innovations[key] = innovation
        correction = self._rows.forward(self._correction)[self._rows.read]
        lengths = float(np.linalg.norm(innovation)) * float(np.linalg.norm(correction))
        alike = float(innovation @ correction) / (lengths + TINY)
        self._trust *= math.exp(min(t.trust_fall * (t.lagging - alike), t.trust_growth))
        self._trust = min(max(self._trust, t.least_trust), 1.0)
        return max(self._noise * self._trust, self._floor)

    def step(self) -> None:
        self._count_step()
        shift = self._n_shifts
        self._n_shifts = (shift + 1) % len(SHIFTS)
        if self._compiled is not None:
            aims = self._target, self._variance, self._read_noise, self._floor
            x, error2, residual2 = self._compiled(self._z, *aims, self._off_target, shift)
        else:
            x, error2, residual2 = self._step(shift)
        self._estimates.append(x)
        self._errors.append(error2)
        self._residuals.append(residual2)

    def _step(self, shift: int) -> tuple[Floats, float, float]:
        """Move z; return the estimate x, its expected squared error, and the mean squared residual
        of z.
        """
        t, rows, z = self._t, self._rows, self._z
        r = self._target - rows.forward(z)
        of_read = r[rows.read]
        rho = float(np.mean(np.square(of_read)))
        residual2 = float(np.mean(np.square(of_read + self._off_target)))
        tau = max(rho - self._read_noise, t.least_tau * rho) + self._floor
        d = tau / (tau + self._variance)
        mean_d = float(np.sum(d)) / rows.n
        s = np.float32(math.sqrt(tau * max(1 - mean_d, 0.0) / mean_d + self._floor))
        u: Floats = z + rows.adjoint(d * r) / np.float32(mean_d)
        windows, back, share = self._tiles.tables(shift)
        scaled = np.zeros(rows.n + 1, dtype=np.float32)
        np.divide(u, s, out=scaled[:-1])
        tiles, error = self._gates.denoise(scaled[windows])
        x: Floats = tiles.reshape(-1)[back] * s
        expected = float(share @ error)
        alpha = np.float32(min(expected, t.most_alpha))
        free = (x - alpha * u) / (1 - alpha)
        self._z = (z + t.damping * (free - z)).astype(np.float32, copy=False)
        return x, expected * float(s) ** 2, residual2

    def finish(self) -> Floats:
        self._steps_left = 0
        t, rows = self._t, self._rows
        if self._estimates:
            self._x = np.mean(self._estimates[-t.averaged :], axis=0, dtype=np.float32)
            error2 = self._error2()
            prior = t.blend * max(self._signal, self._last_error2, self._floor)
            part = min(t.most_predicted, error2 / (error2 + prior))
            self._x += np.float32(part) * (self._predicted - self._x)
            self._last_error2 = (1 - part) * error2
            self.error = math.sqrt(self._last_error2)
        x = self._x
        self._correction = x - self._predicted
        self._n_frames += 1
        forces, bias = x, np.float32(self._bias)
        if bias > 0:
            # Readings of mean b + u of a force that is not clipped as often: u + b (1 - e^(-u/b)).
            forces = x - bias * np.expm1(-x / bias)
        self._whole = rows.forward(x)
        self._follow_bias(self._values - self._whole[rows.read])
        power = float(np.mean(np.square(x, dtype=np.float64)))
        assert self.error is not None
        noise = self._judged_noise
        untouched = power <= t.untouched * noise and self._residual2() <= t.unexplained * noise
        self.trusted = untouched or self.error**2 <= t.trusted**2 * power
        image = np.zeros(self.mask.size, dtype=np.float32)
        image[self._cells] = forces
        return self._finite(image.reshape(self.mask.shape))

    def _error2(self) -> float:
        """Mean squared error of the mean of the last estimates.

        The errors of z do not depend on the noise of the measurements: the residuals exceed the
        noise by them. Where that is not significant, the gates' own expectation counts.
        """
        t, noise = self._t, self._judged_noise
        own = float(np.mean(self._errors[-t.averaged :]))
        seen = max(0.0, self._residual2() - noise)
        doubt = t.doubtful * (seen + noise) * math.sqrt(2 / self._values.size)
        share = seen * seen / (seen * seen + doubt * doubt + TINY)
        return share * seen + (1 - share) * own

    def _residual2(self) -> float:
        """Mean squared residual of the last z."""
        return float(np.mean(self._residuals[-self._t.averaged :]))

    def _follow_bias(self, residual: Floats) -> None:
        """Update the mean reading of an untouched taxel: by the residual along Phi 1, and by the
        taxels within the noise.
        """
        t, ones = self._t, self._ones[self.phi.fingerprint]
        noise = math.sqrt(self._least_noise)
        energy = float(ones @ ones)
        more = float(ones @ residual) / energy if energy > DUST * self._rows.n else 0.0
        near = np.minimum(self._x / np.float32(2 * noise + math.sqrt(TINY)), 8)
        more += float(np.mean(self._x * np.exp(-near * near)))
        rate = max(t.bias_rate, t.bias_begins / (self._n_frames + t.bias_begins))
        bias = self._bias + rate * min(max(more, -noise / 2), noise / 2)
        self._bias = min(max(bias, 0.0), t.most_bias * noise)
        if self._bias < 1e-3 * noise:  # its reciprocal could overflow float32
            self._bias = 0.0


def loosened(variance: Floats | np.float32, noise: float, tuning: OampTuning) -> Floats:
    """Return the variance of errors that are not independent of each other, float32.

    It is as much larger as the errors, of mean square `variance`, exceed the noise variance.
    """
    wide = np.asarray(variance, dtype=np.float64)
    wide = tuning.prior * wide * (1 + tuning.doubt * wide / noise)
    return np.minimum(wide, UNKNOWN).astype(np.float32)
