"""The begin of a frame of a batch: prediction, noise level, gain, target, iterations."""

from __future__ import annotations

import math

from sparseskin.nodes.numerics.arrays import TINY
from sparseskin.nodes.reconstructor.skin.solver import N_DRAWN
from sparseskin.nodes.reconstructor.skin.tuning import TUNING

from .backend import Array
from .memory import recall
from .state import NUMBERS, Numbers, State, unpack
from .tables import Subset, Tables


def begin(t: Tables, state: State, y: Array, number: int, least: int, most: int) -> State:
    """Begin a frame of all patches.

    Parameters
    ----------
    t : Tables
    state : State
        That of the last frame; not modified.
    y : float32 (B, m)
        Measurements, newtons.
    number : int
        Number of the row subset.
    least, most : int
        Iterations of a frame.

    Returns
    -------
    State
        Of the frame: vectors, float32 (B, n), numbers, float64 (B,), flags; and the changed
        numbers of the state by the name "numbers".
    """
    be, s = t.be, unpack(state[NUMBERS], len(t.subsets))
    subset = t.subsets[number]
    s["rotating"] = s["rotating"] | (s["begun"] & (s["subset"] != number))
    s["subset"] = s["subset"] * 0 + number
    rows = t.rows_of(y, subset)
    frame: State = {"power_read": be.dot(rows, rows) / t.m}
    rows = rows - be.column(s["bias"]) * subset.ones
    frame["y"] = rows
    frame["step"] = y - state[f"y{number}"]
    changed2 = be.dot(frame["step"], frame["step"])
    changed2 = be.choose(s["begun_in"][number] > 0, changed2, changed2 * 0 + math.inf)
    frame |= predict(t, state["x"], rows, s["s2"], changed2, subset)
    jumped = _update_noise(t, state, s, frame, changed2, number)
    settling = s["since_jump"] <= TUNING.settling
    frame |= _update_gain(t, s, frame, state["correction"], settling, subset, number)
    # The past says nothing of the frame.
    frame["nothing_known"] = frame["failed"] | ~s["has_estimate"]
    frame["known_noise"] = be.choose(s["known"], frame["noise"], frame["noise"] * 0)
    _plan(t, s, frame, jumped, settling, least, most)
    # While two models are compared, each goes on from its own last estimate.
    usable = s["has_other"] & ~frame["nothing_known"]
    x, other = frame["x"], state["other"]
    frame["haar_start"] = be.choose(usable & s["is_smooth"], other, x)
    frame["smooth_start"] = be.choose(usable & ~s["is_smooth"], other, x)
    innovation, kept = frame.pop("innovation"), subset.kept
    target = rows - innovation * be.column(1 - frame["gain"])
    frame["weights"] = subset.measured * kept + be.xp.zeros_like(rows)
    if len(t.subsets) > 1:
        frame["settling"] = settling
        remembered = recall(t, state, s, frame, number)
        m_counted = remembered.pop("m_counted")
        rotating = s["rotating"]
        target = be.choose(rotating, remembered.pop("target"), target)
        weights = remembered.pop("weights") * kept
        frame["weights"] = be.choose(rotating, weights, frame["weights"])
        frame["threshold"] = frame["threshold"] * be.choose(
            rotating, be.xp.sqrt(t.m / m_counted), m_counted * 0 + 1
        )
        frame |= remembered
    frame["target"] = target * kept
    s["begun"] = s["begun"] | True
    frame["numbers"] = s
    return frame


def predict(t: Tables, x: Array, rows: Array, s2: Array, changed2: Array, subset: Subset) -> State:
    """Predict a frame by the last, x; as `Prediction.predict`.

    Returns
    -------
    dict
        x and whole, the prediction and W of it; whole_last, W of the last frame; innovation;
        e2, mean squared innovation; flag failed.
    """
    be, xp, m = t.be, t.be.xp, t.m
    y2, seen = be.dot(rows, rows), be.dot(x, x) > 0
    whole_last = t.transform(x)
    innovation = rows - whole_last * subset.measured
    e2 = be.dot(innovation, innovation)
    tries = seen & (e2 > TUNING.motion_still * m * s2)
    found, whole = x, whole_last
    if be.any(tries):
        moved, moved_whole, gains = _move(t, x, whole_last, innovation, subset)
        moved_innovation = rows - moved_whole * subset.measured
        moved_e2 = be.dot(moved_innovation, moved_innovation)
        better = tries & (gains > TUNING.motion_significant * s2)
        better = better & (gains * (max(0, m - 3) / 3) > be.at_least(e2 - gains, 0.0))
        better = better & (moved_e2 < xp.minimum(e2, changed2))
        found = be.choose(better, moved, x)
        whole = be.choose(better, moved_whole, whole_last)
        innovation = be.choose(better, moved_innovation, innovation)
        e2 = be.choose(better, moved_e2, e2)
    left = xp.minimum(e2, changed2)
    failed = seen & (left > TUNING.failed_part * y2) & (left > TUNING.failed_noise * m * s2)
    nothing = xp.zeros_like(x)
    return {
        "x": be.choose(failed, nothing, found),
        "whole": be.choose(failed, nothing, whole),
        "whole_last": whole_last,
        "innovation": be.choose(failed, rows, innovation),
        "e2": be.choose(failed, y2, e2) / m,
        "failed": failed,
    }


