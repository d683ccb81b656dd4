"""Differences that noise does not explain, of readings or of measurements.

A difference d = y - r of the measurements y = Phi x of a frame and of a reference r is noise while
nothing changes: that of the readings x, of standard deviation sigma(f) under the force f, as of
`NoiseModel`, where readings are clipped at 0. Two statistics have to stay within their bounds:

- scores: sums of Phi' d over all squares of 1, 2, 4, 8 ... taxels a side, on a grid without
  overlap, each over the norm that noise of unit variance gives it: matched filters for a square
  that is pressed evenly. They are summed over the last 1, 2, 4, 8 ... frames, too;
- energy: the sum of d^2 over its variance, for changes whose signs alternate.

A square is a part of the grid of taxels; the squares of one size are a level of the pyramid.

Readings themselves are measurements with Phi = identity. Phi is known by `forward` and `adjoint`
alone: any matrix has these statistics.

The bound of a sum of independent terms with the cumulant generating functions K is that of
Chernoff, min over t > 0 of (sum K(t) + z^2 / 2) / t, with z the quantile of a normal distribution:
for normal terms it is z standard deviations. Noise clipped at 0 is skewed: a normal distribution of
its variance would miss the frequent large readings. Its K is stated in closed form below.

Source: Chernoff, "A measure of asymptotic efficiency for tests of a hypothesis based on the sum of
observations", Annals of Mathematical Statistics 23 (1952).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.compressor.phi.base import Phi, block_layout
from sparseskin.nodes.numerics.arrays import (
    TINY,
    Doubles,
    Floats,
    Indices,
    Mask,
)
from sparseskin.nodes.sensor.noise import CLIPPED, NoiseModel

CLIPPED_MEAN = 1 / math.sqrt(2 * math.pi)
"""Mean of max(0, z), z ~ N(0, 1). Derived."""
MOST_WEIGHTS = 2**25
"""Most weights of a level that are computed, squares times cells. Chosen: half a second. Levels of
more, as of 2 x 2 taxels from 108 x 108 on, have an upper bound in place of their norms. Norms of
single taxels are always computed."""
AT_ONCE = 256
"""Squares whose weights are computed at once. Chosen: 4 MB on 64 x 64 taxels."""
_T = np.geomspace(0.01, 40.0, 500)
"""Arguments of the cumulant generating functions; the least bound of them holds as any does."""
_T_SQUARE = np.geomspace(1e-4, 0.4999, 500)
"""The same of z^2 in place of z, whose functions end at 1/2."""


def normal_cdf(t: Doubles) -> Doubles:
    """Distribution function of a standard normal variable, float64 of any shape."""
    # numpy has no error function, and scipy's takes long to import.
    arguments = -t.reshape(-1) / math.sqrt(2)
    tails = [math.erfc(argument) for argument in arguments.tolist()]
    return 0.5 * np.array(tails).reshape(t.shape)


def cumulants_clipped(t: Doubles) -> Doubles:
    """Cumulant generating function of max(0, z) - its mean, at t. Derived: its expectation of
    exp(t max(0, z)) is 1/2 + exp(t^2 / 2) cdf(t).
    """
    # By their logarithms: exp(t^2 / 2) itself overflows within `_T`.
    positive = t**2 / 2 + np.log(normal_cdf(t))
    moments: Doubles = np.logaddexp(math.log(0.5), positive)
    return moments - CLIPPED_MEAN * t


def _cumulants_of_square(clips: bool) -> Doubles:
    """Cumulant generating function, at `_T_SQUARE`, of z^2, or of (max(0, z) - its mean)^2.

    Derived: a Gaussian integral over z > 0, and half of the weight at z = 0.
    """
    shrunk = 1 - 2 * _T_SQUARE
    normal_cumulants = -0.5 * np.log(shrunk)
    if not clips:
        return normal_cumulants

    # z <= 0 is clipped: its square is that of the mean, whatever z is.
    at_zero = _T_SQUARE * CLIPPED_MEAN**2
    # For z > 0, completing the square leaves a normal density with a shifted mean.
    shift = 2 * _T_SQUARE * CLIPPED_MEAN / np.sqrt(shrunk)
    above_zero = np.log(normal_cdf(-shift))
    positive = at_zero + shift**2 / 2 + normal_cumulants + above_zero
    return np.logaddexp(math.log(0.5) + at_zero, positive)


def _clipped() -> tuple[Doubles, Doubles]:
    """Mean and variance of max(0, f + z), z ~ N(0, 1), f in [0, 3]. Derived."""
    force = np.linspace(0.0, 3.0, 31)
    below = normal_cdf(force)
    density = CLIPPED_MEAN * np.exp(-(force**2) / 2)
    mean = force * below + density
    mean_square = (force**2 + 1) * below + force * density
    return mean, mean_square - mean**2


_MEANS, _VARIANCES = _clipped()
_K_SQUARE = _cumulants_of_square(clips=False)
_K_SQUARE_CLIPPED = _cumulants_of_square(clips=True)


@dataclass(frozen=True)
class Weights:
    """Weights of the taxels in a score, the sum over a square. Their powers w^2 add up to 1.

    `inside`: sum of the powers of the taxels within the square. `n_inside`: this sum over the
    largest of these powers, the least number of equal weights with this sum. `n_outside`: the same
    ratio of the taxels beyond the square.
    """

    inside: float = 1.0
    n_inside: float = 1.0
    n_outside: float = 1.0


def variance_clipped(weights: Weights, n_frames: int, z: float) -> float:
    """Variance by which a bound of z standard deviations holds for a weighted sum of untouched
    readings, summed over `n_frames`, less its mean. The sum exceeds this bound at most as often as
    a normal variable exceeds z. It is a multiple of the variance of the noise before clipping:
    0.3408 for many equal weights.

    K(t) / t^2 of clipped noise grows with t > 0, and is larger at t than at -t. So of all weights
    with the same sum of powers, equal ones of the largest size have the largest sum of K.
    """
    cumulants = np.zeros_like(_T)
    inside = weights.inside, weights.n_inside
    outside = 1 - weights.inside, weights.n_outside
    for share, n_weights in (inside, outside):
        if share > 0:
            n_terms = n_frames * n_weights
            weight = math.sqrt(share / n_terms)
            cumulants += n_terms * cumulants_clipped(_T * weight)

    # A normal sum of this bound has z standard deviations in it.
    bounds = (cumulants + z * z / 2) / _T
    bound = float(bounds.min())
    return bound * bound / (z * z)


def energy_bound(n_touched: float, n_untouched: float, z: float) -> float:
    """Bound of the sum of squares over the variances of `n_touched` readings with normal noise, and
    `n_untouched` with clipped noise, exceeded as often as z by a standard normal variable. For
    normal noise it is at least the quantile of a chi-square distribution, but for 1 %.
    """
    if n_untouched:
        # The variance of clipped noise is 0.3408: a square over it has an argument larger by that.
        arguments = CLIPPED * _T_SQUARE
        normal_cumulants = -0.5 * np.log1p(-2 * arguments)
        cumulants = n_touched * normal_cumulants + n_untouched * _K_SQUARE_CLIPPED
    else:
        arguments = _T_SQUARE
        cumulants = n_touched * _K_SQUARE
    bounds = (cumulants + z * z / 2) / arguments
    return float(bounds.min())


class SquarePyramid:
    """Sums over the squares of 1, 2, 4 ... taxels a side of a grid, the smallest ones first.

    The squares of one size are a level. `most`: largest number of squares of a level; levels with
    more are left out. `sides`: side of the squares of each level, in taxels; `spans`: slice of the
    sums of each level; `n`: number of all sums.
    """

    def __init__(self, shape: tuple[int, int], most: int | None = None) -> None:
        self.sides: list[int] = []
        self.spans: list[slice] = []
        self._shape = shape
        self._shapes: list[tuple[int, int]] = []
        self.n = 0
        side = 1
        while True:
            # Squares at the last rows and columns may reach beyond the grid.
            rows, cols = (-(-n_cells // side) for n_cells in shape)
            n_squares = rows * cols
            if most is None or n_squares <= most:
                self.sides.append(side)
                self._shapes.append((rows, cols))
                self.spans.append(slice(self.n, self.n + n_squares))
                self.n += n_squares
            if n_squares == 1:
                break
            side *= 2

    def sums(self, grids: Floats) -> Floats:
        """Sums of grids: float32, shape (k, n_rows, n_cols) to (k, n)."""
        k = len(grids)
        sums = np.empty((k, self.n), dtype=np.float32)
        pooled = grids
        side = 1
        levels = zip(self.sides, self.spans, self._shapes, strict=True)
        for level_side, span, (n_rows, n_cols) in levels:
            # Levels that are left out are pooled all the same: the next one is made of them.
            while side < level_side:
                pooled = _pooled(pooled)
                side *= 2
            sums[:, span] = pooled.reshape(k, n_rows * n_cols)
        return sums

    def square_of_cell(self, level: int) -> Indices:
        """Number, in a level, of the square that each cell of the grid lies in, (n_cells,)."""
        n_cols = self._shape[1]
        cells = np.arange(math.prod(self._shape))
        rows, cols = np.divmod(cells, n_cols)

        side = self.sides[level]
        _, squares_of_row = self._shapes[level]
        numbers: Indices = rows // side * squares_of_row + cols // side
        return numbers


def _pooled(grids: Floats) -> Floats:
    """Sums of two by two neighbours, (k, rows, cols) to half of them, rounded up."""
    k, n_rows, n_cols = grids.shape
    # A last row or column of an odd number has no neighbour. (np.pad takes ten times as long.)
    if n_rows % 2 or n_cols % 2:
        even_rows = n_rows + n_rows % 2
        even_cols = n_cols + n_cols % 2
        padded = np.zeros((k, even_rows, even_cols), dtype=grids.dtype)
        padded[:, :n_rows, :n_cols] = grids
        grids = padded

    upper = grids[:, ::2]
    lower = grids[:, 1::2]
    pairs = upper + lower
    return pairs[:, :, ::2] + pairs[:, :, 1::2]


@dataclass
class Bounds:
    """Bounds of the differences d of k patches, where only noise explains them.

    `scores`: of those of single frames, and of the sums of 2, 4 ... frames over the root of their
    number, (k, n_windows, n). `weights`: inverse variances of d, (k, n_rows, n_cols) of
    readings, 0 where no taxel is, (k, 1) of measurements; `energy`: of the sum of d^2 in these,
    (k,).
    """

    scores: Floats
    weights: Floats
    energy: Doubles

    def put(self, patch: int, bounds: "Bounds") -> None:
        """Replace the bounds of a patch, by number, by those of a single one."""
        self.scores[patch] = bounds.scores
        self.weights[patch] = bounds.weights
        self.energy[patch] = bounds.energy[0]


class Departures:
    """Scores of differences, and bounds that noise alone exceeds with a stated chance.

    Parameters
    ----------
    skin : SkinState
        Skin and noise; it states noise.
    chance : float
        Probability of an alarm a frame and patch where only noise explains the differences.
    phis : sequence of Phi
        One a row subset; none: differences are those of readings.
    n_windows : int
        Scores are those of 1, 2, 4 ... 2^(n_windows - 1) frames.
    one_sided : bool
        True if only positive scores are an alarm.
    most : int, optional
        Largest number of squares of a level, as of `SquarePyramid`: a few take one matrix product.

    Raises SettingsError if the noise that the skin states is not valid.
    """

    def __init__(
        self,
        skin: SkinState,
        chance: float,
        phis: Sequence[Phi] = (),
        *,
        n_windows: int = 1,
        one_sided: bool = False,
        most: int | None = None,
    ) -> None:
        self.pyramid = SquarePyramid((skin.n_rows, skin.n_cols), most)
        self.one_sided = one_sided
        self.n_windows = n_windows
        self._exists = skin.skin.exists
        self._cells = np.flatnonzero(self._exists)
        self._clips = skin.clips_noise
        # The noise at both ends of the range is that of an untouched taxel, whose force is 0.
        self._untouched_sd = skin.sigma_end
        self._noise = NoiseModel(
            skin.f_max, skin.sigma_mid, skin.sigma_end, clips=self._clips
        )
        self._phis = phis

        # Scores and energy have half of the false alarms each. A window of 2^w frames is tested
        # every 2^w frames: all windows make 1 + 1/2 + 1/4 ... < 2 tests a frame in the mean.
        quantile = NormalDist().inv_cdf
        n_sides = 1 if one_sided else 2
        n_tests = n_sides * min(n_windows, 2) * self.pyramid.n
        self._z = -quantile(chance / 2 / n_tests)
        self._z_energy = -quantile(chance / 2)

        ones = self._exists[np.newaxis].astype(np.float32)
        #: Number of taxels of each square.
        self._count = self.pyramid.sums(ones)[0]
        norms_and_weights = [self._norms_of_measurements(phi) for phi in phis]
        if not phis:
            norms_and_weights = [self._norms_of_readings()]
        self._scales = [_inverse(norms) for norms, _ in norms_and_weights]
        self._products: list[Floats] = []
        if most is not None:
            self._products = [
                self._product(phi, scale)
                for phi, scale in zip(phis, self._scales, strict=True)
            ]

        # Weights are those of the first subset, to which the others are alike.
        _, weights = norms_and_weights[0]
        self._inside = np.empty(self.pyramid.n, dtype=np.float32)
        for span, level_weights in zip(self.pyramid.spans, weights, strict=True):
            self._inside[span] = level_weights.inside
        self._excess = self._excess_variance(weights)

    def scores(self, differences: Floats, subset: int = 0) -> Floats:
        """Scores of differences, float32 (k, n_rows, n_cols) of readings, (k, m) of measurements by
        a row subset: (k, n), of the variance of a reading where that is the same for all.
        """
        if self._products:
            return differences @ self._products[subset]
        grids = differences
        if self._phis:
            grids = self._back_projected(differences, self._phis[subset])
        scores = self.pyramid.sums(grids)
        scores *= self._scales[subset]
        return scores

    def energy(self, differences: Floats, bounds: Bounds) -> Doubles:
        """Sums of the squares of differences over their variances, (k,)."""
        k = len(differences)
        weighted = differences * bounds.weights
        terms = (weighted * differences).reshape(k, -1)
        # In float64: of thousands of terms, a float32 sum would lose the small ones.
        sums: Doubles = terms.sum(axis=1, dtype=np.float64)
        return sums

    def bounds(self, reference: Floats) -> Bounds:
        """Bounds of differences from mean readings or forces: float32 (k, n_rows, n_cols)."""
        sigma = self._noise.sigma(reference)
        variances = np.square(sigma) * self._exists
        untouched = np.zeros(reference.shape, dtype=np.bool_)
        if self._clips:
            # The tables are of noise with a deviation of 1; a reference is a mean of clipped ones.
            clipped_part = np.interp(reference / self._untouched_sd, _MEANS, _VARIANCES)
            variances *= clipped_part.astype(np.float32)
            is_light = reference < _MEANS[-1] * self._untouched_sd
            untouched = self._exists & is_light

        # Where few weights carry a score, untouched taxels count for more than their variance.
        score_variance = self._mean_by_score(variances)
        untouched_share = self._mean_by_score(untouched.astype(np.float32))
        excess = self._excess * untouched_share[:, np.newaxis]
        excess *= np.float32(self._untouched_sd**2)
        window_variance = score_variance[:, np.newaxis] + excess
        limits = np.float32(self._z) * np.sqrt(window_variance)

        n_untouched = np.count_nonzero(untouched, axis=(1, 2))
        if self._phis:
            weights, energy = self._energy_of_measurements(variances, n_untouched)
        else:
            weights, energy = self._energy_of_readings(variances, n_untouched)
        return Bounds(limits, weights, energy)

    def no_bounds(self, n_patches: int) -> Bounds:
        """Zeros, for as many patches, of which nothing is known yet."""
        one_weight = self._exists.shape
        if self._phis:
            one_weight = (1,)
        return Bounds(
            np.zeros((n_patches, self.n_windows, self.pyramid.n), dtype=np.float32),
            np.zeros((n_patches, *one_weight), dtype=np.float32),
            np.zeros(n_patches),
        )

    def _mean_by_score(self, values: Floats) -> Floats:
        """Mean of the values of taxels, (k, n_rows, n_cols), weighted by their powers in each
        score: (k, n).
        """
        local = self.pyramid.sums(values)
        # The last square is the whole grid.
        mean = local[:, -1:] / self._count[-1]
        local /= np.maximum(self._count, 1)
        # The part `inside` of a score comes from its own square, the rest from all taxels.
        mixed: Floats = mean + self._inside * (local - mean)
        return mixed

    def _energy_of_readings(
        self, variances: Floats, n_untouched: Indices
    ) -> tuple[Floats, Doubles]:
        """Weights and bounds of the energy, as in `Bounds`, of readings."""
        n_touched = self._cells.size - n_untouched
        energy = self._energy_bounds(n_touched, n_untouched)
        weights = np.zeros_like(variances)
        np.divide(1, variances, out=weights, where=variances > 0)
        return weights, energy

    def _energy_of_measurements(
        self, variances: Floats, n_untouched: Indices
    ) -> tuple[Floats, Doubles]:
        """The same of measurements."""
        n = self._cells.size
        phi = self._phis[0]
        mean = variances.sum(axis=(1, 2)) / n
        mean_square = np.square(variances).sum(axis=(1, 2)) / n

        # Differing variances are those of fewer, larger terms (Satterthwaite): the spread.
        relative_variance = mean_square / mean**2 - 1
        spread = 1 + phi.m / n * relative_variance
        share = n_untouched / n
        touched_terms = (1 - share) * phi.m / spread
        untouched_terms = share * phi.m / spread
        energy = spread * self._energy_bounds(touched_terms, untouched_terms)

        # Measurements mix taxels: all have the mean variance, at most `lipschitz` times as much.
        weights = np.float32(1 / phi.lipschitz) / mean
        return weights[:, np.newaxis].astype(np.float32), energy

    def _energy_bounds(
        self, n_touched: Doubles | Indices, n_untouched: Doubles | Indices
    ) -> Doubles:
        """`energy_bound` of each patch, (k,)."""
        numbers = zip(n_touched.tolist(), n_untouched.tolist(), strict=True)
        return np.array([energy_bound(*n, self._z_energy) for n in numbers])

    def _back_projected(self, measurements: Floats, phi: Phi) -> Floats:
        """Phi' d on the grid: (k, m) to (k, n_rows, n_cols), 0 where no taxel is."""
        taxels = phi.adjoint(np.ascontiguousarray(measurements))
        k = len(taxels)
        grids = taxels
        if self._cells.size < self._exists.size:
            grids = np.zeros((k, self._exists.size), dtype=np.float32)
            grids[:, self._cells] = taxels
        return grids.reshape(k, *self._exists.shape)

    def _product(self, phi: Phi, scale: Floats) -> Floats:
        """Matrix (m, n) by which measurements have their scores."""
        rows = []
        for level, span in enumerate(self.pyramid.spans):
            square_of_taxel = self.pyramid.square_of_cell(level)[self._cells]
            numbers = np.arange(span.stop - span.start)
            in_square = square_of_taxel == numbers[:, np.newaxis]
            # The sum of Phi' d over a square is the product of d with Phi times its indicator.
            rows.append(phi.forward(in_square.astype(np.float32)))
        matrix = np.concatenate(rows)
        matrix *= scale[:, np.newaxis]
        return np.ascontiguousarray(matrix.T)

    def _norms_of_readings(self) -> tuple[Doubles, list[Weights]]:
        """Norms of the sums of readings, (n,), and weights of each level."""
        n = self._cells.size
        sizes = [min(side * side, n) for side in self.pyramid.sides]
        weights = [Weights(n_inside=size) for size in sizes]
        return np.sqrt(self._count), weights

    def _norms_of_measurements(self, phi: Phi) -> tuple[Doubles, list[Weights]]:
        """Norms of the sums over squares, (n,), and weights of each level: of its squares, the
        largest `inside`, and the least `n_inside` and `n_outside`.
        """
        norms = np.empty(self.pyramid.n)
        weights = []
        for level, span in enumerate(self.pyramid.spans):
            n_squares = span.stop - span.start
            is_single = self.pyramid.sides[level] == 1
            if not is_single and n_squares * self._exists.size > MOST_WEIGHTS:
                # Phi' Phi lengthens no vector by more than its largest eigenvalue.
                norms[span] = phi.lipschitz * np.sqrt(self._count[span])
                weights.append(Weights())
                continue

            facts = self._facts(phi, level, n_squares)
            norms[span] = facts[:, 0]
            # A square that no measurement reads has no weights.
            is_measured = facts[:, 1] > 0
            measured = facts[is_measured, 1:]
            if not len(measured):
                measured = np.ones((1, 3))
            inside = measured[:, 0].max()
            n_inside, n_outside = measured[:, 1:].min(axis=0)
            weights.append(Weights(inside, n_inside, n_outside))
        return norms, weights

    def _facts(self, phi: Phi, level: int, n_squares: int) -> Doubles:
        """Norm and `Weights` of the squares of a level, float64 (n_squares, 4)."""
        square_of_taxel = self.pyramid.square_of_cell(level)[self._cells]
        facts = np.zeros((n_squares, 4))
        layout = block_layout(phi)
        if self.pyramid.sides[level] > 1 or layout is None:
            for begin in range(0, n_squares, AT_ONCE):
                numbers = np.arange(begin, min(begin + AT_ONCE, n_squares))
                in_square = square_of_taxel == numbers[:, np.newaxis]
                facts[numbers] = _facts_of(phi, in_square)
            return facts

        # Single taxels: those of a block have the same weights in another order, so that its first
        # one stands for all of them.
        begins = np.cumsum(layout.sizes) - layout.sizes
        first_taxels = layout.permutation[begins]
        is_first = np.arange(phi.n) == first_taxels[:, np.newaxis]
        facts_of_block = _facts_of(phi, is_first)
        facts_of_taxel = np.repeat(facts_of_block, layout.sizes, axis=0)
        facts[square_of_taxel[layout.permutation]] = facts_of_taxel
        return facts

    def _excess_variance(self, weights: Sequence[Weights]) -> Floats:
        """`variance_clipped` of each score beyond that of many equal weights, (n_windows, n)."""
        excess = np.zeros((self.n_windows, self.pyramid.n), dtype=np.float32)
        if not self._clips:
            return excess
        for window in range(self.n_windows):
            for span, level_weights in zip(self.pyramid.spans, weights, strict=True):
                variance = variance_clipped(level_weights, 2**window, self._z)
                excess[window, span] = max(0.0, variance - CLIPPED)
        return excess


