"""The description of one skin: geometry, range and calibration, and its form as messages."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sparseskin.messages import Calibration, SkinState
from sparseskin.messages.errors import MessageError
from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE, Integer, Real
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.numerics.arrays import AnyArray, Doubles, Floats, Integers, Mask

MAX_NAME = 64
"""Longest name of a skin, characters."""
MAX_UNIT = 32
"""Longest unit, characters, as in a message."""
MAX_KNOTS = 32
"""Most knots of a response curve, chosen: a person applies fewer weights."""
MAX_CURVES = 1 << 19
"""Most numbers of the response curves, so that a message holds them beside baseline and gains."""
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

    def point_rows(self, exists: Mask) -> Integers:
        """Row of each taxel of a mask of the grid among those of the file, int32 (n_taxels,)."""

    def summary(self) -> Sequence[str]:
        """Lines for a log: number of taxels, grid and distance; what was estimated or left out."""

    def check_size(self, n_readings: int) -> None:
        """Raise SourceError unless a frame of so many readings has one for each taxel."""

    def on_grid(self, values: AnyArray, unused: float = 0.0) -> AnyArray:
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
            raise SkinFileError(
                f"response.force: {k} knots; allowed are 1..{MAX_KNOTS}"
            )
        if self.reading.ndim not in (1, 3) or n != k:
            raise SkinFileError(
                f"response.reading: {n} knots, but response.force has {k}"
            )

        for name, values in vars(self).items():
            steps = np.diff(values, axis=0, prepend=0)
            if not ((steps > 0).all() and values.max() <= MAX_NUMBER):
                raise SkinFileError(
                    f"response.{name}: must be above 0, at most {MAX_NUMBER:g}, and "
                    "rise from knot to knot"
                )

        # Slopes of knots that are too close overflow, which the check refuses.
        with np.errstate(all="ignore"):
            is_allowed = _within_slopes(self.slopes)
        if not is_allowed:
            raise SkinFileError(
                f"response: a slope is outside {SLOPES} (force a reading)"
            )

    @property
    def slopes(self) -> Doubles:
        """Slopes of the K segments, shape of `reading`, in force per reading."""
        # The curve begins at (0, 0).
        rises = np.diff(self.force, prepend=0.0)
        runs = np.diff(self.reading, axis=0, prepend=0.0)
        # Rises of all taxels beside the runs of each.
        shape = (-1, *(1,) * (runs.ndim - 1))
        return rises.reshape(shape) / runs

    def forces(self, readings: AnyArray) -> Doubles:
        """Forces of readings, shape (..., n_rows, n_cols), any real dtype."""
        slopes = self.slopes
        forces: Doubles = slopes[0] * np.asarray(readings, dtype=np.float64)
        # At each knot but the last the slope changes.
        for knot, change in zip(self.reading, np.diff(slopes, axis=0), strict=False):
            forces += change * np.maximum(0.0, readings - knot)
        return forces


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
    #: (rows, cols), True where a taxel exists and works; None: all do.
    mask: Mask | None = None
    #: (rows, cols), raw readings of the untouched skin; None: 0.
    baseline: Doubles | None = None
    #: (rows, cols), factors of raw readings above the baseline, not 0, negative where a reading
    #: falls with force; None: 1.
    gains: Doubles | None = None
    response: Response | None = None  # after the gains; None: the identity
    #: Standard deviation of an untouched taxel before clipping, in `unit`; None: not measured.
    noise: float | None = None
    noise_mid: float | None = None  # the same at half the range; None: as `noise`
    #: Lower end of the range, -f_max..0: below 0, noise is not clipped.
    f_min: float = 0.0
    #: (rows, cols, 6): place in metres and unit normal of the taxel of each cell of a virtual grid,
    #: as in `Skin`; of cells without a taxel, anything. None: a flat grid.
    points: Floats | None = None
    placement: Placement | None = None  # of readings on that grid; None: as they come

    def __post_init__(self) -> None:
        self._check_text("name", MAX_NAME)
        self._check_text("unit", MAX_UNIT)
        self._check_numbers()
        self._check_array("mask", np.bool_, self.shape)
        self._check_array("baseline", np.float64, self.shape)
        self._check_array("gains", np.float64, self.shape)
        self._check_array("points", np.float32, (*self.shape, 6))
        self._check_values()

    def _check_text(self, key: str, longest: int) -> None:
        text = getattr(self, key)
        is_printable = isinstance(text, str) and text.strip() and text.isprintable()
        if not (is_printable and len(text) <= longest):
            raise SkinFileError(
                f"{key}: expected 1..{longest} printable characters, got "
                f"{ascii(text)[:40]}"
            )

    def _check_numbers(self) -> None:
        """Check the size and range, which bound what the arrays may hold."""
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
        # `sigmas` would leave it out.
        if self.noise is None and self.noise_mid is not None:
            raise SkinFileError("noise_mid: is stated without noise")

    def _check_array(
        self, key: str, dtype: type[np.generic], shape: tuple[int, ...]
    ) -> None:
        array = getattr(self, key)
        if array is not None and (array.shape != shape or array.dtype != dtype):
            raise SkinFileError(
                f"{key}: {array.dtype} of shape {array.shape}; expected "
                f"{np.dtype(dtype)} of shape {shape}"
            )

    def _check_values(self) -> None:
        if self.mask is not None and not self.mask.any():
            raise SkinFileError("mask: leaves no taxel")
        # Not `>`, here and in `_within_slopes`: NaN is no number, either.
        baseline = self.baseline
        if baseline is not None and not (np.abs(baseline) <= MAX_NUMBER).all():
            raise SkinFileError(f"baseline: expected numbers of at most {MAX_NUMBER:g}")
        if self.gains is not None and not _within_slopes(np.abs(self.gains)):
            raise SkinFileError(
                f"gains: expected numbers of {SLOPES}, or below 0 the same"
            )

        if self.response is None:
            return
        reading = self.response.reading
        if reading.shape[1:] not in ((), self.shape) or reading.size > MAX_CURVES:
            raise SkinFileError(
                f"response.reading: shape {reading.shape}; expected K numbers, or K "
                f"grids of {self.shape}, {MAX_CURVES} numbers at most"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return (self.n_rows, self.n_cols)

    @property
    def skin(self) -> Skin:
        """Geometry and range, as messages carry them."""
        exists = np.ones(self.shape, np.bool_) if self.mask is None else self.mask
        pitch_m = None
        if self.pitch_mm is not None:
            pitch_m = self.pitch_mm / 1000.0

        # A skin has a row for each taxel that exists, a grid has one for each cell.
        points = None
        if self.points is not None:
            points = self.points[exists]
        point_rows = None
        if self.placement is not None:
            point_rows = self.placement.point_rows(exists)
        return Skin(
            *self.shape,
            self.f_max,
            self.unit,
            pitch_m,
            mask=None if exists.all() else exists,
            points=points,
            point_rows=point_rows,
        )

    @property
    def sigmas(self) -> tuple[float, float] | None:
        """Noise of a taxel at half the range, and untouched, in `unit`; None: not known."""
        if self.noise is None:
            return None
        if self.noise_mid is None:
            return self.noise, self.noise
        return self.noise_mid, self.noise

    @property
    def changes_readings(self) -> bool:
        """True if a reading and its force may differ: a baseline, gains or a curve."""
        # Drift and clipping do not count: they are no part of a description.
        steps = (self.baseline, self.gains, self.response)
        return any(step is not None for step in steps)

    def forces(self, raw: AnyArray) -> Doubles:
        """Forces of raw readings, shape (..., rows, cols), not clipped to the range; 0 in masked
        cells. A fresh array.
        """
        # In float64: counts of a converter of 24 bits less a baseline near them.
        forces = np.array(raw, dtype=np.float64)
        if self.baseline is not None:
            forces -= self.baseline
        if self.gains is not None:
            forces *= self.gains
        if self.response is not None:
            forces = self.response.forces(forces)
        if self.mask is not None:
            forces[..., ~self.mask] = 0.0
        return forces

    def inverted(self) -> "SkinDescription":
        """This description for readings that fall where it has them rise with force."""
        gains = np.ones(self.shape) if self.gains is None else self.gains
        return replace(self, gains=-gains)

    def on(self, skin: Skin, where: str) -> "SkinDescription":
        """This description for a source with a skin of its own: cells that it masks are masked.
        Raises SourceError, after `where`, if the source has another shape.
        """
        if self.shape != skin.shape:
            own_size = "{} x {}".format(*self.shape)
            source_size = "{} x {}".format(*skin.shape)
            raise SourceError(
                f"{where}: describes {own_size} taxels, but the source has {source_size}"
            )

        points = self.points
        if points is None:
            points = points_on_grid(skin)
        mask = self.mask
        if skin.mask is not None:
            mask = skin.exists & self.skin.exists
        return replace(self, points=points, mask=mask)

    def message(self, stamp_ns: int, patch: str) -> Calibration:
        """The calibration as a message, in float32."""
        reading = None
        force = None
        if self.response is not None:
            reading = self.response.reading
            force = self.response.force
            if reading.ndim == 1:  # of all taxels: a grid of one cell in a message
                reading = reading[:, np.newaxis, np.newaxis]
        return Calibration(
            stamp_ns=stamp_ns,
            patch=patch,
            name=self.name,
            baseline=_in_single(self.baseline),
            gains=_in_single(self.gains),
            response_reading=_in_single(reading),
            response_force=_in_single(force),
        )


def _in_single(array: Doubles | None) -> Floats | None:
    """An array in the precision of messages."""
    if array is None:
        return None
    return np.ascontiguousarray(array, dtype=np.float32)


def _in_double(array: Floats | None) -> Doubles | None:
    """An array of a message in the precision of a description."""
    if array is None:
        return None
    return array.astype(np.float64)


def _within_slopes(sizes: Doubles) -> bool:
    return bool(((sizes >= MIN_SLOPE) & (sizes <= MAX_SLOPE)).all())


def of_skin(name: str, skin: Skin) -> SkinDescription:
    """Description of a skin without a calibration: its readings are forces."""
    text = "".join(char for char in name if char.isprintable()).strip()
    return SkinDescription(
        name=text[:MAX_NAME] or "skin",
        n_rows=skin.n_rows,
        n_cols=skin.n_cols,
        f_max=float(skin.f_max),
        unit=skin.unit,
        pitch_mm=1000 * skin.pitch_m if skin.pitch_m else None,
        mask=skin.mask,
        points=points_on_grid(skin),
    )


def of_messages(state: SkinState, calibration: Calibration) -> SkinDescription:
    """The skin that the messages of a patch describe, the inverse of `SkinDescription.message` up
    to the rounding of float32. Raises SkinFileError if they contradict each other.
    """
    reading = _in_double(calibration.response_reading)
    force = _in_double(calibration.response_force)
    response = None
    if reading is not None and force is not None:
        is_of_one_cell = reading.shape[1:] == (1, 1)
        if is_of_one_cell and (state.n_rows, state.n_cols) != (1, 1):
            reading = reading[:, 0, 0]
        response = Response(reading, force)

    # A message has 0 for noise that is not known.
    noise = state.sigma_end or None
    noise_mid = state.sigma_mid or None
    return replace(
        of_skin(calibration.name, state.skin),
        baseline=_in_double(calibration.baseline),
        gains=_in_double(calibration.gains),
        response=response,
        noise=noise,
        noise_mid=None if noise is None else noise_mid,
        f_min=state.f_min,
    )


def points_on_grid(skin: Skin) -> Floats | None:
    """The points of a skin in the cells of its grid, float32 (n_rows, n_cols, 6); 0 elsewhere."""
    if skin.points is None:
        return None
    points = np.zeros((*skin.shape, 6), dtype=np.float32)
    points[skin.exists] = skin.points
    return points