def _move(
    t: Tables, x: Array, whole: Array, innovation: Array, subset: Subset
) -> tuple[Array, Array, Array]:
    """Fit x and its differences to the innovation.

    Return the frame moved, W of it, and by how much that explains the innovation better, 0 where
    nothing can be fitted.
    """
    be, xp = t.be, t.be.xp
    around = xp.reshape(xp.take(x, t.neighbours, axis=1), (-1, 4, t.n))
    terms = xp.concat([x[:, None, :], around[:, :2, :] - around[:, 2:, :]], axis=1)
    wholes = xp.concat([whole[:, None, :], t.transform(terms[:, 1:, :])], axis=1)
    fitted = xp.concat([wholes * subset.measured, innovation[:, None, :]], axis=1)
    gram = be.double(fitted @ xp.matrix_transpose(fitted))
    diagonal = [gram[:, k, k] for k in range(3)]
    largest = xp.maximum(xp.maximum(diagonal[0], diagonal[1]), diagonal[2])
    fits = (largest > 0) & xp.isfinite(largest)
    found = _solve(t, gram, 1e-6 * largest, fits)
    gains = found[0] * gram[:, 3, 0] + found[1] * gram[:, 3, 1] + found[2] * gram[:, 3, 2]
    columns = [be.column(one) for one in found]
    moved = x + sum(column * terms[:, k, :] for k, column in enumerate(columns))
    # The unobserved part must not grow without bound, frame after frame.
    highest = be.column(be.at_least(1 + found[0], 1.0)) * xp.max(x, axis=1, keepdims=True)
    moved = xp.minimum(be.positive(moved), highest)
    return moved, t.transform(moved), be.choose(fits, gains, gains * 0)


def _solve(t: Tables, gram: Array, ridge: Array, fits: Array) -> list[Array]:
    """Solve three normal equations by cofactors; the right side is the fourth row of gram."""
    a, d, f = (gram[:, k, k] + ridge for k in range(3))
    b, c, e = gram[:, 1, 0], gram[:, 2, 0], gram[:, 2, 1]
    first = (d * f - e * e, c * e - b * f, b * e - c * d)
    determinant = a * first[0] + b * first[1] + c * first[2]
    second = (first[1], a * f - c * c, b * c - a * e)
    third = (first[2], second[2], a * d - b * b)
    determinant = t.be.choose(fits & (determinant != 0), determinant, determinant * 0 + 1)
    right = [gram[:, 3, k] for k in range(3)]
    return [
        sum((k * r for k, r in zip(row, right, strict=True)), 0 * determinant) / determinant
        for row in (first, second, third)
    ]


def _update_noise(
    t: Tables, state: State, s: Numbers, frame: State, changed2: Array, number: int
) -> Array:
    """Update the noise level as `NoiseLevel.follow`; return `jumped`, bool (B,)."""
    be, xp, m, e2 = t.be, t.be.xp, t.m, frame["e2"]
    differences = s["differences"]
    second = frame["step"] - state[f"step{number}"]
    old = differences[number]
    first = xp.minimum(e2, changed2 / (2 * m))
    seen = be.choose(old > 0, xp.minimum(first, be.dot(second, second) / (6 * m)), first)
    jumped = frame["failed"] | ~s["begun"] | (first > TUNING.jump * s["s2"])
    since = be.choose(jumped, old * 0, s["since_jump"] + 1)
    new = old + 1
    s["known"] = s["known"] | (new > 1)
    doubtful = s["rotating"] & (seen >= TUNING.noise_clearly * e2)
    learning = (since > 0) & (since <= TUNING.noise_relearned) & (seen < s["s2"])
    nearer = be.choose(learning, seen, s["s2"] + TUNING.noise_rate * (seen - s["s2"]))
    fastest = TUNING.noise_growth + be.double(doubtful) * (
        TUNING.noise_growth_rotating - TUNING.noise_growth
    )
    s2 = xp.minimum(nearer, fastest * s["s2"])
    settled = s["settled"]
    s["s2"] = be.choose(settled, s2, seen)
    forgets = settled & jumped
    s["differences"] = [
        be.choose(forgets, one * 0 - float(k != number), new if k == number else one)
        for k, one in enumerate(differences)
    ]
    s["begun_in"] = [one * 0 + 1 if k == number else one for k, one in enumerate(s["begun_in"])]
    s["settled"] = settled | (new == 1)
    s["since_jump"] = since
    return jumped