def _inverse(norms: Doubles) -> Floats:
    """Inverses of norms, float32; 0 of what is not measured."""
    # Smaller norms are the rounding of a square that no measurement reads.
    is_measured = norms > 1e-6 * norms.max()
    inverses = np.zeros_like(norms)
    np.divide(1, norms, out=inverses, where=is_measured)
    return inverses.astype(np.float32)


def _facts_of(phi: Phi, in_square: Mask) -> Doubles:
    """Norm and `Weights` of the scores of k squares, float64 (k, 4); `in_square`: bool (k, n), True
    for the taxels of each.
    """
    measured = phi.forward(in_square.astype(np.float32))
    weights = phi.adjoint(measured)
    powers = np.square(weights, dtype=np.float64)
    total = powers.sum(axis=1)
    norm = np.sqrt(total)

    inside = powers * in_square
    share_inside = inside.sum(axis=1) / np.maximum(total, TINY)
    n_inside = _n_equal(inside)
    n_outside = _n_equal(powers * ~in_square)
    return np.stack([norm, share_inside, n_inside, n_outside], axis=1)


def _n_equal(powers: Doubles) -> Doubles:
    """Least number of equal weights with the sum of each row of squared weights, (k, n): (k,)."""
    sums = powers.sum(axis=1)
    largest = np.maximum(powers.max(axis=1), TINY)
    numbers: Doubles = sums / largest
    # Those of no weight are as good as infinitely many.
    numbers[sums <= TINY] = np.inf
    return numbers


