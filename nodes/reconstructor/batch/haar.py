"""The Haar model of a batch: iterations in randomly shifted Haar, as many as each patch needs."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Indices
from sparseskin.nodes.reconstructor.skin.solver import N_DRAWN
from sparseskin.nodes.reconstructor.skin.tuning import TUNING

from .backend import Array
from .state import State
from .tables import Tables

#: What an iteration reads of a frame.
READ = ("haar_start", "target", "weights", "threshold", "least", "n_haar", "next_shift")


def first_carry(t: Tables, x: Array) -> State:
    """Return what goes from iteration to iteration: x, z, the sum of the last x, and k."""
    k = t.be.double(x[:, 0]) * 0
    return {"x": x, "z": x, "sum": t.be.xp.zeros_like(x), "k": k}


def iterate(t: Tables, frame: State, carry: State) -> State:
    """Do iteration k of the patches that still need one.

    Parameters
    ----------
    t : Tables
    frame : State
        As of `begin`; `READ` is read.
    carry : State
        As of `first_carry`; not modified.
    """
    be, xp = t.be, t.be.xp
    weights, z, k = frame["weights"], carry["z"], carry["k"]
    r = frame["target"] - t.transform(z) * weights
    limit = xp.maximum(frame["threshold"] * xp.sqrt(be.dot(r, r)), frame["least"])
    lambda2 = be.column(limit * limit + TINY)
    u = t.transform(r * weights) + z
    shifted = xp.remainder(frame["next_shift"] + k, be.number(N_DRAWN))
    shift = xp.take(t.shifts, xp.astype(shifted, be.i64), axis=0)
    c = _gather(t, u if t.n_canvas == t.n else t.with_zero(u), t.to_canvas, shift)
    c = xp.reshape(xp.reshape(c, (-1, 64)) @ t.haar_adjoint, c.shape)
    # The nonnegative garrote.
    c2 = xp.maximum(c * c, lambda2)
    c = c - c * (lambda2 / c2)
    c = xp.reshape(xp.reshape(c, (-1, 64)) @ t.haar, c.shape)
    found = be.positive(_gather(t, c, t.from_canvas, shift))
    active = k < frame["n_haar"]
    x = be.choose(active, found, carry["x"])
    summed = active & (k >= frame["n_haar"] - TUNING.averaged)
    return {
        "x": x,
        "z": x + (x - carry["x"]) * TUNING.momentum,
        "sum": carry["sum"] + x * be.column(be.double(summed)),
        "k": k + 1,
    }


def _gather(t: Tables, vectors: Array, table: Array, shift: Array) -> Array:
    """Return vectors, (b, k), in the order of a table, (n_shifts, l), at shifts, (b,)."""
    xp, (b, k) = t.be.xp, vectors.shape
    places = xp.take(table, shift, axis=0)
    places = places + (t.be.count(b) * k)[:, None]
    found = xp.take(xp.reshape(vectors, (-1,)), xp.reshape(places, (-1,)), axis=0)
    return xp.reshape(found, (b, -1))


def mean_of(t: Tables, frame: State, carry: State) -> Array:
    """Return the mean of the last iterates, float32 (b, n); x where there were none."""
    count = t.be.at_most(frame["n_haar"], float(TUNING.averaged))
    mean = carry["sum"] * t.be.column(1 / t.be.at_least(count, 1.0))
    return t.be.choose(count > 0, mean, carry["x"])


def estimate(t: Tables, frame: State) -> Array:
    """Return the estimate by the Haar model, float32 (B, n).

    The host waits for the numbers of iterations; patches that are done leave the batch.
    """
    be, xp = t.be, t.be.xp
    counts = be.numpy(frame["n_haar"])
    rest = np.arange(counts.size)
    part = {name: frame[name] for name in READ}
    carry = first_carry(t, frame["haar_start"])
    found, order, done = [], [], 0
    for count in np.unique(counts):
        for _ in range(done, int(count)):
            carry = iterate(t, part, carry)
        done = int(count)
        ends = counts[rest] == count
        found.append(_some(t, {"x": mean_of(t, part, carry)}, np.flatnonzero(ends))["x"])
        order.append(rest[ends])
        if ends.all():
            break
        stay = np.flatnonzero(~ends)
        rest, part, carry = rest[stay], _some(t, part, stay), _some(t, carry, stay)
    places = np.argsort(np.concatenate(order))
    return xp.take(xp.concat(found, axis=0), be.array(places), axis=0)


def _some(t: Tables, arrays: State, chosen: Indices) -> State:
    """Return the arrays of some patches, by their numbers."""
    places = t.be.array(chosen.astype(np.int64))
    return {name: t.be.xp.take(array, places, axis=0) for name, array in arrays.items()}
