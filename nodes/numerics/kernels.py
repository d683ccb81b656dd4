"""All loops that numba compiles.

They stand in one file because numba stores compiled code by file: a loop that another one calls
must not change without it.

Vectors are float32 and contiguous. A dealt vector holds the taxels in the order of the scrambled
block Hadamard ensemble, the blocks of one size interleaved: element j of block b is at
j * count + b, so that a butterfly is one sum and one difference of long runs. `groups` states
where the blocks of each size are, int64 (k, 3): start, size, count.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numba import boolean, float32, float64, from_dtype, int32, int64, uint32, void

from .arrays import TINY
from .compiled import compiled

A: TypeAlias = Any
"""An array; mypy and numba read its type differently."""

MOST_ROWS = 32
"""Rows up to which loops are faster than BLAS. Measured: at 20 rows 1.25 times, at 40 0.9 times."""
_ROOT_2 = np.float32(np.sqrt(2.0))

# Types of arguments: vector, matrix, places and tables of them, groups, list, numbers and tables of
# them.
V, M, P, P2 = float32[::1], float32[:, ::1], uint32[::1], uint32[:, ::1]
G, L, D, DM = int64[:, ::1], int64[::1], float64[::1], float64[:, ::1]


_CONSTANTS = """
    damping least_tau most_alpha motion ridge noise_rate noise_growth significant
    signal_rate prior doubt recall_memory recall_ridge blend lagging trust_growth least_trust
    most_bias bias_begins bias_rate bias_known bias_forgotten optimism louder unexplained unresolved
    untouched trusted least_read pressed_noise silence_kept
    resolution repeated same invisible dust negligible unknown unread
    quiet single by_3 by_6 whole clearly strict least error_0 clipped clipped_below
"""
CONSTANTS = np.dtype([(name, np.float64) for name in _CONSTANTS.split()])
"""Constants of a `CompiledEstimator`: `SkinTuning`, and those of modules of the method."""
_NUMBERS = """
    noise bias error trusted least_noise trust signal n_seen n_frames n_repeats left2 silence
    pressed stated_error
    noise_sd f_max sigma_mid sigma_end clips of_touched
