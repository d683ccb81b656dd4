"""The end of a frame of a batch: choice of the model, clip bias, error, trust, forces."""

from __future__ import annotations

import math

from sparseskin.nodes.numerics.arrays import TINY
from sparseskin.nodes.reconstructor.skin.tuning import TUNING

from .backend import Array
from .memory import variances
from .smooth import Known
from .state import NUMBERS, Numbers, State, pack
from .tables import Tables

#: Numbers of a result.
RESULT = ("error", "trusted", "finite", "is_smooth", "n_steps")


def test(t: Tables, frame: State, x: Array, number: int) -> tuple[Array, Array]:
    """Return W x, and the mean square of the residuals of held-out rows, float64 (B,)."""
    be, xp = t.be, t.be.xp
    whole = t.transform(x)
    if not t.n_held:
        return whole, frame["e2"] * 0
    residual = xp.take(frame["y"] - whole, t.subsets[number].held, axis=1)
    return whole, be.dot(residual, residual) / t.n_held


def tested(t: Tables, frame: State, x: Array, number: int) -> tuple[State, Array, Known]:
    """Test the estimate of the Haar model, float32 (B, n).

    Returns
    -------
    haar : State
        As `finish` takes it.
    needed : bool (B,)
        True for the patches that need the smooth model.
    known : Known
        What the smooth model is given, of all patches.
    """
    whole, error2 = test(t, frame, x, number)
    noise = t.be.xp.minimum(frame["known_noise"], frame["numbers"]["most_noise"])
    exceeds = _excess(error2, noise, max(1, t.n_held)) > 0
    needed = frame["uses_smooth"] & (~frame["uses_haar"] | frame["coarse"] | exceeds)
    haar = {"x": x, "whole": whole, "error2": error2}
    return haar, needed, known_of(t, frame, number)


def finish_smooth(
    t: Tables, frame: State, haar: State, needed: Array, x: Array, number: int, median: bool
) -> tuple[State, State]:
    """End a frame as `finish`; x, float32 (B, n), are the estimates of the smooth model."""
    whole, error2 = test(t, frame, x, number)
    smooth = {"x": x, "whole": whole, "error2": error2, "made": needed}
    return finish(t, frame, haar, smooth, number, median)


def known_of(t: Tables, frame: State, number: int) -> Known:
    """Return what the smooth model is given, of all patches."""
    be, xp, s = t.be, t.be.xp, frame["numbers"]
    rows, subset = frame["y"], t.subsets[number]
    y2 = be.dot(rows, rows) / t.m
    least = frame["known_noise"] + TUNING.least_noise * y2
    power = be.choose(frame["nothing_known"], y2, frame["e2"]) - least
    known = subset.measured + xp.zeros_like(rows)
    values, variance = rows, be.column(least) + xp.zeros_like(rows)
    rotating = s["rotating"]
    if len(t.subsets) > 1:
        known = be.choose(rotating, frame["known"], known)
        values = be.choose(rotating, frame["values"], values)
        variance = be.choose(rotating, variances(t, s, least), variance)
    kept = TUNING.kept_fixed + be.double(rotating) * (TUNING.kept_rotating - TUNING.kept_fixed)
    used = be.single(known > 0) * subset.kept
    return Known(frame["smooth_start"], values, variance, used, be.at_least(power, TINY), kept)


