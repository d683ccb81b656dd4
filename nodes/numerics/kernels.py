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

from .compiled import compiled

A: TypeAlias = Any
"""An array; mypy and numba read its type differently."""

MOST_ROWS = 32
"""Rows up to which loops are faster than BLAS. Measured: at 20 rows 1.25 times, at 40 0.9 times."""
_ROOT_2 = np.float32(np.sqrt(2.0))

# Types of signatures: vector, matrix, places and tables of them, groups, grid, numbers and tables
# of them.
V, M, P = "float32[::1]", "float32[:,::1]", "uint32[::1]"
P2, P3 = "uint32[:,::1]", "uint32[:,:,::1]"
G, L, D, DM = "int64[:,::1]", "int64[::1]", "float64[::1]", "float64[:,::1]"


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


@compiled(f"void({V}, {V}, {V}, {V}, {V}, {V}, {V}, {P}, {V}, {V}, {G}, {L}, {V})")
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


@compiled(f"void({V}, {L}, {V})")
def haar_image(v: A, grid: A, half: A) -> None:
    """Replace Haar coefficients, of the scale of `haar`, by their image."""
    haar_transposed(v, grid[0], grid[1], half)


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
def haar_shrink(w: A, numbers: A, s: A, d: A) -> None:
    """Shrink the tiles of windows (t, 144), as in `formula`; numbers: from place 12 on.

    Columns of s and d are tiles. s holds the taxels, and their sums at each level: its first 64
    rows are the result. d holds the details; its row 64 becomes the expected squared error.
    """
    strict, least, half = np.float32(numbers[12]), np.float32(numbers[13]), np.float32(0.5)
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
        error[t] = min(max(expected, np.float32(numbers[6])), one)
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


@compiled(f"void({V}, {G}, {V})")
def orthonormal(v: A, groups: A, scale: A) -> None:
    """Transform a dealt vector in place by W = W^T, orthonormal; scale: that of each place."""
    hadamard(v, groups)
    for p in range(scale.size):
        v[p] *= scale[p]


@compiled(f"void({V}, {V}, {V}, {L}, {P2}, {G}, {V}, {D}, {M}, {M}, {V}, {V}, {V}, {V})")
def skin_predict(
    x: A, whole: A, values: A, read: A, neighbours: A, groups: A, scale: A, numbers: A,
    slopes: A, rows: A, correction: A, predicted: A, moved: A, innovation: A,
) -> None:  # fmt: skip
    """Predict a frame, as in `FrameVectors`; slopes and rows are scratch, predicted, moved and
    innovation the results. numbers: ridge, motion, noise; results: the sums of squares of the
    innovation and of the last correction, and the sum of their products.
    """
    n, largest, energy = x.size, np.float32(0), 0.0
    for k in range(2):
        for p in range(n):
            slopes[k, p] = x[neighbours[k, p]] - x[neighbours[2 + k, p]]
        rows[k] = slopes[k]
        orthonormal(rows[k], groups, scale)
    for p in range(n):
        largest = max(largest, x[p])
        energy += np.float64(x[p]) * np.float64(x[p])
    gram, right = np.zeros((3, 3)), np.zeros(3)
    for i in range(read.size):
        r = read[i]
        e = np.float64(values[i] - whole[r])
        seen = (np.float64(whole[r]), np.float64(rows[0, r]), np.float64(rows[1, r]))
        for j in range(3):
            right[j] += seen[j] * e
            for k in range(3):
                gram[j, k] += seen[j] * seen[k]
    unseen = max(0.0, energy * read.size / n - gram[0, 0])
    gram[0, 0] += unseen * numbers[2] / (numbers[2] + gram[0, 0] / read.size)
    least = numbers[0] ** 2 * gram[0, 0] + numbers[2]
    for j in range(3):
        gram[j, j] += numbers[0] * gram[j, j] + least
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
    a *= explained / (explained + numbers[1] * numbers[2])
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
    numbers[3], numbers[4], numbers[5] = power, of_last, of_both


@compiled()
def loosened(variance: A, prior: float, doubt: float) -> Any:
    """Variance of errors that are not independent of each other; doubt: in noise variances."""
    return min(prior * variance * (1 + doubt * variance), 1e34)