"""
NUMBERS = np.dtype([(name, np.float64) for name in _NUMBERS.split()])
"""Numbers of a `CompiledEstimator`: those of `SkinEstimator`, and the noise that the skin states;
f_max is 0 where it states none."""


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
def haar(v: A, n_rows: int, n_cols: int, half: A) -> None:
    """Haar transform at full depth of a grid of any sides, row by row, in place.

    Sums and differences are not scaled; a sample without a partner is multiplied by sqrt(2), as
    large as the sums of the others. `half` is scratch, as long as v.
    """
    rows, cols = n_rows, n_cols
    while rows > 1 or cols > 1:
        left_rows, left_cols = (rows + 1) // 2, (cols + 1) // 2
        for i in range(rows // 2):
            a, b = v[2 * i * n_cols :][:cols], v[(2 * i + 1) * n_cols :][:cols]
            s, d = half[i * n_cols :][:cols], half[(left_rows + i) * n_cols :][:cols]
            for j in range(cols):
                s[j], d[j] = a[j] + b[j], a[j] - b[j]
        if rows % 2:
            a, s = v[(rows - 1) * n_cols :][:cols], half[(left_rows - 1) * n_cols :][:cols]
            for j in range(cols):
                s[j] = _ROOT_2 * a[j]
        for i in range(rows):
            a, s = half[i * n_cols :][:cols], v[i * n_cols :][:cols]
            d = s[left_cols:]
            for j in range(d.size):
                s[j], d[j] = a[2 * j] + a[2 * j + 1], a[2 * j] - a[2 * j + 1]
            if cols % 2:
                s[left_cols - 1] = _ROOT_2 * a[cols - 1]
        rows, cols = left_rows, left_cols


@compiled()
def haar_transposed(v: A, n_rows: int, n_cols: int, half: A) -> None:
    """The transpose of `haar`."""
    depth = 0
    while (n_rows - 1) >> depth or (n_cols - 1) >> depth:
        depth += 1
    for level in range(depth - 1, -1, -1):
        # Sides at a level: n / 2^level, rounded up.
        rows, cols = ((n_rows - 1) >> level) + 1, ((n_cols - 1) >> level) + 1
        left_rows, left_cols = (rows + 1) // 2, (cols + 1) // 2
        for i in range(rows):
            a, s = half[i * n_cols :][:cols], v[i * n_cols :][:cols]
            d = s[left_cols:]
            for j in range(d.size):
                a[2 * j], a[2 * j + 1] = s[j] + d[j], s[j] - d[j]
            if cols % 2:
                a[cols - 1] = _ROOT_2 * s[left_cols - 1]
        for i in range(rows // 2):
            a, b = v[2 * i * n_cols :][:cols], v[(2 * i + 1) * n_cols :][:cols]
            s, d = half[i * n_cols :][:cols], half[(left_rows + i) * n_cols :][:cols]
            for j in range(cols):
                a[j], b[j] = s[j] + d[j], s[j] - d[j]
        if rows % 2:
            a, s = v[(rows - 1) * n_cols :][:cols], half[(left_rows - 1) * n_cols :][:cols]
            for j in range(cols):
                a[j] = _ROOT_2 * s[j]


@compiled(void(V, V, V, V, V, V, V, P, V, V, G, L, V))
def fista(
    theta: A, before: A, betas: A, weights2: A, threshold: A, z: A, v: A, deal: A, keep: A,
    measured: A, groups: A, grid: A, half: A,
) -> None:  # fmt: skip
    """Iterations of FISTA, one for each of betas; the two thetas alternate, the first is newest."""
    for beta in betas:
        for k in range(z.size):
            z[k] = theta[k] + beta * (theta[k] - before[k])
        haar_transposed(z, grid[0], grid[1], half)
        for p in range(deal.size):
            v[p] = z[deal[p]]
        hadamard(v, groups)
        for p in range(v.size):
            v[p] = v[p] * keep[p] + measured[p]
        hadamard(v, groups)
        for p in range(deal.size):
            z[deal[p]] = v[p]
        haar(z, grid[0], grid[1], half)
        for k in range(z.size):
            u = weights2[k] * z[k]
            before[k] = u - min(max(u, -threshold[k]), threshold[k])
        theta, before = before, theta


@compiled(void(V, L, V))
def haar_image(v: A, grid: A, half: A) -> None:
    """Replace Haar coefficients, of the scale of `haar`, by their image."""
    haar_transposed(v, grid[0], grid[1], half)


@compiled()
def standing_out(image: A, begin: int, width: int, t: A, sums: A, peaks: A) -> Any:
    """Part of the window of 12 x 12 that begins at a place of a flat image, as in `gates`; sums and
    peaks are scratch, 12 columns each.
    """
    highest = of_thirds = of_sixths = whole = left = right = np.float32(0)
    peaks[:] = highest
    for band in range(4):
        at = begin + 3 * band * width
        one, two, three = image[at:][:12], image[at + width :][:12], image[at + 2 * width :][:12]
        for j in range(12):
            sums[j] = one[j] + two[j] + three[j]
            peaks[j] = max(peaks[j], max(one[j], max(two[j], three[j])))
        a, b = sums[0] + sums[1] + sums[2], sums[3] + sums[4] + sums[5]
        c, d = sums[6] + sums[7] + sums[8], sums[9] + sums[10] + sums[11]
        of_thirds = max(max(of_thirds, max(a, b)), max(c, d))
        left, right = left + (a + b), right + (c + d)
        if band % 2:
            of_sixths = max(of_sixths, max(left, right))
            whole += left + right
            left = right = np.float32(0)
    for j in range(12):
        highest = max(highest, peaks[j])
    most = max(highest / t.single, of_thirds / (3 * t.by_3))
    most = max(most, max(of_sixths / (6 * t.by_6), whole / (12 * t.whole)))
    return np.float32(min(max((most - 1) / (t.clearly - 1), 0.0), 1.0))


@compiled(sums_in_any_order=True)
def product(w: A, matrix: A, out: A) -> None:
    """Matrix product out = w matrix^T: of few rows by loops, since BLAS copies the matrix first."""
    n, n_columns = w.shape[0], matrix.shape[0]
    if n > MOST_ROWS or n_columns < 4:
        np.dot(w, matrix.T, out)
        return
    for t in range(0, n, 2):  # two rows by four columns; the last ones may be computed twice
        u = min(t + 1, n - 1)
        x, y = w[t], w[u]
        for begin in range(0, n_columns, 4):
            j = min(begin, n_columns - 4)
            p, q, r, s = matrix[j], matrix[j + 1], matrix[j + 2], matrix[j + 3]
            a = b = c = d = e = f = g = h = np.float32(0)
            for k in range(p.size):
                a, b, c, d = a + x[k] * p[k], b + x[k] * q[k], c + x[k] * r[k], d + x[k] * s[k]
                e, f, g, h = e + y[k] * p[k], f + y[k] * q[k], g + y[k] * r[k], h + y[k] * s[k]
            out[t, j], out[t, j + 1], out[t, j + 2], out[t, j + 3] = a, b, c, d
            out[u, j], out[u, j + 1], out[u, j + 2], out[u, j + 3] = e, f, g, h


@compiled(sums_in_any_order=True)
def haar_shrink(w: A, constants: A, s: A, d: A) -> None:
    """Shrink the tiles of windows (t, 144), as in `formula`.

    Columns of s and d are tiles. s holds the taxels, and their sums at each level: its first 64
    rows are the result. d holds the details; its row 64 becomes the expected squared error.
    """
    strict, least = np.float32(constants.strict), np.float32(constants.least)
    half, quiet = np.float32(0.5), np.float32(constants.quiet)
    one, four = np.float32(1), np.float32(4)
    n_tiles, begin, place, n = w.shape[0], 0, 0, 8
    for p in range(64):
        for t in range(n_tiles):
            s[p, t] = w[t, 12 * (p // 8 + 2) + p % 8 + 2]
    error = d[64][:n_tiles]
    error[:] = np.float32(0)
    while n > 1:
        for k in range(n * n // 4):
            at = begin + 2 * (k // (n // 2)) * n + 2 * (k % (n // 2))
            a, b, c, e, total = s[at], s[at + 1], s[at + n], s[at + n + 1], s[begin + n * n + k]
            x, y, z = d[place], d[place + 1], d[place + 2]
            for t in range(n_tiles):
                up, down, left, right = a[t] + b[t], c[t] + e[t], a[t] - b[t], c[t] - e[t]
                total[t] = half * (up + down)
                u, v, q = half * (up - down), half * (left + right), half * (left - right)
                energy = u * u + v * v + q * q
                ratio = np.float32(3) * strict / (energy + least)
                g = one / (one + ratio * ratio)
                x[t], y[t], z[t] = g * u, g * v, g * q
                lost = one - g
                error[t] += lost * lost * energy + (g + g) * (np.float32(3) + four * lost)
            place += 3
        begin += n * n
        n //= 2
    mean = s[84]
    for t in range(n_tiles):
        energy = mean[t] * mean[t]
        ratio = strict / (energy + least)
        g = one / (one + ratio * ratio)
        mean[t] *= g
        lost = one - g
        total = error[t] + lost * lost * energy + (g + g) * (one + four * lost)
        expected = total / np.float32(64) - one
        error[t] = min(max(expected, quiet), one)
    while n < 8:
        n *= 2
        begin -= n * n
        place -= 3 * n * n // 4
        for k in range(n * n // 4):
            at = begin + 2 * (k // (n // 2)) * n + 2 * (k % (n // 2))
            a, b, c, e, total = s[at], s[at + 1], s[at + n], s[at + n + 1], s[begin + n * n + k]
            x, y, z = d[place + 3 * k], d[place + 3 * k + 1], d[place + 3 * k + 2]
            for t in range(n_tiles):
                up, down, left, right = total[t] + x[t], total[t] - x[t], y[t] + z[t], y[t] - z[t]
                a[t], b[t] = half * (up + left), half * (up - left)
                c[t], e[t] = half * (down + right), half * (down - right)


@compiled(void(V, G, V))
def orthonormal(v: A, groups: A, scale: A) -> None:
    """Transform a dealt vector in place by W = W^T, orthonormal; scale: that of each place."""
    hadamard(v, groups)
    for p in range(scale.size):
        v[p] *= scale[p]


@compiled(sums_in_any_order=True)
def skin_predict(
    x: A, whole: A, values: A, read: A, neighbours: A, groups: A, scale: A,
    noise: float, error2: float, t: A,
    slopes: A, rows: A, correction: A, predicted: A, moved: A, innovation: A,
) -> tuple[float, float, float]:  # fmt: skip
    """Predict a frame, as in `FrameVectors`; slopes and rows are scratch, predicted, moved and
    innovation results. Return the sums of squares of the innovation and of the last correction, and
    of their products.
    """
    n, largest, energy = x.size, np.float32(0), 0.0
    for k in range(2):
        slope, following, last = slopes[k], neighbours[k], neighbours[2 + k]
        for p in range(n):
            slope[p] = x[following[p]] - x[last[p]]
        rows[k] = slope
        orthonormal(rows[k], groups, scale)
    for p in range(n):
        largest = max(largest, x[p])
    for p in range(n):
        energy += np.float64(x[p]) * np.float64(x[p])
    by_down, by_across = rows[0], rows[1]
    a_e = b_e = c_e = aa = ab = ac = bb = bc = cc = 0.0
    for i in range(read.size):
        r = read[i]
        a_i, b_i, c_i = np.float64(whole[r]), np.float64(by_down[r]), np.float64(by_across[r])
        e = np.float64(values[i] - whole[r])
        a_e, b_e, c_e = a_e + a_i * e, b_e + b_i * e, c_e + c_i * e
        aa, ab, ac = aa + a_i * a_i, ab + a_i * b_i, ac + a_i * c_i
        bb, bc, cc = bb + b_i * b_i, bc + b_i * c_i, cc + c_i * c_i
    gram = np.array([[aa, ab, ac], [ab, bb, bc], [ac, bc, cc]])
    right = np.array([a_e, b_e, c_e])
    unseen = max(0.0, energy * read.size / n - gram[0, 0])
    doubt = max(noise, error2)
    gram[0, 0] += unseen * doubt / (doubt + gram[0, 0] / read.size)
    least = t.ridge**2 * gram[0, 0] + noise
    for j in range(3):
        gram[j, j] += t.ridge * gram[j, j] + least
    a = right.copy()  # Gaussian elimination
    for j in range(3):
        for k in range(j + 1, 3):
            factor = gram[k, j] / gram[j, j]
            gram[k] -= factor * gram[j]
            a[k] -= factor * a[j]
    for j in range(2, -1, -1):
        for k in range(j + 1, 3):
            a[j] -= gram[j, k] * a[k]
        a[j] /= gram[j, j]
    explained = max(0.0, a[0] * right[0] + a[1] * right[1] + a[2] * right[2])
    a *= explained / (explained + t.motion * noise) if read.size >= t.least_read else 0.0
    a[0] = min(a[0], 1.0)
    most = np.float32(largest * max(1.0, 1 + a[0]))
    grown, down, across = np.float32(a[0]), np.float32(a[1]), np.float32(a[2])
    for p in range(n):
        one = x[p] + (grown * x[p] + down * slopes[0, p] + across * slopes[1, p])
        predicted[p] = min(max(one, np.float32(0)), most)
    moved[:] = predicted
    orthonormal(moved, groups, scale)
    power, of_last, of_both = 0.0, 0.0, 0.0
    for i in range(read.size):
        innovation[i] = values[i] - moved[read[i]]
        now, last = np.float64(innovation[i]), np.float64(correction[read[i]])
        power += now * now
        of_last += last * last
        of_both += now * last
    return power, of_last, of_both


@compiled()
def loosened(variance: A, prior: A, doubt: A, most: A) -> Any:
    """Variance of errors that are not independent of each other; doubt: in noise variances."""
    return min(prior * variance * (np.float32(1) + doubt * variance), most)


@compiled()
def surplus(seen: float, expected: float, count: int, t: A) -> Any:
    """As `SkinTuning.surplus`."""
    more = max(seen - expected, 0.0)
    z2 = more * more * count / (2 * expected * expected + TINY)
    return more * z2 / (z2 + t.significant**2)


@compiled(sums_in_any_order=True)
def skin_filter(
    values: A, innovation: A, moved: A, whole: A, read: A, mean: A, left: A, change: A,
    target: A, variance: A, off_target: A, recall: A,
    noise: float, signal: float, error2: float, floor: float, t: A,
) -> Any:  # fmt: skip
    """Filter all rows, as in `FrameVectors`; left: variance that their measurements left. Return
    the mean variance of the targets of the rows read.
    """
    n, n_read = mean.size, read.size
    loose, doubt, one = np.float32(t.prior), np.float32(t.doubt / noise), np.float32(1)
    unknown, n_known, seen, expected = np.float32(t.unknown), 0, 0.0, 0.0
    for p in range(n):
        mean[p] += moved[p] - whole[p]
    for i in range(n_read):
        r = read[i]
        before = left[r] + change[r]
        if before < unknown:
            n_known += 1
            seen += np.float64(values[i] - mean[r]) ** 2
            expected += before
    changed = signal
    if 2 * n_known > n_read:
        changed = surplus(seen / n_known, noise + expected / n_known, n_read, t)
    grown = np.float32(changed)
    prior = loosened(np.float32(max(signal, error2)), loose, doubt, unknown)
    # Each loop has few vectors: of many, it would not be computed on several numbers at once.
    for p in range(n):
        change[p] = min(change[p] + grown, unknown)
    for p in range(n):
        variance[p] = prior / (prior + left[p] + loosened(change[p], loose, doubt, unknown))
    for p in range(n):
        target[p] = variance[p] * (mean[p] - moved[p])
    recall *= t.recall_memory
    recall[2] += n_known
    for i in range(n_read):
        r = read[i]
        if left[r] + (change[r] - grown) < unknown:
            correction = np.float64(target[r])
            recall[0] += innovation[i] * correction
            recall[1] += correction * correction
    ridge = t.recall_ridge * noise * recall[2]
    recalled = np.float32(min(max((recall[0] + ridge) / (recall[1] + ridge + TINY), 0.0), 1.0))
    for p in range(n):
        variance[p] = prior * (one - recalled * variance[p])
    for p in range(n):
        target[p] = moved[p] + recalled * target[p]
    r_noise, least, total = np.float32(noise), np.float32(floor), 0.0
    for i in range(n_read):
        r = read[i]
        gain = variance[r] / (variance[r] + r_noise)
        target[r] += gain * (values[i] - target[r])
        variance[r] = max(gain * r_noise, least)
        total += variance[r]
        off_target[i] = values[i] - target[r]
        before = left[r] + change[r]
        gain = before / (before + r_noise)
        mean[r] += gain * (values[i] - mean[r])
        left[r] = max(gain * r_noise, least)
        change[r] = 0
    return total / n_read


@compiled(sums_in_any_order=True)
def skin_step(
    z: A, x: A, target: A, variance: A, read: A, off_target: A, read_noise: float, floor: float,
    groups: A, scale: A, canvas: A, cells: A, width: int, begins: A, share: A, formula: bool, t: A,
    filters: A, hidden: A, hidden_0: A, gates: A, gates_0: A, synthesis: A, error: A,
    v: A, image: A, found: A, w: A, a: A, levels: A, h: A, g: A, out: A, sums: A, details: A,
    parts: A, busy: A,
) -> tuple[float, float]:  # fmt: skip
    """A step, as in `FrameVectors`: z and x become the next; return the expected squared error and
    the mean squared residual before it.

    canvas, width and begins are the places that the cells read, the cells of a row, and the first
    cell of each window; cells those of the taxels. Arrays of the last two lines are scratch; v has
    a place more than z.
    """
    n, n_tiles, k = z.size, begins.size, filters.shape[0]
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
    tau = np.float32(max(rho - read_noise, t.least_tau * max(rho, read_noise)) + floor)
    weight = 0.0
    for p in range(n):
        d = tau / (tau + variance[p])
        weight += d
        v[p] = d * x[p] * scale[p]
    weight /= n
    hadamard(v[:n], groups)
    s = np.float32(np.sqrt(tau * max(1 - weight, 0.0) / weight + floor))
    inverse, per_s = np.float32(1 / weight), one / s
    for p in range(n):
        u = z[p] + v[p] * inverse
        x[p] = u
        v[p] = u * per_s
    v[n] = 0
    for q in range(canvas.size):
        image[q] = v[canvas[q]]
    found[:] = none
    expected, n_busy = 0.0, 0
    for tile in range(n_tiles):
        part = standing_out(image, begins[tile], width, t, w[-1][:12], w[-1][12:24])
        if part > 0:
            for i in range(12):
                w[n_busy, 12 * i : 12 * i + 12] = image[begins[tile] + i * width :][:12]
            busy[n_busy], parts[n_busy] = tile, part
            n_busy += 1
        else:
            expected += share[tile] * t.quiet
    w, a, levels = w[:n_busy], a[:n_busy], levels[:n_busy]
    h, g, out = h[:n_busy], g[:n_busy], out[:n_busy]
    if n_busy and formula:
        haar_shrink(w, t, sums, details)
        for b in range(n_busy):
            e, begin = np.float64(details[64, b]), begins[busy[b]] + 2 * width + 2
            expected += share[busy[b]] * (t.quiet + parts[b] * (e - t.quiet))
            for i in range(8):
                for j in range(8):
                    found[begin + i * width + j] = s * parts[b] * max(sums[8 * i + j, b], none)
    elif n_busy:
        product(w, filters, a)
        for b in range(n_busy):
            one_a, sizes = a[b], levels[b, k:]
            for j in range(sizes.size):  # without a choice, so that its roots become vectors
                sizes[j] = four * (np.sqrt(np.sqrt(one + abs(one_a[j]))) - one)
            for j in range(k):
                levels[b, j] = sizes[j] if one_a[j] >= 0 else -sizes[j]
        product(levels, hidden, h)
        for b in range(n_busy):
            for j in range(h.shape[1]):
                h[b, j] = max(h[b, j] + hidden_0[j], none)
        product(h, gates, g)
        for b in range(n_busy):
            logarithm = t.error_0
            for j in range(h.shape[1]):
                logarithm += h[b, j] * error[j]
            e = np.exp(min(max(logarithm, -12.0), 0.0))
            expected += share[busy[b]] * (t.quiet + parts[b] * (e - t.quiet))
            passed = min(max(g[b, k] + gates_0[k], none), one)
            g[b, k] = passed
            for j in range(k):
                a[b, j] *= min(max(g[b, j] + gates_0[j], none), one) - passed
        product(a, synthesis, out)
        for b in range(n_busy):
            begin = begins[busy[b]] + 2 * width + 2
            for i in range(8):
                for j in range(8):
                    inner = g[b, k] * w[b, 12 * (i + 2) + j + 2]
                    one_x = max(out[b, 8 * i + j] + inner, none)
                    found[begin + i * width + j] = s * parts[b] * one_x
    alpha, damping = np.float32(min(expected, t.most_alpha)), np.float32(t.damping)
    more = one / (one - alpha)
    for p in range(n):
        v[p] = found[cells[p]]
    for p in range(n):
        z[p] += damping * ((v[p] - alpha * x[p]) * more - z[p])
        x[p] = v[p]
    return expected * np.float64(s) ** 2, residual2 / read.size


@compiled(sums_in_any_order=True)
def skin_settle(
    estimates: A, predicted: A, values: A, ones: A, read: A, moved: A, groups: A, scale: A,
    of_prediction: float, of_bias: float, noise_sd: float, least_force: float,
    x: A, whole: A, correction: A, forces: A,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Settle a frame, as in `FrameVectors`; return what it does but for the forces."""
    part, bias = np.float32(of_prediction), np.float32(of_bias)
    near, least = np.float32(2 * noise_sd + np.sqrt(TINY)), np.float32(least_force)
    mean = np.float32((1 - of_prediction) / len(estimates))
    x[:] = estimates[0]
    for k in range(1, len(estimates)):
        for p in range(x.size):
            x[p] += estimates[k, p]
    power, unpressed, pressed = np.float32(0), np.float32(0), np.float32(0)
    residual2, along = 0.0, 0.0
    for p in range(x.size):
        x[p] = x[p] * mean + part * predicted[p]
        power += x[p] * x[p]
    whole[:] = x
    orthonormal(whole, groups, scale)
    for p in range(x.size):
        correction[p] = whole[p] - moved[p]
    for i in range(read.size):
        residual = values[i] - whole[read[i]]
        residual2 += residual * residual
        along += ones[i] * residual
    for p in range(x.size):
        one = x[p]
        forces[p] = np.float32(0)
        # Exponentials, the slowest part, are found where they are neither 0 nor 1 but for rounding.
        if 2 * one < least:
            unpressed += one
        elif one < 6 * near:
            weak = np.exp(-((one / near) ** 2))
            unpressed += one * weak
            pressed += (np.float32(1) - weak) ** 2
            more = bias * (np.float32(1) - np.exp(-one / bias)) if bias > 0 else bias
            if one + more >= least:
                forces[p] = one + more
        else:
            pressed += np.float32(1)
            forces[p] = one + bias
    n = x.size
    return np.float64(power / n), residual2 / read.size, along, np.float64(unpressed), pressed / n


