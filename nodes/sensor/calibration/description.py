"""The description of one skin: geometry, range and calibration, and its form as messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Calibration, SkinState
from sparseskin.messages.errors import MessageError
from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE, Integer, Real
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask

MAX_NAME = 64
"""Longest name of a skin, characters."""
MAX_UNIT = 32
"""Longest unit, characters, as in a message."""
MAX_KNOTS = 32
"""Most knots of a response curve, chosen: a person applies fewer weights."""
MAX_CURVES = 1 << 19
"""Most numbers of the response curves, so that a message holds them beside baseline and gains."""
ARRAYS = ("baseline", "gains", "response_reading", "response_force")
"""Arrays of a message of a calibration."""
MAX_NUMBER = 1e30
"""Largest baseline, knot or range: as that of a reading, float32 holds it."""
MIN_SLOPE = 1e-12
MAX_SLOPE = 1e12
"""Allowed gains, and slopes of a response curve, by magnitude."""
SLOPES = f"{MIN_SLOPE:g}..{MAX_SLOPE:g}"


class SkinFileError(SparseskinError):
    """A skin.toml that cannot be read, used or written: the file, the key, what is allowed."""


class Placement(Protocol):
    """The virtual grid of a skin of points, as a plug-in makes it."""

    @property
    def layout(self) -> str:
        """Absolute path of the file with the points, or `example:NAME`."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""

    @property
    def pitch_m(self) -> float:
        """Median distance of neighbours, metres."""

    def skin(self, f_max: float, unit: str) -> Skin:
        """The skin of this grid with a range."""

    def point_rows(self, exists: Mask) -> npt.NDArray[np.int32]:
        """Row of each taxel of a mask of the grid among those of the file, int32 (n_taxels,)."""

    def summary(self) -> Sequence[str]:
        """Lines for a log: number of taxels, grid and distance; what was estimated or left out."""

    def check_size(self, n_readings: int) -> None:
        """Raise SourceError unless a frame of so many readings has one for each taxel."""

    def on_grid(self, values: npt.NDArray[Any], unused: float = 0.0) -> npt.NDArray[Any]:
        """Readings in the order of the file on the grid, of the same dtype; `unused` in cells
        without a taxel. Raises SourceError as `check_size`.
        """


@dataclass(frozen=True, eq=False)
class Response:
    """The response curve of the taxels: force against reading, piecewise linear and rising.

    It passes through (0, 0) and the K knots. Below 0 it goes on with the slope of its first
    segment, beyond the last knot with that of its last. Raises SkinFileError if a number is not as
    stated, or a slope is outside 1e-12..1e12.

    Attributes
    ----------
    reading : ndarray of float64, shape (K,) or (K, n_rows, n_cols)
        (raw - baseline) times gain at the knots, of all taxels or of each, above 0 and rising.
    force : ndarray of float64, shape (K,)
        Forces at the knots, in the skin's unit, above 0 and rising.
    """

    reading: Doubles
    force: Doubles

    def __post_init__(self) -> None:
        k = len(self.force)
        n = len(self.reading)
        if not (self.force.ndim == 1 and 1 <= k <= MAX_KNOTS):
            raise SkinFileError(f"response.force: {k} knots; allowed are 1..{MAX_KNOTS}")
        if self.reading.ndim not in (1, 3) or n != k:
            raise SkinFileError(f"response.reading: {n} knots, but response.force has {k}")
        for name, values in vars(self).items():
            steps = np.diff(values, axis=0, prepend=0)
            if not ((steps > 0).all() and values.max() <= MAX_NUMBER):
                allowed = f"must be above 0, at most {MAX_NUMBER:g}, and rise from knot to knot"
                raise SkinFileError(f"response.{name}: {allowed}")
        with np.errstate(all="ignore"):
            is_allowed = _within_slopes(self.slopes)
        if not is_allowed:
            raise SkinFileError(f"response: a slope is outside {SLOPES} (force a reading)")

    @property
    def slopes(self) -> Doubles:
        """Slopes of the K segments, shape of `reading`, in force per reading."""
        rise = np.diff(self.force, prepend=0.0)
        shape = (-1, *(1,) * (self.reading.ndim - 1))
        slopes: Doubles = rise.reshape(shape) / np.diff(self.reading, axis=0, prepend=0.0)
        return slopes

    def forces(self, readings: npt.NDArray[Any]) -> Doubles:
        """Forces of readings, shape (..., n_rows, n_cols), any real dtype."""
        slopes = self.slopes
        found: Doubles = slopes[0] * np.asarray(readings, dtype=np.float64)
        for knot, change in zip(self.reading, np.diff(slopes, axis=0), strict=False):
            found += change * np.maximum(0.0, readings - knot)
        return found