@compiled(f"void({V}, {V}, {V}, {V}, {L}, {V}, {V}, {V}, {V}, {V}, {V}, {D}, {D})")
def skin_filter(
    values: A, innovation: A, moved: A, whole: A, read: A, mean: A, left: A, change: A,
    target: A, variance: A, off_target: A, recall: A, numbers: A,
) -> None:  # fmt: skip
    """Filter all rows, as in `FrameVectors`; left: variance that their measurements left.

    numbers: noise, signal, error2, floor, significant, prior, doubt, recall memory and ridge; the
    last becomes the mean variance of the targets of the rows read.
    """
    noise, signal, floor = numbers[0], numbers[1], numbers[3]
    n, n_read, doubt = mean.size, read.size, numbers[6] / noise
    unknown, n_known, seen, expected = np.float32(1e34), 0, 0.0, 0.0
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
        expected = noise + expected / n_known
        more = max(0.0, seen / n_known - expected)
        z2 = more * more * n_read / (2 * expected * expected + 1e-30)
        changed = more * z2 / (z2 + numbers[4] ** 2)
    grown = np.float32(changed)
    prior = np.float32(loosened(np.float32(max(signal, numbers[2])), numbers[5], doubt))
    for p in range(n):
        change[p] = min(change[p] + grown, unknown)
        wide = np.float32(loosened(change[p], numbers[5], doubt))
        variance[p] = prior / (prior + left[p] + wide)
        target[p] = variance[p] * (mean[p] - moved[p])
    recall *= numbers[7]
    recall[2] += n_known
    for i in range(n_read):
        r = read[i]
        if left[r] + (change[r] - grown) < unknown:
            correction = np.float64(target[r])
            recall[0] += innovation[i] * correction
            recall[1] += correction * correction
    ridge = numbers[8] * noise * recall[2]
    recalled = np.float32(min(max((recall[0] + ridge) / (recall[1] + ridge + 1e-30), 0.0), 1.0))
    for p in range(n):
        variance[p] = prior * (1 - recalled * variance[p])
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
    numbers[9] = total / n_read


@compiled(
    f"void({V}, {M}, {V}, {V}, {L}, {V}, {G}, {V}, {V}, {P3}, {P2}, {M}, {L}, int64, int64, {DM}, "
    f"{M}, {M}, {V}, {M}, {V}, {M}, {V}, {D}, "
    f"{M}, {M}, {M}, {M}, {M}, {M}, {M}, {M}, {M}, {V}, {L})",
    sums_in_any_order=True,
)
def skin_steps(
    z: A, estimates: A, target: A, variance: A, read: A, off_target: A, groups: A, scale: A, v: A,
    windows: A, back: A, share: A, counts: A, first: int, n_formula: int, found: A,
    filters: A, hidden: A, hidden_0: A, gates: A, gates_0: A, synthesis: A, error: A, numbers: A,
    w: A, a: A, levels: A, h: A, g: A, out: A, tiles: A, sums: A, details: A, parts: A, busy: A,
) -> None:  # fmt: skip
    """The steps of a frame, as in `FrameVectors`: found (steps, 2) gets expected squared error and
    squared residual of each, estimates the last ones. windows, back and share are of each shift,
    counts its tiles; others as of `skin_step`.
    """
    n, n_kept = found.shape[0], estimates.shape[0]
    for k in range(n):
        shift, x = (first + k) % counts.size, estimates[max(0, k - (n - n_kept))]
        numbers[14] = 1.0 if k < n_formula else 0.0
        found[k, 0] = skin_step(
            z, x, target, variance, read, off_target, groups, scale, v,
            windows[shift, : counts[shift]], back[shift], share[shift],
            filters, hidden, hidden_0, gates, gates_0, synthesis, error, numbers,
            w, a, levels, h, g, out, tiles, sums, details, parts, busy,
        )  # fmt: skip
        found[k, 1] = numbers[15]


