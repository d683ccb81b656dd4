"""Calibration of a skin from untouched frames and presses of known weight."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import AnyArray, Doubles, Mask
from sparseskin.nodes.sensor.sign import MAD_TO_SD

from .description import MAX_KNOTS, MAX_NUMBER, Response, SkinDescription

GRAVITY = 9.80665
"""Standard acceleration of free fall, m/s^2. Source: ISO 80000-3."""
NEWTONS = {"kg": GRAVITY, "g": GRAVITY / 1000, "N": 1.0, "mN": 0.001}
"""Newtons of each unit of a load."""
_LOAD = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ?(kg|g|N|mN)")
_AREA = re.compile(r"(\d{1,4})-(\d{1,4})x(\d{1,4})-(\d{1,4})")
LOADS = "500g, 0.5kg, 4.9N or 800mN"
AREAS = "all, or ROWSxCOLUMNS as 4-11x8-15"
Curve = Literal["shared", "taxel", "linear"]

OUTLIER = 5.0
"""Robust standard deviations from the median beyond which a reading is not of the steady ones."""
TOUCHED = 4.0
"""Standard deviations of a mean above which a taxel is pressed; chosen."""
NOISY = 8.0
"""Noise above which a taxel is faulty, as a multiple of that of the median taxel; chosen."""
TOUCHED_SHARE = 0.01
"""Share of noisy taxels above which the skin was rather touched; chosen."""
OUTLIERS = 0.01
"""Share of unsteady readings above which the skin was rather touched; chosen."""
MOVED = 0.2
"""Part of a load that its steady readings may lack; chosen."""
DEAD = 0.1
"""Response to an even load below which a taxel is dead, as a multiple of that of the median taxel;
chosen."""
KEPT_SIGMAS = 4.0
"""Standard deviations of noise that a lower end of the range keeps; chosen: all but 3e-5."""
HEADROOM = 1.25
"""Range of a taxel as a multiple of the largest force of a press, where the range is not stated;
chosen."""
ONE_GAIN_ERROR = 0.1
"""Relative error of a total by one gain of all taxels that is reported: weights and noise explain
less. Chosen."""


class CalibrationError(SparseskinError):
    """Frames from which no calibration follows."""


@dataclass(frozen=True, eq=False)
class Press:
    """Frames of a skin under a known load."""

    label: str  # for reports, e.g. "500g"
    force: float  # total, newtons, above 0
    frames: AnyArray  # (n, rows, cols), raw readings under the steady load
    #: (rows, cols), True for the cells that carry the load evenly; None: only the total is known.
    area: Mask | None = None


def read_load(text: str) -> float:
    """Newtons of a load such as "500g" or "4.9N".
    Raises CalibrationError if it is none, or 0.
    """
    match = _LOAD.fullmatch(text.strip())
    force = 0.0
    if match is not None:
        number, unit = match.groups()
        force = float(number) * NEWTONS[unit]
    # "0g" matches, too: no gain follows from it.
    if not force:
        raise CalibrationError(f"{text[:40]!r} is no load; allowed are {LOADS}")
    return force


def read_area(text: str, shape: tuple[int, int]) -> Mask:
    """Cells of an area such as "all" or "4-11x8-15", ends included, from 0, as of `Press`.
    Raises CalibrationError if it is none, or not on a skin of that shape.
    """
    if text.strip() == "all":
        return np.ones(shape, dtype=np.bool_)
    match = _AREA.fullmatch(text.strip())
    if match is None:
        raise CalibrationError(f"{text[:40]!r} is no area; allowed are {AREAS}")
    top_row, bottom_row, left_col, right_col = map(int, match.groups())
    n_rows, n_cols = shape
    if not (top_row <= bottom_row < n_rows and left_col <= right_col < n_cols):
        raise CalibrationError(f"{text} is not on a skin of {n_rows} x {n_cols}")
    area = np.zeros(shape, dtype=np.bool_)
    area[top_row : bottom_row + 1, left_col : right_col + 1] = True
    return area


@dataclass(frozen=True)
class PressResult:
    """A press as the calibrated skin measures it."""

    label: str
    force: float  # stated total, newtons
    measured: float  # the same; of an even load, the mean of its working taxels times its cells
    #: Standard deviation of the forces of the taxels under an even load, over their mean.
    spread: float | None = None
    spread_before: float | None = None  # the same of raw readings above the baseline


@dataclass(frozen=True, eq=False)
class Fit:
    """A calibration: the skin, how well it measures its presses, and remarks, a line each."""

    skin: SkinDescription
    n_frames: int  # untouched ones
    noise_raw: float  # of the median taxel, in raw readings
    stuck: int = 0  # numbers of taxels masked, and why
    noisy: int = 0
    dead: int = 0
    presses: list[PressResult] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


def fit(
    name: str,
    untouched: AnyArray,
    presses: Sequence[Press] = (),
    *,
    f_max: float | None = None,
    unit: str = "N",
    pitch_mm: float | None = None,
    mask: Mask | None = None,
    curve: Curve = "shared",
    keep_noise: bool = False,
    invert: bool = False,
) -> Fit:
    """Calibrate a skin.

    The baseline is the mean of the steady untouched readings (`steady`). Even loads of one force
    give each taxel its gain, by least squares through 0; of several forces, with `curve` "shared",
    also the knots of a curve that all taxels share, or with "taxel" one of each. Where only totals
    are known, one gain of all taxels follows from them, by least squares.

    Parameters
    ----------
    name, unit, pitch_mm, mask
        As of `SkinDescription`; with presses the unit is "N".
    untouched : ndarray, shape (n, rows, cols)
        Raw readings of the untouched skin, n >= 2.
    presses : sequence of Press
        Known loads; none: readings above the baseline are forces.
    f_max : float, optional
        Upper end of the range, in `unit`; by default 1.25 times the largest force of a press.
    curve : "shared", "taxel" or "linear"
        Response curve where even loads of several forces are known.
    keep_noise : bool
        True: the range begins at -4 standard deviations of the noise, so that none is clipped.
    invert : bool
        Readings fall with force, where there are no presses, which would show it.

    Raises CalibrationError if there are too few frames, a press is not seen, readings do not rise
    with force, or `invert` is stated beside presses.
    """
    if presses and invert:
        raise CalibrationError(
            "invert: the presses show whether readings fall with force"
        )
    untouched = np.asarray(untouched)
    shape = _checked_shape(untouched, presses)
    exists = np.ones(shape, np.bool_) if mask is None else mask
    remarks: list[str] = []
    at_rest = _at_rest(untouched, presses, exists, remarks)
    rises = [_rise(press, at_rest) for press in presses]

    # Before the fit: a dead taxel would have an absurd gain.
    even = _even_loads(presses, rises)
    dead = _dead(even, at_rest.works)
    works = at_rest.works & ~dead

    gains: Doubles | None = None
    response: Response | None = None
    if even:
        gains, response = _even_fit(even, works, curve, remarks)
    elif presses:
        floor = TOUCHED * at_rest.noise
        gains = _common_gain(presses, rises, works, floor, remarks)
    elif invert:
        gains = np.full(shape, -1.0)
    if not works.any():
        raise CalibrationError(
            "no taxel works: none changes, or all are far noisier than half"
        )

    # Presses are stated in newtons.
    if presses:
        unit = "N"
    skin = SkinDescription(
        name,
        *shape,
        f_max=MAX_NUMBER,  # until the forces of the presses are known
        unit=unit,
        pitch_mm=pitch_mm,
        mask=None if works.all() else works,
        baseline=at_rest.baseline,
        gains=gains,
        response=response,
    )
    forces = [skin.forces(at_rest.baseline + rise) for rise in rises]
    if f_max is None:
        f_max = _range_of([frame[works] for frame in forces], remarks)

    measured = zip(presses, rises, forces, strict=True)
    return Fit(
        _with_range(skin, at_rest.noise, works, f_max, keep_noise),
        n_frames=len(untouched),
        noise_raw=at_rest.typical_noise,
        stuck=int(at_rest.stuck.sum()),
        noisy=int(at_rest.noisy.sum()),
        dead=int(dead.sum()),
        presses=[_result(*press_forces, works) for press_forces in measured],
        remarks=remarks,
    )


class _Rest(NamedTuple):
    """The readings of the untouched taxels, (rows, cols)."""

    baseline: Doubles
    noise: Doubles  # standard deviation
    typical_noise: float  # of the median taxel
    stuck: Mask
    noisy: Mask
    works: Mask  # exists, and is neither stuck nor noisy


class _EvenLoad(NamedTuple):
    """A press that all taxels of an area carry evenly, and how far it raised each reading."""

    press: Press
    area: Mask
    rise: Doubles


def _checked_shape(untouched: AnyArray, presses: Sequence[Press]) -> tuple[int, int]:
    """Rows and columns of all frames; CalibrationError if they differ, or there are too few."""
    if untouched.ndim != 3 or len(untouched) < 2:
        raise CalibrationError(
            f"untouched: {len(untouched)} frames; at least 2 are needed"
        )
    shape = (untouched.shape[1], untouched.shape[2])
    for press in presses:
        n_frames = len(press.frames)
        press_shape = press.frames.shape[1:]
        if press_shape != shape or not n_frames:
            raise CalibrationError(
                f"{press.label}: frames of shape {press_shape}; the untouched ones "
                f"have {shape}, and at least one is needed"
            )
    return shape


def _at_rest(
    untouched: AnyArray,
    presses: Sequence[Press],
    exists: Mask,
    remarks: list[str],
) -> _Rest:
    """Baseline and noise of the taxels, and those whose readings show that they are faulty."""
    baseline, noise, unsteady = steady(untouched)
    stuck = _stuck(untouched, presses, exists)
    works = exists & ~stuck
    # Without noise at all, as of a coarse converter, no taxel is noisier than others.
    typical_noise = 0.0
    if works.any():
        typical_noise = float(np.median(noise[works]))
    noisy = works & (noise > NOISY * typical_noise) & (typical_noise > 0)

    # One remark is enough: a touch makes taxels noisy and readings unsteady.
    n_noisy = int(noisy.sum())
    unsteady_share = float(unsteady[exists].mean())
    if n_noisy > TOUCHED_SHARE * exists.sum():
        remarks.append(
            f"{n_noisy} taxels are noisy: was the skin touched where it should not be?"
        )
    elif unsteady_share > OUTLIERS:
        remarks.append(
            f"{100 * unsteady_share:.0f} % of the untouched readings come and go: was "
            "the skin touched?"
        )
    return _Rest(baseline, noise, typical_noise, stuck, noisy, works & ~noisy)


def _even_loads(presses: Sequence[Press], rises: Sequence[Doubles]) -> list[_EvenLoad]:
    """The presses whose area is known."""
    loads = []
    for press, rise in zip(presses, rises, strict=True):
        if press.area is not None:
            loads.append(_EvenLoad(press, press.area, rise))
    return loads


def _range_of(forces: Sequence[Doubles], remarks: list[str]) -> float:
    """Range of a taxel from the forces of the presses; CalibrationError if there are none."""
    if not forces:
        raise CalibrationError("the range is not known: state f_max, or add presses")
    largest = max(float(frame.max()) for frame in forces)
    # Two digits: a number that a person reads, and may state instead.
    f_max = float(f"{HEADROOM * largest:.2g}")
    remarks.append(
        f"f_max = {f_max:g} N is {HEADROOM:g} times the largest force of a press"
    )
    return f_max


def _with_range(
    skin: SkinDescription, noise: Doubles, works: Mask, f_max: float, keep_noise: bool
) -> SkinDescription:
    """A skin with its range, and the noise of its median taxel by that of raw readings."""
    slope = np.ones(skin.shape)  # force per raw reading, near 0
    if skin.gains is not None:
        slope = np.abs(skin.gains)
    if skin.response is not None:
        slope = slope * skin.response.slopes[0]
    sigma = min(float(np.median((noise * slope)[works])), f_max)

    # To as many digits as so few frames state.
    f_min = 0.0
    if keep_noise:
        f_min = max(-float(f"{KEPT_SIGMAS * sigma:.1e}"), -f_max)
    return replace(skin, f_max=f_max, noise=float(f"{sigma:.3g}"), f_min=f_min)


def steady(frames: AnyArray) -> tuple[Doubles, Doubles, Doubles]:
    """Mean and standard deviation of each taxel over steady frames, and the share of its readings
    that are not steady, float64 (rows, cols) each.

    Readings further from the median than `OUTLIER` robust standard deviations, as of a short touch,
    are left out. Unlike the median, the mean resolves less than one count.
    """
    values = np.asarray(frames, dtype=np.float64)
    median = np.median(values, axis=0)
    deviation = values - median
    size = np.abs(deviation)
    spread = MAD_TO_SD * np.median(size, axis=0)
    # Of a reading coarser than its noise, half of the frames are the median: none is left out.
    is_steady = (size <= OUTLIER * spread) | (spread == 0)

    mean = np.mean(deviation, axis=0, where=is_steady)
    noise = np.std(deviation, axis=0, where=is_steady)
    unsteady_share = 1 - is_steady.mean(axis=0)
    return median + mean, noise, unsteady_share


def _rise(press: Press, at_rest: _Rest) -> Doubles:
    """Steady readings under a load, above the baseline. Raises CalibrationError if the load moved:
    its frames read it, its steady readings do not.
    """
    means, _, _ = steady(press.frames)
    rise = means - at_rest.baseline
    works = at_rest.works

    # Sums over all taxels: a load that moves keeps its sum, frame by frame.
    readings = np.asarray(press.frames, dtype=np.float64)[:, works]
    above = readings - at_rest.baseline[works]
    frame_sum = float(np.median(above.sum(axis=1)))
    steady_sum = float(rise[works].sum())

    noise_of_sum = math.sqrt(float(np.square(at_rest.noise[works]).sum()))
    noise_bound = TOUCHED * noise_of_sum
    if abs(frame_sum - steady_sum) > MOVED * abs(frame_sum) + noise_bound:
        raise CalibrationError(
            f"{press.label}: the load moves: its frames add up to {frame_sum:.4g}, the "
            f"readings that stay to {steady_sum:.4g}; let it stand still"
        )
    return rise


def _stuck(untouched: AnyArray, presses: Sequence[Press], exists: Mask) -> Mask:
    """Taxels whose reading never changes, where that of most does, bool (rows, cols)."""
    # A cell without a taxel often reads a constant: it is neither stuck, nor counted below.
    still = exists.copy()
    for frames in (untouched, *(press.frames for press in presses)):
        still &= (frames == untouched[0]).all(axis=0)
    # A skin that is silent as a whole is no set of stuck taxels.
    if 2 * np.count_nonzero(still) >= np.count_nonzero(exists):
        return np.zeros_like(still)
    return still


def _dead(even: Sequence[_EvenLoad], works: Mask) -> Mask:
    """Taxels that respond to no even load that is on them."""
    responds: Mask = np.zeros(works.shape, np.bool_)
    covered: Mask = np.zeros(works.shape, np.bool_)
    for press, area, rise in even:
        cells = area & works
        if not cells.any():
            raise CalibrationError(f"{press.label}: no taxel under it works")
        # Readings may fall with force: the sign of the median taxel is that of all. A product,
        # so that both signs are compared in one way.
        median_rise = float(np.median(rise[cells]))
        covered |= cells
        responds |= cells & (rise * median_rise > DEAD * median_rise**2)
    return covered & ~responds


def _even_fit(
    even: Sequence[_EvenLoad], works: Mask, curve: Curve, remarks: list[str]
) -> tuple[Doubles, Response | None]:
    """Gains, and the response curve, of loads that press all taxels of an area evenly."""
    forces, rise = _rise_by_force(even, works)
    median_rise = np.nanmedian(rise.reshape(len(forces), -1), axis=1)
    _check_rising(median_rise, forces)
    if len(forces) > MAX_KNOTS:
        raise CalibrationError(f"{len(forces)} different loads; at most {MAX_KNOTS}")

    # Without a curve the target is the force itself, else the reading of the median taxel.
    is_straight = curve == "linear" or len(forces) < 2
    scale = forces[0] / median_rise[0]  # newtons per raw reading, at the least load
    target = forces if is_straight else scale * median_rise
    gains = _least_squares_gains(rise, target.reshape(-1, 1, 1), works, remarks)
    if is_straight:
        return gains, None

    # A reading of a taxel times its gain is that of the median taxel: one curve fits all.
    if curve == "shared":
        return gains, Response(scale * median_rise, forces)

    # Of each taxel; that of the median taxel where its own is not known, or would not be a curve.
    readings = scale * rise
    rises_always = (np.diff(readings, axis=0, prepend=0) > 0).all(axis=0)
    median_readings = scale * median_rise.reshape(-1, 1, 1)
    readings = np.where(works & rises_always, readings, median_readings)
    return np.full(works.shape, scale), Response(readings, forces)


def _rise_by_force(even: Sequence[_EvenLoad], works: Mask) -> tuple[Doubles, Doubles]:
    """Forces of a taxel, rising (K,), and the mean rise of each taxel over the presses of each,
    (K, rows, cols), NaN where none covers it.
    """
    # Dead taxels carry their part of the load. Forces that differ by rounding are equal.
    per_taxel = [float(f"{load.press.force / load.area.sum():.6g}") for load in even]
    forces, index = np.unique(per_taxel, return_inverse=True)
    shape = (len(forces), *works.shape)
    total = np.zeros(shape)
    n_presses = np.zeros(shape)
    for k, load in zip(index, even, strict=True):
        cells = load.area & works
        total[k] += np.where(cells, load.rise, 0.0)
        n_presses[k] += cells
    rise = np.full(shape, np.nan)
    np.divide(total, n_presses, out=rise, where=n_presses > 0)
    return forces, rise


def _check_rising(median_rise: Doubles, forces: Doubles) -> None:
    """Raise CalibrationError unless the readings all rise, or all fall, with force."""
    # The largest load shows the sign best.
    sign = math.copysign(1.0, median_rise[-1])
    if (np.diff(sign * median_rise, prepend=0) > 0).all():
        return
    pairs = zip(median_rise, forces, strict=True)
    measured = ", ".join(f"{reading:.4g} at {force:.3g} N" for reading, force in pairs)
    raise CalibrationError(
        f"readings do not rise with the force of a taxel: {measured}"
    )


def _least_squares_gains(
    rise: Doubles, target: Doubles, works: Mask, remarks: list[str]
) -> Doubles:
    """Gain of each taxel through 0 from its rise to the target; the median where none is known."""
    # A load that does not cover a taxel has no part in its sums.
    rise = np.nan_to_num(rise)
    energy = np.square(rise).sum(axis=0)
    product = (rise * target).sum(axis=0)
    gains = np.full(works.shape, np.nan)
    np.divide(product, energy, out=gains, where=works & (energy > 0))

    has_gain = np.isfinite(gains)
    gains[~has_gain] = np.median(gains[has_gain])
    n_without = np.count_nonzero(works & ~has_gain)
    if n_without:
        remarks.append(
            f"{n_without} taxels lay under no even load: they have the median gain"
        )
    return gains


def _common_gain(
    presses: Sequence[Press],
    rises: Sequence[Doubles],
    works: Mask,
    floor: Doubles,
    remarks: list[str],
) -> Doubles:
    """One gain of all taxels from totals: force = gain x the sum of the readings above a floor."""
    sums = []
    for press, rise in zip(presses, rises, strict=True):
        # Noise of untouched taxels would add up.
        pressed = works & (np.abs(rise) > floor / math.sqrt(len(press.frames)))
        if not pressed.any():
            raise CalibrationError(f"{press.label}: no taxel reads more than its noise")
        sums.append(float(rise[pressed].sum()))
    total = np.array(sums)
    force = np.array([press.force for press in presses])

    # Least squares through 0.
    gain = float(total @ force / (total @ total))
    error = np.abs(gain * total / force - 1)
    if error.max() > ONE_GAIN_ERROR:
        worst = presses[int(error.argmax())].label
        remarks.append(
            f"{worst}: {100 * error.max():.0f} % off one gain for all: taxels or loads "
            "differ; even loads over a stated area give each taxel its own"
        )
    return np.full(works.shape, gain)


def _result(press: Press, rise: Doubles, forces: Doubles, works: Mask) -> PressResult:
    if press.area is None:
        return PressResult(press.label, press.force, float(forces[works].sum()))
    cells = press.area & works

    # Taxels that do not work carry their part of the load.
    mean = float(forces[cells].mean())
    raw_mean = np.abs(rise[cells].mean())
    return PressResult(
        press.label,
        press.force,
        measured=mean * int(press.area.sum()),
        spread=float(forces[cells].std()) / mean,
        spread_before=float(rise[cells].std() / raw_mean),
    )
