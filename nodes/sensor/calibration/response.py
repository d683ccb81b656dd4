"""The response curve of a taxel: force against reading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import Doubles

MAX_KNOTS = 32
"""Most knots of a response curve, chosen: a person applies fewer weights."""
MAX_NUMBER = 1e30
"""Largest baseline, knot or range: as that of a reading, float32 holds it."""
MIN_SLOPE, MAX_SLOPE = 1e-12, 1e12
"""Allowed gains, and slopes of a response curve, by magnitude."""


class SkinFileError(SparseskinError):
    """A skin.toml that cannot be read, used or written: the file, the key, what is allowed."""


@dataclass(frozen=True, eq=False)
class Response:
    """The response curve of the taxels: force against reading, piecewise linear and rising.

    It passes through (0, 0) and the K knots. Below 0 it goes on with the slope of its first
    segment, beyond the last knot with that of its last. The inverse is of the same kind: a curve
    of one for all taxels whose knots are exchanged.

    Attributes
    ----------
    reading : ndarray of float64, shape (K,) or (K, n_rows, n_cols)
        Readings at the knots, above 0 and rising, of all taxels or of each: (raw - baseline) times
        gain.
    force : ndarray of float64, shape (K,)
        Forces at the knots, above 0 and rising, in the skin's unit.

    Raises
    ------
    SkinFileError
        If a number is not as stated, or a slope is outside 1e-12..1e12.
    """

    reading: Doubles
    force: Doubles

    def __post_init__(self) -> None:
        k = len(self.force)
        if not (self.force.ndim == 1 and 1 <= k <= MAX_KNOTS):
            raise SkinFileError(f"response.force: {k} knots; allowed are 1..{MAX_KNOTS}")
        if self.reading.ndim not in (1, 3) or len(self.reading) != k:
            raise SkinFileError(
                f"response.reading: {len(self.reading)} knots, but response.force has {k}"
            )
        for name, values in (("reading", self.reading), ("force", self.force)):
            if values.dtype != np.float64:
                raise SkinFileError(f"response.{name}: {values.dtype}; expected float64")
            if not np.isfinite(values).all() or not (np.diff(values, axis=0, prepend=0) > 0).all():
                raise SkinFileError(f"response.{name}: must be above 0 and rise from knot to knot")
            if values.max() > MAX_NUMBER:
                raise SkinFileError(f"response.{name}: at most {MAX_NUMBER:g}")
        with np.errstate(all="ignore"):
            slopes = self.slopes
        if not ((slopes >= MIN_SLOPE) & (slopes <= MAX_SLOPE)).all():
            raise SkinFileError(
                f"response: a slope is outside {MIN_SLOPE:g}..{MAX_SLOPE:g} (force a reading)"
            )

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