@dataclass(frozen=True, eq=False)
class SkinDescription:
    """The description of one skin, as its skin.toml states it.

    A raw reading c of a taxel becomes the force R(g (c - b)): b its baseline, g its gain, R the
    response curve, which is the identity where none is stated.

    Raises SkinFileError if a value is not as stated; the text begins with its key.
    """

    name: str  # at most 64 printable characters
    n_rows: int  # 1..4096, as n_cols; 2**20 cells at most
    n_cols: int
    f_max: float  # upper end of the range of a taxel, in `unit`, above 0
    unit: str = "N"  # of the calibrated readings, at most 32 printable characters
    pitch_mm: float | None = None  # between the centres of neighbouring taxels
    mask: Mask | None = None  # (rows, cols), True where a taxel exists and works; None: all do
    baseline: Doubles | None = None  # (rows, cols), raw readings of the untouched skin; None: 0
    #: (rows, cols), factors of raw readings above the baseline, not 0, negative where a reading
    #: falls with force; None: 1.
    gains: Doubles | None = None
    response: Response | None = None  # after the gains; None: the identity
    #: Standard deviation of an untouched taxel before clipping, in `unit`; None: not measured.
    noise: float | None = None
    noise_mid: float | None = None  # the same at half the range; None: as `noise`
    f_min: float = 0.0  # lower end of the range, -f_max..0: below 0, noise is not clipped
    #: (rows, cols, 6): place in metres and unit normal of the taxel of each cell of a virtual grid,
    #: as in `Skin`; of cells without a taxel, anything. None: a flat grid.
    points: Floats | None = None
    placement: Placement | None = None  # of readings on that grid; None: as they come

    def __post_init__(self) -> None:
        for key, longest in (("name", MAX_NAME), ("unit", MAX_UNIT)):
            text = getattr(self, key)
            printable = isinstance(text, str) and text.strip() and text.isprintable()
            if not (printable and len(text) <= longest):
                expected = f"expected 1..{longest} printable characters"
                raise SkinFileError(f"{key}: {expected}, got {ascii(text)[:40]}")
        try:
            for key in ("n_rows", "n_cols"):
                Integer(1, MAX_SIDE).check(key, getattr(self, key))
            Real(1e-9, MAX_NUMBER).check("f_max", self.f_max)
            Real(-self.f_max, 0.0).check("f_min", self.f_min)
            Real(1e-6, 1e6, optional=True).check("pitch_mm", self.pitch_mm)
            for key in ("noise", "noise_mid"):
                Real(0.0, self.f_max, optional=True).check(key, getattr(self, key))
        except MessageError as error:
            raise SkinFileError(str(error)) from error
        if self.n_rows * self.n_cols > MAX_ELEMENTS:
            raise SkinFileError(
                f"n_rows: {self.n_rows} x {self.n_cols} cells; at most {MAX_ELEMENTS}"
            )
        if self.noise is None and self.noise_mid is not None:
            raise SkinFileError("noise_mid: is stated without noise")
        for key, dtype, beyond in (
            ("mask", np.bool_, ()),
            ("baseline", np.float64, ()),
            ("gains", np.float64, ()),
            ("points", np.float32, (6,)),
        ):
            array = getattr(self, key)
            shape = (*self.shape, *beyond)
            if array is not None and (array.shape != shape or array.dtype != dtype):
                expected = f"expected {np.dtype(dtype)} of shape {shape}"
                raise SkinFileError(f"{key}: {array.dtype} of shape {array.shape}; {expected}")
        if self.mask is not None and not self.mask.any():
            raise SkinFileError("mask: leaves no taxel")
        if self.baseline is not None and not (np.abs(self.baseline) <= MAX_NUMBER).all():
            raise SkinFileError(f"baseline: expected numbers of at most {MAX_NUMBER:g}")
        if self.gains is not None and not _within_slopes(np.abs(self.gains)):
            raise SkinFileError(f"gains: expected numbers of {SLOPES}, or below 0 the same")
        reading = np.zeros(0) if self.response is None else self.response.reading
        if reading.shape[1:] not in ((), self.shape) or reading.size > MAX_CURVES:
            expected = f"K numbers, or K grids of {self.shape}, {MAX_CURVES} numbers at most"
            raise SkinFileError(f"response.reading: shape {reading.shape}; expected {expected}")

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return (self.n_rows, self.n_cols)

    @property
    def skin(self) -> Skin:
        """Geometry and range, as messages carry them."""
        exists = np.ones(self.shape, np.bool_) if self.mask is None else self.mask
        mask = None if exists.all() else exists
        pitch_m = None if self.pitch_mm is None else self.pitch_mm / 1000.0
        points = None if self.points is None else self.points[exists]
        rows = None if self.placement is None else self.placement.point_rows(exists)
        return Skin(*self.shape, self.f_max, self.unit, pitch_m, mask, points, rows)

    @property
    def sigmas(self) -> tuple[float, float] | None:
        """Noise of a taxel at half the range, and untouched, in `unit`; None: not known."""
        if self.noise is None:
            return None
        return (self.noise if self.noise_mid is None else self.noise_mid), self.noise

    @property
    def changes_readings(self) -> bool:
        """True if a reading and its force may differ: a baseline, gains or a curve."""
        return any(one is not None for one in (self.baseline, self.gains, self.response))

    def forces(self, raw: npt.NDArray[Any]) -> Doubles:
        """Forces of raw readings, shape (..., rows, cols), not clipped to the range; 0 in masked
        cells. A fresh array.
        """
        found: Doubles = np.array(raw, dtype=np.float64)
        if self.baseline is not None:
            found -= self.baseline
        if self.gains is not None:
            found *= self.gains
        if self.response is not None:
            found = self.response.forces(found)
        if self.mask is not None:
            found[..., ~self.mask] = 0.0
        return found

    def inverted(self) -> SkinDescription:
        """This description for readings that fall where it has them rise with force."""
        gains = np.ones(self.shape) if self.gains is None else self.gains
        return replace(self, gains=-gains)

    def on(self, skin: Skin, where: str) -> SkinDescription:
        """This description for a source with a skin of its own: cells that it masks are masked.
        Raises SourceError, after `where`, if the source has another shape.
        """
        if self.shape != skin.shape:
            sizes = "{} x {} taxels, but the source has {} x {}".format(*self.shape, *skin.shape)
            raise SourceError(f"{where}: describes {sizes}")
        points = points_on_grid(skin) if self.points is None else self.points
        mask = self.mask if skin.mask is None else skin.exists & self.skin.exists
        return replace(self, points=points, mask=mask)

    def message(self, stamp_ns: int, patch: str) -> Calibration:
        """The calibration as a message, in float32."""
        reading = force = None
        if self.response is not None:
            reading = self.response.reading
            force = self.response.force
            reading = reading if reading.ndim == 3 else reading[:, None, None]
        single: dict[str, Any] = {
            key: None if array is None else np.ascontiguousarray(array, dtype=np.float32)
            for key, array in zip(ARRAYS, (self.baseline, self.gains, reading, force), strict=True)
        }
        return Calibration(stamp_ns=stamp_ns, patch=patch, name=self.name, **single)