@compiled(sums_in_any_order=True)
def mean_variance(forces: A, s: A, t: A) -> Any:
    """Mean variance of the readings of forces, as `NoiseModel.variance`."""
    total, per_force = np.float32(0), np.float32(2 / s.f_max)
    rise = np.float32(s.sigma_end - s.sigma_mid)
    one, slope, middle = np.float32(1), np.float32(0), np.float32(s.sigma_mid)
    clipped, least = one, np.float32(0 if s.of_touched > 0 else -1)
    if s.clips > 0 and s.sigma_end > 0:
        slope = np.float32((1 - t.clipped) / t.clipped_below / s.sigma_end)
        clipped = np.float32(t.clipped)
    for p in range(forces.size):
        force = forces[p]
        sigma = middle + rise * min(abs(per_force * force - one), one)
        variance = sigma * sigma * min(clipped + slope * force, one)
        total += variance if force > least else np.float32(0)
    return np.float64(total) / forces.size


@compiled()
def error2_of(own: float, residual2: float, noise: float, m: int, wide: float, t: A) -> Any:
    """As `SkinEstimator._error2`; wide: how many sampling deviations are doubtful."""
    seen = max(residual2 - noise, 0.0)
    doubt = wide * (seen + noise) * np.sqrt(2 / m)
    share = seen * seen / (seen * seen + doubt * doubt + TINY)
    return share * seen + (1 - share) * own


