"""The stored grid of simulated accuracy, and interpolation in it.

A base grid of taxels x noise at one frame rate and many bits holds PSNR and its spread over scenes;
beside it stand the effects of the rate and of a narrow shape on the mean, the rounding of the
converter, and the light touch in units of the noise. Between the points all are linear in the
logarithms of taxels, noise, rate and columns a row. Few bits count as noise: variances of noise and
rounding add up.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from sparseskin.nodes.numerics.arrays import Doubles

from .strategies import SINGLE, STRATEGIES

GRID_FILE = Path(__file__).with_name("grid.json")
GRID_VERSION = 2
WITHIN = 0.9
"""Part of the scenes that lie within the band."""
BEYOND = 4.0
"""Factor beyond the ends of the grid up to which it is extrapolated. Chosen."""


@dataclass(frozen=True)
class Axes:
    """Points of the grid.

    Attributes
    ----------
    sides : tuple of int
        Rows, as many as columns, of the skins.
    noise : tuple of float
        Standard deviations as parts of the range.
    rate_hz, bits : float, int
        Of the base grid.
    n_scenes : int
        Scenes a point.
    rate_sides, rate_noise, rates_hz, rate_scenes
        The same, where the effect of the rate is measured against the base's.
    touch_sides, touch_noise
        Where the light touch is measured.
    narrow_sides, narrow_noise, narrow
        Where the effect of the shape is measured, against squares of as many taxels: skins
        `narrow` times as wide as high, and as high as wide; a square number. `rate_scenes` a point.
    """

    sides: tuple[int, ...]
    noise: tuple[float, ...]
    rate_hz: float
    bits: int
    n_scenes: int
    rate_sides: tuple[int, ...]
    rate_noise: tuple[float, ...]
    rates_hz: tuple[float, ...]
    rate_scenes: int
    touch_sides: tuple[int, ...]
    touch_noise: tuple[float, ...]
    narrow_sides: tuple[int, ...]
    narrow_noise: tuple[float, ...]
    narrow: int

    @property
    def aspects(self) -> list[float]:
        """Columns a row of all shapes, ascending."""
        return [1 / self.narrow, 1.0, float(self.narrow)]

    @property
    def n_taxels(self) -> list[int]:
        """Taxels of the skins."""
        return [side * side for side in self.sides]

    @property
    def all_rates_hz(self) -> list[float]:
        """All rates, ascending."""
        return sorted({*self.rates_hz, self.rate_hz})


@dataclass(frozen=True)
class Table:
    """Figures of one strategy.

    Attributes
    ----------
    db, low_db, high_db : ndarray of float64, shape (sides, noise)
        PSNR of contact frames: mean of the scenes, and their `band`.
    rounding : ndarray of float64, shape (sides,)
        Standard deviation of the rounding at `Axes.bits`, as a part of the range.
    rate_db : ndarray of float64, shape (rate_sides, rate_noise, all_rates_hz)
        PSNR above that at the base rate, in the mean of the scenes.
    narrow_db : ndarray of float64, shape (narrow_sides, narrow_noise, aspects)
        PSNR above that of a square, in the mean of the scenes.
    touch : ndarray of float64, shape (touch_sides, touch_noise)
        Light touch in standard deviations of the noise; NaN where none is found.
    error_db : float
        Largest error of the interpolated mean at points that were simulated besides.
    touch_error : float
        Largest factor between interpolated and simulated light touch there.
    """

    db: Doubles
    low_db: Doubles
    high_db: Doubles
    rounding: Doubles
    rate_db: Doubles
    narrow_db: Doubles
    touch: Doubles
    error_db: float = 0.0
    touch_error: float = 1.0


@dataclass(frozen=True)
class Figure:
    """An interpolated figure.

    Attributes
    ----------
    db, low_db, high_db : float
        Mean, and band of 90 % of the scenes without the interpolation error.
    touch : float
        As a part of the range; NaN if none is found.
    beyond : tuple of str
        Quantities that lie outside the grid.
    """

    db: float
    low_db: float
    high_db: float
    touch: float
    beyond: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """The grid: its points, and a table a strategy."""

    axes: Axes
    tables: Mapping[str, Table]

    def at(
        self,
        strategy: str,
        n_taxels: int,
        noise: float,
        bits: int,
        rate_hz: float,
        aspect: float = 1.0,
    ) -> Figure | None:
        """Interpolate; None where a quantity is more than `BEYOND` times outside the grid.

        Rates above the grid's have the figures of its highest; narrower skins than are allowed
        those of the narrowest. `aspect`: columns a row.
        """
        axes, table = self.axes, self.tables[strategy]
        sides = _log(axes.n_taxels)
        n = math.log(n_taxels)
        rounding = table.rounding * steps(strategy, bits) / steps(strategy, axes.bits)
        base = math.exp(_linear(sides, np.log(table.rounding), n))
        here = math.exp(_linear(sides, np.log(rounding), n))
        # At the bits of the grid its noise includes the rounding.
        effective = math.sqrt(max(noise**2 + here**2 - base**2, 1e-18))
        stated = {
            "taxels": (float(n_taxels), [float(k) for k in axes.n_taxels]),
            "noise": (effective, list(axes.noise)),
            "rate": (min(rate_hz, axes.all_rates_hz[-1]), axes.all_rates_hz),
            "shape": (
                min(max(aspect, axes.aspects[0] / BEYOND), axes.aspects[-1] * BEYOND),
                axes.aspects,
            ),
        }
        beyond = tuple(
            name for name, (value, known) in stated.items() if _outside(value, known) > 1 + 1e-9
        )
        if any(_outside(value, known) > BEYOND for value, known in stated.values()):
            return None
        if rate_hz > axes.all_rates_hz[-1] * (1 + 1e-9):
            beyond = tuple(dict.fromkeys((*beyond, "rate")))
        x = math.log(effective)
        mean, low, high = (
            _linear(sides, np.array([_linear(_log(axes.noise), row, x) for row in of]), n)
            for of in (table.db, table.low_db, table.high_db)
        )
        change = _effect(table.rate_db, axes.rate_sides, axes.rate_noise, axes.all_rates_hz)(
            n, x, stated["rate"][0]
        ) + _effect(table.narrow_db, axes.narrow_sides, axes.narrow_noise, axes.aspects)(
            n, x, stated["shape"][0]
        )
        touch = self._touch(table, n, effective if _rounds_touch(strategy) else noise)
        return Figure(mean + change, low + change, high + change, touch, beyond)

    def _touch(self, table: Table, n: float, noise: float) -> float:
        """Light touch as a part of the range; in units of the noise it is constant outside."""
        levels = _log(self.axes.touch_noise)
        level = float(np.clip(math.log(max(noise, 1e-9)), levels[0], levels[-1]))
        rows = np.log(table.touch)
        sides = _log([side * side for side in self.axes.touch_sides])
        n = float(np.clip(n, sides[0], sides[-1]))
        found = _linear(sides, np.array([_linear(levels, row, level) for row in rows]), n)
        touch = math.exp(found) * noise
        return touch if touch <= 1 else math.nan


def _effect(
    db: Doubles, sides: Sequence[int], noise: Sequence[float], places: Sequence[float]
) -> Callable[[float, float, float], float]:
    """Effect in dB by log(taxels), log(noise) and a place; taxels and noise outside those measured
    count as the ends.
    """
    sizes, levels = _log([side * side for side in sides]), _log(noise)

    def at(n: float, x: float, place: float) -> float:
        along = [[_linear(_log(places), of, math.log(place)) for of in row] for row in db]
        x = float(np.clip(x, levels[0], levels[-1]))
        of_sizes = np.array([_linear(levels, np.array(row), x) for row in along])
        return _linear(sizes, of_sizes, float(np.clip(n, sizes[0], sizes[-1])))

    return at


def steps(strategy: str, bits: int) -> float:
    """Rounding of a strategy's values in few bits, up to a factor."""
    return 1 / (2.0 ** (bits - (STRATEGIES[strategy].sums != SINGLE)) - 1)


