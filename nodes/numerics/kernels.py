"""All loops that numba compiles.

They stand in one file because numba stores compiled code by file: a loop that another one calls
must not change without it.

Vectors are float32 and contiguous. A dealt vector holds the taxels in the order of the scrambled
block Hadamard ensemble, the blocks of one size interleaved: element j of block b is at
j * count + b, so that a butterfly is one sum and one difference of long runs. `groups` states
where the blocks of each size are, int64 (k, 3): start, size, count. A tiled vector holds a grid
so that the four samples of a 2 x 2 square are a quarter of the vector apart, see `halve`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from .compiled import compiled

A: TypeAlias = Any
"""An array; mypy and numba read its type differently."""

_ROOT_2 = np.sqrt(2.0)

# Types of signatures: vector, matrix, places in 32 and in 16 bits and tables of them, groups, grid,
# numbers.
V, M, P, S = "float32[::1]", "float32[:,::1]", "uint32[::1]", "uint16[::1]"
P2, S2 = "uint32[:,::1]", "uint16[:,::1]"
G, L, D = "int64[:,::1]", "int64[::1]", "float64[::1]"
#: A vector that may be read-only.
R = "Array(float32, 1, 'C', True)"


@compiled()
def hadamard(v: A, groups: A) -> None:
    """Transform a dealt vector in place: each block by its matrix of +1 and -1."""
    for g in range(groups.shape[0]):
        start, size, count = groups[g, 0], groups[g, 1], groups[g, 2]
        run = count
        while 4 * run <= size * count:
            for base in range(start, start + size * count, 4 * run):
                a, b = v[base : base + run], v[base + run : base + 2 * run]
                c, d = v[base + 2 * run : base + 3 * run], v[base + 3 * run : base + 4 * run]
                for k in range(run):
                    s, t = a[k] + b[k], c[k] + d[k]
                    u, w = a[k] - b[k], c[k] - d[k]
                    a[k], b[k], c[k], d[k] = s + t, u + w, s - t, u - w
            run *= 4
        if run < size * count:
            a, b = v[start : start + run], v[start + run : start + 2 * run]
            for k in range(run):
                a[k], b[k] = a[k] + b[k], a[k] - b[k]


@compiled()
def butterflies(v: A, start: int, run: int, stop: int) -> None:
    """Sums and differences of partners that are `run` apart, in place."""
    for base in range(start, stop, 2 * run):
        a, b = v[base : base + run], v[base + run : base + 2 * run]
        for k in range(run):
            a[k], b[k] = a[k] + b[k], a[k] - b[k]


@compiled(f"void({P}, {G}, {P}, {V}, {V}, {R}, {V})")
def measure(deal: A, groups: A, places: A, scale: A, v: A, x: A, y: A) -> None:
    """y = Phi x, with the sums of `SbhePhi` in its order: the same bits.

    deal: taxel of each place of the dealt vector v; places: place of each measurement in it.
    """
    for p in range(v.size):
        v[p] = x[deal[p]]
    for g in range(groups.shape[0]):
        start, size, count = groups[g, 0], groups[g, 1], groups[g, 2]
        stop = start + size * count
        if size > 1:
            butterflies(v, start, count, stop)
        run = size * count // 2
        while run > count:
            butterflies(v, start, run, stop)
            run //= 2
    for i in range(y.size):
        y[i] = v[places[i]] * scale[i]


@compiled()
def halve(v: A, levels: int) -> None:
    """Haar steps of a tiled vector along both axes, in place: sums and differences, not scaled."""
    part = v.size
    for _ in range(levels):
        q = part // 4
        a, b, c, d = v[:q], v[q : 2 * q], v[2 * q : 3 * q], v[3 * q : part]
        for k in range(q):
            s, t = a[k] + c[k], b[k] + d[k]
            u, w = a[k] - c[k], b[k] - d[k]
            a[k], b[k], c[k], d[k] = s + t, s - t, u + w, u - w
        part = q


@compiled()
def double(v: A, levels: int) -> None:
    """The transpose of `halve`."""
    for level in range(levels - 1, -1, -1):
        part = v.size >> (2 * level)
        q = part // 4
        a, b, c, d = v[:q], v[q : 2 * q], v[2 * q : 3 * q], v[3 * q : part]
        for k in range(q):
            s, t = a[k] + b[k], a[k] - b[k]
            u, w = c[k] + d[k], c[k] - d[k]
            a[k], b[k], c[k], d[k] = s + u, t + w, s - u, t - w


@compiled()
def split_line(v: A, at: int, step: int, n: int, scratch: A) -> None:
    """One level of Haar of n samples, `step` apart from place `at` on, in place; not scaled.

    A sample without a partner is multiplied by sqrt(2), as large as the sums of the others.
    """
    half, left = n // 2, n - n // 2
    for k in range(n):
        scratch[k] = v[at + k * step]
    for k in range(half):
        a, b = scratch[2 * k], scratch[2 * k + 1]
        v[at + k * step] = a + b
        v[at + (left + k) * step] = a - b
    if left > half:
        v[at + half * step] = _ROOT_2 * scratch[n - 1]


@compiled()
def join_line(v: A, at: int, step: int, n: int, scratch: A) -> None:
    """The transpose of `split_line`."""
    half, left = n // 2, n - n // 2
    for k in range(n):
        scratch[k] = v[at + k * step]
    for k in range(half):
        s, d = scratch[k], scratch[left + k]
        v[at + 2 * k * step] = s + d
        v[at + (2 * k + 1) * step] = s - d
    if left > half:
        v[at + (n - 1) * step] = _ROOT_2 * scratch[half]


@compiled()
def pyramid(v: A, n_rows: int, n_cols: int, scratch: A) -> None:
    """Haar transform at full depth of a grid of any sides, row by row, in place; not scaled."""
    rows, cols = n_rows, n_cols
    while rows > 1 or cols > 1:
        if rows > 1:
            for j in range(cols):
                split_line(v, j, n_cols, rows, scratch)
        if cols > 1:
            for i in range(rows):
                split_line(v, i * n_cols, 1, cols, scratch)
        rows, cols = (rows + 1) // 2, (cols + 1) // 2


@compiled()
def unpyramid(v: A, n_rows: int, n_cols: int, scratch: A) -> None:
    """The transpose of `pyramid`."""
    depth = 0
    while (n_rows - 1) >> depth or (n_cols - 1) >> depth:
        depth += 1
    for level in range(depth - 1, -1, -1):
        # Sides at a level: n / 2^level, rounded up.
        rows, cols = ((n_rows - 1) >> level) + 1, ((n_cols - 1) >> level) + 1
        if cols > 1:
            for i in range(rows):
                join_line(v, i * n_cols, 1, cols, scratch)
        if rows > 1:
            for j in range(cols):
                join_line(v, j, n_cols, rows, scratch)


@compiled(sums_in_any_order=True)
def dot(a: A, b: A) -> Any:
    """Product of two vectors, float32."""
    total = np.float32(0)
    for k in range(a.size):
        total += a[k] * b[k]
    return total


def _fista(
    theta: A, before: A, betas: A, weights2: A, threshold: A, z: A, v: A, deal: A, keep: A,
    measured: A, groups: A, grid: A, scratch: A,
) -> None:  # fmt: skip
    """Iterations of FISTA, one for each of betas; the two thetas alternate, the first is newest."""
    levels, n_rows, n_cols = grid[0], grid[1], grid[2]
    rest = z[: n_rows * n_cols]
    for beta in betas:
        for k in range(z.size):
            z[k] = theta[k] + beta * (theta[k] - before[k])
        unpyramid(rest, n_rows, n_cols, scratch)
        double(z, levels)
        for p in range(deal.size):
            v[p] = z[deal[p]]
        hadamard(v, groups)
        for p in range(v.size):
            v[p] = v[p] * keep[p] + measured[p]
        hadamard(v, groups)
        for p in range(deal.size):
            z[deal[p]] = v[p]
        halve(z, levels)
        pyramid(rest, n_rows, n_cols, scratch)
        for k in range(z.size):
            u = weights2[k] * z[k]
            before[k] = u - min(max(u, -threshold[k]), threshold[k])
        theta, before = before, theta


fista, fista_large = (
    compiled(f"void({V}, {V}, {V}, {V}, {V}, {V}, {V}, {T}, {V}, {V}, {G}, {L}, {V})")(_fista)
    for T in (S, P)
)


@compiled()
def shrink(v: A, lambda2: A) -> None:
    """Nonnegative garrote in three levels of Haar of a tiled vector, in place.

    Of coefficients c that are not scaled: c (w^2 - lambda^2 / max(c^2, lambda^2 / w^2)).
    """
    w2 = np.float32(1)
    part = v.size
    for _ in range(3):
        w2 *= np.float32(0.25)
        limit = lambda2 / w2
        q = part // 4
        a, b, c, d = v[:q], v[q : 2 * q], v[2 * q : 3 * q], v[3 * q : part]
        for k in range(q):
            s, t = a[k] + c[k], b[k] + d[k]
            u, w = a[k] - c[k], b[k] - d[k]
            e, f, g, h = s + t, s - t, u + w, u - w
            a[k] = e
            b[k] = f * (w2 - lambda2 / max(f * f, limit))
            c[k] = g * (w2 - lambda2 / max(g * g, limit))
            d[k] = h * (w2 - lambda2 / max(h * h, limit))
        part = q
    for k in range(part):
        e = v[k]
        v[k] = e * (w2 - lambda2 / max(e * e, limit))
    double(v, 3)


@compiled(f"void({M}, {V}, {G}, {M})")
def dealt_forward(x: A, measured: A, groups: A, rows: A) -> None:
    """rows = measured * W x of k dealt vectors."""
    for f in range(x.shape[0]):
        one, result = x[f], rows[f]
        for p in range(one.size):
            result[p] = one[p]
        hadamard(result, groups)
        for p in range(one.size):
            result[p] *= measured[p]


@compiled(f"void({V}, {V}, {G}, {V})")
def dealt_adjoint(rows: A, measured: A, groups: A, x: A) -> None:
    """x = W (measured * rows), the transpose of `dealt_forward`."""
    for p in range(rows.size):
        x[p] = measured[p] * rows[p]
    hadamard(x, groups)


# Rows of the work of a frame of the solver `skin`, float32, each followed by zeros.
X, U, Z, RESIDUAL, TARGET, TOTAL, Y, INNOVATION, CORRECTION, WHOLE, FITTED = range(11)
KNOWN, VALUES, WEIGHTS, MOVED, MOVED_INNOVATION = range(11, 16)
ROW_X, ROW_DOWN, ROW_RIGHT, DOWN, RIGHT = range(16, 21)
N_WORK = 21
# Rows of the table of a row subset: 1 / sqrt(B) where measured; 1 where measured; 1 unless held
# out; Phi 1; 1 / sqrt(B).
MEASURED, READ, KEPT, ONES, SCALE = range(5)
# Constants of the prediction, as in `SkinTuning`: those times M, or a third of the freedom left.
STILL, SIGNIFICANT, FREEDOM, FAILED_PART, FAILED_NOISE = range(5)


@compiled()
def copy(source: A, target: A) -> None:
    """Copy a vector; a slice assignment does the same, and takes far longer to compile."""
    for k in range(target.size):
        target[k] = source[k]


@compiled()
def fill(target: A) -> None:
    """Set a vector to 0."""
    for k in range(target.size):
        target[k] = 0


@compiled(sums_in_any_order=True)
def change(y: A, last: A, step: A) -> Any:
    """Squares of y - last and of its change; step becomes y - last, last becomes y."""
    first, second = np.float32(0), np.float32(0)
    for i in range(y.size):
        now = y[i] - last[i]
        again = now - step[i]
        first += now * now
        second += again * again
        step[i] = now
        last[i] = y[i]
    return np.float64(first), np.float64(second)


@compiled(sums_in_any_order=True)
def innovate(rows: A, ones: A, bias: A, read: A, whole: A, innovation: A) -> Any:
    """Subtract the bias from rows; innovation = rows - Phi x. Return the squares of both."""
    y2, e2 = np.float32(0), np.float32(0)
    for p in range(rows.size):
        y = rows[p] - bias * ones[p]
        e = y - read[p] * whole[p]
        rows[p], innovation[p] = y, e
        y2 += y * y
        e2 += e * e
    return np.float64(y2), np.float64(e2)


@compiled(sums_in_any_order=True)
def align(innovation: A, correction: A, read: A) -> Any:
    """Product of the innovation with the rows of the correction, and the square of those."""
    along, square = np.float32(0), np.float32(0)
    for p in range(read.size):
        c = correction[p] * read[p]
        along += innovation[p] * c
        square += c * c
    return np.float64(along), np.float64(square)


@compiled()
def move(
    work: A, table: A, groups: A, around: A, limits: A, e2: float, most: float, s2: float
) -> float:
    """Add to x the combination of x and its two slopes that fits the innovation best, in place.

    Return the squared innovation after it. Nothing is added unless it falls from e2 below most, by
    a significant number of noise variances s2, and by more than what remains.
    around: places of the next neighbour by row and by column, and of the last ones.
    """
    measured, read = table[MEASURED], table[READ]
    n = read.size
    x, y, innovation, whole = work[X, :n], work[Y, :n], work[INNOVATION, :n], work[WHOLE, :n]
    row_x, row_d, row_r = work[ROW_X, :n], work[ROW_DOWN, :n], work[ROW_RIGHT, :n]
    down, right = work[DOWN, :n], work[RIGHT, :n]
    below, beside, above, before = around[0], around[1], around[2], around[3]
    for k in range(n):
        down[k] = x[below[k]] - x[above[k]]
    for k in range(n):
        right[k] = x[beside[k]] - x[before[k]]
    copy(down, row_d)
    copy(right, row_r)
    for row in range(ROW_DOWN, ROW_RIGHT + 1):  # compiled once
        hadamard(work[row, :n], groups)
    for k in range(n):
        row_d[k] *= measured[k]
        row_r[k] *= measured[k]
        row_x[k] = read[k] * whole[k]
    xx, xr, xc = dot(row_x, row_x), dot(row_d, row_x), dot(row_r, row_x)
    rr, rc, cc = dot(row_d, row_d), dot(row_r, row_d), dot(row_r, row_r)
    bx, br, bc = dot(row_x, innovation), dot(row_d, innovation), dot(row_r, innovation)
    largest = max(xx, max(rr, cc))
    if not (largest > 0 and np.isfinite(largest)):
        return e2
    # Three normal equations by cofactors, in double precision.
    ridge = 1e-6 * largest
    p, q, s = xx + ridge, rr + ridge, cc + ridge
    f, g, h = np.float64(xr), np.float64(xc), np.float64(rc)
    m00, m01, m02 = q * s - h * h, g * h - f * s, f * h - g * q
    m11, m12, m22 = p * s - g * g, f * g - p * h, p * q - f * f
    determinant = p * m00 + f * m01 + g * m02
    by_x = (m00 * bx + m01 * br + m02 * bc) / determinant
    by_row = (m01 * bx + m11 * br + m12 * bc) / determinant
    by_col = (m02 * bx + m12 * br + m22 * bc) / determinant
    explained = by_x * bx + by_row * br + by_col * bc
    if not (
        explained > limits[SIGNIFICANT] * s2
        and explained * limits[FREEDOM] > max(0.0, e2 - explained)
    ):
        return e2
    top = np.float32(0)
    for k in range(n):
        top = max(top, x[k])
    top = np.float32(top * max(1.0, 1 + by_x))
    a, b, c = np.float32(by_x), np.float32(by_row), np.float32(by_col)
    moved, moved_innovation = work[MOVED, :n], work[MOVED_INNOVATION, :n]
    for k in range(n):
        there = x[k] + (a * x[k] + b * down[k] + c * right[k])
        moved[k] = min(max(there, np.float32(0)), top)
        moved_innovation[k] = moved[k]
    hadamard(moved_innovation, groups)
    for k in range(n):
        moved_innovation[k] = y[k] - measured[k] * moved_innovation[k]
    moved_e2 = np.float64(dot(moved_innovation, moved_innovation))
    if not moved_e2 < most:
        return e2
    copy(moved, x)
    copy(moved_innovation, innovation)
    return moved_e2


@compiled()
def follow_prediction(work: A, table: A, groups: A, moved: bool) -> float:
    """Move the known rows along, replace those of y; return the square of that change."""
    read, scale = table[READ], table[SCALE]
    n = read.size
    y, rows, whole, values = work[Y, :n], work[ROW_X, :n], work[WHOLE, :n], work[VALUES, :n]
    if moved:
        copy(work[X, :n], rows)
        hadamard(rows, groups)
        for k in range(n):
            row = scale[k] * rows[k]
            values[k] += row - whole[k]
            whole[k] = row
    for k in range(n):
        rows[k] = read[k] * (y[k] - values[k])
        values[k] += rows[k]
    return np.float64(dot(rows, rows))


@compiled(
    f"UniTuple(float64, 9)({M}, {M}, {R}, {M}, {L}, {G}, {P2}, {D}, float64, float64, "
    "float64, boolean, boolean, boolean)"
)
def skin_read(
    work: A, table: A, y: A, past: A, places: A, groups: A, around: A, limits: A, most2: float,
    bias: float, s2: float, begun: bool, known: bool, remembers: bool,
) -> Any:  # fmt: skip
    """Begin a frame: rows of y without the bias, their change since `past`, prediction, innovation.

    Return the square of y; of its change and of the change of that, inf without a past; of the
    innovation; its product with the last correction, the square of that; the square of the change
    of known rows; 1 if the prediction moved, and if it failed. If the square of y is not below
    most2, nothing else is done.
    """
    power = np.float64(dot(y, y))
    changed2, second2, change2, moved, failed = np.inf, np.inf, 0.0, False, False
    if not power < most2:
        return power, changed2, second2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    read = table[READ]
    n = read.size
    x, rows, innovation, whole = work[X, :n], work[Y, :n], work[INNOVATION, :n], work[WHOLE, :n]
    last, step = past[0], past[1]
    if begun:
        changed2, second2 = change(y, last, step)
    else:
        copy(y, last)
    fill(rows)
    for i in range(y.size):
        rows[places[i]] = y[i]
    seen = dot(x, x) > 0
    if not seen:
        fill(whole)
    elif not known:
        copy(x, whole)
        hadamard(whole, groups)
        for k in range(n):
            whole[k] *= table[SCALE, k]
    y2, e2 = innovate(rows, table[ONES], np.float32(bias), read, whole, innovation)
    if seen:
        if e2 > limits[STILL] * s2:
            still_e2 = e2
            e2 = move(work, table, groups, around, limits, e2, min(e2, changed2), s2)
            moved = e2 < still_e2
        least = min(e2, changed2)
        failed = least > limits[FAILED_PART] * y2 and least > limits[FAILED_NOISE] * s2
        if failed:
            moved = True
            e2 = y2
            fill(x)
            copy(rows, innovation)
    along, correction2 = align(innovation, work[CORRECTION, :n], read)
    if remembers:
        if failed:
            fill(work[KNOWN, :n])
            fill(work[VALUES, :n])
        change2 = follow_prediction(work, table, groups, moved)
    elif moved:
        for k in range(n):
            whole[k] = rows[k] - innovation[k]
    return (
        power, changed2, second2, e2, along, correction2, change2, np.float64(moved),
        np.float64(failed),
    )  # fmt: skip


@compiled(f"void({M}, {M}, float64, float64, boolean)")
def skin_aim(work: A, table: A, gain: float, counted: float, remembers: bool) -> None:
    """Set z to x, target and weights of rows; earlier ones have the weight `counted`, if any."""
    measured, read, kept, scale = table[MEASURED], table[READ], table[KEPT], table[SCALE]
    n = read.size
    target, weights = work[TARGET, :n], work[WEIGHTS, :n]
    copy(work[X, :n], work[Z, :n])
    fill(work[TOTAL, :n])
    if not remembers:
        y, innovation = work[Y, :n], work[INNOVATION, :n]
        rest = np.float32(1 - gain)
        for i in range(n):
            weights[i] = measured[i] * kept[i]
            target[i] = (y[i] - innovation[i] * rest) * kept[i]
        return
    known, values, whole = work[KNOWN, :n], work[VALUES, :n], work[WHOLE, :n]
    k, w = np.float32(gain), np.float32(counted)
    rest = np.float32(1) - w
    for i in range(n):
        known[i] = max(known[i], read[i])
        counts = (known[i] * w + read[i] * rest) * kept[i]
        weights[i] = counts * scale[i]
        target[i] = ((values[i] - whole[i]) * k + whole[i]) * counts


@compiled(sums_in_any_order=True)
def residual(target: A, weights: A, u: A, r: A) -> Any:
    """r = target - weights u, and u becomes weights r; return the square of r."""
    power = np.float32(0)
    for p in range(r.size):
        here = target[p] - weights[p] * u[p]
        r[p] = here
        u[p] = weights[p] * here
        power += here * here
    return power


def _skin_iterate(
    work: A, canvas: A, groups: A, to_canvas: A, from_canvas: A, shifts: A, n_summed: int,
    threshold: float, least: float, momentum: float,
) -> None:  # fmt: skip
    """Iterations of the Haar model, one for each of `shifts`; the last `n_summed` are summed."""
    n = from_canvas.shape[1]
    x, z, total = work[X, :n], work[Z, :n], work[TOTAL, :n]
    u, with_zero = work[U, :n], work[U, : n + 1]
    target, weights, r = work[TARGET, :n], work[WEIGHTS, :n], work[RESIDUAL, :n]
    beta = np.float32(momentum)
    for k in range(shifts.size):
        there, back = to_canvas[shifts[k]], from_canvas[shifts[k]]
        copy(z, u)
        hadamard(u, groups)
        power = residual(target, weights, u, r)
        hadamard(u, groups)
        for p in range(n):
            u[p] = u[p] + z[p]
        limit = max(threshold * np.sqrt(np.float64(power)), least)
        lambda2 = np.float32(limit * limit + 1e-30)
        for p in range(canvas.size):
            canvas[p] = with_zero[there[p]]
        shrink(canvas, lambda2)
        for p in range(n):
            after = max(canvas[back[p]], np.float32(0))
            z[p] = after + beta * (after - x[p])
            x[p] = after
        if k >= shifts.size - n_summed:
            for p in range(n):
                total[p] += x[p]


skin_iterate, skin_iterate_large = (
    compiled(f"void({M}, {V}, {G}, {T}, {T}, {L}, int64, float64, float64, float64)")(_skin_iterate)
    for T in (S2, P2)
)


@compiled(sums_in_any_order=True)
def judge(x: A, rows: A, ones: A, scale: A, fitted: A) -> Any:
    """fitted *= scale; return the sum of x^2, of x > 0, and the product of ones with the rest."""
    square, touched, left = np.float32(0), np.float32(0), np.float32(0)
    for p in range(x.size):
        fitted[p] *= scale[p]
        square += x[p] * x[p]
        touched += np.float32(x[p] > 0)
        left += ones[p] * (rows[p] - fitted[p])
    return np.float64(square), np.float64(touched), np.float64(left)


@compiled(f"UniTuple(float64, 3)({M}, {M}, {G}, float64)")
def skin_test(work: A, table: A, groups: A, factor: float) -> Any:
    """x = factor * total unless that is 0; W x as fitted. Returns as `judge`."""
    n = table.shape[1]
    x, fitted, total = work[X, :n], work[FITTED, :n], work[TOTAL, :n]
    if factor > 0:
        mean = np.float32(factor)
        for p in range(n):
            x[p] = total[p] * mean
    copy(x, fitted)
    hadamard(fitted, groups)
    return judge(x, work[Y, :n], table[ONES], table[SCALE], fitted)


@compiled()
def add_bias(x: A, place_of_cell: A, bias: float, forces: A) -> None:
    """Forces f + b (1 - exp(-f / b)) of all cells from forces f without the clip bias b."""
    for k in range(forces.size):
        forces[k] = x[place_of_cell[k]]
    if bias > 0:
        b, sixteenth = np.float32(bias), np.float32(1 / (16 * bias))
        for k in range(forces.size):
            # exp(-16 t) = exp(-t)^16; t <= 1, so a series of 8 terms is exact to float32.
            t = min(forces[k] * sixteenth, np.float32(1))
            e = np.float32(1 / 5040)
            e = np.float32(1 / 720) - t * e
            e = np.float32(1 / 120) - t * e
            e = np.float32(1 / 24) - t * e
            e = np.float32(1 / 6) - t * e
            e = np.float32(1 / 2) - t * e
            e = np.float32(1) - t * e
            e = np.float32(1) - t * e
            e *= e
            e *= e
            e *= e
            e *= e
            forces[k] += b * (np.float32(1) - e)


@compiled(f"void({M}, {V}, {P}, float64, {V})")
def skin_end(work: A, fitted: A, place_of_cell: A, bias: float, forces: A) -> None:
    """End a frame: the correction of the prediction, W x, and the forces of all cells."""
    n = fitted.size
    correction, whole = work[CORRECTION, :n], work[WHOLE, :n]
    for k in range(n):
        correction[k] = fitted[k] - whole[k]
        whole[k] = fitted[k]
    add_bias(work[X, : n + 1], place_of_cell, bias, forces)


RUN = 1024
"""Elements of a vector that are summed at a time, all of whose terms the cache holds (timed)."""


@compiled()
def taps(source: A, target: A, at: int, n: int, step: int, weights: A, adds: bool) -> None:
    """Filter n elements from place `at` on, by symmetric weights of terms `step` apart.

    target[k] = w[0] source[k] + sum over d of w[d] (source[k - d step] + source[k + d step]); with
    `adds` that is added to it. The number of weights is odd.
    """
    for base in range(at, at + n, RUN):
        size = min(RUN, at + n - base)
        out, here = target[base : base + size], source[base : base + size]
        first = weights[0]
        if adds:
            for k in range(size):
                out[k] += first * here[k]
        else:
            for k in range(size):
                out[k] = first * here[k]
        for d in range(1, weights.size - 1, 2):
            near, far = d * step, (d + 1) * step
            a, b = source[base - near : base - near + size], source[base + near :]
            c, e = source[base - far : base - far + size], source[base + far :]
            v, w = weights[d], weights[d + 1]
            for k in range(size):
                out[k] += v * (a[k] + b[k]) + w * (c[k] + e[k])


@compiled(f"void({V}, {V}, {V}, {L}, {M}, {L})")
def filter_image(image: A, half: A, total: A, layout: A, weights: A, reach: A) -> None:
    """total = sum over lengths of K_down image K_right.

    `weights` are those of the filters down and right of each length, `reach` how many terms follow
    the first. An image is padded: `layout` is its first cell, its size, and that of a row, zeros
    behind each included.
    """
    at, n, stride = layout[0], layout[1], layout[2]
    for k in range(0, reach.size, 2):
        taps(image, half, at, n, stride, weights[k, : reach[k] + 1], False)
        taps(half, total, at, n, 1, weights[k + 1, : reach[k + 1] + 1], k > 0)


# Rows of the work of the smooth model, float32: what it is given, and its conjugate gradients.
(
    DEVIATION, ROWS_KNOWN, ROWS_USED, VARIANCE, FIELD, NEIGHBOURS, SOLUTION, LEFT, SCALED,
    DIRECTION, PRODUCT, INVERSE, ADDED, N_SMOOTH,
) = range(14)  # fmt: skip


@compiled()
def correlate(
    rows: A, v: A, work: A, images: A, place: A, scale: A, groups: A, layout: A, weights: A,
    reach: A,
) -> None:  # fmt: skip
    """v = C W^T rows."""
    deviation = work[DEVIATION, : v.size]
    image, half, total = images[0], images[1], images[2]
    for p in range(v.size):
        v[p] = scale[p] * rows[p]
    hadamard(v, groups)
    for p in range(v.size):
        image[place[p]] = v[p] * deviation[p]
    filter_image(image, half, total, layout, weights, reach)
    for p in range(v.size):
        v[p] = total[place[p]] * deviation[p]


@compiled(sums_in_any_order=True)
def descend(step: A, work: A, n: int) -> Any:
    """A step of conjugate gradients; return the squares of what is left, plain and scaled."""
    solution, left, scaled = work[SOLUTION], work[LEFT], work[SCALED]
    direction, product, inverse = work[DIRECTION], work[PRODUCT], work[INVERSE]
    square, slope = np.float32(0), np.float32(0)
    for p in range(n):
        solution[p] += step * direction[p]
        rest = left[p] - step * product[p]
        left[p] = rest
        scaled[p] = inverse[p] * rest
        square += rest * rest
        slope += rest * scaled[p]
    return np.float64(square), np.float64(slope)


@compiled(f"void({M}, {M}, {P}, {V}, {G}, {L}, {M}, {L}, int64, float64, float64, float64)")
def smooth_descend(
    work: A, images: A, place: A, scale: A, groups: A, layout: A, weights: A, reach: A, most: int,
    mean: float, added: float, precise: float,
) -> None:  # fmt: skip
    """Field C W^T (W C W^T + V)^-1 of the known rows, by at most `most` conjugate gradients.

    V is the variance of a row, and `added`; `mean` that of the diagonal of C.
    """
    n = place.size
    known, used, variance = work[ROWS_KNOWN, :n], work[ROWS_USED, :n], work[VARIANCE, :n]
    left, scaled, direction = work[LEFT, :n], work[SCALED, :n], work[DIRECTION, :n]
    product, inverse, field = work[PRODUCT, :n], work[INVERSE, :n], work[FIELD, :n]
    added_to, solution = work[ADDED, :n], work[SOLUTION, :n]
    more, diagonal = np.float32(added), np.float32(mean)
    for p in range(n):
        # Of a row that is not used, 1: it stays 0.
        added_to[p] = variance[p] + more if used[p] > 0 else np.float32(1)
        inverse[p] = np.float32(1) / (added_to[p] + diagonal)
        left[p] = known[p]
        scaled[p] = inverse[p] * left[p]
        direction[p] = scaled[p]
    fill(solution)
    square, slope = np.float64(dot(left, left)), np.float64(dot(left, scaled))
    enough = precise * square
    for _ in range(most):
        if not square > enough:
            break
        correlate(direction, product, work, images, place, scale, groups, layout, weights, reach)
        hadamard(product, groups)
        for p in range(n):
            product[p] = scale[p] * product[p] * used[p] + added_to[p] * direction[p]
        curvature = np.float64(dot(direction, product))
        if not (curvature > 0 and slope > 0):
            break
        last = slope
        square, slope = descend(np.float32(slope / curvature), work, n)
        again = np.float32(slope / last)
        for p in range(n):
            direction[p] = again * direction[p] + scaled[p]
    correlate(solution, field, work, images, place, scale, groups, layout, weights, reach)


@compiled(f"void({M}, {M}, {P}, {L}, {M}, {L}, {V}, float64)")
def smooth_deviation(
    work: A, images: A, place: A, layout: A, weights: A, reach: A, x: A, floor: float
) -> None:  # fmt: skip
    """Deviation of each taxel that follows from an estimate x: blurred, its largest 1."""
    deviation, neighbours = work[DEVIATION], work[NEIGHBOURS]
    image, half, total = images[0], images[1], images[2]
    for p in range(x.size):
        image[place[p]] = max(x[p], np.float32(0))
    filter_image(image, half, total, layout, weights, reach)
    largest = np.float32(0)
    for p in range(x.size):
        deviation[p] = total[place[p]] / neighbours[p]
        largest = max(largest, deviation[p])
    if not largest > 0:
        for p in range(x.size):
            deviation[p] = 1
        return
    least = np.float32(floor)
    for p in range(x.size):
        deviation[p] = deviation[p] / largest + least


@compiled(f"void({V}, {P}, {L}, {V}, {V}, {V})")
def tiled_image(w: A, order: A, grid: A, v: A, scratch: A, image: A) -> None:
    """Image of Haar coefficients w of a tiled vector; element p of it is pixel order[p]."""
    v[:] = w
    unpyramid(v[: grid[1] * grid[2]], grid[1], grid[2], scratch)
    double(v, grid[0])
    for p in range(v.size):
        image[order[p]] = v[p]


@compiled()
def standing_out(w: A, numbers: A) -> Any:
    """Part of a window of 12 x 12 that counts, as in `gates`; numbers: from place 7 on."""
    most, whole = np.float32(0), np.float32(0)
    for top in range(0, 144, 72):
        for left in range(0, 12, 6):
            sixth = np.float32(0)
            for at in (top + left, top + left + 3, top + left + 36, top + left + 39):
                third = np.float32(0)
                for i in range(at, at + 36, 12):
                    third += w[i] + w[i + 1] + w[i + 2]
                    most = max(most, max(w[i], w[i + 1], w[i + 2]) / np.float32(numbers[7]))
                most = max(most, third / np.float32(3 * numbers[8]))
                sixth += third
            most = max(most, sixth / np.float32(6 * numbers[9]))
            whole += sixth
    most = max(most, whole / np.float32(12 * numbers[10]))
    return min(
        max((most - np.float32(1)) / np.float32(numbers[11] - 1), np.float32(0)), np.float32(1)
    )


@compiled(f"void({V}, {G}, {V})")
def orthonormal(v: A, groups: A, scale: A) -> None:
    """Transform a dealt vector in place by W = W^T, orthonormal; scale: that of each place."""
    hadamard(v, groups)
    for p in range(scale.size):
        v[p] *= scale[p]


@compiled(
    f"float64({V}, {V}, {V}, {V}, {L}, {V}, {G}, {V}, {V}, {P2}, {P}, {V}, "
    f"{M}, {M}, {V}, {M}, {V}, {M}, {V}, {D}, {M}, {M}, {M}, {M}, {M}, {M}, {M}, {V}, {L})",
    sums_in_any_order=True,
)
def gated_step(
    z: A, x: A, target: A, variance: A, read: A, off_target: A, groups: A, scale: A, v: A,
    windows: A, back: A, share: A,
    filters: A, hidden: A, hidden_0: A, gates: A, gates_0: A, synthesis: A, error: A, numbers: A,
    w: A, a: A, levels: A, h: A, g: A, out: A, tiles: A, parts: A, busy: A,
) -> float:  # fmt: skip
    """A step of `OampSolver`: z and x become the next ones; return the expected squared error.

    v has a place more than z. Matrices are transposed; those of the last line are scratch.
    numbers: read noise, floor, least tau, most alpha, damping, the constant of the error, that of a
    tile in which nothing stands out, those of `standing_out`; the last becomes the mean squared
    residual of z.
    """
    n, n_tiles, k = z.size, windows.shape[0], filters.shape[1]
    one, none, four = np.float32(1), np.float32(0), np.float32(4)
    v[:n] = z
    hadamard(v[:n], groups)
    for p in range(n):
        x[p] = target[p] - v[p] * scale[p]
    rho, residual2 = 0.0, 0.0
    for i in range(read.size):
        r = x[read[i]]
        rho += np.float64(r) ** 2
        residual2 += np.float64(r + off_target[i]) ** 2
    rho /= read.size
    numbers[12] = residual2 / read.size
    tau = np.float32(max(rho - numbers[0], numbers[2] * rho) + numbers[1])
    weight = 0.0
    for p in range(n):
        d = tau / (tau + variance[p])
        weight += d
        v[p] = d * x[p] * scale[p]
    weight /= n
    hadamard(v[:n], groups)
    s = np.float32(np.sqrt(tau * max(1 - weight, 0.0) / weight + numbers[1]))
    inverse, per_s = np.float32(1 / weight), one / s
    for p in range(n):
        u = z[p] + v[p] * inverse
        x[p] = u
        v[p] = u * per_s
    v[n] = 0
    expected, n_busy = 0.0, 0
    for t in range(n_tiles):
        for j in range(w.shape[1]):
            w[n_busy, j] = v[windows[t, j]]
        part = standing_out(w[n_busy], numbers)
        if part > 0:
            busy[n_busy], parts[n_busy] = t, part
            n_busy += 1
        else:
            tiles[t] = none
            expected += share[t] * numbers[6]
    w, a, levels, h, g, out = (
        w[:n_busy],
        a[:n_busy],
        levels[:n_busy],
        h[:n_busy],
        g[:n_busy],
        out[:n_busy],
    )
    if n_busy:
        np.dot(w, filters, a)
        for b in range(n_busy):
            for j in range(k):
                size = four * (np.sqrt(np.sqrt(one + abs(a[b, j]))) - one)
                levels[b, k + j] = size
                levels[b, j] = size if a[b, j] >= 0 else -size
        np.dot(levels, hidden, h)
        for b in range(n_busy):
            for j in range(h.shape[1]):
                h[b, j] = max(h[b, j] + hidden_0[j], none)
        np.dot(h, gates, g)
        for b in range(n_busy):
            logarithm = numbers[5]
            for j in range(h.shape[1]):
                logarithm += h[b, j] * error[j]
            e = np.exp(min(max(logarithm, -12.0), 0.0))
            expected += share[busy[b]] * (numbers[6] + parts[b] * (e - numbers[6]))
            passed = min(max(g[b, k] + gates_0[k], none), one)
            g[b, k] = passed
            for j in range(k):
                a[b, j] *= min(max(g[b, j] + gates_0[j], none), one) - passed
        np.dot(a, synthesis, out)
        for b in range(n_busy):
            for i in range(8):
                for j in range(8):
                    inner = g[b, k] * w[b, 12 * (i + 2) + j + 2]
                    tile = max(out[b, 8 * i + j] + inner, none)
                    tiles[busy[b], 8 * i + j] = s * parts[b] * tile
    flat = tiles.reshape(-1)
    alpha, damping = np.float32(min(expected, numbers[3])), np.float32(numbers[4])
    more = one / (one - alpha)
    for p in range(n):
        u, x[p] = x[p], flat[back[p]]
        z[p] += damping * ((x[p] - alpha * u) * more - z[p])
    return expected * np.float64(s) ** 2


LOOPS: dict[str, tuple[Callable[..., Any], ...]] = {
    "phi": (measure,),
    "skin": (
        *(dealt_forward, dealt_adjoint),
        *(skin_read, skin_aim, skin_iterate, skin_test, skin_end),
        *(filter_image, smooth_descend, smooth_deviation),
    ),
    "fista": (fista, tiled_image),
    "oamp": (orthonormal, gated_step),
}
"""Loops of each solver, by its name, and of "phi".

Beyond `MAX_PLACES` cells solvers have others, with larger tables.
"""