def _within_slopes(sizes: Doubles) -> bool:
    return bool(((sizes >= MIN_SLOPE) & (sizes <= MAX_SLOPE)).all())


def of_skin(name: str, skin: Skin) -> SkinDescription:
    """Description of a skin without a calibration: its readings are forces."""
    text = "".join(char for char in name if char.isprintable()).strip()[:MAX_NAME] or "skin"
    return SkinDescription(
        *(text, skin.n_rows, skin.n_cols, float(skin.f_max), skin.unit),
        pitch_mm=1000 * skin.pitch_m if skin.pitch_m else None,
        mask=skin.mask,
        points=points_on_grid(skin),
    )


def of_messages(state: SkinState, calibration: Calibration) -> SkinDescription:
    """The skin that the messages of a patch describe, the inverse of `SkinDescription.message` up
    to the rounding of float32. Raises SkinFileError if they contradict each other.
    """
    single = (getattr(calibration, key) for key in ARRAYS)
    baseline, gains, reading, force = (
        None if array is None else array.astype(np.float64) for array in single
    )
    response = None
    if reading is not None and force is not None:
        shared = reading.shape[1:] == (1, 1) != (state.n_rows, state.n_cols)
        response = Response(reading[:, 0, 0] if shared else reading, force)
    return replace(
        of_skin(calibration.name, state.skin),
        baseline=baseline,
        gains=gains,
        response=response,
        noise=state.sigma_end or None,
        noise_mid=state.sigma_mid if state.sigma_mid and state.sigma_end else None,
        f_min=state.f_min,
    )


def points_on_grid(skin: Skin) -> Floats | None:
    """The points of a skin in the cells of its grid, float32 (n_rows, n_cols, 6); 0 elsewhere."""
    if skin.points is None:
        return None
    found = np.zeros((*skin.shape, 6), dtype=np.float32)
    found[skin.exists] = skin.points
    return found