def made_grid(
    axes: Axes,
    base: Sequence[Sequence[Mapping[str, Sequence[float]]]],
    rates: Sequence[Sequence[Mapping[str, Sequence[float]]]],
    narrow: Sequence[Sequence[Mapping[str, Sequence[float]]]],
    touches: Sequence[Mapping[str, float | None]],
) -> Grid:
    """Make the grid from simulated figures, its errors not yet known.

    Parameters
    ----------
    axes : Axes
    base, rates, narrow : sequence of sequence of mapping
        Of each cell of `base_cells`, `rate_cells` and `narrow_cells` the figures of its scenes, as
        `simulation.scene_accuracy` returns them.
    touches : sequence of mapping
        Of each cell of `touch_cells`, as `simulation.touch_accuracy` returns them.
    """
    n_sides, n_noise = len(axes.sides), len(axes.noise)
    tables = {}
    for name in STRATEGIES:
        found = np.array([[scene[name] for scene in cell] for cell in base])
        db = found[..., 0].reshape(n_sides, n_noise, -1)
        low_db, high_db = band(db)
        changed = np.array([[scene[name][0] for scene in cell] for cell in rates])
        tables[name] = Table(
            db=db.mean(axis=-1),
            low_db=low_db,
            high_db=high_db,
            rounding=found[..., 1].reshape(n_sides, -1).mean(axis=-1),
            rate_db=_rate_effect(axes, db, changed),
            narrow_db=_narrow_effect(
                axes, db, np.array([[scene[name][0] for scene in cell] for cell in narrow])
            ),
            touch=np.array(
                [math.nan if cell[name] is None else cell[name] for cell in touches],
                dtype=np.float64,
            ).reshape(len(axes.touch_sides), -1)
            / np.array(axes.touch_noise),
        )
    return Grid(axes, tables)


