"""Total force and centre of pressure from the measurements, before the frame is reconstructed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Indices

#: Solvers whose untouched taxels are 0; a bias on all taxels would add to the total.
RESULTANT_SOLVERS = ("skin",)


@dataclass(frozen=True)
class Tuning:
    """Constants of `ResultantEstimator`.

    Those from `total_scale` on are fitted on the six scenes and random ones, so that bands of 1.645
    standard deviations hold 85 % and more; in many scenes they hold nearly all.
    """

    #: Least reduction of the squared innovation by motion, in noise variances.
    significant: float = 12.0
    #: Mean squared innovation, in noise variances, beyond which the last frame does not predict the
    #: centre.
    jump: float = 3.0
    #: Back-projection beyond which a taxel is pressed then, in standard deviations.
    pressed: float = 2.5
    #: Total from which a skin is touched and has a centre, in standard deviations. Derived: noise
    #: exceeds it in one frame of 700.
    touched: float = 3.0
    #: Rates of the errors of earlier frames, and of the noise variance.
    rate: float = 0.1
    noise_rate: float = 0.05
    #: Largest coefficient of motion: of a contact that stays the same.
    largest_change: float = 0.5
    #: Factors on the standard deviations that the frames show, which err, too.
    total_scale: float = 1.3
    centre_scale: float = 1.2
    #: Least deviation of a total, in noise deviations of all pressed taxels; of a centre, taxels.
    total_floor: float = 1.0
    centre_floor: float = 0.02
    #: Error of a reconstructed taxel, in noise deviations, at most its force: errors common to all
    #: frames do not show in their differences.
    taxel_error: float = 3.0
    #: Rate of the slow means of total and centre; parts of the distance from them that deviations
    #: include.
    drift_rate: float = 0.05
    drift: float = 0.5
    total_drift: float = 0.03
    #: Distance of a wrong force from the centre, in that of the others.
    leak: float = 1.4
    #: Variance of a centre after a jump, in that of its image alone: first value, largest one.
    jump_ratio: float = 4.0
    largest_ratio: float = 100.0
    #: With fixed rows, innovations of what no row measures add up: factor, in N / M; decay a frame;
    #: largest part of the total.
    missed: float = 0.125
    kept: float = 0.98
    most_missed: float = 0.08


T = Tuning()


@dataclass(frozen=True)
class Estimate:
    """Total force and centre of pressure of a frame, with their standard deviations.

    Newtons; rows and columns from the middle of taxel (0, 0), None if nothing presses.
    """

    total: float
    total_sd: float
    centre: tuple[float, float] | None
    centre_sd: tuple[float, float] | None


class ResultantEstimator:
    """Weighted mean of a prediction from the last frame and an estimate from the measurements.

    Prediction: the last frame x, moved by least squares on the measurements over x and its
    differences along rows and columns (more or less pressure, and a slide). Its sum and centre
    follow from sums of these terms. Its innovation e gives the error of the sum,
    N <Phi 1, e> / <Phi 1, Phi 1>: for "sbhe", the blocks whose sum is measured are a sample of all.
    The variance of that is the one of such a sample; the variance of the prediction is that of its
    earlier errors.

    If the innovation is no noise, the centre is that of Phi^T e, where that exceeds its noise.

    Parameters
    ----------
    phi : Phi
    taxels : ndarray of intp, shape (n,)
        Place in the flat grid of each existing taxel.
    shape : (n_rows, n_cols)

    Notes
    -----
    Source: ratio and regression estimates of a sum from a sample: Cochran, "Sampling
    Techniques", Wiley, 1977, chapters 6 and 7.
    """

    def __init__(self, phi: Phi, taxels: Indices, shape: tuple[int, int]) -> None:
        self._n, self._m = phi.n, phi.m
        self._shape, self._taxels = shape, taxels
        places = np.divmod(taxels, shape[1])
        #: Weights of the sums: 1, row and column.
        self._weights = np.stack([np.ones(phi.n), *places]).astype(np.float64)
        self._ones: dict[str, Floats] = {}
        self._terms = np.zeros((3, phi.n), dtype=np.float32)
        self._sums = np.zeros((3, 3))
        self._rows: Floats | None = None
        self._rows_of = ""
        self._bias = self._noise2 = 0.0
        self._n_frames = 0
        self._last: Estimate | None = None
        self._prior = self._total_error2 = self._slow_total = 0.0
        self._centre_error2 = np.zeros(2)
        self._jumped_by: Doubles | None = None
        self._jump_ratio = T.jump_ratio
        self._doubt = np.zeros(phi.n)
        self._missed2, self._missed_by = 0.0, ""
        self._slow_centre: Doubles | None = None

    def estimate(self, phi: Phi, y: Floats) -> Estimate:
        """Estimate total and centre of a frame from y = Phi x, float32 (m,), newtons."""
        ones = self._ones_of(phi)
        if self._rows is None or self._rows_of != phi.fingerprint:
            self._rows, self._rows_of = phi.forward(self._terms), phi.fingerprint
        e = y - self._rows[0] - np.float32(self._bias) * ones
        change = self._change(e)
        sums = self._sums[:, 0] + self._sums @ change
        e -= change.astype(np.float32) @ self._rows
        self._prior = float(sums[0])
        energy = float(np.dot(ones, ones))
        mean = float(np.dot(ones, e)) / (energy + TINY)
        left = np.square(ones * (e - np.float32(mean) * ones), dtype=np.float64)
        unseen = max(0.0, 1 - energy / self._n)
        noise = self._noise2 * self._n**2 / (energy + TINY)
        by_sample2 = noise + unseen * self._n**2 * float(left.sum()) / (energy + TINY) ** 2
        more = self._n * mean
        by_last2 = max(self._total_error2, more * more - by_sample2)
        gain = by_last2 / (by_last2 + by_sample2 + TINY)
        total = max(0.0, self._prior + gain * more)
        floor2 = (T.total_floor**2) * self._noise2 * max(1, int(np.count_nonzero(self._terms[0])))
        excess = max(0.0, float(left.sum()) - energy * self._noise2)
        self._add_missed(phi, unseen * self._n**2 * excess / (energy + TINY) ** 2)
        floor2 += min(self._missed2, (T.most_missed * total) ** 2)
        floor2 += (T.total_drift * (total - self._slow_total)) ** 2
        total_sd = T.total_scale * math.sqrt(gain * by_sample2 + floor2)
        jumped = float(np.dot(e, e)) > T.jump * self._m * self._noise2
        centre, centre_sd = self._centre(phi, e, sums, change, total, total_sd, jumped)
        self._last = Estimate(total, total_sd, centre, centre_sd)
        return self._last

    def learn(self, phi: Phi, y: Floats, x: Floats, fitted: Floats, bias: float) -> None:
        """Process the reconstructed frame: forces x, float32 (n,), and `fitted` = Phi x, (m,);
        bias is the mean reading of an untouched taxel, newtons.
        """
        self._n_frames += 1
        # A pressed taxel has none.
        self._bias = bias * float(np.mean(x <= 2 * bias))
        left = y - fitted - np.float32(self._bias) * self._ones_of(phi)
        rate = max(T.noise_rate, 1 / self._n_frames)
        noise2 = float(np.dot(left, left)) / self._m
        self._noise2 += rate * (noise2 - self._noise2)
        frame = np.zeros(self._shape, dtype=np.float32)
        frame.reshape(-1)[self._taxels] = x
        edged = np.pad(frame, 1, mode="edge")
        down = (edged[2:, 1:-1] - edged[:-2, 1:-1]).reshape(-1)[self._taxels]
        right = (edged[1:-1, 2:] - edged[1:-1, :-2]).reshape(-1)[self._taxels]
        self._terms = np.stack([x, down, right])
        self._sums = self._weights @ self._terms.T.astype(np.float64)
        total = float(self._sums[0, 0])
        if self._last is not None:
            self._total_error2 += T.rate * ((total - self._prior) ** 2 - self._total_error2)
            # The centre of a skin that turns out to be untouched is no error of a centre.
            if self._last.centre is not None and total > T.touched * self._last.total_sd:
                off = self._sums[1:, 0] / total - np.array(self._last.centre)
                if self._jumped_by is None:
                    self._centre_error2 += T.rate * (off**2 - self._centre_error2)
                else:
                    ratio = float(np.mean(off**2 / self._jumped_by))
                    self._jump_ratio += T.rate * (min(ratio, T.largest_ratio) - self._jump_ratio)
        self._slow_total += T.drift_rate * (total - self._slow_total)
        if total > 0:
            centre = self._sums[1:, 0] / total
            # The mean over frames before a jump is that of another contact.
            slow = self._slow_centre
            if slow is None or self._jumped_by is not None:
                slow = centre
            self._slow_centre = slow + T.drift_rate * (centre - slow)
        else:
            self._slow_centre = None
        wrong2 = np.float32(T.taxel_error**2 * self._noise2)
        self._doubt = np.minimum(np.square(x), wrong2).astype(np.float64)
        self._rows, self._rows_of = None, ""

    def prepare(self, phi: Phi) -> None:
        """Compute Phi times the terms before the measurements of the next frame arrive."""
        self._rows, self._rows_of = phi.forward(self._terms), phi.fingerprint

    def _ones_of(self, phi: Phi) -> Floats:
        if phi.fingerprint not in self._ones:
            self._ones[phi.fingerprint] = phi.forward(np.ones(phi.n, dtype=np.float32))
        return self._ones[phi.fingerprint]

    def _add_missed(self, phi: Phi, excess2: float) -> None:
        """Accumulate the variance of what the rows do not measure; other rows reset it."""
        if phi.fingerprint != self._missed_by:
            self._missed2, self._missed_by = 0.0, phi.fingerprint
        self._missed2 = T.kept * self._missed2 + (T.missed * self._n / self._m) ** 2 * excess2

    def _change(self, e: Floats) -> Doubles:
        """Return the coefficients of the terms, fitted to the innovation; 0 if not significant."""
        assert self._rows is not None
        gram = (self._rows @ self._rows.T).astype(np.float64)
        right = (self._rows @ e).astype(np.float64)
        largest = float(gram.diagonal().max())
        if not largest > 0:
            return np.zeros(3)
        found = np.linalg.solve(gram + 1e-6 * largest * np.eye(3), right)
        if not float(found @ right) > T.significant * self._noise2:
            return np.zeros(3)
        return np.clip(found, -T.largest_change, T.largest_change)

    def _centre(
        self,
        phi: Phi,
        e: Floats,
        sums: Doubles,
        change: Doubles,
        total: float,
        total_sd: float,
        jumped: bool,
    ) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        self._jumped_by = None
        if not total > T.touched * total_sd:
            return None, None
        if not jumped:
            if not sums[0] > 0:
                return None, None
            centre = sums[1:] / sums[0]
            apart = np.square(self._weights[1:] - centre[:, None])
            own2 = apart @ self._doubt / sums[0] ** 2
            slow = centre if self._slow_centre is None else self._slow_centre
            own2 += np.square(T.drift * (centre - slow))
            own2 += (T.leak * total_sd / total) ** 2 * (apart @ self._terms[0]) / sums[0]
            sd = T.centre_scale * np.sqrt(self._centre_error2 + own2 + T.centre_floor**2)
        else:
            image = (self._terms[0] + change.astype(np.float32) @ self._terms).astype(np.float64)
            image += phi.adjoint(e) * (self._n / self._m)
            spread = 1.4826 * float(np.median(np.abs(image)))
            image[image < T.pressed * spread] = 0
            whole = float(image.sum())
            if not whole > 0:
                return None, None
            centre = self._weights[1:] @ image / whole
            apart = np.square(self._weights[1:] - centre[:, None])
            doubt = np.square(image) + spread**2 * (image > 0)
            self._jumped_by = apart @ doubt / whole**2 + T.centre_floor**2
            sd = T.centre_scale * np.sqrt(self._jump_ratio * self._jumped_by)
        return (float(centre[0]), float(centre[1])), (float(sd[0]), float(sd[1]))
