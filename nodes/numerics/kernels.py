"""All loops that numba compiles.

They stand in one file because numba stores compiled code by file: a loop that another one calls
must not change without it.

Vectors are float32 and contiguous. A dealt vector holds the taxels in the order of the scrambled
block Hadamard ensemble, the blocks of one size interleaved: element j of block b is at
j * count + b, so that a butterfly is one sum and one difference of long runs. `groups` states
where the blocks of each size are, int64 (k, 3): start, size, count.

Arrays that belong together are passed as one NamedTuple. A loop reads their fields before it
begins, and has few vectors: of many, it would not be computed on several numbers at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import (
    Annotated,
    Any,
    NamedTuple,
    TypeAlias,
    TypeVar,
    get_type_hints,
)

import numpy as np
from numba import float32, float64, int32, int64, types, uint32

from .arrays import TINY
from .compiled import compiled

A: TypeAlias = Any
"""An array; mypy and numba read its type differently."""

# Numbers of Python are float64: one of them would make a loop compute so, half as many at once.
_ROOT_2 = np.float32(np.sqrt(2.0))
_0 = np.float32(0)
_1 = np.float32(1)
_HALF = np.float32(0.5)
_3 = np.float32(3)
_4 = np.float32(4)
_64 = np.float32(64)
_NEGLIGIBLE = np.float32(1e-18)
"""Force, N, and gain of a filter, that are kept as 0, chosen: no sum of a frame resolves them. What
fades in taxels that nothing presses, and its squares, would reach numbers below 1e-38, with which
some processors compute 15 times longer.
"""
_THIRD = np.float32(1 / 3)
_QUARTER = np.float32(1 / 4)
_FIFTH = np.float32(1 / 5)
_SIXTH = np.float32(1 / 6)
_SEVENTH = np.float32(1 / 7)
_NINTH = np.float32(1 / 9)
# A float32 is 9 bits, of sign and exponent, and the 23 of its mantissa.
_N_MANTISSA = np.uint32(23)
_MANTISSA = np.uint32(0x007FFFFF)
_BITS_OF_1 = np.uint32(0x3F800000)

V: TypeAlias = Annotated[Any, float32[::1]]
"""A vector. `M`: a matrix; `P`, `P2`: places and tables of them; `G`: groups; `L`: whole numbers;
`D`, `DM`: numbers and tables of them. mypy reads the first type, numba the second one."""
M: TypeAlias = Annotated[Any, float32[:, ::1]]
P: TypeAlias = Annotated[Any, uint32[::1]]
P2: TypeAlias = Annotated[Any, uint32[:, ::1]]
G: TypeAlias = Annotated[Any, int64[:, ::1]]
L: TypeAlias = Annotated[Any, int64[::1]]
D: TypeAlias = Annotated[Any, float64[::1]]
DM: TypeAlias = Annotated[Any, float64[:, ::1]]
_NUMBERS = {float: float64, int: int64, np.float32: float32}
Loop = TypeVar("Loop", bound=Callable[..., Any])


def numba_type(annotation: Any) -> Any:
    """The type that numba has for an annotation: a number, an array, or a NamedTuple of them."""
    if annotation in _NUMBERS:
        return _NUMBERS[annotation]
    if hasattr(annotation, "_fields"):
        base: Any = types.BaseTuple
        return base.from_types(_numba_types(annotation), annotation)
    return annotation.__metadata__[0]


def _numba_types(annotated: Any) -> tuple[Any, ...]:
    hints = get_type_hints(annotated, include_extras=True)
    hints.pop("return", None)
    return tuple(numba_type(hint) for hint in hints.values())


def entry(*, sums_in_any_order: bool = False) -> Callable[[Loop], Loop]:
    """Decorator of a loop that Python calls: as `compiled`, for the types of its annotations."""

    def decorate(loop: Loop) -> Loop:
        return compiled(_numba_types(loop), sums_in_any_order=sums_in_any_order)(loop)

    return decorate


class Transform(NamedTuple):
    """W of a scrambled block Hadamard ensemble, symmetric."""

    groups: G  # int64 (k, 3)
    scale: V  # of each row: 1 / sqrt(size of its block)


class Measured(NamedTuple):
    """Rows that a frame reads, and vectors of them."""

    read: L  # int64 (n_read,), ascending
    values: V
    innovation: V  # values less those predicted
    last_innovation: V  # when these rows were read before
    predicted: V  # values that are predicted
    last_predicted: V  # when these rows were read before
    off_target: V  # values less their targets
    residual: V  # values less W x of the estimate
    doubt: V  # part of each value that no force explains, 0 to 1
    excess: V  # variance that this adds to that of its noise
    change: V  # values less those of the last estimate, without what is doubted
    target_variance: V  # variance of the targets
    own: V  # what each row has added to its own value in the estimate of the steps


class Received(NamedTuple):
    """The row subset of a frame."""

    order: L  # int64 (n_read,): order of the measurements in which their rows ascend
    last_y: V  # its last measurements, float32 (n_read,)
    ones: V  # Phi 1, in the order of the rows read
    block: L  # int64 (n_read,): block that each row is compared within, -1 for none
    n_blocks: int
    faulty: V  # 1 for a measurement that is not to count, else 0


class DoubtConstants(NamedTuple):
    """Constants of `doubt_values`."""

    outlying: float
    """Squared change, in that of others, at which half of a value is doubted."""
    clear_ratio: float
    """The same in `outlying`, beyond which a larger one does not count."""
    certain: float
    """Least part that is not doubted."""
    unknown: float
    """Variance of a row that was not read yet, a number of float32."""


class Estimate(NamedTuple):
    """The last estimate."""

    x: V
    rows: V  # W x
    correction: V  # W times what the last measurements changed


class Prediction(NamedTuple):
    """The prediction of a frame."""

    x: V
    rows: V  # W x


class Slopes(NamedTuple):
    """Slopes of the last estimate along rows and columns; scratch."""

    of_taxels: M  # float32 (2, n)
    of_rows: M  # W times each


class Filters(NamedTuple):
    """The filter of each row."""

    mean: V
    variance: V  # that its measurements left
    change: V  # of what has changed since
    #: float64 (4,): sums of the regressions of `move_means`, products and squares, of the growth
    #: and then of the translation.
    confirmed: D


class Targets(NamedTuple):
    """The value that each row is expected to have."""

    value: V
    variance: V


class Iterates(NamedTuple):
    """State of the steps of a frame; scratch."""

    z: V
    u: V  # truth and noise, of a step
    mean: V  # of the estimates so far


class TileMaps(NamedTuple):
    """Windows and tiles of a skin on a canvas with a margin around it."""

    canvas: P  # uint32: place in the vector of taxels that each cell reads, n for none
    cells: P  # uint32 (n,): cell of each taxel
    begins: P2  # uint32 (shifts, t): first cell of each window
    shares: M  # float32 (shifts, t): part of the taxels that lie in each tile
    kinds: P2  # uint32 (shifts, t): row of the limits' scales of each window
    counts: L  # int64 (shifts,): number of tiles
    width: int  # cells of a row


class Weights(NamedTuple):
    """Weights of the learned gates, as of `Gates`, their matrices transposed: BLAS copies none."""

    filters: M
    hidden: M
    hidden_0: V
    gates: M
    gates_0: V
    synthesis: M
    error: V
    error_0: float


class Limits(NamedTuple):
    """Constants of the denoisers."""

    scales: M  # (k, 22): inverses of what the sums of a kind of window stand out by
    clearly: float  # factor of these limits at which a window counts in full
    quiet: float  # expected squared error of a tile in which nothing stands out
    strict: float  # of shrinkage: energy at which half of a group is kept
    least: float  # of shrinkage: energy that is nothing


class StepScratch(NamedTuple):
    """Scratch of a step. Of w to tiles, rows are windows; of sums and details, columns are."""

    v: A  # (n + 1,)
    image: A  # cells of the canvas
    denoised: A  # cells of the canvas
    w: A  # (t, 144)
    a: A
    levels: A
    h: A
    g: A
    tiles: A  # (t, 64)
    sums: A  # (85, t)
    details: A  # (65, t)
    parts: A  # (t,): part of a window that counts
    busy: A  # int64 (t,): windows in which something stands out


class Denoiser(NamedTuple):
    """A denoiser of windows."""

    weights: Weights
    limits: Limits
    scratch: V  # as of `step_scratch`
    has_gates: int  # 0: all steps are by the formula


class MotionWeights(NamedTuple):
    """A prediction (1 + growth) x + down dx/drow + across dx/dcol, within 0 to bound."""

    growth: float
    down: float
    across: float
    bound: float


class Variances(NamedTuple):
    """Variances by which the rows of a frame are filtered."""

    noise: float  # of a measurement
    prediction: float  # of the prediction of a row
    change: float  # of what has changed in a row since the last frame
    floor: float  # least variance


class FilterConstants(NamedTuple):
    """Constants of `skin_predict` and `skin_filter`."""

    prior: float
    doubt: float
    recall_memory: float
    recall_ridge: float
    motion_memory: float
    most_recalled: float
    most_confirmed: float
    unknown: float  # variance of a row that was not read yet


class Plan(NamedTuple):
    """Steps of a frame, as of `StepPlan`: by the formula, then by the weights."""

    n_formula: int
    n: int
    first_shift: int
    frame_tiles: int
    step_tiles: int
    most: int
    target_variance: float  # mean variance of the targets of the rows read
    floor: float  # least variance


class StepConstants(NamedTuple):
    """Constants of `skin_steps`."""

    damping: float
    damped_from: float
    least_tau: float
    most_alpha: float
    residual_power: float
    rise_power: float
    fully_averaged: float
    converged: int
    n_formula: int
    formula_share: int


class StepInputs(NamedTuple):
    """What the steps of all frames take: it is made once, as long as the scratch is the same."""

    transform: Transform
    prediction: Prediction
    targets: Targets
    iterates: Iterates
    tiles: TileMaps
    denoiser: Denoiser
    constants: StepConstants


class BlendNumbers(NamedTuple):
    """How the estimate of a frame and its forces are made."""

    part: float  # weight of the prediction
    bias: float  # mean reading of an untouched taxel
    noise_sd: float  # noise of an untouched taxel
    least_force: float  # smaller forces are returned as 0


class NoiseCurve(NamedTuple):
    """The noise of readings, as of `NoiseModel`."""

    f_max: float
    sigma_mid: float
    sigma_end: float
    clips: float  # 1 or 0
    of_touched: float  # 1 or 0
    clipped: float  # variance of noise of variance 1 that is clipped at 0
    clipped_below: float  # force, in deviations, from which noise is not clipped


@compiled()
def hadamard(v: A, groups: A) -> None:
    """Transform a dealt vector in place: each block by its matrix of +1 and -1."""
    for g in range(groups.shape[0]):
        start = groups[g, 0]
        count = groups[g, 2]
        length = groups[g, 1] * count

        # Two stages at a time: half of the reads and writes.
        run = count
        while 4 * run <= length:
            for base in range(start, start + length, 4 * run):
                a = v[base : base + run]
                b = v[base + run : base + 2 * run]
                c = v[base + 2 * run : base + 3 * run]
                d = v[base + 3 * run : base + 4 * run]
                for k in range(run):
                    sum_ab = a[k] + b[k]
                    sum_cd = c[k] + d[k]
                    off_ab = a[k] - b[k]
                    off_cd = c[k] - d[k]
                    a[k] = sum_ab + sum_cd
                    b[k] = off_ab + off_cd
                    c[k] = sum_ab - sum_cd
                    d[k] = off_ab - off_cd
            run *= 4

        # A stage is left where their number is odd.
        if run < length:
            a = v[start : start + run]
            b = v[start + run : start + 2 * run]
            for k in range(run):
                difference = a[k] - b[k]
                a[k] += b[k]
                b[k] = difference


@compiled()
def haar(v: A, n_rows: int, n_cols: int, half: A) -> None:
    """Haar transform at full depth of a grid of any sides, row by row, in place.

    Sums and differences are not scaled; a sample without a partner is multiplied by sqrt(2), as
    large as the sums of the others. `half` is scratch, as long as v.
    """
    rows = n_rows
    cols = n_cols
    while rows > 1 or cols > 1:
        half_rows = (rows + 1) // 2
        half_cols = (cols + 1) // 2

        # Along columns, to scratch: in place a sum would replace what its difference needs.
        for i in range(rows // 2):
            upper = v[2 * i * n_cols :][:cols]
            lower = v[(2 * i + 1) * n_cols :][:cols]
            sums = half[i * n_cols :][:cols]
            details = half[(half_rows + i) * n_cols :][:cols]
            for j in range(cols):
                sums[j] = upper[j] + lower[j]
                details[j] = upper[j] - lower[j]
        if rows % 2:
            upper = v[(rows - 1) * n_cols :][:cols]
            sums = half[(half_rows - 1) * n_cols :][:cols]
            for j in range(cols):
                sums[j] = _ROOT_2 * upper[j]

        # Along rows, and back.
        for i in range(rows):
            upper = half[i * n_cols :][:cols]
            sums = v[i * n_cols :][:cols]
            details = sums[half_cols:]
            for j in range(details.size):
                sums[j] = upper[2 * j] + upper[2 * j + 1]
                details[j] = upper[2 * j] - upper[2 * j + 1]
            if cols % 2:
                sums[half_cols - 1] = _ROOT_2 * upper[cols - 1]

        rows = half_rows
        cols = half_cols


@compiled()
def haar_transposed(v: A, n_rows: int, n_cols: int, half: A) -> None:
    """The transpose of `haar`."""
    depth = 0
    while (n_rows - 1) >> depth or (n_cols - 1) >> depth:
        depth += 1

    # The levels and axes of `haar`, the last one first.
    for level in range(depth - 1, -1, -1):
        # Sides at a level: n / 2^level, rounded up.
        rows = ((n_rows - 1) >> level) + 1
        cols = ((n_cols - 1) >> level) + 1
        half_rows = (rows + 1) // 2
        half_cols = (cols + 1) // 2

        for i in range(rows):
            upper = half[i * n_cols :][:cols]
            sums = v[i * n_cols :][:cols]
            details = sums[half_cols:]
            for j in range(details.size):
                upper[2 * j] = sums[j] + details[j]
                upper[2 * j + 1] = sums[j] - details[j]
            if cols % 2:
                upper[cols - 1] = _ROOT_2 * sums[half_cols - 1]

        for i in range(rows // 2):
            upper = v[2 * i * n_cols :][:cols]
            lower = v[(2 * i + 1) * n_cols :][:cols]
            sums = half[i * n_cols :][:cols]
            details = half[(half_rows + i) * n_cols :][:cols]
            for j in range(cols):
                upper[j] = sums[j] + details[j]
                lower[j] = sums[j] - details[j]
        if rows % 2:
            upper = v[(rows - 1) * n_cols :][:cols]
            sums = half[(half_rows - 1) * n_cols :][:cols]
            for j in range(cols):
                upper[j] = _ROOT_2 * sums[j]


@entry()
def fista(
    theta: V, before: V, betas: V, weights2: V, threshold: V, z: V, v: V, deal: P, keep: V,
    measured: V, groups: G, grid: L, half: V,
) -> None:  # fmt: skip
    """Iterations of FISTA, one for each of betas; the two thetas alternate, the first is newest."""
    for beta in betas:
        # Momentum.
        for k in range(z.size):
            z[k] = theta[k] + beta * (theta[k] - before[k])

        # The gradient step: rows that are read become their measurements, others stay.
        haar_transposed(z, grid[0], grid[1], half)
        for p in range(deal.size):
            v[p] = z[deal[p]]
        hadamard(v, groups)
        # `keep` is 0 where a row is read.
        for p in range(v.size):
            v[p] = v[p] * keep[p] + measured[p]
        hadamard(v, groups)
        for p in range(deal.size):
            z[deal[p]] = v[p]
        haar(z, grid[0], grid[1], half)

        # Soft threshold.
        for k in range(z.size):
            u = weights2[k] * z[k]
            before[k] = u - min(max(u, -threshold[k]), threshold[k])
        theta, before = before, theta


@entry()
def haar_image(v: V, grid: L, half: V) -> None:
    """Replace Haar coefficients, of the scale of `haar`, by their image."""
    haar_transposed(v, grid[0], grid[1], half)


@compiled()
def sum_bands(image: A, begin: Any, width: int, n_columns: Any, bands: A) -> None:
    """Set the first four rows of bands, each of n_columns, to the sums of three rows each of a flat
    image from its place `begin` on, and the last one to the peaks of all twelve: what windows that
    lie beside each other share.
    """
    peaks = bands[4 * n_columns :][:n_columns]
    for j in range(n_columns):
        peaks[j] = _0
    for band in range(4):
        at = begin + 3 * band * width
        upper = image[at:][:n_columns]
        middle = image[at + width :][:n_columns]
        lower = image[at + 2 * width :][:n_columns]
        sums = bands[band * n_columns :][:n_columns]
        for j in range(n_columns):
            sums[j] = upper[j] + middle[j] + lower[j]
            of_lower = max(middle[j], lower[j])
            peak = max(upper[j], of_lower)
            peaks[j] = max(peaks[j], peak)


@compiled()
def standing_out(bands: A, n_columns: Any, column: Any, scales: A, clearly: Any) -> Any:
    """Part of the window of 12 x 12 that begins at a column of `sum_bands`, as in the module of
    this name, by the scales of its kind.
    """
    highest = _0
    peaks = bands[4 * n_columns + column :][:12]
    for j in range(12):
        highest = max(highest, peaks[j])
    excess = highest * scales[0]

    whole = _0
    left_half = _0
    right_half = _0
    # Each square once, by all four sizes: windows without a contact are most of all.
    for band in range(4):
        sums = bands[band * n_columns + column :][:12]
        of_thirds = scales[1 + 4 * band :][:4]

        # Squares of 3 x 3.
        a = sums[0] + sums[1] + sums[2]
        b = sums[3] + sums[4] + sums[5]
        c = sums[6] + sums[7] + sums[8]
        d = sums[9] + sums[10] + sums[11]
        of_left = max(a * of_thirds[0], b * of_thirds[1])
        of_right = max(c * of_thirds[2], d * of_thirds[3])
        excess = max(max(excess, of_left), of_right)

        # Squares of 6 x 6, of two bands each.
        left_half += a + b
        right_half += c + d
        if band % 2:
            of_sixths = scales[16 + band :][:2]
            of_left = left_half * of_sixths[0]
            of_right = right_half * of_sixths[1]
            excess = max(max(excess, of_left), of_right)
            whole += left_half + right_half
            left_half = _0
            right_half = _0

    excess = max(excess, whole * scales[21])
    part = (excess - _1) / (np.float32(clearly) - _1)
    return min(max(part, _0), _1)


@compiled(sums_in_any_order=True)
def haar_shrink(w: A, limits: Limits, sums: A, details: A) -> None:
    """Shrink the tiles of windows (t, 144), as in `formula`.

    Columns of sums and details are tiles. sums holds the taxels, and their sums at each level: its
    first 64 rows are the result. Row 64 of details becomes the expected squared error.
    """
    strict = np.float32(limits.strict)
    least = np.float32(limits.least)
    quiet = np.float32(limits.quiet)
    n_tiles = w.shape[0]
    # A tile is the middle of its window of 12 x 12.
    for p in range(64):
        place = 12 * (p // 8 + 2) + p % 8 + 2
        for t in range(n_tiles):
            sums[p, t] = w[t, place]
    error = details[64][:n_tiles]
    for t in range(n_tiles):
        error[t] = _0

    # Details of each level, shrunk, and the sums that the next level is made of. The error is
    # Stein's unbiased estimate: what is removed, and twice the divergence of the shrinkage.
    begin = 0
    place = 0
    n = 8
    while n > 1:
        for k in range(n * n // 4):
            corner = begin + 2 * (k // (n // 2)) * n + 2 * (k % (n // 2))
            top_left = sums[corner]
            top_right = sums[corner + 1]
            bottom_left = sums[corner + n]
            bottom_right = sums[corner + n + 1]
            total = sums[begin + n * n + k]
            row_details = details[place]
            col_details = details[place + 1]
            diagonal_details = details[place + 2]
            for t in range(n_tiles):
                top = top_left[t] + top_right[t]
                bottom = bottom_left[t] + bottom_right[t]
                off_top = top_left[t] - top_right[t]
                off_bottom = bottom_left[t] - bottom_right[t]
                total[t] = _HALF * (top + bottom)
                along_rows = _HALF * (top - bottom)
                along_cols = _HALF * (off_top + off_bottom)
                diagonal = _HALF * (off_top - off_bottom)
                energy = (
                    along_rows * along_rows
                    + along_cols * along_cols
                    + diagonal * diagonal
                )
                ratio = _3 * strict / (energy + least)
                gain = _1 / (_1 + ratio * ratio)
                row_details[t] = gain * along_rows
                col_details[t] = gain * along_cols
                diagonal_details[t] = gain * diagonal
                loss = _1 - gain
                error[t] += loss * loss * energy + (gain + gain) * (_3 + _4 * loss)
            place += 3
        begin += n * n
        n //= 2

    # The mean is a group of its own.
    mean = sums[84]
    for t in range(n_tiles):
        energy = mean[t] * mean[t]
        ratio = strict / (energy + least)
        gain = _1 / (_1 + ratio * ratio)
        mean[t] *= gain
        loss = _1 - gain
        of_groups = error[t] + loss * loss * energy + (gain + gain) * (_1 + _4 * loss)
        error[t] = min(max(of_groups / _64 - _1, quiet), _1)

    # Back from the mean to the taxels.
    while n < 8:
        n *= 2
        begin -= n * n
        place -= 3 * n * n // 4
        for k in range(n * n // 4):
            corner = begin + 2 * (k // (n // 2)) * n + 2 * (k % (n // 2))
            top_left = sums[corner]
            top_right = sums[corner + 1]
            bottom_left = sums[corner + n]
            bottom_right = sums[corner + n + 1]
            total = sums[begin + n * n + k]
            row_details = details[place + 3 * k]
            col_details = details[place + 3 * k + 1]
            diagonal_details = details[place + 3 * k + 2]
            for t in range(n_tiles):
                top = total[t] + row_details[t]
                bottom = total[t] - row_details[t]
                off_top = col_details[t] + diagonal_details[t]
                off_bottom = col_details[t] - diagonal_details[t]
                top_left[t] = _HALF * (top + off_top)
                top_right[t] = _HALF * (top - off_top)
                bottom_left[t] = _HALF * (bottom + off_bottom)
                bottom_right[t] = _HALF * (bottom - off_bottom)


@entry()
def orthonormal(v: V, groups: G, scale: V) -> None:
    """Transform a dealt vector in place by W = W^T, orthonormal; scale: that of each place."""
    hadamard(v, groups)
    for p in range(scale.size):
        v[p] *= scale[p]


@compiled(sums_in_any_order=True)
def compare(
    y: A, received: Received, bias: Any, values: A
) -> tuple[float, float, float]:
    """Set values to measurements y in the order of the rows read, less the bias. Return their sum
    of squares, the largest one and the largest change since the last ones.
    """
    order = received.order
    last_y = received.last_y
    ones = received.ones
    squares = 0.0
    largest = _0
    change = _0
    for i in range(values.size):
        measurement = y[order[i]]
        last_measurement = last_y[order[i]]
        squares += np.float64(measurement) ** 2
        largest = max(largest, abs(measurement))
        change = max(change, abs(measurement - last_measurement))
        values[i] = measurement - bias * ones[i]
    return squares, np.float64(largest), np.float64(change)


@compiled(sums_in_any_order=True)
def squared_changes(
    measured: Measured, x_rows: A, filters: Filters, unknown: float
) -> tuple[D, D]:
    """Squares of what the values have changed by since the last estimate; and, of rows that were
    read before, the smaller ones of these and of what they differ from the filters by.
    """
    read = measured.read
    values = measured.values
    mean = filters.mean
    variance = filters.variance
    squares = np.empty(read.size)
    unexplained = np.empty(read.size)
    for i in range(read.size):
        row = read[i]
        change = np.float64(values[i] - x_rows[row])
        squares[i] = change**2
        unexplained[i] = squares[i]
        if variance[row] < unknown:
            off_mean = np.float64(values[i] - mean[row])
            unexplained[i] = min(squares[i], off_mean**2)
    return squares, unexplained


@compiled(sums_in_any_order=True)
def doubt_values(
    received: Received,
    measured: Measured,
    x_rows: A,
    filters: Filters,
    noise: float,
    constants: DoubtConstants,
) -> None:
    """Set doubt and excess of the values, as in `FrameVectors`."""
    block = received.block
    n_blocks = received.n_blocks
    squares, unexplained = squared_changes(measured, x_rows, filters, constants.unknown)
    # The last place, -1, is of the values that are not compared.
    count = np.zeros(n_blocks + 1)
    total = np.zeros(n_blocks + 1)
    # Of each block the two largest squares: a second outlier must not excuse the first.
    largest = np.zeros(n_blocks + 1)
    second = np.zeros(n_blocks + 1)
    for i in range(squares.size):
        number = block[i]
        square = squares[i]
        count[number] += 1
        total[number] += square
        lesser = min(square, largest[number])
        second[number] = max(second[number], lesser)
        largest[number] = max(largest[number], square)

    expected = np.empty(squares.size)
    per_other = 1 / np.maximum(count - 2, 1.0)
    for i in range(squares.size):
        number = block[i]
        square = squares[i]
        largest_other = second[number] if square == largest[number] else largest[number]
        others = (total[number] - square - largest_other) * per_other[number]
        # Of a value that is not compared any square is expected: it is not doubted.
        expected[i] = others + noise if number >= 0 else np.inf

    # A loop without choices: its quotients are computed several at once.
    doubt = measured.doubt
    excess = measured.excess
    faulty = received.faulty
    outlying = constants.outlying
    clear_ratio = constants.clear_ratio
    certain = constants.certain
    for i in range(squares.size):
        ratio = min(unexplained[i] / (outlying * expected[i] + TINY), clear_ratio)
        power = ratio * ratio * ratio * ratio
        doubted = max(power / (1 + power), np.float64(faulty[i]))
        doubt[i] = doubted
        believed = np.float64(_1 - np.float32(doubted)) + certain
        excess[i] = doubted * unexplained[i] / believed


@compiled(sums_in_any_order=True)
def motion_sums(
    measured: Measured, estimate: Estimate, by_down: A, by_across: A
) -> tuple[float, ...]:
    """Sums of `MotionSums` over the rows read: the products of its terms a, b and c, and those of
    each term and what the values exceed W x by.
    """
    read = measured.read
    values = measured.values
    doubt = measured.doubt
    changes = measured.change
    x_rows = estimate.rows
    aa = ab = ac = bb = bc = cc = 0.0
    a_change = b_change = c_change = 0.0
    for i in range(read.size):
        r = read[i]
        a = np.float64(x_rows[r])
        b = np.float64(by_down[r])
        c = np.float64(by_across[r])
        changes[i] = (_1 - doubt[i]) * (values[i] - x_rows[r])
        change = np.float64(changes[i])
        aa += a * a
        ab += a * b
        ac += a * c
        bb += b * b
        bc += b * c
        cc += c * c
        a_change += a * change
        b_change += b * change
        c_change += c * change
    return aa, ab, ac, bb, bc, cc, a_change, b_change, c_change


@entry(sums_in_any_order=True)
def skin_begin(
    y: V,
    received: Received,
    bias: float,
    noise: float,
    constants: DoubtConstants,
    measured: Measured,
    estimate: Estimate,
    filters: Filters,
    neighbours: P2,
    transform: Transform,
    slopes: Slopes,
) -> tuple[float, ...]:
    """Begin a frame of measurements y, as in `FrameVectors`. Set the values of the rows read and
    the slopes of the last estimate. Return the numbers of `Comparison` and the sums of
    `MotionSums`.

    neighbours are the places of the next and the previous neighbour of each taxel along rows and
    columns, uint32 (4, n).
    """
    squares, largest_y, change_y = compare(
        y, received, np.float32(bias), measured.values
    )
    doubt_values(received, measured, estimate.rows, filters, noise, constants)

    x = estimate.x
    n = x.size
    for k in range(2):
        slope = slopes.of_taxels[k]
        following = neighbours[k]
        previous = neighbours[2 + k]
        of_rows = slopes.of_rows[k]
        for p in range(n):
            slope[p] = x[following[p]] - x[previous[p]]
            of_rows[p] = slope[p]
        orthonormal(of_rows, transform.groups, transform.scale)

    largest = _0
    for p in range(n):
        largest = max(largest, x[p])
    # Not in the same loop: of float32 alone, the largest of several numbers is found at once.
    energy = 0.0
    for p in range(n):
        force = np.float64(x[p])
        energy += force * force

    comparison = (squares / measured.values.size, largest_y, change_y)
    sums = motion_sums(measured, estimate, slopes.of_rows[0], slopes.of_rows[1])
    return *comparison, *sums, energy, np.float64(largest)


@compiled(sums_in_any_order=True)
def confirmed_part(
    sums: A, motion: A, unexpected: A, constants: FilterConstants
) -> Any:
    """As `ConfirmedMotion.follow`; sums are its two."""
    energy = 0.0
    for i in range(motion.size):
        energy += np.float64(motion[i] * motion[i])
    mean_square = np.float32(energy / motion.size + TINY)

    products = 0.0
    squares = 0.0
    # A row counts less the more it moves beyond the others: sums of blocks are wrong together.
    for i in range(motion.size):
        square = motion[i] * motion[i]
        weighted = motion[i] * (mean_square / (mean_square + square))
        products += np.float64(weighted * unexpected[i])
        squares += np.float64(weighted * motion[i])
    sums *= constants.motion_memory
    sums[0] += products
    sums[1] += squares
    part = sums[0] / (sums[1] + TINY)
    return np.float32(min(max(part, 0.0), constants.most_confirmed))


@compiled(sums_in_any_order=True)
def move_means(
    measured: Measured,
    estimate: Estimate,
    prediction: Prediction,
    filters: Filters,
    growth: Any,
    constants: FilterConstants,
) -> None:
    """Move the means of the filters as the prediction moves, so far as their rows confirm it."""
    read = measured.read
    values = measured.values
    doubt = measured.doubt
    x_rows = estimate.rows
    predicted_rows = prediction.rows
    mean = filters.mean
    variance = filters.variance
    change = filters.change
    unknown = np.float32(constants.unknown)
    grown = np.zeros(read.size, np.float32)
    translated = np.zeros(read.size, np.float32)
    unexpected = np.zeros(read.size, np.float32)
    # Rows that were never read have no mean that their values could confirm: they stay 0.
    for i in range(read.size):
        r = read[i]
        if variance[r] + change[r] < unknown:
            certain = _1 - doubt[i]
            grown[i] = growth * x_rows[r]
            translated[i] = (predicted_rows[r] - x_rows[r]) - grown[i]
            unexpected[i] = certain * (values[i] - mean[r])

    confirmed = filters.confirmed
    growth_part = confirmed_part(confirmed[:2], grown, unexpected, constants)
    part = confirmed_part(confirmed[2:], translated, unexpected, constants)
    for p in range(mean.size):
        row_grown = growth * x_rows[p]
        row_translated = (predicted_rows[p] - x_rows[p]) - row_grown
        mean[p] += growth_part * row_grown + part * row_translated


@compiled(sums_in_any_order=True)
def filter_sums(
    measured: Measured, filters: Filters, unknown: float
) -> tuple[int, float, float]:
    """Number of the rows read that are known, and the sums of squared innovation and variance of
    their filters.
    """
    read = measured.read
    values = measured.values
    doubt = measured.doubt
    mean = filters.mean
    variance = filters.variance
    change = filters.change
    limit = np.float32(unknown)
    n_known = 0
    filter_squares = 0.0
    filter_variances = 0.0
    for i in range(read.size):
        r = read[i]
        expected = variance[r] + change[r]
        if expected < limit:
            n_known += 1
            certain = _1 - doubt[i]
            unexpected = certain * (values[i] - mean[r])
            filter_squares += np.float64(unexpected) ** 2
            filter_variances += expected
    return n_known, filter_squares, filter_variances


@compiled(sums_in_any_order=True)
def noise_squares(measured: Measured, squares: float) -> float:
    """As `Innovation.noise_squares`, of the two innovations of the rows read; `squares` is the
    squared length of the new one.
    """
    new = measured.innovation
    last = measured.last_innovation
    predicted = measured.predicted
    last_predicted = measured.last_predicted
    along_change = 0.0
    change_squares = 0.0
    last_squares = 0.0
    for i in range(new.size):
        change = np.float64(predicted[i] - last_predicted[i])
        fall = np.float64(last[i] - new[i])
        along_change += fall * change
        change_squares += change * change
        last_squares += np.float64(last[i]) ** 2

    # What fell in proportion to the change of the prediction was no noise.
    regression = along_change / (change_squares + TINY)
    part = min(max(regression, 0.0), 1.0)
    of_last = 0.0
    of_new = 0.0
    for i in range(new.size):
        change = np.float64(predicted[i] - last_predicted[i])
        fall = np.float64(last[i] - new[i]) - part * change
        of_last += np.float64(last[i]) * fall
        of_new -= np.float64(new[i]) * fall
    weighted = squares * of_last + last_squares * of_new
    return weighted / (squares + last_squares + TINY)


@entry(sums_in_any_order=True)
def skin_predict(
    estimate: Estimate,
    motion: MotionWeights,
    slopes: Slopes,
    transform: Transform,
    measured: Measured,
    prediction: Prediction,
    filters: Filters,
    constants: FilterConstants,
) -> tuple[float, float, float, float, int, float, float]:
    """Predict a frame, as in `FrameVectors`, and move the means of the filters with it. Return the
    sums of `Innovation`, in its order.
    """
    x = estimate.x
    n = x.size
    down_slope = slopes.of_taxels[0]
    across_slope = slopes.of_taxels[1]
    growth = np.float32(motion.growth)
    down = np.float32(motion.down)
    across = np.float32(motion.across)
    bound = np.float32(motion.bound)
    predicted = prediction.x
    for p in range(n):
        motion_of_force = (
            growth * x[p] + down * down_slope[p] + across * across_slope[p]
        )
        moved = x[p] + motion_of_force
        predicted[p] = min(max(moved, _0), bound)

    predicted_rows = prediction.rows
    for p in range(n):
        predicted_rows[p] = predicted[p]
    orthonormal(predicted_rows, transform.groups, transform.scale)
    move_means(measured, estimate, prediction, filters, growth, constants)

    read = measured.read
    values = measured.values
    doubt = measured.doubt
    innovation = measured.innovation
    predicted_read = measured.predicted
    correction = estimate.correction
    squares = 0.0
    correction_squares = 0.0
    products = 0.0
    for i in range(read.size):
        predicted_read[i] = predicted_rows[read[i]]
        innovation[i] = (_1 - doubt[i]) * (values[i] - predicted_read[i])
        new = np.float64(innovation[i])
        corrected = np.float64(correction[read[i]])
        squares += new * new
        correction_squares += corrected * corrected
        products += new * corrected

    of_noise = noise_squares(measured, squares)
    of_innovation = (squares, correction_squares, products, of_noise)
    return *of_innovation, *filter_sums(measured, filters, constants.unknown)


@compiled()
def of_dependent(variance: A, prior: A, doubt: A, bound: A) -> Any:
    """As `SkinTuning.of_dependent`, at most bound; doubt: in noise variances."""
    return min(prior * variance * (_1 + doubt * variance), bound)


@compiled(sums_in_any_order=True)
def follow_recall(
    recall: A,
    measured: Measured,
    correction: A,
    filters: Filters,
    variances: Variances,
    constants: FilterConstants,
) -> Any:
    """As `Recall.follow`; recall are its three sums, correction is that of all rows."""
    read = measured.read
    innovation = measured.innovation
    variance = filters.variance
    change = filters.change
    new_change = np.float32(variances.change)
    unknown = np.float32(constants.unknown)
    products = 0.0
    squares = 0.0
    n_known = 0
    for i in range(read.size):
        r = read[i]
        if variance[r] + (change[r] - new_change) < unknown:
            corrected = np.float64(correction[r])
            products += innovation[i] * corrected
            squares += corrected * corrected
            n_known += 1

    recall *= constants.recall_memory
    recall[0] += products
    recall[1] += squares
    recall[2] += n_known
    # While little is known of it, the correction is used: the ridge draws the part to 1.
    ridge = constants.recall_ridge * variances.noise * recall[2]
    part = (recall[0] + ridge) / (recall[1] + ridge + TINY)
    return np.float32(min(max(part, 0.0), constants.most_recalled))


@compiled(sums_in_any_order=True)
def raise_all(numbers: A, exponent: Any, factor: Any) -> None:
    """Replace numbers of 0 to 1 by factor * number^exponent, where the exponent is 0 to 1, to the
    rounding of float32: in a quarter of the time of pow, which is not computed on several at once.

    A number is sqrt(2) 2^k (1 + q) / (1 - q), with abs(q) < 0.172. What comes of 2^k is in a table,
    by the bits of k; the rest is exp(2 exponent artanh(q)).
    """
    # By the 8 bits of a float32's exponent, 127 for 1; no number here is above that.
    per_binade = np.exp2(np.float64(exponent))
    of_binade = np.empty(256, np.float32)
    power = np.float64(factor) * np.sqrt(per_binade)
    for k in range(127, -1, -1):
        of_binade[k] = power
        power /= per_binade
    for k in range(128, 256):
        of_binade[k] = of_binade[127]

    # Split each number into that of its table and its mantissa.
    factors = np.empty(numbers.size, np.float32)
    bits = numbers.view(np.uint32)
    for p in range(numbers.size):
        factors[p] = of_binade[bits[p] >> _N_MANTISSA]
        bits[p] = bits[p] & _MANTISSA | _BITS_OF_1

    # Power series, nested so that no term is computed twice.
    double = np.float32(2 * exponent)
    for p in range(numbers.size):
        q = (numbers[p] - _ROOT_2) / (numbers[p] + _ROOT_2)
        q2 = q * q
        tail = _FIFTH + q2 * (_SEVENTH + q2 * _NINTH)
        artanh = q * (_1 + q2 * (_THIRD + q2 * tail))
        e = double * artanh
        series = _1 + e * _SIXTH * (_1 + e * _SEVENTH)
        series = _1 + e * _QUARTER * (_1 + e * _FIFTH * series)
        series = _1 + e * _HALF * (_1 + e * _THIRD * series)
        numbers[p] = factors[p] * (_1 + e * series)


@compiled(sums_in_any_order=True)
def set_targets(
    measured: Measured,
    prediction: Prediction,
    filters: Filters,
    targets: Targets,
    recall: A,
    variances: Variances,
    constants: FilterConstants,
) -> None:
    """Combine the prediction and the filter of each row, by their precisions."""
    mean = filters.mean
    variance = filters.variance
    change = filters.change
    predicted_rows = prediction.rows
    target = targets.value
    target_variance = targets.variance
    n = mean.size
    new_change = np.float32(variances.change)
    prior = np.float32(variances.prediction)
    factor = np.float32(constants.prior)
    doubt = np.float32(constants.doubt / variances.noise)
    unknown = np.float32(constants.unknown)
    for p in range(n):
        change[p] = min(change[p] + new_change, unknown)

    # The target is first the gain of the filter's correction, then that correction. A quotient and
    # a product in one loop could be computed in another order, and overflow.
    for p in range(n):
        of_filter = variance[p] + of_dependent(change[p], factor, doubt, unknown)
        target_variance[p] = of_filter / (prior + of_filter)
        gain = prior / (prior + of_filter)
        # A row that was never read has a filter of no weight.
        target[p] = gain if gain > _NEGLIGIBLE else _0
    for p in range(n):
        target[p] *= mean[p] - predicted_rows[p]

    # Between the variances without the filter and with it, by their logarithms: see
    # `FrameVectors`.
    recalled = follow_recall(recall, measured, target, filters, variances, constants)
    raise_all(target_variance, recalled, prior)
    for p in range(n):
        target[p] = predicted_rows[p] + recalled * target[p]


@compiled(sums_in_any_order=True)
def read_values(
    measured: Measured, filters: Filters, targets: Targets, variances: Variances
) -> Any:
    """Update the targets and the filters of the rows read by their values. Return the mean variance
    of these targets.
    """
    read = measured.read
    values = measured.values
    doubt = measured.doubt
    excess = measured.excess
    off_target = measured.off_target
    target = targets.value
    target_variance = targets.variance
    of_read = measured.target_variance
    own = measured.own
    # A value that is doubted has a larger variance, and a smaller gain.
    noise_of_all = np.float32(variances.noise)
    floor = np.float32(variances.floor)
    total = 0.0
    for i in range(read.size):
        r = read[i]
        noise = noise_of_all + excess[i]
        gain = target_variance[r] / (target_variance[r] + noise)
        target[r] += gain * (values[i] - target[r])
        target_variance[r] = max(gain * noise, floor)
        off_target[i] = (_1 - doubt[i]) * (values[i] - target[r])
        of_read[i] = target_variance[r]
        own[i] = _0
        total += target_variance[r]

    mean = filters.mean
    variance = filters.variance
    change = filters.change
    for i in range(read.size):
        r = read[i]
        noise = noise_of_all + excess[i]
        expected = variance[r] + change[r]
        gain = expected / (expected + noise)
        mean[r] += gain * (values[i] - mean[r])
        variance[r] = max(gain * noise, floor)
        change[r] = _0
    return total / read.size


@entry(sums_in_any_order=True)
def skin_filter(
    measured: Measured,
    prediction: Prediction,
    filters: Filters,
    targets: Targets,
    recall: D,
    variances: Variances,
    constants: FilterConstants,
) -> tuple[float, int]:
    """Filter all rows, as in `FrameVectors`. Return the mean variance of the targets of the rows
    read, and the number of the rows that were read so far.
    """
    set_targets(measured, prediction, filters, targets, recall, variances, constants)
    target_variance = read_values(measured, filters, targets, variances)

    variance = filters.variance
    unknown = np.float32(constants.unknown)
    n_known = 0
    for p in range(variance.size):
        n_known += variance[p] < unknown
    return target_variance, n_known


def step_scratch_size(n: int, n_cells: int, n_windows: int, k: int, h: int) -> int:
    """Length of the scratch of a step, as of `step_scratch`."""
    of_window = 144 + k + 2 * k + h + k + 1 + 64 + 85 + 65 + 1
    return n + 1 + 2 * n_cells + n_windows * of_window


@compiled()
def matrix_of(scratch: A, begin: int, n_rows: int, n_columns: int) -> Any:
    """The matrix that begins at a place of scratch."""
    return scratch[begin : begin + n_rows * n_columns].reshape(n_rows, n_columns)


@compiled()
def step_scratch(denoiser: Denoiser, tiles: TileMaps, n: int) -> Any:
    """Cut the scratch of a step out of one array: of many, each call would have to check each."""
    flat = denoiser.scratch
    k = denoiser.weights.filters.shape[1]
    h = denoiser.weights.hidden_0.size
    n_cells = tiles.canvas.size
    n_windows = tiles.begins.shape[1]

    image = n + 1
    denoised = image + n_cells
    w = denoised + n_cells
    a = w + 144 * n_windows
    levels = a + k * n_windows
    hidden = levels + 2 * k * n_windows
    g = hidden + h * n_windows
    of_tiles = g + (k + 1) * n_windows
    sums = of_tiles + 64 * n_windows
    details = sums + 85 * n_windows
    parts = details + 65 * n_windows
    return StepScratch(
        flat[:image],
        flat[image:denoised],
        flat[denoised:w],
        matrix_of(flat, w, n_windows, 144),
        matrix_of(flat, a, n_windows, k),
        matrix_of(flat, levels, n_windows, 2 * k),
        matrix_of(flat, hidden, n_windows, h),
        matrix_of(flat, g, n_windows, k + 1),
        matrix_of(flat, of_tiles, n_windows, 64),
        matrix_of(flat, sums, 85, n_windows),
        matrix_of(flat, details, 65, n_windows),
        flat[parts : parts + n_windows],
        np.empty(n_windows, np.int64),
    )


@compiled(sums_in_any_order=True)
def target_residual(
    z: A, transform: Transform, measured: Measured, targets: Targets, off: A, v: A
) -> tuple[float, float]:
    """Set `off` to what the targets exceed W z by. Return the mean squares of it and of the
    residual of z, of the rows read, which is kept; v is scratch.
    """
    target = targets.value
    scale = transform.scale
    n = z.size
    for p in range(n):
        v[p] = z[p]
    hadamard(v[:n], transform.groups)
    for p in range(n):
        off[p] = target[p] - v[p] * scale[p]

    read = measured.read
    off_target = measured.off_target
    residual = measured.residual
    off2 = 0.0
    residual2 = 0.0
    for i in range(read.size):
        off_read = off[read[i]]
        residual[i] = off_read + off_target[i]
        off2 += np.float64(off_read) ** 2
        residual2 += np.float64(off_read + off_target[i]) ** 2
    return off2 / read.size, residual2 / read.size


@compiled(sums_in_any_order=True)
def linear_estimate(
    z: A, transform: Transform, targets: Targets, tau: Any, floor: float, u: A, v: A
) -> tuple[Any, Any]:
    """Replace u, which is what the targets exceed W z by, by the truth and noise; set v to u in
    units of the deviation of this noise. Return it, and the factor of the weights.
    """
    variance = targets.variance
    scale = transform.scale
    n = z.size
    mean_weight = 0.0
    for p in range(n):
        weight = tau / (tau + variance[p])
        mean_weight += weight
        v[p] = weight * u[p] * scale[p]
    mean_weight /= n
    hadamard(v[:n], transform.groups)

    # Divided by the mean weight, u has the whole truth, and noise of variance s2.
    s2 = tau * max(1 - mean_weight, 0.0) / mean_weight + floor
    s = np.float32(np.sqrt(s2))
    per_weight = np.float32(1 / mean_weight)
    per_s = _1 / s
    for p in range(n):
        u[p] = z[p] + v[p] * per_weight
        v[p] = u[p] * per_s
    return s, per_weight


@compiled(sums_in_any_order=True)
def add_own(measured: Measured, tau: Any, factor: Any, part: Any) -> None:
    """Move the mean of what the rows read add to their own values by a part towards that of a step:
    `factor` times their weights times what their targets exceed W z by.
    """
    residual = measured.residual
    off_target = measured.off_target
    variance = measured.target_variance
    own = measured.own
    for i in range(own.size):
        weight = tau / (tau + variance[i])
        off = residual[i] - off_target[i]
        added = factor * weight * off
        own[i] += part * (added - own[i])


@compiled(sums_in_any_order=True)
def busy_windows(
    tiles: TileMaps, shift: int, limits: Limits, scratch: StepScratch
) -> tuple[int, float]:
    """Copy the windows of scratch.v in which something stands out to scratch.w. Return their
    number, and the expected squared error of the others.
    """
    v = scratch.v
    image = scratch.image
    canvas = tiles.canvas
    v[v.size - 1] = _0  # what cells without a taxel read
    for q in range(canvas.size):
        image[q] = v[canvas[q]]

    w = scratch.w
    parts = scratch.parts
    busy = scratch.busy
    begins = tiles.begins[shift]
    shares = tiles.shares[shift]
    kinds = tiles.kinds[shift]
    width = tiles.width
    bands = scratch.sums.reshape(-1)  # not in use yet
    n_tiles = tiles.counts[shift]
    n_busy = 0
    expected = 0.0
    first = 0
    while first < n_tiles:
        # Tiles that lie beside each other, 8 cells apart, share the sums of their columns.
        row = np.int64(begins[first])
        last_begin = row
        stop = first + 1
        while stop < n_tiles and np.int64(begins[stop]) - last_begin == 8:
            last_begin = np.int64(begins[stop])
            stop += 1
        n_columns = last_begin - row + 12
        sum_bands(image, row, width, n_columns, bands)
        for tile in range(first, stop):
            begin = np.int64(begins[tile])
            scales = limits.scales[kinds[tile]]
            part = standing_out(bands, n_columns, begin - row, scales, limits.clearly)
            if part > 0:
                window = w[n_busy]
                for i in range(12):
                    for j in range(12):
                        window[12 * i + j] = image[begin + i * width + j]
                busy[n_busy] = tile
                parts[n_busy] = part
                n_busy += 1
            else:
                expected += shares[tile] * limits.quiet
        first = stop
    return n_busy, expected


@compiled(sums_in_any_order=True)
def shrink_tiles(
    tiles: TileMaps,
    shift: int,
    limits: Limits,
    scratch: StepScratch,
    n_busy: int,
    s: Any,
) -> Any:
    """Denoise the busy windows by `haar_shrink`, into scratch.denoised, times s. Return the
    expected squared error of their taxels, in those of the skin.
    """
    sums = scratch.sums
    details = scratch.details
    haar_shrink(scratch.w[:n_busy], limits, sums, details)

    denoised = scratch.denoised
    parts = scratch.parts
    busy = scratch.busy
    begins = tiles.begins[shift]
    shares = tiles.shares[shift]
    width = tiles.width
    expected = 0.0
    for b in range(n_busy):
        error = np.float64(details[64, b])
        error_of_tile = limits.quiet + parts[b] * (error - limits.quiet)
        expected += shares[busy[b]] * error_of_tile
        # Only the middle of a window is denoised: its margin is two cells wide.
        begin = begins[busy[b]] + 2 * width + 2
        for i in range(8):
            for j in range(8):
                force = max(sums[8 * i + j, b], _0)
                denoised[begin + i * width + j] = s * parts[b] * force
    return expected


@compiled(sums_in_any_order=True)
def hidden_units(weights: Weights, scratch: StepScratch, n_busy: int) -> None:
    """Set the filtered windows, a, and the hidden units, h, of the busy windows."""
    a = scratch.a[:n_busy]
    levels = scratch.levels[:n_busy]
    h = scratch.h[:n_busy]
    k = a.shape[1]
    np.dot(scratch.w[:n_busy], weights.filters, a)
    for b in range(n_busy):
        of_window = a[b]
        sizes = levels[b, k:]
        # A loop without choices: its roots are computed several at once.
        for j in range(sizes.size):
            fourth_root = np.sqrt(np.sqrt(_1 + abs(of_window[j])))
            sizes[j] = _4 * (fourth_root - _1)
        for j in range(k):
            levels[b, j] = sizes[j] if of_window[j] >= 0 else -sizes[j]

    hidden_0 = weights.hidden_0
    np.dot(levels, weights.hidden, h)
    for b in range(n_busy):
        for j in range(h.shape[1]):
            h[b, j] = max(h[b, j] + hidden_0[j], _0)


@compiled(sums_in_any_order=True)
def gate_tiles(
    tiles: TileMaps,
    shift: int,
    weights: Weights,
    limits: Limits,
    scratch: StepScratch,
    n_busy: int,
    s: Any,
) -> Any:
    """As `shrink_tiles`, by the learned gates."""
    quiet = limits.quiet
    hidden_units(weights, scratch, n_busy)

    w = scratch.w
    a = scratch.a[:n_busy]
    h = scratch.h[:n_busy]
    g = scratch.g[:n_busy]
    gates_0 = weights.gates_0
    error = weights.error
    parts = scratch.parts
    busy = scratch.busy
    begins = tiles.begins[shift]
    shares = tiles.shares[shift]
    k = a.shape[1]
    np.dot(h, weights.gates, g)
    expected = 0.0
    for b in range(n_busy):
        log_error = weights.error_0
        for j in range(h.shape[1]):
            log_error += h[b, j] * error[j]
        bounded = min(max(log_error, -12.0), 0.0)
        error2 = np.exp(bounded)
        error_of_tile = quiet + parts[b] * (error2 - quiet)
        expected += shares[busy[b]] * error_of_tile

        # What passes as it is needs no coefficients: the gates are those of the rest.
        passed = min(max(g[b, k] + gates_0[k], _0), _1)
        g[b, k] = passed
        for j in range(k):
            gate = min(max(g[b, j] + gates_0[j], _0), _1)
            a[b, j] *= gate - passed

    denoised = scratch.denoised
    filtered = scratch.tiles[:n_busy]
    width = tiles.width
    np.dot(a, weights.synthesis, filtered)
    for b in range(n_busy):
        begin = begins[busy[b]] + 2 * width + 2
        passed = g[b, k]
        for i in range(8):
            for j in range(8):
                inner = passed * w[b, 12 * (i + 2) + j + 2]
                force = max(filtered[b, 8 * i + j] + inner, _0)
                denoised[begin + i * width + j] = s * parts[b] * force
    return expected


@compiled(sums_in_any_order=True)
def move_iterate(iterates: Iterates, x: A, alpha: Any, damping: Any, part: Any) -> None:
    """Move z towards the estimate whose errors are not correlated with those of u; move the mean
    of the estimates by a part towards x.
    """
    z = iterates.z
    u = iterates.u
    mean = iterates.mean
    per_free = _1 / (_1 - alpha)
    for p in range(z.size):
        free = (x[p] - alpha * u[p]) * per_free
        z[p] += damping * (free - z[p])
        mean[p] += part * (x[p] - mean[p])


@compiled()
def weight_of(k: int, residual2: float, plan: Plan, constants: StepConstants) -> float:
    """Weight of the estimate of step k in their mean, as `FrameVectors._weights_of` without a
    common factor; residual2 is the mean squared residual before the step.
    """
    if k < plan.n_formula:
        return 0.0
    n_rising = max(1.0, plan.n + 1 - constants.fully_averaged)
    rising = (k + 1 - plan.n_formula) / n_rising
    rise = min(rising, 1.0) ** constants.rise_power
    weight: float = rise / (residual2 + plan.floor) ** constants.residual_power
    return weight


@compiled()
def steps_for(plan: Plan, n_busy: int, constants: StepConstants) -> Any:
    """As `vectors.steps_for`."""
    if plan.frame_tiles == 0:
        return plan
    # Few steps by the weights do not converge: some by the formula, which is faster, come first.
    per_step = plan.step_tiles + n_busy
    n_formula = 0
    n = min(plan.frame_tiles // per_step, plan.most)
    if n < constants.converged:
        n_formula = constants.n_formula
        by_formula = plan.step_tiles + n_busy // constants.formula_share
        n = (plan.frame_tiles - n_formula * by_formula) // per_step
        n = min(n, constants.converged - 1, plan.most)
    if n < plan.n:
        return plan
    return Plan(
        n_formula,
        n,
        plan.first_shift,
        plan.frame_tiles,
        plan.step_tiles,
        plan.most,
        plan.target_variance,
        plan.floor,
    )


class StepMeans(NamedTuple):
    """Means over the steps so far, weighted as their estimates are."""

    weight: float  # sum of the weights
    expected2: float  # squared error that the denoiser expects
    residual2: float  # squared residual before the step


@compiled(sums_in_any_order=True)
def skin_step(
    inputs: StepInputs,
    measured: Measured,
    plan: Plan,
    scratch: StepScratch,
    k: int,
    means: StepMeans,
) -> tuple[StepMeans, Any, int]:
    """Step k, as in `FrameVectors`: z becomes the next, and its estimate is added to their mean.
    Return the means with this step, the plan, which the first one chooses, and the number of tiles
    in which something stands out.
    """
    iterates = inputs.iterates
    z = iterates.z
    u = iterates.u
    tiles = inputs.tiles
    constants = inputs.constants
    limits = inputs.denoiser.limits
    v = scratch.v
    shift = (plan.first_shift + k) % tiles.counts.size
    targets = inputs.targets
    off2, residual2 = target_residual(z, inputs.transform, measured, targets, u, v)

    # Error variance of z, seen by the rows read.
    least_tau = constants.least_tau * max(off2, plan.target_variance)
    error_variance = max(off2 - plan.target_variance, least_tau)
    tau = np.float32(error_variance + plan.floor)
    s, per_weight = linear_estimate(z, inputs.transform, targets, tau, plan.floor, u, v)

    # Tiles in which nothing stands out have no force.
    denoised = scratch.denoised
    for q in range(denoised.size):
        denoised[q] = _0
    n_busy, expected = busy_windows(tiles, shift, limits, scratch)
    if k == 0:
        plan = steps_for(plan, n_busy, constants)
    if n_busy and (k < plan.n_formula or not inputs.denoiser.has_gates):
        expected += shrink_tiles(tiles, shift, limits, scratch, n_busy, s)
    elif n_busy:
        weights = inputs.denoiser.weights
        expected += gate_tiles(tiles, shift, weights, limits, scratch, n_busy, s)

    cells = tiles.cells
    for p in range(z.size):
        v[p] = denoised[cells[p]]

    weight = weight_of(k, residual2, plan, constants)
    total = means.weight + weight
    part = weight / total if weight > 0 else 0.0
    alpha = np.float32(min(expected, constants.most_alpha))
    damping = constants.damping * min(1.0, constants.damped_from / (k + 1))
    move_iterate(iterates, v, alpha, np.float32(damping), np.float32(part))
    add_own(measured, tau, alpha * per_weight, np.float32(part))

    error2 = expected * np.float64(s) ** 2
    means = StepMeans(
        total,
        means.expected2 + part * (error2 - means.expected2),
        means.residual2 + part * (residual2 - means.residual2),
    )
    return means, plan, n_busy


@entry(sums_in_any_order=True)
def skin_steps(
    inputs: StepInputs, measured: Measured, plan: Plan
) -> tuple[float, float, int, int, int]:
    """The steps of a frame from its prediction, which set the mean of the estimates. Return the
    same means of the expected squared error and of the squared residual before the step; the
    numbers of steps by the formula and by the weights, and of tiles that counted in all of them.
    """
    iterates = inputs.iterates
    scratch = step_scratch(inputs.denoiser, inputs.tiles, iterates.z.size)
    z = iterates.z
    mean = iterates.mean
    predicted = inputs.prediction.x
    for p in range(z.size):
        z[p] = predicted[p]
        mean[p] = _0
    means = StepMeans(0.0, 0.0, 0.0)
    least = plan.n_formula + plan.n
    k = 0
    n_busy = 0
    n_tiles = 0
    while k < plan.n_formula + plan.n:
        # Forces of a sudden contact stand out step by step: what it takes is counted.
        spent = (k + 1) * plan.step_tiles + n_tiles + n_busy
        if k >= least and spent > plan.frame_tiles:
            break
        means, plan, n_busy = skin_step(inputs, measured, plan, scratch, k, means)
        is_by_formula = k < plan.n_formula
        n_tiles += n_busy // inputs.constants.formula_share if is_by_formula else n_busy
        k += 1
    n_by_weights = k - plan.n_formula
    return means.expected2, means.residual2, plan.n_formula, n_by_weights, n_tiles


@compiled(sums_in_any_order=True)
def settle_forces(x: A, blend: BlendNumbers, forces: A) -> tuple[float, float]:
    """Set the forces of an estimate. Return the sum of x over taxels within the noise, and the part
    of the taxels beyond it.
    """
    bias = np.float32(blend.bias)
    near = np.float32(2 * blend.noise_sd + np.sqrt(TINY))
    least = np.float32(blend.least_force)
    unpressed = _0
    pressed = _0
    for p in range(x.size):
        force = x[p]
        forces[p] = _0
        # Exponentials, the slowest part, are computed where they are neither 0 nor 1 but for
        # rounding.
        if 2 * force < least:
            unpressed += force
        elif force < 6 * near:
            weak = np.exp(-((force / near) ** 2))
            unpressed += force * weak
            pressed += (_1 - weak) ** 2
            offset = bias
            if bias > 0:
                offset = bias * (_1 - np.exp(-force / bias))
            if force + offset >= least:
                forces[p] = force + offset
        else:
            pressed += _1
            forces[p] = force + bias
    return np.float64(unpressed), np.float64(pressed) / x.size


@entry(sums_in_any_order=True)
def skin_settle(
    of_steps: V,
    prediction: Prediction,
    measured: Measured,
    ones: V,
    transform: Transform,
    estimate: Estimate,
    blend: BlendNumbers,
    forces: V,
) -> tuple[float, float, float, float, float, float, float, float]:
    """Settle a frame, as in `FrameVectors`; return what it does but for the forces."""
    x = estimate.x
    n = x.size
    predicted = prediction.x
    part = np.float32(blend.part)
    rest = _1 - part
    power = _0
    for p in range(n):
        x[p] = rest * of_steps[p] + part * predicted[p]
        power += x[p] * x[p]
    for p in range(n):
        x[p] = x[p] if abs(x[p]) > _NEGLIGIBLE else _0

    x_rows = estimate.rows
    predicted_rows = prediction.rows
    correction = estimate.correction
    for p in range(n):
        x_rows[p] = x[p]
    orthonormal(x_rows, transform.groups, transform.scale)
    for p in range(n):
        correction[p] = x_rows[p] - predicted_rows[p]

    read = measured.read
    values = measured.values
    doubt = measured.doubt
    residual = measured.residual
    residual2 = 0.0
    along_ones = 0.0
    for i in range(read.size):
        residual[i] = (_1 - doubt[i]) * (values[i] - x_rows[read[i]])
        residual2 += residual[i] * residual[i]
        along_ones += ones[i] * residual[i]

    # Residual of the steps in their part of x, without what each row added to its own value: with
    # it, the residual would understate the error.
    innovation = measured.innovation
    own = measured.own
    left_out2 = 0.0
    along_x = 0.0
    read2 = 0.0
    for i in range(read.size):
        x_read = x_rows[read[i]]
        left_out = residual[i] + rest * ((_1 - doubt[i]) * own[i])
        along_x += x_read * left_out
        read2 += x_read * x_read
        left_out -= part * innovation[i]
        left_out2 += left_out * left_out
    unpressed, pressed = settle_forces(x, blend, forces)
    m = read.size
    fits = residual2 / m, left_out2 / m, along_x, read2
    return np.float64(power / n), *fits, along_ones, unpressed, pressed


@entry(sums_in_any_order=True)
def skin_variance(forces: V, noise: NoiseCurve) -> Any:
    """Mean variance of the readings of forces, as `NoiseModel.variance`."""
    per_force = np.float32(2 / noise.f_max)
    middle = np.float32(noise.sigma_mid)
    rise = np.float32(noise.sigma_end - noise.sigma_mid)
    clipped = _1
    slope = _0
    if noise.clips > 0 and noise.sigma_end > 0:
        clipped = np.float32(noise.clipped)
        slope = np.float32((1 - noise.clipped) / noise.clipped_below / noise.sigma_end)
    # Forces above this one count: none is negative.
    untouched = np.float32(noise.of_touched - 1)

    total = _0
    for p in range(forces.size):
        force = forces[p]
        from_middle = abs(per_force * force - _1)
        sigma = middle + rise * min(from_middle, _1)
        variance = sigma * sigma * min(clipped + slope * force, _1)
        total += variance if force > untouched else _0
    return np.float64(total) / forces.size


@compiled()
def root_of(parents: A, k: int) -> int:
    """Least label of the labels that are one component."""
    while parents[k] != k:
        k = parents[k]
    return k


@compiled()
def label_cells(
    forces: A,
    low: Any,
    high: float,
    regions: A,
    index: A,
    labels: A,
    parents: A,
    is_kept: A,
) -> tuple[int, int]:
    """Label the cells above `low`, in one scan; regions becomes 0 elsewhere. Set the cells, index,
    and of each label a label of the same component, parents, and whether a cell of it is above
    `high` or in a region. Return the numbers of cells and labels. Other cells have the label -1.
    """
    n_rows, n_cols = forces.shape
    flat = forces.reshape(-1)
    n_cells = 0
    n_labels = 0
    for i in range(n_rows):
        for j in range(n_cols):
            p = i * n_cols + j
            if not flat[p] > low:
                regions[p] = 0
                continue
            index[n_cells] = p
            n_cells += 1

            # Of the four before it, the one above is beside the others, and the left two are
            # beside each other: those are one component already.
            label = labels[p - n_cols] if i else -1
            if label < 0:
                label = labels[p - 1] if j else -1
                if label < 0 and i and j:
                    label = labels[p - n_cols - 1]
                right = labels[p - n_cols + 1] if i and j + 1 < n_cols else -1
                if label < 0:
                    label = right
                elif right >= 0:
                    label = root_of(parents, label)
                    right = root_of(parents, right)
                    parents[max(label, right)] = min(label, right)
            if label < 0:
                label = n_labels
                parents[label] = label
                n_labels += 1
            labels[p] = label
            is_kept[label] |= flat[p] > high or regions[p] > 0
    return n_cells, n_labels


@compiled()
def number_components(parents: A, is_kept: A, n_labels: int) -> int:
    """Replace the parent of each label by the number of its component, -1 if it is not kept. Return
    the number of components.
    """
    # A parent has a lower label: downwards, each mark has come from all labels below.
    for label in range(n_labels - 1, -1, -1):
        is_kept[parents[label]] |= is_kept[label]

    n = 0
    for label in range(n_labels):
        if parents[label] < label:
            parents[label] = parents[parents[label]]
        elif is_kept[label]:
            parents[label] = n
            n += 1
        else:
            parents[label] = -1
    return n


@compiled()
def component_moments(
    flat: A, variances: A, places: A, index: A, numbers: A, sums: A
) -> None:
    """Complete the rows of sums of `components` that depend on the centres."""
    k = places.shape[0]
    n = sums.shape[1]
    for t in range(index.size):
        p = index[t]
        c = numbers[t]
        force = np.float64(flat[p])
        sums[0, c] += force
        sums[1, c] += 1
        sums[2, c] = max(sums[2, c], force)
        sums[3 + k, c] += variances[p]
        for d in range(k):
            sums[3 + d, c] += force * places[d, p]
    for c in range(n):
        for d in range(k):
            sums[3 + d, c] /= sums[0, c]

    # Variances of the centres.
    for t in range(index.size):
        p = index[t]
        c = numbers[t]
        for d in range(k):
            off = places[d, p] - sums[3 + d, c]
            sums[4 + k + d, c] += variances[p] * off * off
    for c in range(n):
        total2 = sums[0, c] ** 2
        for d in range(k):
            sums[4 + k + d, c] /= total2


@entry()
def components(
    forces: M,
    low: np.float32,
    high: float,
    variances: V,
    places: DM,
    regions: Annotated[Any, int32[::1]],
    n_regions: int,
) -> tuple[A, A, A, A, int]:
    """The same as `components` of the module `contacts`, but for rounding, in one scan."""
    n_rows, n_cols = forces.shape
    k = places.shape[0]
    flat = forces.reshape(-1)
    index = np.empty(flat.size, np.int64)
    labels = np.full(flat.size, -1, np.int32)
    # No two labels begin within the same 2 x 2 cells: these are neighbours.
    bound = ((n_rows + 1) // 2) * ((n_cols + 1) // 2)
    parents = np.empty(bound, np.int64)
    is_kept = np.zeros(bound, np.bool_)
    n_pressed, n_labels = label_cells(
        forces, low, high, regions, index, labels, parents, is_kept
    )
    n = number_components(parents, is_kept, n_labels)

    # The cells of components that are kept move to the front of index.
    numbers = np.empty(n_pressed, np.int64)
    overlap = np.zeros((n, n_regions), np.int64)
    n_cells = 0
    for t in range(n_pressed):
        p = index[t]
        c = parents[labels[p]]
        region = regions[p]
        regions[p] = c + 1
        if c < 0:
            continue
        index[n_cells] = p
        numbers[n_cells] = c
        n_cells += 1
        if region:
            overlap[c, region - 1] += 1

    sums = np.zeros((4 + 2 * k, n))
    index = index[:n_cells]
    numbers = numbers[:n_cells]
    component_moments(flat, variances, places, index, numbers, sums)
    return index, numbers, sums, overlap, n_pressed


SKIN_LOOPS: tuple[Callable[..., Any], ...] = (
    orthonormal,
    skin_begin,
    skin_predict,
    skin_filter,
    skin_steps,
    skin_settle,
    skin_variance,
)
"""The loops of solver `skin` that Python calls."""
LOOPS: tuple[Callable[..., Any], ...] = (*SKIN_LOOPS, fista, haar_image, components)
"""All loops that Python calls."""