def band(db: Doubles) -> tuple[Doubles, Doubles]:
    """Ends of the interval in which the PSNR of a further scene lies in 90 % of cases.

    Mean -/+ t s sqrt(1 + 1 / n) over the last axis of n scenes, 2 or more; t is of Student's
    distribution with n - 1 degrees of freedom.

    Notes
    -----
    Source: prediction interval of a normal distribution; Hahn, Meeker, "Statistical Intervals",
    Wiley, 1991, section 4.7.
    """
    n = db.shape[-1]
    factor = float(student.ppf((1 + WITHIN) / 2, n - 1)) * math.sqrt(1 + 1 / n)
    mean, half = db.mean(axis=-1), factor * db.std(axis=-1, ddof=1)
    return mean - half, mean + half


def _rate_effect(axes: Axes, base: Doubles, changed: Doubles) -> Doubles:
    """PSNR above that of the same scenes at the base rate; shape as `Table.rate_db`."""
    shape = (len(axes.rate_sides), len(axes.rate_noise), len(axes.rates_hz))
    sides = [axes.sides.index(side) for side in axes.rate_sides]
    levels = [axes.noise.index(level) for level in axes.rate_noise]
    same = base[np.ix_(sides, levels)][..., : axes.rate_scenes]
    above = changed.reshape(*shape, -1).mean(axis=-1) - same.mean(axis=-1)[..., None]
    rates = axes.all_rates_hz
    effect = np.zeros((*shape[:2], len(rates)))
    for k, rate_hz in enumerate(axes.rates_hz):
        effect[..., rates.index(rate_hz)] = above[..., k]
    return effect


def _narrow_effect(axes: Axes, base: Doubles, changed: Doubles) -> Doubles:
    """PSNR above that of the same scenes on a square; shape as `Table.narrow_db`."""
    sides = [axes.sides.index(side) for side in axes.narrow_sides]
    levels = [axes.noise.index(level) for level in axes.narrow_noise]
    of_squares = base[np.ix_(sides, levels)][..., : axes.rate_scenes].mean(axis=-1)
    found = changed.mean(axis=-1).reshape(*of_squares.shape, 2) - of_squares[..., None]
    return np.insert(found, 1, 0.0, axis=-1)