def finish(
    t: Tables, frame: State, haar: State, smooth: State, number: int, median: bool
) -> tuple[State, State]:
    """End a frame of all patches.

    Parameters
    ----------
    t : Tables
    frame : State
        As of `begin`; not modified.
    haar, smooth : State
        Of each model: x and whole, float32 (B, n), error2, the mean square of held-out residuals;
        of smooth also made: bool (B,), where it was made.
    number : int
        Number of the row subset.
    median : bool
        True if the bias of some patch is to be estimated by the median, too.

    Returns
    -------
    state : State
        The changed parts of the next state.
    result : State
        forces, float32 (B, n_rows, n_cols); numbers, float64 (k, B), in the order of `RESULT`.
    """
    be, xp = t.be, t.be.xp
    s = dict(frame["numbers"])
    error2, held2 = _choose(t, s, frame, haar, smooth)
    is_smooth = s["is_smooth"]
    x = be.choose(is_smooth, smooth["x"], haar["x"])
    other = be.choose(is_smooth, haar["x"], smooth["x"])
    whole = be.choose(is_smooth, smooth["whole"], haar["whole"])
    subset = t.subsets[number]
    left = be.dot(frame["y"] - whole, subset.ones + xp.zeros_like(whole))
    # Until the noise is known, held-out residuals bound it, too.
    most = be.choose(s["known"], s["s2"], TUNING.bias_bound * held2) if t.n_held else None
    _update_bias(t, s, left / subset.energy if subset.energy else left * 0, x, most, median)
    power = be.dot(x, x) / t.n
    # A kernel may read what is not a number as 0.
    finite = xp.isfinite(power) & xp.isfinite(frame["power_read"] + s["s2"] + s["bias"])
    error, trusted = _judge(t, frame, x, power, error2, is_smooth)
    s["error2"] = error * error
    s["has_estimate"] = s["has_estimate"] | True
    state = {"x": x, "other": other, "correction": x - frame["x"], NUMBERS: pack(be, s)}
    state |= {name: frame[name] for name in ("values", "known") if name in frame}
    state[f"step{number}"] = frame["step"]
    forces = t.image(_forces(t, x, s["bias"]))
    error = xp.where(finite, error, be.number(math.inf))
    flags = [be.double(one) for one in (trusted & finite, finite, is_smooth)]
    return state, {
        "forces": xp.where(finite[:, None, None], forces, xp.zeros_like(forces)),
        "numbers": xp.stack([error, *flags, frame["n_haar"]], axis=0),
    }


def _excess(mean: Array, noise: Array, count: float) -> Array:
    return mean - noise * (1 + 2 * math.sqrt(2 / count))


def _choose(t: Tables, s: Numbers, frame: State, haar: State, smooth: State) -> tuple[Array, Array]:
    """Choose a model as `HeldOut.choose`.

    Return the mean squared error beyond the noise, and the mean square of the held-out residuals.
    """
    be, xp = t.be, t.be.xp
    noise, failed = frame["known_noise"], frame["nothing_known"]
    bound = xp.minimum(noise, s["most_noise"])
    with_haar, with_smooth = frame["uses_haar"], smooth["made"]
    both, was_smooth = with_haar & with_smooth, s["is_smooth"]
    first = both & (s["left"] == TUNING.trial)
    others = {"haar": first & was_smooth, "smooth": first & ~was_smooth}
    means = {}
    for name, estimate, made in (("haar", haar, with_haar), ("smooth", smooth, with_smooth)):
        now, old = estimate["error2"], s[f"{name}_error"]
        last = be.choose(failed | others[name] | (old < 0), now, old)
        last = xp.minimum(last, TUNING.error_fading * now + bound)
        mean = TUNING.error_memory * last + (1 - TUNING.error_memory) * now
        means[name] = s[f"{name}_error"] = be.choose(made, mean, old)
        worse = made & ~both & (now > TUNING.worse * last)
        s["wait"] = be.choose(worse, now * 0, s["wait"])
    count = max(1, t.n_held)
    frames = count * TUNING.error_frames
    if t.n_held:
        none = noise * 0 + math.inf
        least = xp.minimum(
            be.choose(with_haar, means["haar"], none), be.choose(with_smooth, means["smooth"], none)
        )
        slack = 1 + 2 * math.sqrt(2 / frames)
        s["most_noise"] = xp.minimum(s["most_noise"], slack * least)
    bound = xp.minimum(noise, s["most_noise"])
    s["most_noise"] = TUNING.noise_growth_rotating * s["most_noise"]
    averaged = (1 - frame["gain"] * be.double(s["rotating"])) * bound
    averaged = xp.minimum(averaged, means["smooth"])
    clearly = 1 + 2 * TUNING.margin / math.sqrt(frames)
    better = means["haar"] > clearly * means["smooth"] + averaged
    s["left"] = be.choose(both, s["left"] - 1, noise * 0)
    decides = both & (failed | (s["left"] <= 0))
    longer = be.at_most(2 * s["period"], float(TUNING.seldom))
    longer = be.choose(s["left"] <= 0, longer, s["period"])
    same = (better == was_smooth) & ~frame["coarse"]
    period = be.choose(same, longer, noise * 0 + TUNING.often)
    s["period"] = be.choose(decides, period, s["period"])
    s["wait"] = be.choose(decides, period, s["wait"])
    keeps = both & ~decides & was_smooth
    is_smooth = (decides & better) | keeps | (with_smooth & ~with_haar)
    s["is_smooth"], s["has_other"] = is_smooth, both
    # The gain has fallen meanwhile, without the noise of the smooth model.
    s["since_jump"] = be.choose(was_smooth & ~is_smooth, noise * 0, s["since_jump"])
    mean = be.choose(is_smooth, means["smooth"], means["haar"])
    now = be.choose(is_smooth, smooth["error2"], haar["error2"])
    excess = xp.maximum(_excess(mean, noise, frames), _excess(now, noise, count))
    s["exceeds"] = xp.maximum(_excess(mean, bound, frames), _excess(now, bound, count)) > 0
    return be.at_least(excess, 0.0), now


