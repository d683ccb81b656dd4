"""Calibration of a skin from untouched frames and presses of known weight."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import Doubles, Mask

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

MAD_TO_SD = 1.4826
"""Standard deviation of normal noise, in its median absolute deviation; derived."""
OUTLIER = 5.0
"""Robust standard deviations from the median beyond which a reading is not of the steady ones."""
TOUCHED = 4.0
"""Standard deviations of a mean above which a taxel is pressed; chosen."""
NOISY = 8.0
"""Noise of a taxel in that of the median taxel above which it is faulty; chosen."""
TOUCHED_SHARE = 0.01
"""Share of noisy taxels above which the skin was rather touched; chosen."""
OUTLIERS = 0.01
"""Share of unsteady readings above which the skin was rather touched; chosen."""
MOVED = 0.2
"""Part of a load that its steady readings may lack; chosen."""
DEAD = 0.1
"""Response to an even load in that of the median taxel below which a taxel is dead; chosen."""
KEPT_SIGMAS = 4.0
"""Standard deviations of noise that a lower end of the range keeps; chosen: all but 3e-5."""
HEADROOM = 1.25
"""Range of a taxel in the largest force of a press, where the range is not stated; chosen."""


class CalibrationError(SparseskinError):
    """Frames from which no calibration follows."""


@dataclass(frozen=True, eq=False)
class Press:
    """Frames of a skin under a known load."""

    label: str  # for reports, e.g. "500g"
    force: float  # total, newtons, above 0
    frames: npt.NDArray[Any]  # (n, rows, cols), raw readings under the steady load
    #: (rows, cols), True for the cells that carry the load evenly; None: only the total is known.
    area: Mask | None = None


def read_load(text: str) -> float:
    """Newtons of a load such as "500g" or "4.9N".
    Raises CalibrationError if it is none, or 0.
    """
    found = _LOAD.fullmatch(text.strip())
    force = float(found[1]) * NEWTONS[found[2]] if found else 0.0
    if not force:
        raise CalibrationError(f"{text[:40]!r} is no load; allowed are {LOADS}")
    return force


def read_area(text: str, shape: tuple[int, int]) -> Mask:
    """Cells of an area such as "all" or "4-11x8-15", ends included, from 0, as of `Press`.
    Raises CalibrationError if it is none, or not on a skin of that shape.
    """
    if text.strip() == "all":
        return np.ones(shape, dtype=np.bool_)
    found = _AREA.fullmatch(text.strip())
    if found is None:
        raise CalibrationError(f"{text[:40]!r} is no area; allowed are {AREAS}")
    top, bottom, left, right = map(int, found.groups())
    if not (top <= bottom < shape[0] and left <= right < shape[1]):
        raise CalibrationError(f"{text} is not on a skin of {shape[0]} x {shape[1]}")
    area = np.zeros(shape, dtype=np.bool_)
    area[top : bottom + 1, left : right + 1] = True
    return area


@dataclass(frozen=True)
class PressResult:
    """A press as the calibrated skin measures it."""

    label: str
    force: float  # stated total, newtons
    measured: float  # the same; of an even load, the mean of its working taxels times its cells
    #: Standard deviation of the forces of the taxels under an even load, in their mean.
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
    untouched: npt.NDArray[Any],
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
    untouched = np.asarray(untouched)
    if untouched.ndim != 3 or len(untouched) < 2:
        raise CalibrationError(f"untouched: {len(untouched)} frames; at least 2 are needed")
    shape = (untouched.shape[1], untouched.shape[2])
    for press in presses:
        n, *own = press.frames.shape
        if tuple(own) != shape or not n:
            needed = f"the untouched ones have {shape}, and at least one is needed"
            raise CalibrationError(f"{press.label}: frames of shape {tuple(own)}; {needed}")
    exists = np.ones(shape, np.bool_) if mask is None else mask
    baseline, noise, unsteady = steady(untouched)
    stuck = exists & _stuck(untouched, presses)
    works = exists & ~stuck
    typical = float(np.median(noise[works])) if works.any() else 0.0
    noisy = works & (noise > NOISY * typical) & (typical > 0)
    works &= ~noisy
    remarks: list[str] = []
    if noisy.sum() > TOUCHED_SHARE * exists.sum():
        n = int(noisy.sum())
        remarks.append(f"{n} taxels are noisy: was the skin touched where it should not be?")
    elif (share := float(unsteady[exists].mean())) > OUTLIERS:
        part = f"{100 * share:.0f} % of the untouched readings"
        remarks.append(f"{part} come and go: was the skin touched?")
    rises = [steady(press.frames)[0] - baseline for press in presses]
    for press, rise in zip(presses, rises, strict=True):
        _check_still(press, rise, baseline, noise, works)
    dead = np.zeros(shape, np.bool_)
    gains: Doubles | None = None
    response: Response | None = None
    even = [(p, p.area, r) for p, r in zip(presses, rises, strict=True) if p.area is not None]
    if even:
        dead = works & _dead(even, works)
        works &= ~dead
        gains, response = _even_fit(even, works, curve, remarks)
    elif presses:
        gains = np.full(shape, _common_gain(presses, rises, works, TOUCHED * noise, remarks))
    elif invert:
        gains = np.full(shape, -1.0)
    if presses and invert:
        raise CalibrationError("invert: the presses show whether readings fall with force")
    if not works.any():
        raise CalibrationError("no taxel works: none changes, or all are far noisier than half")
    arrays: Any = (None if works.all() else works, baseline, gains, response)
    unit = "N" if presses else unit
    skin = SkinDescription(name, *shape, MAX_NUMBER, unit, pitch_mm, *arrays)
    forces = [skin.forces(baseline + rise) for rise in rises]
    if f_max is None:
        if not presses:
            raise CalibrationError("the range is not known: state f_max, or add presses")
        f_max = float(f"{HEADROOM * max(float(force[works].max()) for force in forces):.2g}")
        remarks.append(f"f_max = {f_max:g} N is {HEADROOM:g} times the largest force of a press")
    slope = np.ones(shape) if gains is None else np.abs(gains)  # newtons per raw reading at 0
    if response is not None:
        slope = slope * response.slopes[0]
    sigma = min(float(np.median((noise * slope)[works])), f_max)
    f_min = max(-float(f"{KEPT_SIGMAS * sigma:.1e}"), -f_max) if keep_noise else 0.0
    skin = replace(skin, f_max=f_max, noise=float(f"{sigma:.3g}"), f_min=f_min)
    results = [_result(*each, works) for each in zip(presses, rises, forces, strict=True)]
    faulty = (int(stuck.sum()), int(noisy.sum()), int(dead.sum()))
    return Fit(skin, len(untouched), typical, *faulty, results, remarks)


def steady(frames: npt.NDArray[Any]) -> tuple[Doubles, Doubles, Doubles]:
    """Mean and standard deviation of each taxel over steady frames, and the share of its readings
    that are not steady, float64 (rows, cols) each.

    Readings further from the median than `OUTLIER` robust standard deviations, as of a short touch,
    are left out. Unlike the median, the mean resolves less than one count.
    """
    values = np.asarray(frames, dtype=np.float64)
    median = np.median(values, axis=0)
    apart = values - median
    spread = MAD_TO_SD * np.median(np.abs(apart), axis=0)
    # Of a reading coarser than its noise, half of the frames are the median: none is left out.
    kept = (np.abs(apart) <= OUTLIER * spread) | (spread == 0)
    mean = np.mean(apart, axis=0, where=kept)
    return median + mean, np.std(apart, axis=0, where=kept), 1 - kept.mean(axis=0)


def _check_still(
    press: Press, rise: Doubles, baseline: Doubles, noise: Doubles, works: Mask
) -> None:
    """Raise CalibrationError if the load moved: its frames read it, its steady readings do not."""
    above = np.asarray(press.frames, dtype=np.float64)[:, works] - baseline[works]
    read = float(np.median(above.sum(axis=1)))
    kept = float(rise[works].sum())
    chance = TOUCHED * math.sqrt(float(np.square(noise[works]).sum()))
    if abs(read - kept) > MOVED * abs(read) + chance:
        sums = f"its frames add up to {read:.4g}, the readings that stay to {kept:.4g}"
        raise CalibrationError(f"{press.label}: the load moves: {sums}; let it stand still")


def _stuck(untouched: npt.NDArray[Any], presses: Sequence[Press]) -> Mask:
    """Taxels whose reading never changes, where that of most does."""
    still = np.ones(untouched.shape[1:], dtype=np.bool_)
    for frames in (untouched, *(press.frames for press in presses)):
        still &= (frames == untouched[0]).all(axis=0)
    return still if still.mean() < 0.5 else np.zeros_like(still)


def _dead(even: Sequence[tuple[Press, Mask, Doubles]], works: Mask) -> Mask:
    """Taxels that respond to no even load that is on them."""
    answered: Mask = np.zeros(works.shape, np.bool_)
    covered: Mask = np.zeros(works.shape, np.bool_)
    for press, area, rise in even:
        cells = area & works
        if not cells.any():
            raise CalibrationError(f"{press.label}: no taxel under it works")
        typical = float(np.median(rise[cells]))
        covered |= cells
        answered |= cells & (rise * typical > DEAD * typical**2)
    return covered & ~answered


def _even_fit(
    even: Sequence[tuple[Press, Mask, Doubles]], works: Mask, curve: Curve, remarks: list[str]
) -> tuple[Doubles, Response | None]:
    """Gains, and the response curve, of loads that press all taxels of an area evenly."""
    # Dead taxels carry their part of the load. Forces that differ by rounding are equal.
    each = [press.force / area.sum() for press, area, _ in even]
    forces, level = np.unique([float(f"{force:.6g}") for force in each], return_inverse=True)
    # At each force the mean rise of each taxel over its presses, NaN where none covers it.
    total, times = np.zeros((2, len(forces), *works.shape))
    for k, (_, area, rise) in zip(level, even, strict=True):
        total[k] += np.where(area & works, rise, 0.0)
        times[k] += area & works
    rise = np.divide(total, times, out=np.full(total.shape, np.nan), where=times > 0)
    middle = np.nanmedian(rise.reshape(len(forces), -1), axis=1)
    if not (np.diff(math.copysign(1.0, middle[-1]) * middle, prepend=0) > 0).all():
        read = ", ".join(f"{m:.4g} at {f:.3g} N" for m, f in zip(middle, forces, strict=True))
        raise CalibrationError(f"readings do not rise with the force of a taxel: {read}")
    if len(forces) > MAX_KNOTS:
        raise CalibrationError(f"{len(forces)} different loads; at most {MAX_KNOTS}")
    # Without a curve the target is the force itself, else the reading of the median taxel.
    straight = curve == "linear" or len(forces) < 2
    scale = forces[0] / middle[0]
    target = (forces if straight else scale * middle).reshape(-1, 1, 1)
    filled = np.nan_to_num(rise)
    energy = np.square(filled).sum(axis=0)
    gains = np.full(works.shape, np.nan)
    np.divide((filled * target).sum(axis=0), energy, out=gains, where=works & (energy > 0))
    known = np.isfinite(gains)
    gains[~known] = np.median(gains[known])
    if unknown := np.count_nonzero(works & ~known):
        remarks.append(f"{unknown} taxels lay under no even load: they have the median gain")
    if straight:
        return gains, None
    if curve == "shared":
        return gains, Response(scale * middle, forces)
    # Of each taxel; that of the median taxel where its own is not known.
    sound = works & (np.diff(scale * rise, axis=0, prepend=0) > 0).all(axis=0)
    reading = np.where(sound, scale * rise, scale * middle.reshape(-1, 1, 1))
    return np.full(works.shape, scale), Response(reading, forces)


def _common_gain(
    presses: Sequence[Press],
    rises: Sequence[Doubles],
    works: Mask,
    floor: Doubles,
    remarks: list[str],
) -> float:
    """One gain of all taxels from totals: force = gain x the sum of the readings."""
    sums = []
    for press, rise in zip(presses, rises, strict=True):
        pressed = works & (np.abs(rise) > floor / math.sqrt(len(press.frames)))
        if not pressed.any():
            raise CalibrationError(f"{press.label}: no taxel reads more than its noise")
        sums.append(float(rise[pressed].sum()))
    total = np.array(sums)
    force = np.array([press.force for press in presses])
    gain = float(total @ force / (total @ total))
    apart = np.abs(gain * total / force - 1)
    if apart.max() > 0.1:
        off = f"{presses[int(apart.argmax())].label}: {100 * apart.max():.0f} % off"
        remedy = "even loads over a stated area give each taxel its own"
        remarks.append(f"{off} one gain for all: taxels or loads differ; {remedy}")
    return gain


def _result(press: Press, rise: Doubles, forces: Doubles, works: Mask) -> PressResult:
    if press.area is None:
        return PressResult(press.label, press.force, float(forces[works].sum()))
    cells = press.area & works
    mean = float(forces[cells].mean())
    before = np.abs(rise[cells].mean())
    spreads = float(forces[cells].std()) / mean, float(rise[cells].std() / before)
    return PressResult(press.label, press.force, mean * int(press.area.sum()), *spreads)