def base_cells(axes: Axes) -> list[dict[str, Any]]:
    """Cells of the base grid, noise changing first."""
    common = {"bits": axes.bits, "rate_hz": axes.rate_hz}
    return [
        {"shape": [side, side], "noise": noise, **common}
        for side in axes.sides
        for noise in axes.noise
    ]


def rate_cells(axes: Axes) -> list[dict[str, Any]]:
    """Cells at other rates, the rate changing first."""
    return [
        {"shape": [side, side], "noise": noise, "bits": axes.bits, "rate_hz": rate_hz}
        for side in axes.rate_sides
        for noise in axes.rate_noise
        for rate_hz in axes.rates_hz
    ]


def narrow_cells(axes: Axes) -> list[dict[str, Any]]:
    """Cells of narrow skins, high ones before wide ones, the shape changing first."""
    root = math.isqrt(axes.narrow)
    common = {"bits": axes.bits, "rate_hz": axes.rate_hz}
    return [
        {"shape": list(shape), "noise": noise, **common}
        for side in axes.narrow_sides
        for noise in axes.narrow_noise
        for shape in ((side * root, side // root), (side // root, side * root))
    ]


def touch_cells(axes: Axes) -> list[dict[str, Any]]:
    """Cells of the light touch, noise changing first."""
    return [
        {"shape": [side, side], "noise": noise, "bits": axes.bits}
        for side in axes.touch_sides
        for noise in axes.touch_noise
    ]


def write_grid(path: Path, grid: Grid) -> None:
    """Write a grid as JSON, figures of 6 digits; raises OSError."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return [plain(one) for one in value]
        if isinstance(value, float):
            return None if math.isnan(value) else float(f"{value:.6g}")
        return value

    def text(value: Any) -> str:
        return json.dumps(value, separators=(",", ":"))

    # A line a strategy, so that changes are seen.
    lines = [
        f"{text(name)}:{text({key: plain(value) for key, value in vars(table).items()})}"
        for name, table in grid.tables.items()
    ]
    head = f'{{"version":{GRID_VERSION},"axes":{text(asdict(grid.axes))},"strategies":{{'
    path.write_text("\n".join([head, ",\n".join(lines), "}}"]) + "\n", encoding="utf-8")


@cache
def stored_grid(path: Path = GRID_FILE) -> Grid:
    """Read the grid that is installed with the package, or another one."""
    record = json.loads(path.read_text("utf-8"))
    if record["version"] != GRID_VERSION:
        raise ValueError(f"{path}: version {record['version']}; expected {GRID_VERSION}")
    axes: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in record["axes"].items()
    }
    tables = {name: _table(table) for name, table in record["strategies"].items()}
    return Grid(Axes(**axes), tables)


def _table(record: Mapping[str, Any]) -> Table:
    figures: dict[str, Any] = {
        # None, which JSON has for NaN, becomes NaN.
        key: np.array(value, dtype=np.float64) if isinstance(value, list) else value
        for key, value in record.items()
    }
    return Table(**figures)


def _rounds_touch(strategy: str) -> bool:
    """True if a light touch is rounded to steps of the range, not of the frame's largest value."""
    return STRATEGIES[strategy].sums == SINGLE


def _log(values: Sequence[float]) -> Doubles:
    logs: Doubles = np.log(np.array(values, dtype=np.float64))
    return logs


def _outside(value: float, known: Sequence[float]) -> float:
    """Factor by which a value lies outside its known ones; 1 inside."""
    return max(known[0] / value, value / known[-1], 1.0)


def _linear(places: Doubles, values: Doubles, at: float) -> float:
    """Interpolate linearly between places, ascending; beyond them along the last piece."""
    if len(places) == 1:
        return float(values[0])
    k = int(np.clip(np.searchsorted(places, at) - 1, 0, len(places) - 2))
    part = (at - places[k]) / (places[k + 1] - places[k])
    # At a place its value alone counts, whatever the other is.
    if part == 0:
        return float(values[k])
    if part == 1:
        return float(values[k + 1])
    return float(values[k] * (1 - part) + values[k + 1] * part)
