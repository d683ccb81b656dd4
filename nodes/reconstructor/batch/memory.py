"""Measurements of the other row subsets of rotating rows, for a batch."""

from __future__ import annotations

from sparseskin.nodes.numerics.arrays import TINY
from sparseskin.nodes.reconstructor.skin.tuning import TUNING

from .backend import Array
from .state import Numbers, State
from .tables import Tables


def recall(t: Tables, state: State, s: Numbers, frame: State, number: int) -> State:
    """Process the rows of a frame as `RowMemory` does; patches without rotation are as before.

    Returns
    -------
    dict
        target, weights: those of the iteration, float32 (B, n); m_counted, float64 (B,); values,
        known: the new memory.
    """
    be, xp, m = t.be, t.be.xp, t.m
    subset = t.subsets[number]
    # Whether rows rotate shows in the second frame, which remembers the first.
    rotating = s["rotating"] | ~s["begun"]
    failed, noise = frame["failed"], frame["known_noise"]
    nothing = xp.zeros_like(frame["y"])
    values = state["values"] + (frame["whole"] - frame["whole_last"])
    values = be.choose(failed, nothing, values)
    known = be.choose(failed, nothing, state["known"])
    change = (frame["y"] - values) * subset.measured
    change2 = be.dot(change, change) / m
    values = values + change
    known = xp.maximum(known, subset.measured)

    none = change2 * 0
    read_in = [be.choose(failed, none, one) for one in s["read_in"]]
    count = be.choose(failed, none, s["remembered"]) + 1
    last = read_in[number]
    read_before = last > 0
    grown = be.choose(
        read_before,
        change2 - 2 * noise,
        frame["e2"] - noise,
    )
    grown = be.at_least(grown, 0.0)
    age = be.choose(read_before, count - last, none + 1)
    drift = be.choose(failed, none, s["drift"])
    drift = xp.maximum(grown / age, TUNING.drift_decay * drift)
    counted = TUNING.memory_weight / xp.sqrt(1 + TUNING.memory_decay * grown / (noise + TINY))
    counted = be.choose(frame["settling"], none, counted)
    read_in[number] = count
    n_known = sum((be.double(one > 0) for one in read_in), none)

    s["read_in"] = [be.choose(rotating, a, b) for a, b in zip(read_in, s["read_in"], strict=True)]
    s["remembered"] = be.choose(rotating, count, s["remembered"])
    s["drift"] = be.choose(rotating, drift, s["drift"])
    weight = be.column(counted)
    weights = known * weight + subset.measured * (1 - weight)
    target = ((values - frame["whole"]) * be.column(frame["gain"]) + frame["whole"]) * weights
    return {
        "target": target,
        "weights": weights,
        "m_counted": m * (1 + counted**2 * (n_known - 1)),
        "values": be.choose(rotating, values, state["values"]),
        "known": be.choose(rotating, known, state["known"]),
    }


def variances(t: Tables, s: Numbers, noise: Array) -> Array:
    """Return the variance of each row, float32 (b, n), as `RowMemory.variances`."""
    be, xp = t.be, t.be.xp
    ages = be.column(noise) * t.subsets[0].measured * 0 - 1
    for subset, frame in zip(t.subsets, s["read_in"], strict=True):
        age = be.column(s["remembered"] - frame)
        read = (subset.measured > 0) & (frame > 0)[:, None]
        newer = read & ((ages < 0) | (age < ages))
        ages = xp.where(newer, age, ages)
    found = be.column(noise) + be.column(TUNING.memory_doubt * s["drift"]) * ages
    return xp.where(ages < 0, xp.zeros_like(found), found)
