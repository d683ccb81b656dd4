"""The geometry and range of a patch of taxels."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from .arrays import AnyArray, Floats, Integers, Mask
from .errors import FieldError, ShapeError
from .fields import MAX_SIDE
from .ranges import is_real, is_whole

PAPER_F_MAX_N = 2.5
"""Upper end of the range of the paper's taxels, newtons. Source: paper, section V-B."""
CONTACT_FRACTION = 0.004
"""A taxel is touched where its true force is above this part of f_max: 0.01 N of 2.5 N. Chosen:
below the noise of an untouched taxel (0.0141 N), far above the rounding of float32."""
MAX_COORDINATE_M = 1000.0
"""Largest coordinate of a taxel, metres; chosen: beyond any robot, within the precision of float32
(0.06 mm)."""
NORM_TOLERANCE = 1e-3
"""Allowed difference of the length of a normal from 1."""


@dataclass(frozen=True, eq=False)
class Skin:
    """The geometry and range of one patch of taxels.
    Raises MessageError if a side, the range, the mask or the points are not as stated.
    """

    n_rows: int
    n_cols: int
    """Size of the grid of taxels, 1..4096 each."""
    f_max: float
    """Upper end of the range, in `unit`; the peak of PSNR. Readings lie in [0, f_max]."""
    unit: str = "N"
    """Unit of the readings: "N" (newtons) or what a recording states, e.g. "raw"."""
    pitch_m: float | None = None
    """Distance between the centres of neighbouring taxels, metres; None where not known."""
    mask: Mask | None = None
    """True where a taxel exists, (n_rows, n_cols); None if all exist."""
    points: Floats | None = None
    """Of a skin that is no flat grid: x, y, z in metres, then the outward unit normal, of each cell
    that exists, in row-major order, (n_taxels, 6). Its grid is virtual: neighbours on it are
    neighbours on the surface, `pitch_m` is their median distance. None: a flat grid."""
    point_rows: Integers | None = None
    """Row of each point in its file, from 0, which is the place of its reading in a frame of the
    source, (n_taxels,)."""

    def __post_init__(self) -> None:
        for name, side in (("n_rows", self.n_rows), ("n_cols", self.n_cols)):
            if not is_whole(side, 1, MAX_SIDE):
                raise FieldError(f"skin: {name} = {side} is outside 1..{MAX_SIDE}")
        if not (is_real(self.f_max, 0.0) and self.f_max > 0):
            raise FieldError(f"skin: f_max = {self.f_max} must be finite and above 0")

        # The mask decides how many points there must be.
        if self.mask is not None:
            _check_array("the mask is", self.mask, np.bool_, self.shape)
            if not self.mask.any():
                raise FieldError("skin: the mask leaves no taxel")
        if self.points is not None:
            _check_points(self.points, self.n_taxels)
        if self.point_rows is not None:
            self._check_point_rows(self.point_rows)

    def _check_point_rows(self, point_rows: Integers) -> None:
        if self.points is None:
            raise FieldError("skin: point_rows without points")
        _check_array("point_rows are", point_rows, np.int32, (len(self.points),))
        if (point_rows < 0).any():
            raise FieldError(f"skin: point_rows, {int(point_rows.min())} is below 0")

    @property
    def shape(self) -> tuple[int, int]:
        """(n_rows, n_cols)."""
        return (self.n_rows, self.n_cols)

    @property
    def exists(self) -> Mask:
        """True where a taxel exists, bool (n_rows, n_cols)."""
        if self.mask is None:
            return np.ones(self.shape, dtype=np.bool_)
        return self.mask

    @property
    def n_taxels(self) -> int:
        """Number of taxels N: those that exist."""
        if self.mask is None:
            return self.n_rows * self.n_cols
        return int(np.count_nonzero(self.mask))

    def without(self, cells: Mask) -> Self:
        """The skin without some of its cells: bool (n_rows, n_cols), True where none is left.
        Raises MessageError if the shape differs, or no taxel is left.
        """
        exists = self.exists
        # Points have a row for each taxel that exists, in row-major order.
        remains = ~cells[exists]
        points = self.points
        rows = self.point_rows
        if points is not None:
            points = points[remains]
        if rows is not None:
            rows = rows[remains]
        return replace(self, mask=exists & ~cells, points=points, point_rows=rows)


def first_far(places: AnyArray) -> int | None:
    """Number of the first place, (n, 3) in metres, that is not within `MAX_COORDINATE_M` or not
    finite; None: there is none.
    """
    # Not `>`: NaN is not within it, either.
    near = (np.abs(places) <= MAX_COORDINATE_M).all(axis=1)
    if near.all():
        return None
    return int(np.argmin(near))


def _check_array(
    what: str, value: AnyArray, dtype: type, shape: tuple[int, ...]
) -> None:
    """Raise MessageError unless an array is of a type and shape."""
    if value.shape != shape or value.dtype != dtype:
        expected = f"expected {np.dtype(dtype)} {list(shape)}"
        raise ShapeError(f"skin: {what} {value.dtype} {list(value.shape)}, {expected}")


def _check_points(points: Floats, n: int) -> None:
    """Raise MessageError unless points are n rows of x, y, z and a unit normal."""
    _check_array("the points are", points, np.float32, (n, 6))
    # Its own test, not a norm: a coordinate may be infinite.
    k = first_far(points[:, :3])
    if k is not None:
        raise FieldError(f"skin: point {k} is not within {MAX_COORDINATE_M:g} m")

    # In float64, so that huge values do not overflow.
    normals = points[:, 3:].astype(np.float64)
    lengths = np.linalg.norm(normals, axis=1)
    # Not `>`: a length that is not a number is wrong, too.
    wrong = ~(np.abs(lengths - 1) <= NORM_TOLERANCE)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise FieldError(f"skin: normal {k} has length {lengths[k]:.4g}, expected 1")
