"""Total force and centre of pressure from the measurements, before the frame is restored."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.phi import Phi

#: Solvers whose untouched taxels are 0: the sum of what the others leave there is a force, too.
RESULTANT_SOLVERS = ("skin",)
#: Reduction of the squared misfit, in noise variances, that a move has to earn.
SIGNIFICANT = 12.0
#: Misfit, in noise variances, beyond which the last frame says nothing of where it presses now;
#: and below which a restored frame is right.
JUMP, SETTLED = 3.0, 2.0
#: Deviations of the back-projection beyond which a taxel is taken for pressed then.
PRESSED = 2.5
#: How fast the errors of earlier frames are forgotten, and the bias of what is cut off at 0.
RATE, BIAS_RATE = 0.1, 0.05
#: Largest change of all forces that is taken for more or less pressure of the same contact.
LARGEST_CHANGE = 0.5
#: Deviations are so many times what the frames alone show, which err too. These and the ones below
#: were chosen on the six scenes and random ones, so that bands of 1.645 deviations hold 85 % and
#: more; in many scenes they hold nearly all.
TOTAL_SCALE, CENTRE_SCALE = 1.3, 1.2
#: Least deviation of a total: so many noises of all pressed taxels; of a centre, in taxels.
TOTAL_FLOOR, CENTRE_FLOOR = 1.0, 0.02
#: How wrong a restored taxel is, in noises, but no more than it is pressed: what the frames
#: before this one are wrong by, too, does not show in how they differ.
TAXEL_ERROR = 3.0
#: How fast means of total and centre follow, and by which part of the distance from them one
#: that has moved away may still be on its way.
DRIFT_RATE, DRIFT, TOTAL_DRIFT = 0.05, 0.5, 0.03
#: A force that is too much or too little lies as far from the centre as so many times the others.
LEAK = 1.4
#: How many times the variance of a centre told after a jump is what its picture alone says, until
#: jumps have shown it, and at most.
JUMP_RATIO, LARGEST_RATIO = 4.0, 100.0
#: Where rows are fixed, what no row measures is restored anew by none: the surprises of earlier
#: frames add up there, so many times N / M of them, forgotten at this rate; and the largest part of
#: the total that they are taken for.
MISSED, KEPT, MOST_MISSED = 0.125, 0.98, 0.08
TINY = 1e-30


@dataclass(frozen=True)
class Estimate:
    """Total force and centre of pressure of a frame, with their standard deviations.

    Newtons; rows and columns from the middle of taxel (0, 0), None where nothing presses.
    """

    total: float
    total_sd: float
    centre: tuple[float, float] | None
    centre_sd: tuple[float, float] | None


class ResultantEstimator:
    """Weighs what the last frame says of total and centre against the measurements.

    The last restored frame x is moved by least squares on the measurements over x and its
    differences along rows and columns: more or less pressure, and a slide. Sum and centre of that
    follow from sums known beforehand. What it leaves of the measurements, e, tells by how much
    the sum of all forces is off: N <Phi 1, e> / <Phi 1, Phi 1>, for "sbhe" the blocks whose sum
    is measured standing for the others. Its variance is that of a sample of the blocks; the
    variance of what the last frame says is how wrong it was so far. The weights follow.

    Where the misfit is no noise the centre comes from Phi^T e, where that stands out.

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
        #: What is summed: forces, and forces times row and column.
        self._weights = np.stack([np.ones(phi.n), *places]).astype(np.float64)
        self._ones: dict[str, Floats] = {}
        self._terms = np.zeros((3, phi.n), dtype=np.float32)
        self._sums = np.zeros((3, 3))
        self._rows: Floats | None = None
        self._rows_of = ""
        self._bias = 0.0
        self._noise2 = 0.0
        self._n_frames = 0
        self._said: Estimate | None = None
        self._prior = 0.0
        self._total_error2 = 0.0
        self._centre_error2 = np.zeros(2)
        self._jumped_by: np.ndarray[tuple[int], np.dtype[np.float64]] | None = None
        self._jump_ratio = JUMP_RATIO
        self._doubt = np.zeros(phi.n)
        self._missed2, self._missed_by = 0.0, ""
        self._slow_total = 0.0
        self._slow_centre: np.ndarray[tuple[int], np.dtype[np.float64]] | None = None

    def estimate(self, phi: Phi, y: Floats) -> Estimate:
        """Total and centre of a frame.

        Parameters
        ----------
        phi : Phi
            That made the measurements.
        y : ndarray of float32, shape (m,)
            Newtons.
        """
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
        weight = by_last2 / (by_last2 + by_sample2 + TINY)
        total = max(0.0, self._prior + weight * more)
        floor2 = (TOTAL_FLOOR**2) * self._noise2 * max(1, int(np.count_nonzero(self._terms[0])))
        news = max(0.0, float(left.sum()) - energy * self._noise2)
        self._add_missed(phi, unseen * self._n**2 * news / (energy + TINY) ** 2)
        floor2 += min(self._missed2, (MOST_MISSED * total) ** 2)
        floor2 += (TOTAL_DRIFT * (total - self._slow_total)) ** 2
        total_sd = TOTAL_SCALE * math.sqrt(weight * by_sample2 + floor2)
        jumped = float(np.dot(e, e)) > JUMP * self._m * self._noise2
        centre, centre_sd = self._centre(phi, e, sums, change, total, total_sd, jumped)
        self._said = Estimate(total, total_sd, centre, centre_sd)
        return self._said

    def learn(self, phi: Phi, y: Floats, x: Floats, fitted: Floats) -> None:
        """Take in the frame that was restored from the measurements.

        Parameters
        ----------
        phi, y
            As in `estimate`.
        x : ndarray of float32, shape (n,)
            Its forces, newtons.
        fitted : ndarray of float32, shape (m,)
            Phi x.
        """
        self._n_frames += 1
        ones = self._ones_of(phi)
        left = y - fitted
        rate = max(BIAS_RATE, 1 / self._n_frames)
        bias = float(np.dot(ones, left)) / (float(np.dot(ones, ones)) + TINY)
        noise2 = float(np.dot(left, left)) / self._m
        # Of a frame that lags behind its contact the rest is no bias.
        if self._n_frames == 1 or noise2 < SETTLED * self._noise2:
            self._bias += rate * (max(0.0, bias) - self._bias)
        left -= np.float32(self._bias) * ones
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
        if self._said is not None:
            self._total_error2 += RATE * ((total - self._prior) ** 2 - self._total_error2)
            if self._said.centre is not None and total > 0:
                off = self._sums[1:, 0] / total - np.array(self._said.centre)
                if self._jumped_by is None:
                    self._centre_error2 += RATE * (off**2 - self._centre_error2)
                else:
                    ratio = float(np.mean(off**2 / self._jumped_by))
                    self._jump_ratio += RATE * (min(ratio, LARGEST_RATIO) - self._jump_ratio)
        self._slow_total += DRIFT_RATE * (total - self._slow_total)
        if total > 0:
            centre = self._sums[1:, 0] / total
            slow = centre if self._slow_centre is None else self._slow_centre
            self._slow_centre = slow + DRIFT_RATE * (centre - slow)
        else:
            self._slow_centre = None
        wrong2 = np.float32(TAXEL_ERROR**2 * self._noise2)
        self._doubt = np.minimum(np.square(x), wrong2).astype(np.float64)
        self._rows, self._rows_of = None, ""

    def prepare(self, phi: Phi) -> None:
        """Do what can be done before the measurements of the next frame come."""
        self._rows, self._rows_of = phi.forward(self._terms), phi.fingerprint

    def _ones_of(self, phi: Phi) -> Floats:
        if phi.fingerprint not in self._ones:
            self._ones[phi.fingerprint] = phi.forward(np.ones(phi.n, dtype=np.float32))
        return self._ones[phi.fingerprint]

    def _add_missed(self, phi: Phi, news2: float) -> None:
        """Add the variance of what a frame's rows have not seen; other rows would have by now."""
        if phi.fingerprint != self._missed_by:
            self._missed2, self._missed_by = 0.0, phi.fingerprint
        self._missed2 = KEPT * self._missed2 + (MISSED * self._n / self._m) ** 2 * news2

    def _change(self, e: Floats) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """How much of each term the misfit asks for."""
        assert self._rows is not None
        gram = (self._rows @ self._rows.T).astype(np.float64)
        right = (self._rows @ e).astype(np.float64)
        largest = float(gram.diagonal().max())
        if not largest > 0:
            return np.zeros(3)
        found = np.linalg.solve(gram + 1e-6 * largest * np.eye(3), right)
        if not float(found @ right) > SIGNIFICANT * self._noise2:
            return np.zeros(3)
        return np.clip(found, -LARGEST_CHANGE, LARGEST_CHANGE)

    def _centre(
        self,
        phi: Phi,
        e: Floats,
        sums: np.ndarray[tuple[int], np.dtype[np.float64]],
        change: np.ndarray[tuple[int], np.dtype[np.float64]],
        total: float,
        total_sd: float,
        jumped: bool,
    ) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        self._jumped_by = None
        if not total > 2 * total_sd:
            return None, None
        if not jumped:
            if not sums[0] > 0:
                return None, None
            centre = sums[1:] / sums[0]
            apart = np.square(self._weights[1:] - centre[:, None])
            own2 = apart @ self._doubt / sums[0] ** 2
            slow = centre if self._slow_centre is None else self._slow_centre
            own2 += np.square(DRIFT * (centre - slow))
            own2 += (LEAK * total_sd / total) ** 2 * (apart @ self._terms[0]) / sums[0]
            sd = CENTRE_SCALE * np.sqrt(self._centre_error2 + own2 + CENTRE_FLOOR**2)
        else:
            image = (self._terms[0] + change.astype(np.float32) @ self._terms).astype(np.float64)
            image += phi.adjoint(e) * (self._n / self._m)
            spread = 1.4826 * float(np.median(np.abs(image)))
            image[image < PRESSED * spread] = 0
            whole = float(image.sum())
            if not whole > 0:
                return None, None
            centre = self._weights[1:] @ image / whole
            apart = np.square(self._weights[1:] - centre[:, None])
            doubt = np.square(image) + spread**2 * (image > 0)
            self._jumped_by = apart @ doubt / whole**2 + CENTRE_FLOOR**2
            sd = CENTRE_SCALE * np.sqrt(self._jump_ratio * self._jumped_by)
        return (float(centre[0]), float(centre[1])), (float(sd[0]), float(sd[1]))