@compiled(
    void(
        *(V, L, V, M, boolean, M, M, D, P2, G, V),
        *(P, P, int64, P2, M, L, int64, int64, int64, boolean),
        *(M, M, V, M, V, M, V, M, M, V, V, V, M, M, M, M, M, M, M, M, V, L),
        *(V, from_dtype(NUMBERS)[::1], from_dtype(CONSTANTS)[::1]),
    )
)
def skin_frame(
    y: A, read: A, ones: A, last: A, known: bool, vectors: A, of_read: A, recall: A,
    neighbours: A, groups: A, scale: A,
    canvas: A, cells: A, width: int, begins: A, shares: A, counts: A, first: int, n_formula: int,
    n: int, gated: bool,
    filters: A, hidden: A, hidden_0: A, gates: A, gates_0: A, synthesis: A, error: A,
    estimates: A, slopes: A, v: A, image: A, found: A,
    w: A, a: A, levels: A, h: A, g: A, out: A, sums: A, details: A, parts: A, busy: A,
    forces: A, numbers: A, constants: A,
) -> None:  # fmt: skip
    """A frame, as in `SkinEstimator`, whose numbers are `numbers`; forces are the result.

    y are the measurements in the order of the rows read; last those of this row subset before, and
    their innovation, if known. Tables of tiles are of each shift. estimates are as many as are
    averaged.
    """
    s, t, m, total, n_kept = numbers[0], constants[0], read.size, n_formula + n, len(estimates)
    x, whole, correction, mean = vectors[0], vectors[1], vectors[2], vectors[3]
    left, change, target, variance = vectors[4], vectors[5], vectors[6], vectors[7]
    predicted, moved, z = vectors[8], vectors[9], vectors[10]
    values, innovation, off_target = of_read[0], of_read[1], of_read[2]
    power, ones2, off, largest = 0.0, 0.0, 0.0, 0.0
    for i in range(m):
        power += np.float64(y[i]) ** 2
        ones2 += np.float64(ones[i]) ** 2
        off = max(off, abs(np.float64(y[i]) - last[0, i]))
        largest = max(largest, abs(y[i]))
        values[i] = y[i] - np.float32(s.bias) * ones[i]
    floor = max(t.resolution**2 * power / m, TINY)
    power, of_last, of_both = skin_predict(
        x, whole, values, read, neighbours, groups, scale, max(s.noise, floor), s.error**2,
        t, slopes[:2], slopes[2:], correction, predicted, moved, innovation,
    )  # fmt: skip
    e2 = power / m
    alike = of_both / np.sqrt(power * (of_last + t.negligible**2 * power) + TINY)
    noise, repeated = s.noise, 0.0
    if known:
        repeated = 1 / (1 + min(off / (t.same * largest + TINY), 1e3) ** 8)
        level, n_seen, new = 0.0, s.n_seen + 1, 1 - repeated
        for i in range(m):
            level += last[1, i] * (last[1, i] - innovation[i])
        level = noise + max(1 / n_seen, t.noise_rate) * (max(level / m, 0.0) - noise)
        least = level
        level = min(level, t.noise_growth * max(noise, s.left2))
        if n_seen > 1 / t.noise_rate + 0.5:
            if m >= t.least_read:
                most = (1 + t.significant * np.sqrt(2 / m)) * s.least_noise
                level = min(level, most * (1 + t.pressed_noise * s.pressed))
            least = min(t.bias_forgotten * s.least_noise, level)
        s.n_seen += new
        s.least_noise = new * least + repeated * s.least_noise
        noise = new * min(level, e2) + repeated * noise
    last[0], last[1] = y, innovation
    s.noise = max(noise, floor, s.noise_sd**2)
    trust = s.trust * np.exp(min(t.lagging / np.sqrt(m) - alike, t.trust_growth))
    s.trust = min(max(trust, t.least_trust), 1.0)
    noise = max(s.noise * s.trust, floor)
    now = surplus(e2, noise, m, t)
    signal = s.signal + t.signal_rate * (e2 - noise - s.signal)
    most = max(e2 - noise, 0.0) + 2 * noise * np.sqrt(2 / m)
    s.signal = max(min(signal, most), now / 2)
    own, residual2, last_error2 = max(s.signal, now, 0.0), e2, s.error**2
    doubt = noise * (1 + repeated * t.repeated * (noise / (noise + now)) ** 2)
    read_noise = skin_filter(
        values, innovation, moved, whole, read, mean, left, change, target, variance, off_target,
        recall, doubt, own, max(last_error2, floor), floor, t,
    )  # fmt: skip
    stated, lacking = s.noise, 0.0
    if s.n_seen > 1 / t.noise_rate + 0.5:
        most = t.louder * s.least_noise
        stated, noise = min(stated, most), min(noise, most)
    z[:] = predicted
    if n == 0:
        estimates[0] = predicted
    else:
        own, residual2 = 0.0, 0.0
        for k in range(total):
            shift, kept = (first + k) % counts.size, k - (total - n_kept)
            formula = k < n_formula or not gated
            error2, before2 = skin_step(
                z, estimates[max(0, kept)], target, variance, read, off_target, read_noise, floor,
                groups, scale, canvas, cells, width, begins[shift, : counts[shift]], shares[shift],
                formula, t,
                filters, hidden, hidden_0, gates, gates_0, synthesis, error,
                v, image, found, w, a, levels, h, g, out, sums, details, parts, busy,
            )  # fmt: skip
            if kept >= 0:
                own += error2 / n_kept
                residual2 += before2 / n_kept
    if largest == 0:
        estimates[:], predicted[:] = 0, 0
    error2 = error2_of(own, residual2, noise, m, 1.0, t)
    part = error2 / (error2 + t.blend * max(s.signal, last_error2, floor))
    power, left2, along, unpressed, s.pressed = skin_settle(
        estimates, predicted, values, ones, read, moved, groups, scale, part, s.bias,
        np.sqrt(s.least_noise), t.invisible * np.sqrt(noise), x, whole, correction, forces,
    )  # fmt: skip
    kept2 = repeated * min(last_error2, noise)
    s.left2 = repeated * s.left2 + (1 - repeated) * left2
    s.error = np.sqrt(max((1 - part) * error2, kept2))
    excess, knows_bias = t.unexplained, s.n_frames > t.bias_known + 0.5
    if s.f_max > 0:
        stated = min(mean_variance(forces, s, t), s.noise)
        lacking = stated - left2
        if knows_bias:
            excess = min(excess, t.unresolved * np.sqrt(2 / m))
    error2 = (1 - part) * error2_of(t.optimism * own, residual2, stated, m, t.significant / 2, t)
    fitted = np.sqrt(np.sqrt(residual2**3 * left2))
    unknown, n_known = np.float32(t.unknown), 0
    for p in range(left.size):
        n_known += left[p] < unknown
    again = repeated if n_known < (1 - t.unread) * left.size else 0.0
    s.n_repeats = again * (s.n_repeats + 1)
    least = again * s.stated_error**2 * s.n_repeats / (s.n_repeats + 1)
    error2 = max((1 + 1 / np.sqrt(m)) ** 2 * min(error2, fitted), kept2, lacking, least)
    s.stated_error = np.sqrt(error2)
    if largest == 0:
        s.silence += t.noise_rate * (1 - s.silence)
    else:
        s.silence *= t.silence_kept
        noise = max(noise * (1 - s.silence), s.noise_sd**2)
    of_skin, most = noise / s.trust, t.untouched if knows_bias else t.most_bias**2
    untouched = power <= most * of_skin and left2 <= (1 + excess) * of_skin
    s.trusted = untouched or error2 <= t.trusted**2 * power
    sd = np.sqrt(s.least_noise)
    more = (along / (ones2 + TINY) if ones2 > t.dust * x.size else 0.0) + unpressed / x.size
    n_frames = s.n_frames + 1
    rate = max(t.bias_begins / (n_frames + t.bias_begins), t.bias_rate)
    bias = s.bias + rate * min(max(more, -sd / 2), sd / 2)
    bias = min(max(bias, 0.0), t.most_bias * sd)
    bias = (1 - repeated) * bias + repeated * s.bias
    s.n_frames, s.bias = n_frames - repeated, 0.0 if bias < 1e-3 * sd else bias


