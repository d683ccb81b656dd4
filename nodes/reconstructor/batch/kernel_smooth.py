# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"
"""The smooth model of one patch, in Triton; imported where Triton is installed."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def _transform(x, signs, SCALE: tl.constexpr, PRECISION: tl.constexpr):
    """Return W x."""
    rows = tl.reshape(x, [x.shape[0] // signs.shape[0], signs.shape[0]])
    return tl.reshape(tl.dot(rows, signs, input_precision=PRECISION), [x.shape[0]]) * SCALE


@triton.jit
def _correlated(
    rows,
    deviation,
    signs,
    to_image,
    from_image,
    lefts0,
    rights0,
    SCALE: tl.constexpr,
    N_ROWS: tl.constexpr,
    N_COLS: tl.constexpr,
    LENGTHS: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Return C W^T rows; 0 where no taxel is."""
    x = _transform(rows, signs, SCALE, PRECISION)
    image = tl.reshape(tl.gather(x, to_image, 0), [N_ROWS, N_COLS]) * deviation
    down = tl.arange(0, N_ROWS)
    right = tl.arange(0, N_COLS)
    total = tl.zeros([N_ROWS, N_COLS], dtype=tl.float32)
    for k in range(LENGTHS):
        square = N_ROWS * N_ROWS
        left = tl.load(lefts0 + k * square + down[:, None] * N_ROWS + down[None, :])
        square = N_COLS * N_COLS
        other = tl.load(rights0 + k * square + right[:, None] * N_COLS + right[None, :])
        half = tl.dot(left, image, input_precision=PRECISION)
        total += tl.dot(half, other, input_precision=PRECISION)
    total = tl.reshape(total * deviation, [N_ROWS * N_COLS])
    found = tl.gather(total, tl.maximum(from_image, 0), 0)
    return tl.where(from_image >= 0, found, 0.0)


@triton.jit
def estimate(
    x0,
    values0,
    variance0,
    used0,
    out,
    needed0,
    cold0,
    power0,
    kept0,
    signs0,
    lefts0,
    rights0,
    blur_left0,
    blur_right0,
    neighbours0,
    exists0,
    to_image0,
    from_image0,
    n,
    PLACES: tl.constexpr,
    N_ROWS: tl.constexpr,
    N_COLS: tl.constexpr,
    BLOCK: tl.constexpr,
    SCALE: tl.constexpr,
    LENGTHS: tl.constexpr,
    ROUNDS: tl.constexpr,
    COLD_ROUNDS: tl.constexpr,
    GRADIENTS: tl.constexpr,
    COLD_GRADIENTS: tl.constexpr,
    FLOOR: tl.constexpr,
    MODEL_ERROR: tl.constexpr,
    PRECISE: tl.constexpr,
    TINY: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Estimate a patch where that is needed; see `SmoothBatch.estimate`."""
    patch = tl.program_id(0)
    places = tl.arange(0, PLACES)
    exists = places < n
    at = patch * n + places
    if tl.load(needed0 + patch) == 0:
        tl.store(out + at, tl.zeros([PLACES], dtype=tl.float32), mask=exists)
    else:
        rows = tl.arange(0, BLOCK)
        signs = tl.load(signs0 + rows[:, None] * BLOCK + rows[None, :])
        down = tl.arange(0, N_ROWS)
        right = tl.arange(0, N_COLS)
        cells = down[:, None] * N_COLS + right[None, :]
        present = tl.load(exists0 + cells)
        to_image = tl.load(to_image0 + places)
        from_image = tl.load(from_image0 + places)
        cold = tl.load(cold0 + patch)
        power = tl.load(power0 + patch)
        used = tl.load(used0 + at, mask=exists, other=0.0)
        values = tl.load(values0 + at, mask=exists, other=0.0)
        variance = tl.load(variance0 + at, mask=exists, other=0.0)
        x = tl.load(x0 + at, mask=exists, other=0.0)
        x = tl.where(cold > 0, 0.0, x)
        start = x * tl.load(kept0 + patch)
        known = used * (values - _transform(start, signs, SCALE, PRECISION))
        n_used = tl.sum(used, axis=0)
        known2 = tl.sum(known * known, axis=0)
        n_rounds = tl.where(cold > 0, COLD_ROUNDS, ROUNDS)
        n_gradients = tl.where(cold > 0, COLD_GRADIENTS, GRADIENTS)
        for number in range(n_rounds):
            image = tl.reshape(tl.gather(tl.maximum(x, 0.0), to_image, 0), [N_ROWS, N_COLS])
            left = tl.load(blur_left0 + down[:, None] * N_ROWS + down[None, :])
            other = tl.load(blur_right0 + right[:, None] * N_COLS + right[None, :])
            half = tl.dot(left, image * present, input_precision=PRECISION)
            blurred = tl.dot(half, other, input_precision=PRECISION)
            blurred = blurred / tl.load(neighbours0 + cells)
            largest = tl.max(tl.max(tl.where(present > 0, blurred, 0.0), axis=1), axis=0)
            relative = blurred / tl.where(largest > 0, largest, 1.0) + FLOOR
            plain = (largest <= 0) | ((cold > 0) & (number == 0))
            deviation = present * tl.where(plain, 1.0, relative)
            mean = tl.sum(tl.sum(deviation * deviation, axis=1), axis=0) / n
            scale = known2 / tl.maximum(n_used * mean, TINY)
            added = variance / tl.maximum(scale, TINY) + MODEL_ERROR * mean
            added = tl.where(used > 0, added, 1.0)
            inverse = 1.0 / (added + mean)
            found = tl.zeros([PLACES], dtype=tl.float32)
            residual = known
            direction = inverse * residual
            slope = tl.sum(residual * direction, axis=0)
            residual2 = known2
            done = 0
            while (done < n_gradients) & (residual2 > PRECISE * known2):
                product = _correlated(
                    direction,
                    deviation,
                    signs,
                    to_image,
                    from_image,
                    lefts0,
                    rights0,
                    SCALE,
                    N_ROWS,
                    N_COLS,
                    LENGTHS,
                    PRECISION,
                )
                product = _transform(product, signs, SCALE, PRECISION) * used + added * direction
                curvature = tl.sum(direction * product, axis=0)
                goes = (curvature > 0) & (slope > 0)
                step = tl.where(goes, slope / tl.where(goes, curvature, 1.0), 0.0)
                found += step * direction
                residual -= step * product
                scaled = inverse * residual
                new = tl.sum(residual * scaled, axis=0)
                direction = scaled + (new / tl.where(goes, slope, 1.0)) * direction
                slope = new
                residual2 = tl.sum(residual * residual, axis=0)
                done = tl.where(goes, done + 1, n_gradients)
            field = _correlated(
                found,
                deviation,
                signs,
                to_image,
                from_image,
                lefts0,
                rights0,
                SCALE,
                N_ROWS,
                N_COLS,
                LENGTHS,
                PRECISION,
            )
            x = tl.maximum(start + field, 0.0)
        gain = power / (power + variance + TINY) * used
        residual = gain * (values - _transform(x, signs, SCALE, PRECISION))
        x = tl.maximum(x + _transform(residual, signs, SCALE, PRECISION), 0.0)
        tl.store(out + at, x, mask=exists)