class Windows:
    """Sums of the scores of k patches over the last 1, 2, 4 ... frames, on a grid without overlap.

    Parameters
    ----------
    n_patches, n : int
        Patches, and scores of each.
    n_windows : int
    cycle : int
        Number of row subsets, each of which has a reference of its own.
    """

    def __init__(self, n_patches: int, n: int, n_windows: int, cycle: int = 1) -> None:
        self._n_windows = n_windows
        self._cycle = cycle
        self._n_frames = 0
        #: First half of the window of twice as many frames.
        self._halves = np.zeros((n_windows - 1, n_patches, n), dtype=np.float32)

    def restart(self, patches: Mask | slice = slice(None)) -> None:
        """Forget the scores of some patches."""
        self._halves[:, patches] = 0.0

    def alarms(
        self, scores: Floats, limits: Floats, noise: Doubles, one_sided: bool = False
    ) -> Mask:
        """Add the scores of a frame, (k, n); return True for each patch of which a window that ends
        with it exceeds its limits, as of `Bounds.scores`. `noise` is the variance of a reference as
        a multiple of that of a frame, (k,).
        """
        self._n_frames += 1
        total = scores
        alarms = np.zeros(len(scores), dtype=np.bool_)
        for window in range(self._n_windows):
            n = 1 << window
            # The error of a reference is the same in all frames of its row subset: it adds up.
            n_alike = max(1.0, n / self._cycle)
            variance = n * (1 + n_alike * noise)
            widened = np.sqrt(variance).astype(np.float32)
            limit = limits[:, window] * widened[:, np.newaxis]
            size = total
            if not one_sided:
                size = np.abs(total)
            exceeds = size > limit
            alarms |= np.logical_or.reduce(exceeds, axis=1)

            if window + 1 == self._n_windows:
                break
            # A bit of the number of frames: set, the next window is at its half.
            if self._n_frames >> window & 1:
                self._halves[window] = total
                break
            total = self._halves[window] + total
        return alarms
