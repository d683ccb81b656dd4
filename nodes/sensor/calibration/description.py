"""The description of one skin: geometry, range and calibration, and its form as messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sparseskin.messages import Calibration, SkinState
from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE
from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask

from .response import MAX_NUMBER, MAX_SLOPE, MIN_SLOPE, Response, SkinFileError

if TYPE_CHECKING:
    from sparseskin.nodes.sensor.placement import Placement

MAX_NAME = 64
"""Longest name of a skin, characters."""
MAX_UNIT = 32
"""Longest unit, characters, as in a message."""
MAX_CURVES = 1 << 19
"""Most numbers of the response curves, so that a message holds them beside baseline and gains."""


@dataclass(frozen=True, eq=False)
class SkinDescription:
    """The description of one skin, as its skin.toml states it.

    A raw reading c of a taxel becomes the force R(g (c - b)): b its baseline, g its gain, R the
    response curve, which is the identity where none is stated.

    Attributes
    ----------
    name : str
        Name of the skin, at most 64 printable characters.
    rows, cols : int
        Size of the grid of taxels, 1..4096 each, 2**20 cells at most.
    f_max : float
        Upper end of the range of a taxel, in `unit`, above 0.
    unit : str
        Unit of the calibrated readings, at most 32 printable characters.
    pitch_mm : float or None
        Distance between the centres of neighbouring taxels, millimetres.
    mask : ndarray of bool, shape (rows, cols), or None
        True where a taxel exists and works; None if all do.
    baseline : ndarray of float64, shape (rows, cols), or None
        Raw readings of the untouched skin; None: 0.
    gains : ndarray of float64, shape (rows, cols), or None
        Factors of raw readings above the baseline, not 0, negative where a reading falls with
        force; None: 1.
    response : Response or None
        Response curve after the gains; None: the identity.
    noise : float or None
        Standard deviation of the noise of an untouched taxel before clipping, in `unit`; None where
        it was not measured.
    noise_mid : float or None
        The same at half the range; None: as `noise`.
    f_min : float
        Lower end of the range, -f_max..0, in `unit`: below 0, noise around 0 is not clipped.
    points : ndarray of float32, shape (rows, cols, 6), or None
        Place in metres and unit normal of the taxel of each cell of a virtual grid, as in
        `sparseskin.messages.skin.Skin`; of cells without a taxel, anything. None: a flat grid.
    placement : Placement or None
        Where the readings of the source are to stand on that grid; None: as they come.

    Raises
    ------
    SkinFileError
        If a value is not as stated; the text begins with its key.
    """

    name: str
    rows: int
    cols: int
    f_max: float
    unit: str = "N"
    pitch_mm: float | None = None
    mask: Mask | None = None
    baseline: Doubles | None = None
    gains: Doubles | None = None
    response: Response | None = None
    noise: float | None = None
    noise_mid: float | None = None
    f_min: float = 0.0
    points: Floats | None = None
    placement: Placement | None = None

    def __post_init__(self) -> None:
        for key, longest in (("name", MAX_NAME), ("unit", MAX_UNIT)):
            text = getattr(self, key)
            if not (isinstance(text, str) and text.strip() and text.isprintable()):
                raise SkinFileError(f"{key}: expected a printable text, got {ascii(text)[:40]}")
            if len(text) > longest:
                raise SkinFileError(f"{key}: {len(text)} characters; at most {longest}")
        for key in ("rows", "cols"):
            side = getattr(self, key)
            if not is_whole(side, 1, MAX_SIDE):
                shown = ascii(side)[:40]
                raise SkinFileError(f"{key}: expected a whole number in 1..{MAX_SIDE}, got {shown}")
        if self.rows * self.cols > MAX_ELEMENTS:
            raise SkinFileError(f"rows: {self.rows} x {self.cols} cells; at most {MAX_ELEMENTS}")
        self._check_number("f_max", 1e-9, MAX_NUMBER)
        self._check_number("pitch_mm", 1e-6, 1e6)
        self._check_number("noise", 0.0, self.f_max)
        self._check_number("noise_mid", 0.0, self.f_max)
        self._check_number("f_min", -self.f_max, 0.0)
        if self.noise is None and self.noise_mid is not None:
            raise SkinFileError("noise_mid: is stated without noise")
        self._check_array("mask", np.bool_, self.shape)
        self._check_array("baseline", np.float64, self.shape)
        self._check_array("gains", np.float64, self.shape)
        self._check_array("points", np.float32, (*self.shape, 6))
        if self.mask is not None and not self.mask.any():
            raise SkinFileError("mask: leaves no taxel")
        if self.baseline is not None and not (np.abs(self.baseline) <= MAX_NUMBER).all():
            raise SkinFileError(f"baseline: expected numbers of at most {MAX_NUMBER:g}")
        if self.gains is not None:
            size = np.abs(self.gains)
            if not ((size >= MIN_SLOPE) & (size <= MAX_SLOPE)).all():
                raise SkinFileError(
                    f"gains: expected numbers of {MIN_SLOPE:g}..{MAX_SLOPE:g}, or below 0 the same"
                )
        if self.response is not None:
            reading = self.response.reading
            if reading.shape[1:] not in ((), self.shape):
                raise SkinFileError(
                    f"response.reading: shape {reading.shape}; expected K numbers, or K grids of "
                    f"{self.shape}"
                )
            if reading.size > MAX_CURVES:
                raise SkinFileError(
                    f"response.reading: {reading.size} numbers; at most {MAX_CURVES}"
                )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return (self.rows, self.cols)

    @property
    def skin(self) -> Skin:
        """Geometry and range, as messages carry them."""
        mask = None if self.mask is None or self.mask.all() else self.mask
        pitch_m = None if self.pitch_mm is None else self.pitch_mm / 1000.0
        points = self.points
        if points is not None:
            points = points[np.ones(self.shape, np.bool_) if mask is None else mask]
        return Skin(self.rows, self.cols, self.f_max, self.unit, pitch_m, mask, points)

    @property
    def changes_readings(self) -> bool:
        """True if a reading and its force may differ: a baseline, gains or a curve."""
        stated = (self.baseline, self.gains, self.response)
        return any(one is not None for one in stated)

    def message(self, stamp_ns: int, patch: str) -> Calibration:
        """The calibration as a message, in float32."""
        reading = force = None
        if self.response is not None:
            reading, force = self.response.reading, self.response.force
            reading = reading if reading.ndim == 3 else reading[:, None, None]

        def single(array: Doubles | None) -> Floats | None:
            return None if array is None else np.ascontiguousarray(array, dtype=np.float32)

        return Calibration(
            stamp_ns=stamp_ns,
            patch=patch,
            name=self.name,
            baseline=single(self.baseline),
            gains=single(self.gains),
            response_reading=single(reading),
            response_force=single(force),
        )

    def _check_number(self, key: str, low: float, high: float) -> None:
        value = getattr(self, key)
        optional = key in ("pitch_mm", "noise", "noise_mid")
        if not (value is None and optional) and not is_real(value, low, high):
            shown = ascii(value)[:40]
            raise SkinFileError(f"{key}: expected a number in {low:g}..{high:g}, got {shown}")

    def _check_array(self, key: str, dtype: type[np.generic], shape: tuple[int, ...]) -> None:
        array = getattr(self, key)
        if array is not None and (array.shape != shape or array.dtype != dtype):
            raise SkinFileError(
                f"{key}: {array.dtype} of shape {array.shape}; expected {np.dtype(dtype)} of "
                f"shape {shape}"
            )


def of_messages(state: SkinState, calibration: Calibration) -> SkinDescription:
    """The skin that the messages of a patch describe, the inverse of `SkinDescription.message` up
    to the rounding of float32.

    Raises
    ------
    SkinFileError
        If the messages, which may come from anywhere, contradict each other.
    """

    def double(array: Floats | None) -> Doubles | None:
        return None if array is None else array.astype(np.float64)

    response = None
    reading, force = double(calibration.response_reading), double(calibration.response_force)
    if reading is not None and force is not None:
        shared = reading.shape[1:] == (1, 1) != (state.n_rows, state.n_cols)
        response = Response(reading[:, 0, 0] if shared else reading, force)
    return SkinDescription(
        *(calibration.name, state.n_rows, state.n_cols, state.f_max, state.unit),
        pitch_mm=1000 * state.pitch_m if state.pitch_m else None,
        mask=state.mask,
        baseline=double(calibration.baseline),
        gains=double(calibration.gains),
        response=response,
        noise=state.sigma_end or None,
        noise_mid=state.sigma_mid if state.sigma_mid and state.sigma_end else None,
        f_min=state.f_min,
        points=points_on_grid(state.skin),
    )


def points_on_grid(skin: Skin) -> Floats | None:
    """The points of a skin in the cells of its grid, float32 (n_rows, n_cols, 6); 0 elsewhere."""
    if skin.points is None:
        return None
    found = np.zeros((*skin.shape, 6), dtype=np.float32)
    found[skin.exists] = skin.points
    return found