@compiled(sums_in_any_order=True)
def skin_step(
    z: A, x: A, target: A, variance: A, read: A, off_target: A, groups: A, scale: A, v: A,
    windows: A, back: A, share: A,
    filters: A, hidden: A, hidden_0: A, gates: A, gates_0: A, synthesis: A, error: A, numbers: A,
    w: A, a: A, levels: A, h: A, g: A, out: A, tiles: A, sums: A, details: A, parts: A, busy: A,
) -> float:  # fmt: skip
    """A step, as in `FrameVectors`: z and x become the next; return the expected squared error.

    v has a place more than z. Arrays of the last line are scratch.
    numbers: read noise, floor, least tau, most alpha, damping, the constant of the error, that of a
    tile in which nothing stands out, those of `standing_out` and `haar_shrink`, whether that is
    used; the last becomes the mean squared residual of z.
    """
    n, n_tiles, k = z.size, windows.shape[0], filters.shape[0]
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
    numbers[15] = residual2 / read.size
    tau = np.float32(max(rho - numbers[0], numbers[2] * max(rho, numbers[0])) + numbers[1])
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
    w, a, levels = w[:n_busy], a[:n_busy], levels[:n_busy]
    h, g, out = h[:n_busy], g[:n_busy], out[:n_busy]
    if n_busy and numbers[14] > 0:
        haar_shrink(w, numbers, sums, details)
        for b in range(n_busy):
            e = np.float64(details[64, b])
            expected += share[busy[b]] * (numbers[6] + parts[b] * (e - numbers[6]))
            for p in range(64):
                tiles[busy[b], p] = s * parts[b] * max(sums[p, b], none)
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
            logarithm = numbers[5]
            for j in range(h.shape[1]):
                logarithm += h[b, j] * error[j]
            e = np.exp(min(max(logarithm, -12.0), 0.0))
            expected += share[busy[b]] * (numbers[6] + parts[b] * (e - numbers[6]))
            passed = min(max(g[b, k] + gates_0[k], none), one)
            g[b, k] = passed
            for j in range(k):
                a[b, j] *= min(max(g[b, j] + gates_0[j], none), one) - passed
        product(a, synthesis, out)
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
        v[p] = flat[back[p]]
    for p in range(n):
        z[p] += damping * ((v[p] - alpha * x[p]) * more - z[p])
        x[p] = v[p]
    return expected * np.float64(s) ** 2


@compiled(
    f"void({M}, {V}, {V}, {V}, {L}, {V}, {G}, {V}, {D}, {V}, {V}, {V}, {V})",
    sums_in_any_order=True,
)
def skin_settle(
    estimates: A, predicted: A, values: A, ones: A, read: A, moved: A, groups: A, scale: A,
    numbers: A, x: A, whole: A, correction: A, forces: A,
) -> None:  # fmt: skip
    """Settle a frame, as in `FrameVectors`. numbers: part, bias, twice the noise's deviation, least
    force; results: power, residual2, along, unpressed.
    """
    part, bias, near = np.float32(numbers[0]), np.float32(numbers[1]), np.float32(numbers[2])
    mean, least = np.float32((1 - numbers[0]) / len(estimates)), np.float32(numbers[3])
    x[:] = estimates[0]
    for k in range(1, len(estimates)):
        for p in range(x.size):
            x[p] += estimates[k, p]
    power, unpressed, residual2, along = np.float32(0), np.float32(0), 0.0, 0.0
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
            unpressed += one * np.exp(-((one / near) ** 2))
            more = bias * (np.float32(1) - np.exp(-one / bias)) if bias > 0 else bias
            if one + more >= least:
                forces[p] = one + more
        else:
            forces[p] = one + bias
    numbers[4], numbers[5] = power / x.size, residual2 / read.size
    numbers[6], numbers[7] = along, unpressed


@compiled()
def root_of(parents: A, k: int) -> int:
    """Least label of the labels that are one component."""
    while parents[k] != k:
        k = parents[k]
    return k


@compiled(
    f"Tuple(({L}, {L}, {DM}, {G}, int64))({M}, float32, float64, {V}, {DM}, int32[::1], int64)"
)
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


LOOPS: tuple[Callable[..., Any], ...] = (
    *(orthonormal, skin_predict, skin_filter, skin_steps, skin_settle),
    *(fista, haar_image, components),
)
"""All loops that Python calls."""