def _update_bias(
    t: Tables, s: Numbers, more: Array, x: Array, most: Array | None, median: bool
) -> None:
    """Update the clip bias as `ClipBias.update`."""
    be, xp = t.be, t.be.xp
    frames = s["bias_frames"] + 1
    if median:
        ordered = xp.sort(x, axis=1)
        middle = (ordered[:, (t.n - 1) // 2] + ordered[:, t.n // 2]) * 0.5
        uses = (frames <= t.median_first) | (
            xp.remainder(frames, be.number(TUNING.median_every)) == 0
        )
        more = more + be.choose(uses, be.double(middle), more * 0)
    s["least_s2"] = xp.minimum(TUNING.bias_forgotten * s["least_s2"], s["s2"])
    noise = xp.sqrt(s["least_s2"] if most is None else xp.minimum(s["least_s2"], most))
    more = xp.minimum(xp.maximum(more, -noise / 2), noise / 2)
    rate = be.at_least(1 / (frames + 1), TUNING.bias_slowest)
    bias = be.at_least(s["bias"] + rate * more, 0.0)
    s["bias"] = xp.minimum(bias, TUNING.bias_largest * noise)
    s["bias_frames"] = frames


def _judge(
    t: Tables, frame: State, x: Array, power: Array, beyond: Array, is_smooth: Array
) -> tuple[Array, Array]:
    """Return error and trust of the estimate, as `SkinSolver`."""
    be, xp = t.be, t.be.xp
    if not t.tests:
        return power * 0, power >= 0
    noise = frame["known_noise"]
    touched = xp.sqrt(xp.sum(be.single(x != 0), axis=1, dtype=be.f64) / t.n)
    gain = be.choose(is_smooth, noise * 0 + 1, frame["gain"])
    filtered = TUNING.filtered_error * touched * gain * noise
    error2 = xp.maximum(beyond, filtered)
    excess = xp.maximum(power, xp.minimum(beyond, frame["power_read"] - noise))
    untouched = excess <= TUNING.untouched * noise
    return xp.sqrt(error2), untouched | (error2 <= TUNING.trusted**2 * power)


def _forces(t: Tables, x: Array, bias: Array) -> Array:
    """Return forces of vectors of means above the bias."""
    be, xp = t.be, t.be.xp
    some = bias > 0
    divisor = be.column(be.choose(some, bias, bias * 0 + 1))
    share = be.column(bias) * (1 - xp.exp(x * (-1 / divisor)))
    return x + share