@compiled()
def root_of(parents: A, k: int) -> int:
    """Least label of the labels that are one component."""
    while parents[k] != k:
        k = parents[k]
    return k


@compiled((M, float32, float64, V, DM, int32[::1], int64))
def components(
    forces: A, low: float, high: float, variances: A, places: A, regions: A, n_regions: int
) -> tuple[A, A, A, A, int]:
    """The same as `components` of the module `contacts`, but for rounding, in one scan."""
    (n_rows, n_cols), k = forces.shape, places.shape[0]
    flat = forces.reshape(-1)
    index, grid = np.empty(flat.size, np.int64), np.full(flat.size, -1, np.int32)
    most = ((n_rows + 1) // 2) * ((n_cols + 1) // 2)
    parents, wanted = np.empty(most, np.int64), np.zeros(most, np.bool_)
    n_pressed, n_labels = 0, 0
    for i in range(n_rows):
        for j in range(n_cols):
            p = i * n_cols + j
            if not flat[p] > low:
                regions[p] = 0
                continue
            index[n_pressed] = p
            n_pressed += 1
            # Of the four before it, the one above is beside the others, and the left two are
            # beside each other: those are one component already.
            label = grid[p - n_cols] if i else -1
            if label < 0:
                label = grid[p - 1] if j else -1
                if label < 0 and i and j:
                    label = grid[p - n_cols - 1]
                other = grid[p - n_cols + 1] if i and j + 1 < n_cols else -1
                if label < 0:
                    label = other
                elif other >= 0:
                    label, other = root_of(parents, label), root_of(parents, other)
                    parents[max(label, other)] = min(label, other)
            if label < 0:
                label = n_labels
                parents[label] = label
                n_labels += 1
            grid[p] = label
            wanted[label] |= flat[p] > high or regions[p] > 0
    for label in range(n_labels - 1, -1, -1):  # a parent has a lower label
        wanted[parents[label]] |= wanted[label]
    n = 0
    for label in range(n_labels):
        if parents[label] < label:
            parents[label] = parents[parents[label]]
        elif wanted[label]:
            parents[label] = n
            n += 1
        else:
            parents[label] = -1
    labels, n_kept = np.empty(n_pressed, np.int64), 0
    sums, overlap = np.zeros((4 + 2 * k, n)), np.zeros((n, n_regions), np.int64)
    for t in range(n_pressed):
        p = index[t]
        c, before = parents[grid[p]], regions[p]
        regions[p] = c + 1
        if c < 0:
            continue
        index[n_kept], labels[n_kept] = p, c
        n_kept += 1
        value = np.float64(flat[p])
        sums[0, c] += value
        sums[1, c] += 1
        sums[2, c] = max(sums[2, c], value)
        sums[3 + k, c] += variances[p]
        for d in range(k):
            sums[3 + d, c] += value * places[d, p]
        if before:
            overlap[c, before - 1] += 1
    for c in range(n):
        for d in range(k):
            sums[3 + d, c] /= sums[0, c]
    for t in range(n_kept):
        p, c = index[t], labels[t]
        for d in range(k):
            off = places[d, p] - sums[3 + d, c]
            sums[4 + k + d, c] += variances[p] * off * off
    for c in range(n):
        for d in range(k):
            sums[4 + k + d, c] /= sums[0, c] ** 2
    return index[:n_kept], labels[:n_kept], sums, overlap, n_pressed


LOOPS: tuple[Callable[..., Any], ...] = (*(orthonormal, skin_frame, fista, haar_image, components),)
"""All loops that Python calls."""