def _update_gain(
    t: Tables,
    s: Numbers,
    frame: State,
    correction: Array,
    settling: Array,
    subset: Subset,
    number: int,
) -> State:
    """Update gain and trust as `AdaptiveGain.follow`; return gain, noise, nis."""
    be, xp = t.be, t.be.xp
    innovation = frame["innovation"]
    last = t.transform(correction) * subset.measured
    energy = t.m * frame["e2"]
    both = energy * be.dot(last, last)
    alike = be.dot(innovation, last) / xp.sqrt(both + be.double(both <= 0))
    change = xp.exp(TUNING.trust_fall * (TUNING.lagging - alike))
    change = be.choose(alike > TUNING.lagging, change, change * 0 + TUNING.trust_growth)
    trust = be.at_most(be.at_least(s["trust"] * change, TUNING.trust_least), 1.0)
    s["trust"] = be.choose((both > 0) & ~settling, trust, s["trust"])
    noise = s["s2"] * s["trust"]
    nis = energy / t.m / (noise + TINY)
    signal = be.at_least(nis - TUNING.gain_expected, 0.0)
    old = s["gain"][number]
    gain = xp.maximum(old / (1 + old), be.at_least(signal / (1 + signal), TUNING.gain_least))
    gain = be.choose(settling, gain * 0 + 1, gain)
    s["gain"] = [
        gain if k == number else be.choose(settling, one * 0 + 1, one)
        for k, one in enumerate(s["gain"])
    ]
    return {"gain": gain, "noise": noise, "nis": nis}


def _plan(
    t: Tables, s: Numbers, frame: State, jumped: Array, settling: Array, least: int, most: int
) -> None:
    """Set models, iterations and thresholds of a frame."""
    be, xp = t.be, t.be.xp
    gain, nis = frame["gain"], frame["nis"]
    held = TUNING.held_threshold + be.double(s["rotating"]) * (
        TUNING.held_rotating - TUNING.held_threshold
    )
    floor = xp.maximum(
        TUNING.least_threshold * xp.sqrt(frame["noise"] * gain),
        held * xp.sqrt(frame["e2"]) * gain,
    )
    frame["least"] = be.choose(jumped, floor * 0, floor)
    cold = min(TUNING.threshold, TUNING.cold_threshold / math.sqrt(t.n / t.m))
    # In root sums of squares of r.
    threshold = TUNING.threshold + be.double(jumped) * (cold - TUNING.threshold)
    frame["threshold"] = threshold / math.sqrt(t.m)
    more = be.at_least(TUNING.iterations_per_nis * (nis - TUNING.expected_nis), 0.0)
    more = xp.where(more >= 0, be.at_most(more, float(most)), be.number(0.0))
    more = xp.where(settling, be.number(float(most)), more)
    s["wait"] = s["wait"] - 1
    noise = frame["known_noise"]
    touch = frame["power_read"] - noise
    coarse = s["has_estimate"] & s["rotating"] & (touch > TUNING.untouched * noise) & t.tests
    coarse = coarse & (gain >= TUNING.coarse_gain)
    coarse = coarse & (s["error2"] + gain * noise > TUNING.trusted**2 * touch)
    frame["coarse"] = coarse
    due = (s["wait"] <= 0) & (s["exceeds"] | coarse | s["is_smooth"])
    begins = (frame["nothing_known"] | (due & (s["left"] <= 0))) & t.tests
    s["left"] = be.choose(begins, s["left"] * 0 + TUNING.trial, s["left"])
    both = s["left"] > 0
    frame["uses_haar"] = both | ~s["is_smooth"]
    frame["uses_smooth"] = both | s["is_smooth"]
    count = be.at_most(least + xp.floor(more), float(most))
    frame["n_haar"] = count * be.double(frame["uses_haar"])
    frame["next_shift"] = s["next_shift"]
    s["next_shift"] = xp.remainder(s["next_shift"] + frame["n_haar"], be.number(N_DRAWN))
