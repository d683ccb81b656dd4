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

# Types of signatures: vector, matrix, places in 32 and in 16 bits, groups, grid.
V, M, P, S = "float32[::1]", "float32[:,::1]", "uint32[::1]", "uint16[::1]"
G, L = "int64[:,::1]", "int64[::1]"


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


@compiled(f"void({V}, {V}, {V}, {V}, {V}, {V}, {V}, {S}, {V}, {V}, {G}, {L}, {V})")
def fista(
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


@compiled(
    f"void({V}, {V}, {V}, {V}, {V}, {S}, {S}, {V}, {V}, {V}, {G}, float64, float64, "
    f"float64, boolean)"
)
def skin_step(
    x: A, z: A, r: A, target: A, total: A, to_canvas: A, from_canvas: A, canvas: A, u: A,
    measured: A, groups: A, threshold: float, least: float, momentum: float, summed: bool,
) -> None:  # fmt: skip
    """One iteration of the solver `skin`: r, x, z, and the total if `summed`."""
    n = x.size
    for p in range(n):
        u[p] = z[p]
    hadamard(u[:n], groups)
    for p in range(n):
        r[p] = target[p] - measured[p] * u[p]
        u[p] = measured[p] * r[p]
    power = dot(r, r)
    hadamard(u[:n], groups)
    for p in range(n):
        u[p] = u[p] + z[p]
    limit = max(threshold * np.sqrt(np.float64(power)), least)
    lambda2 = np.float32(limit * limit + 1e-30)
    for k in range(canvas.size):
        canvas[k] = u[to_canvas[k]]
    shrink(canvas, lambda2)
    beta = np.float32(momentum)
    for p in range(n):
        after = max(canvas[from_canvas[p]], np.float32(0))
        z[p] = after + beta * (after - x[p])
        x[p] = after
    if summed:
        for p in range(n):
            total[p] += x[p]


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


@compiled(f"float64({V}, boolean, {V}, {V}, {V}, {G}, {V}, {M}, {V})")
def stay(
    x: A, known: bool, y: A, read: A, scale: A, groups: A, whole: A, rows: A, innovation: A
) -> float:
    """whole = W x unless known, rows[0] = Phi x, innovation = y - Phi x; return its square."""
    row = rows[0]
    if not known:
        for k in range(x.size):
            whole[k] = x[k]
        hadamard(whole, groups)
        for k in range(x.size):
            whole[k] *= scale[k]
    for k in range(x.size):
        row[k] = read[k] * whole[k]
        innovation[k] = y[k] - row[k]
    return np.float64(dot(innovation, innovation))


@compiled(
    f"float64({V}, {V}, {V}, float64, float64, float64, float64, uint32[:,::1], uint32[:,::1], "
    f"{M}, {M}, {V}, {G}, {V}, {V})"
)
def move(
    x: A, y: A, innovation: A, e2: float, most: float, least_gain: float, freedom: float,
    after: A, before: A, terms: A, rows: A, measured: A, groups: A, moved: A, moved_innovation: A,
) -> float:  # fmt: skip
    """Add to x the combination of x and its two slopes that fits the innovation best, in place.

    Return the squared innovation after it. Nothing is added unless it falls from e2 below most, by
    more than least_gain, and by more than what remains over freedom.
    after and before: places of the next and the last neighbour by row and column.
    """
    for axis in range(2):
        ahead, behind = after[axis], before[axis]
        slope, row = terms[axis + 1], rows[axis + 1]
        for k in range(x.size):
            slope[k] = x[ahead[k]] - x[behind[k]]
            row[k] = slope[k]
        hadamard(row, groups)
        for k in range(x.size):
            row[k] *= measured[k]
    n = x.size
    xx, xr, xc = dot(rows[0], rows[0]), dot(rows[1], rows[0]), dot(rows[2], rows[0])
    rr, rc, cc = dot(rows[1], rows[1]), dot(rows[2], rows[1]), dot(rows[2], rows[2])
    bx, br, bc = dot(rows[0], innovation), dot(rows[1], innovation), dot(rows[2], innovation)
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
    if not (explained > least_gain and explained * freedom > max(0.0, e2 - explained)):
        return e2
    top = np.float32(0)
    for k in range(n):
        top = max(top, x[k])
    top = np.float32(top * max(1.0, 1 + by_x))
    a, b, c = np.float32(by_x), np.float32(by_row), np.float32(by_col)
    for k in range(n):
        there = x[k] + (a * x[k] + b * terms[1, k] + c * terms[2, k])
        moved[k] = min(max(there, np.float32(0)), top)
        moved_innovation[k] = moved[k]
    hadamard(moved_innovation, groups)
    for k in range(n):
        moved_innovation[k] = y[k] - measured[k] * moved_innovation[k]
    moved_e2 = np.float64(dot(moved_innovation, moved_innovation))
    if not moved_e2 < most:
        return e2
    for k in range(n):
        x[k] = moved[k]
        innovation[k] = moved_innovation[k]
    return moved_e2


@compiled(f"float64({V}, boolean, {V}, {V}, {V}, {G}, {V}, {V}, {V})")
def compare_rows(
    x: A, moved: bool, y: A, read: A, scale: A, groups: A, whole: A, values: A, rows: A
) -> float:
    """Add W x - whole to values, then replace those that y measures; return that change squared."""
    if moved:
        for k in range(x.size):
            rows[k] = x[k]
        hadamard(rows, groups)
        for k in range(x.size):
            row = scale[k] * rows[k]
            values[k] += row - whole[k]
            whole[k] = row
    for k in range(y.size):
        rows[k] = read[k] * (y[k] - values[k])
        values[k] += rows[k]
    return np.float64(dot(rows, rows))


@compiled(f"void(float64, float64, {V}, {V}, {V}, {V}, {V}, {V}, {V})")
def follow_rows(
    weight: float, counted: float, read: A, known: A, values: A, whole: A, scale: A, weights: A,
    target: A,
) -> None:  # fmt: skip
    """Set the weights of all rows, times their scale, and the target by those weights."""
    k, w = np.float32(weight), np.float32(counted)
    rest = np.float32(1) - w
    for i in range(read.size):
        known[i] = max(known[i], read[i])
        counts = known[i] * w + read[i] * rest
        weights[i] = counts * scale[i]
        target[i] = ((values[i] - whole[i]) * k + whole[i]) * counts


@compiled(f"void({V}, {P}, float64, {V})")
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


@compiled(f"void({V}, {P}, {L}, {V}, {V}, {V})")
def tiled_image(w: A, order: A, grid: A, v: A, scratch: A, image: A) -> None:
    """Image of Haar coefficients w of a tiled vector; element p of it is pixel order[p]."""
    v[:] = w
    unpyramid(v[: grid[1] * grid[2]], grid[1], grid[2], scratch)
    double(v, grid[0])
    for p in range(v.size):
        image[order[p]] = v[p]


LOOPS: dict[str, tuple[Callable[..., Any], ...]] = {
    "skin": (
        *(dealt_forward, dealt_adjoint, stay, move, skin_step, add_bias),
        *(compare_rows, follow_rows),
    ),
    "fista": (fista, tiled_image),
}
"""Loops of each solver, by its name."""
