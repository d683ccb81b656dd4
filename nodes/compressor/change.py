"""Readings that depart from a reference by more than the noise that the skin states.

The reference r of a patch is the mean of n frames of readings x. While nothing changes, d = x - r
is noise: of a taxel under the force f, of standard deviation sigma(f), as of `NoiseModel`, where
readings are clipped at 0. Two statistics have to stay within their bounds:

- squares: sums of d over all squares of 1, 2, 4, 8 ... taxels a side, on a grid without overlap;
- energy: the sum of d^2 over its variance, for changes whose signs alternate.

The bound of a sum of independent terms with the cumulant generating functions K is that of
Chernoff, min over t > 0 of (sum K(t) + z^2 / 2) / t, with z the quantile of a normal distribution:
for normal terms it is z standard deviations. Noise clipped at 0 is skewed: a normal distribution of
its variance would miss the frequent large readings. Its K is stated in closed form below.

Source: Chernoff, "A measure of asymptotic efficiency for tests of a hypothesis based on the sum of
observations", Annals of Mathematical Statistics 23 (1952).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.nodes.sensor.noise import CLIPPED, NoiseModel

FALSE_SENDS = 1e-4
"""False sends a frame and patch at rest. Chosen: one in 10,000."""
BLOCK = 8
"""Frames in the means that are compared with the reference. Chosen."""
SENT = 32
CYCLES = 8
"""Frames, and cycles of the rows, that are sent at least once something has changed. Chosen: the
solver finds weak contacts in the mean of so many."""
LEARNT = 4
"""Sent blocks whose number of frames a reference has at most. Chosen: the noise of 128 frames adds
1/128 to the variance of a reading."""
FIRST_BLOCKS = 2
"""Blocks that are sent first. Chosen: no contact begins in the first three cycles of rows."""
N_TESTS = 3
"""Tests that share the false sends: squares of a frame, squares of a block, energy of a frame."""

CLIPPED_MEAN = 1 / math.sqrt(2 * math.pi)
"""Mean of max(0, z), z ~ N(0, 1). Derived."""
_T = np.geomspace(0.01, 40.0, 500)
"""Arguments of the cumulant generating functions; the least bound of them holds as any does."""
_T_SQUARE = np.geomspace(1e-4, 0.4999, 500)
"""The same of squares, whose functions end at 1/2."""


def normal_cdf(t: Doubles) -> Doubles:
    """Distribution function of a standard normal variable, float64 of any shape."""
    values = [0.5 * math.erfc(-each / math.sqrt(2)) for each in t.reshape(-1).tolist()]
    return np.array(values).reshape(t.shape)


def _cumulants_clipped() -> Doubles:
    """Cumulant generating function of max(0, z) - its mean, at `_T`. Derived: its expectation of
    exp(t max(0, z)) is 1/2 + exp(t^2 / 2) cdf(t).
    """
    positive = _T**2 / 2 + np.log(normal_cdf(_T))
    values: Doubles = np.logaddexp(math.log(0.5), positive) - CLIPPED_MEAN * _T
    return values


def _cumulants_of_square(clips: bool) -> Doubles:
    """Cumulant generating function, at `_T_SQUARE`, of z^2, or of (max(0, z) - its mean)^2.

    Derived: a Gaussian integral over z > 0, and half of the weight at z = 0.
    """
    shrunk = 1 - 2 * _T_SQUARE
    of_normal: Doubles = -0.5 * np.log(shrunk)
    if not clips:
        return of_normal
    at_zero = _T_SQUARE * CLIPPED_MEAN**2
    shift = 2 * _T_SQUARE * CLIPPED_MEAN / np.sqrt(shrunk)
    positive = at_zero + shift**2 / 2 + of_normal + np.log(normal_cdf(-shift))
    return np.logaddexp(math.log(0.5) + at_zero, positive)


def _clipped() -> tuple[Doubles, Doubles]:
    """Mean and variance of max(0, f + z), z ~ N(0, 1), f in [0, 3]. Derived."""
    force = np.linspace(0.0, 3.0, 31)
    below = normal_cdf(force)
    density = CLIPPED_MEAN * np.exp(-(force**2) / 2)
    mean = force * below + density
    return mean, (force**2 + 1) * below + force * density - mean**2


_MEANS, _VARIANCES = _clipped()
_K_CLIPPED = _cumulants_clipped()
_K_SQUARE = _cumulants_of_square(clips=False)
_K_SQUARE_CLIPPED = _cumulants_of_square(clips=True)


def variance_clipped(n: int, z: float) -> float:
    """Variance, in that of the noise before clipping, with which the sum of `n` untouched readings
    less its mean exceeds z standard deviations as often as a normal variable: 0.3408 for many.
    """
    bound = float(((n * _K_CLIPPED + z * z / 2) / _T).min())
    return bound * bound / (z * z * n)


def energy_bound(n_touched: int, n_untouched: int, z: float) -> float:
    """Bound of the sum of squares over the variances of `n_touched` readings with normal noise, and
    `n_untouched` with clipped noise, exceeded as often as z by a standard normal variable. For
    normal noise it is at least the quantile of a chi-square distribution, but for 1 %.
    """
    t = _T_SQUARE
    # Of clipped noise the variance is 0.3408: its argument is larger by that.
    scaled = CLIPPED * t
    of_normal = -0.5 * np.log1p(-2 * scaled)
    cumulants = n_touched * of_normal + n_untouched * _K_SQUARE_CLIPPED
    if not n_untouched:
        scaled = t
        cumulants = n_touched * _K_SQUARE
    return float(((cumulants + z * z / 2) / scaled).min())


class Squares:
    """Sums over the squares of 1, 2, 4 ... taxels a side of a grid, the smallest ones first.

    `levels`: side of a square in taxels of each level; `spans`: its slice of the sums.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.levels: list[int] = []
        self.spans: list[slice] = []
        self._shapes: list[tuple[int, int]] = []
        rows, cols = shape
        begin = 0
        side = 1
        while True:
            self.levels.append(side)
            self._shapes.append((rows, cols))
            self.spans.append(slice(begin, begin + rows * cols))
            begin += rows * cols
            if rows == cols == 1:
                break
            rows = -(-rows // 2)
            cols = -(-cols // 2)
            side *= 2
        self.n = begin

    def sums(self, grids: Floats) -> Floats:
        """Sums of grids: float32, shape (k, n_rows, n_cols) to (k, n)."""
        k = len(grids)
        sums = np.empty((k, self.n), dtype=np.float32)
        level = grids
        for span, shape in zip(self.spans, self._shapes, strict=True):
            if span.start:
                level = _pooled(level)
            sums[:, span] = level.reshape(k, shape[0] * shape[1])
        return sums


def _pooled(grids: Floats) -> Floats:
    """Sums of two by two neighbours, (k, rows, cols) to half of them, rounded up."""
    _, n_rows, n_cols = grids.shape
    # A last row or column of an odd number has no neighbour.
    if n_rows % 2 or n_cols % 2:
        grids = np.pad(grids, ((0, 0), (0, n_rows % 2), (0, n_cols % 2)))
    rows = grids[:, ::2] + grids[:, 1::2]
    pooled: Floats = rows[:, :, ::2] + rows[:, :, 1::2]
    return pooled


@dataclass
class Bounds:
    """Bounds of the differences d of k patches, where only noise explains them.

    `frame`: of |sums| of one reading, (k, n); `block`: of the mean of several, times the root of
    their number. `weights`: inverse variances of the taxels, (k, n_rows, n_cols), 0 where none is;
    `energy`: of the sum of d^2 in these, (k,).
    """

    frame: Floats
    block: Floats
    weights: Floats
    energy: Doubles


class NoiseBounds:
    """Bounds of differences between readings that only noise explains, on one skin.

    `chance` is that of a false alarm of one test of a patch.
    Raises SettingsError if the noise that the skin states is not valid.
    """

    def __init__(self, skin: SkinState, chance: float) -> None:
        self.squares = Squares((skin.n_rows, skin.n_cols))
        self._exists = skin.skin.exists
        self._clips = skin.clips_noise
        self._end = skin.sigma_end
        sigmas = skin.sigma_mid, skin.sigma_end
        self._noise = NoiseModel(skin.f_max, *sigmas, clips=self._clips)
        quantile = NormalDist().inv_cdf
        self._z = -quantile(chance / 2 / self.squares.n)
        self._z_energy = -quantile(chance)
        self._excess_of_frame = self._excess(1)
        self._excess_of_block = self._excess(BLOCK // 2)

    def _excess(self, n_frames: int) -> list[float]:
        """Variance of an untouched taxel beyond 0.3408, by level, in the mean of some frames."""
        if not self._clips:
            return [0.0] * len(self.squares.levels)
        n_taxels = int(np.count_nonzero(self._exists))
        sizes = [min(side * side, n_taxels) for side in self.squares.levels]
        variances = [variance_clipped(n_frames * size, self._z) for size in sizes]
        return [max(0.0, variance - CLIPPED) for variance in variances]

    def of(self, reference: Floats) -> Bounds:
        """Bounds of readings less their mean, `reference`: float32 (k, n_rows, n_cols)."""
        variances = np.square(self._noise.sigma(reference)) * self._exists
        untouched = np.zeros(reference.shape, dtype=np.bool_)
        if self._clips:
            variances *= np.interp(reference / self._end, _MEANS, _VARIANCES).astype(
                np.float32
            )
            untouched = self._exists & (reference < _MEANS[-1] * self._end)

        sums = self.squares.sums(variances)
        counts = self.squares.sums(untouched.astype(np.float32))
        frame = self._limits(sums, counts, self._excess_of_frame)
        block = self._limits(sums, counts, self._excess_of_block)

        n_untouched = np.count_nonzero(untouched, axis=(1, 2))
        n_touched = np.count_nonzero(self._exists) - n_untouched
        pairs = zip(n_touched.tolist(), n_untouched.tolist(), strict=True)
        energy = np.array([energy_bound(*pair, self._z_energy) for pair in pairs])
        weights = np.divide(
            1, variances, out=np.zeros_like(variances), where=variances > 0
        )
        return Bounds(frame, block, weights, energy)

    def _limits(
        self, variances: Floats, untouched: Floats, excess: list[float]
    ) -> Floats:
        """Bounds of sums: (k, n), of sums of the variances and numbers of untouched taxels."""
        wide = variances.copy()
        for span, of_level in zip(self.squares.spans, excess, strict=True):
            wide[:, span] += np.float32(of_level * self._end**2) * untouched[:, span]
        limits: Floats = np.float32(self._z) * np.sqrt(wide)
        return limits


class ChangeWatch:
    """Finds the patches whose frames have to be sent.

    A patch that changes is sent for a block of frames at least, until the two halves of a block
    agree; that block is the reference of the frames that follow. Each of these is compared with
    it, and so is the mean of each `BLOCK` of them, which joins the reference if it agrees. The sums
    of a frame, those of a block and the energy have a third of the false sends each.

    Parameters
    ----------
    n_patches : int
        Number of patches.
    skin : SkinState
        Skin and noise of all of them; it states noise.
    cycle : int
        Number of frames that together read all rows of the measurement matrix.

    Attributes
    ----------
    sending : ndarray of bool, shape (n_patches,)
        True for each patch whose next frame is sent, whatever it reads.
    """

    def __init__(self, n_patches: int, skin: SkinState, cycle: int = 1) -> None:
        self.length = max(SENT, CYCLES * cycle)
        self._bounds = NoiseBounds(skin, FALSE_SENDS / self.length / N_TESTS)
        shape = n_patches, skin.n_rows, skin.n_cols
        n_sums = self._bounds.squares.n
        self.sending = np.ones(n_patches, dtype=np.bool_)
        #: Blocks that are still to be sent, the present one too.
        self._blocks = np.full(n_patches, FIRST_BLOCKS)
        self._reference = np.zeros(shape, dtype=np.float32)
        self._n = np.full(n_patches, self.length)
        self._total = np.zeros(shape, dtype=np.float32)
        self._half_total = np.zeros(shape, dtype=np.float32)
        self._k = np.zeros(n_patches, dtype=np.intp)
        self._of = Bounds(
            np.zeros((n_patches, n_sums), dtype=np.float32),
            np.zeros((n_patches, n_sums), dtype=np.float32),
            np.zeros(shape, dtype=np.float32),
            np.zeros(n_patches),
        )

    def to_send(self, readings: Floats) -> Mask:
        """Look at the next frame: float32 (n_patches, n_rows, n_cols); return True for each patch
        that is to be sent, bool (n_patches,).
        """
        send = self.sending.copy()
        if not send.all():
            departs = self._departs(readings)
            if departs.any():
                send |= departs
                self._begin(departs)

        self._total += readings
        self._k += 1
        halves = np.flatnonzero(self.sending & (self._k == self.length // 2))
        if halves.size:
            self._half_total[halves] = self._total[halves]
        ends = self._k == np.where(self.sending, self.length, BLOCK)
        quiet = np.flatnonzero(ends & ~self.sending)
        for patch in np.flatnonzero(ends & self.sending).tolist():
            self._end_sent(patch)
        if quiet.size:
            send[self._end_quiet(quiet, readings)] = True
        return send

    def _begin(self, patches: Mask | Indices) -> None:
        """Begin to send some patches: a block of each, of which there is no frame yet."""
        self.sending[patches] = True
        self._blocks[patches] = 1
        self._total[patches] = 0.0
        self._k[patches] = 0

    def _departs(self, readings: Floats) -> Mask:
        """True where one frame of a patch that is not sent departs from its reference."""
        difference = readings - self._reference
        widened = 1 + 1 / self._n
        sums = self._bounds.squares.sums(difference)
        limits = self._of.frame * np.sqrt(widened, dtype=np.float32)[:, np.newaxis]
        by_sums: Mask = np.logical_or.reduce(np.abs(sums, out=sums) > limits, axis=1)
        difference *= difference
        energy = np.einsum("krc,krc->k", difference, self._of.weights)
        by_energy: Mask = energy > self._of.energy * widened
        departs: Mask = (by_sums | by_energy) & ~self.sending
        return departs

    def _exceed(
        self, patches: Indices, differences: Floats, variances: Doubles
    ) -> Mask:
        """True where the difference of two means, of a variance in that of a reading, is no noise:
        of some patches, (k, n_rows, n_cols) and (k,) to bool (k,).
        """
        sums = self._bounds.squares.sums(differences)
        limits = (
            self._of.block[patches]
            * np.sqrt(variances).astype(np.float32)[:, np.newaxis]
        )
        exceed: Mask = np.logical_or.reduce(np.abs(sums, out=sums) > limits, axis=1)
        return exceed

    def _end_sent(self, patch: int) -> None:
        """End a block that was sent: it is the reference, if its halves agree."""
        length = self.length
        half = length // 2
        mean = self._total[patch] / length
        early = self._half_total[patch] / half
        late = (self._total[patch] - self._half_total[patch]) / (length - half)
        self._blocks[patch] -= 1
        self._total[patch] = 0.0
        self._k[patch] = 0

        if self._blocks[patch] > 0:
            return

        bounds = self._bounds.of(mean[np.newaxis])
        self._of.frame[patch] = bounds.frame
        self._of.block[patch] = bounds.block
        self._of.weights[patch] = bounds.weights
        self._of.energy[patch] = bounds.energy[0]
        difference = (late - early)[np.newaxis]
        if not self._exceed(np.array([patch]), difference, np.array([4 / length]))[0]:
            self._reference[patch] = mean
            self._n[patch] = length
            self.sending[patch] = False

    def _end_quiet(self, patches: Indices, readings: Floats) -> Indices:
        """End a block of some patches that was not sent: it joins the reference, or the patch is
        sent from this frame on. Returns the patches that are.
        """
        differences = (
            self._total[patches] / np.float32(BLOCK) - self._reference[patches]
        )
        n = self._n[patches]
        self._total[patches] = 0.0
        self._k[patches] = 0

        exceed = self._exceed(patches, differences, 1 / BLOCK + 1 / n)
        begin = patches[exceed]
        self._begin(begin)
        # This frame is the first of the block.
        self._total[begin] = readings[begin]
        self._k[begin] = 1

        joins = np.logical_not(exceed)
        joins &= n < LEARNT * self.length
        share = (BLOCK / (n[joins] + BLOCK)).astype(np.float32)
        self._reference[patches[joins]] += (
            differences[joins] * share[:, np.newaxis, np.newaxis]
        )
        self._n[patches[joins]] += BLOCK
        return begin
