# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"
"""The iterations of one patch, in Triton; imported where Triton is installed."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def iterate(
    x0,
    target0,
    weights0,
    out,
    signs0,
    steps0,
    steps_adjoint0,
    norms0,
    to_canvas,
    from_canvas,
    shifts,
    next_shift,
    n_haar,
    threshold0,
    least0,
    n,
    PLACES: tl.constexpr,
    BLOCK: tl.constexpr,
    SCALE: tl.constexpr,
    MOMENTUM: tl.constexpr,
    AVERAGED: tl.constexpr,
    N_DRAWN: tl.constexpr,
    LEAST2: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Do all iterations of a patch; see `haar.iterate` for one, and `FusedIterations`."""
    patch = tl.program_id(0)
    places = tl.arange(0, PLACES)
    exists = places < n
    at = patch * n + places
    x = tl.load(x0 + at, mask=exists, other=0.0)
    target = tl.load(target0 + at, mask=exists, other=0.0)
    weights = tl.load(weights0 + at, mask=exists, other=0.0)
    rows = tl.arange(0, BLOCK)
    signs = tl.load(signs0 + rows[:, None] * BLOCK + rows[None, :])
    cells = tl.arange(0, 64)
    steps = tl.load(steps0 + cells[:, None] * 64 + cells[None, :])
    steps_adjoint = tl.load(steps_adjoint0 + cells[:, None] * 64 + cells[None, :])
    norms = tl.load(norms0 + cells)[None, :]
    count = tl.load(n_haar + patch)
    first = tl.load(next_shift + patch)
    threshold = tl.load(threshold0 + patch)
    least = tl.load(least0 + patch)

    z = x
    total = tl.zeros([PLACES], dtype=tl.float32)
    for k in range(count):
        shift = tl.load(shifts + (first + k) % N_DRAWN)
        w = tl.dot(tl.reshape(z, [PLACES // BLOCK, BLOCK]), signs, input_precision=PRECISION)
        r = target - weights * SCALE * tl.reshape(w, [PLACES])
        limit = tl.maximum(threshold * tl.sqrt(tl.sum(r * r, axis=0)), least)
        lambda2 = limit * limit + LEAST2
        r = r * weights
        u = tl.dot(tl.reshape(r, [PLACES // BLOCK, BLOCK]), signs, input_precision=PRECISION)
        u = tl.reshape(u, [PLACES]) * SCALE + z
        c = tl.gather(u, tl.load(to_canvas + shift * PLACES + places), 0)
        c = tl.dot(tl.reshape(c, [PLACES // 64, 64]), steps_adjoint, input_precision=PRECISION)
        c = c * norms
        c = c - c * (lambda2 / tl.maximum(c * c, lambda2))
        c = tl.dot(c * norms, steps, input_precision=PRECISION)
        found = tl.gather(
            tl.reshape(c, [PLACES]), tl.load(from_canvas + shift * PLACES + places), 0
        )
        found = tl.where(exists, tl.maximum(found, 0.0), 0.0)
        z = found + MOMENTUM * (found - x)
        x = found
        total += tl.where(k >= count - AVERAGED, x, 0.0)
    mean = total / tl.maximum(tl.minimum(count, AVERAGED), 1)
    tl.store(out + at, tl.where(count > 0, mean, x), mask=exists)
