"""Contacts of a frame: where the skin is touched, how strong, since when, and what changed."""

import re
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from .arrays import AnyArray, Floats, Integers, Mask
from .errors import ShapeError
from .fields import Array, Integer, omitted, wire
from .frames import TRUSTED, Frames

BEGIN, END, OVER, SLIDE, TOUCH = range(5)
EVENTS = ("begin", "end", "over", "slide", "touch")
"""Names of the events, by number."""


def _column(dtype: str, ndim: int = 1, optional: bool = False) -> Any:
    """A field with an entry or a row for each contact, of which there may be none."""
    kind = Array(dtype, ndim, optional=optional, sparse=True)
    if optional:
        return omitted(kind)
    return wire(kind)


@dataclass(frozen=True, kw_only=True, eq=False)
class Contacts(Frames):
    """Contacts of a reconstructed frame: arrays with an entry or a row for each, n of them."""

    schema: ClassVar[str] = "contacts"
    times: ClassVar[tuple[str, ...]] = ("stamp_ns", "done_ns")

    id: Integers = _column("<i4")
    """Number of a contact, which it keeps from frame to frame, from 1 on."""
    total: Floats = _column("<f4")
    total_sd: Floats = _column("<f4")
    peak: Floats = _column("<f4")
    """Sum of its forces, standard deviation of that, and largest force, in the skin's unit."""
    centre: Floats = _column("<f4", 2)
    centre_sd: Floats = _column("<f4", 2)
    """Row and column of the centre of pressure, from the middle of taxel (0, 0), and deviations."""
    area: Integers = _column("<i4")
    """Number of taxels."""
    velocity: Floats = _column("<f4", 2)
    """Of the centre, rows and columns a second."""
    age_s: Floats = _column("<f4")
    over: Mask = _column("|b1")
    sliding: Mask = _column("|b1")
    """True from the event of that name until force or speed are half of what it was reported at."""
    done_ns: int = wire(Integer())
    """Time of the estimate on the graph's clock, nanoseconds."""
    trusted: tuple[bool, ...] = omitted(TRUSTED, ())
    """As of the reconstruction, of each patch."""
    place_mm: Floats | None = _column("<f4", 2, optional=True)
    place_sd_mm: Floats | None = _column("<f4", 2, optional=True)
    """Centre (n, 3), x, y, z, and deviations: of a flat skin, column and row times the pitch, and
    0; of one of points, in the frame of their file. None where no pitch is known."""
    velocity_mm_s: Floats | None = _column("<f4", 2, optional=True)
    """Of that, (n, 3)."""
    area_mm2: Floats | None = _column("<f4", 1, optional=True)
    """Number of taxels times the square of the pitch."""
    normal: Floats | None = _column("<f4", 2, optional=True)
    """Outward unit normal, (n, 3), of a skin of points."""
    patch_of: Integers | None = _column("<i4", 1, optional=True)
    """Row in `patches` of each contact's patch; None: all are of the first."""
    events: Integers | None = _column("<i4", 2, optional=True)
    """What changed in this frame, (n_events, 3): row of the patch in `patches`, id, and number in
    `EVENTS`: begin; end; over (the total exceeds a stated force); slide; touch (measurements show
    that an untouched patch is touched: of no contact, id 0). None: nothing."""

    def validate(self) -> None:
        super().validate()
        # `_column` can say that there is a row for each contact, but not how many these are.
        n = self.id.size
        for name, sides in _SIDES.items():
            column = self.__dict__[name]
            if column is not None and column.shape != (n, *sides):
                raise ShapeError(
                    f"{name}: shape {column.shape}, expected {(n, *sides)}"
                )

        n_patches = len(self.patches)
        # Rows of patches, and numbers of events, are used as indices.
        if self.patch_of is not None and not _within(self.patch_of, n_patches):
            raise ShapeError(f"patch_of: a row outside 0..{n_patches - 1}")
        if self.events is None:
            return

        if self.events.shape[1] != 3:
            raise ShapeError(f"events: shape {self.events.shape}, expected rows of 3")
        patches = self.events[:, 0]
        kinds = self.events[:, 2]
        are_known = _within(patches, n_patches) and _within(kinds, len(EVENTS))
        if not are_known:
            raise ShapeError("events: a patch or event that is not known")

    def _single(self, k: int, **changes: Any) -> Self:
        # Of patch k alone: rows of the others are left out.
        patch_of = self.patch_of
        if patch_of is None:
            patch_of = np.zeros(self.id.size, np.int32)
        is_of_patch = patch_of == k
        columns = {}
        for name in _SIDES:
            column = self.__dict__[name]
            if column is not None and name != "patch_of":
                columns[name] = column[is_of_patch]

        events = self.events
        if events is not None:
            # A copy, as of any choice by a mask: it may be written to.
            events = events[events[:, 0] == k]
            # The only patch of a message has number 0.
            events[:, 0] = 0
            if not events.size:
                events = None
        return super()._single(k, **columns, events=events, patch_of=None)

    def at(
        self, stamp_ns: int, done_ns: int, trusted: tuple[bool, ...], **changes: Any
    ) -> Self:
        """Copy at another time with other fields, which are not checked."""
        return self._copy(
            stamp_ns=stamp_ns, done_ns=done_ns, trusted=trusted, **changes
        )

    @property
    def named_events(self) -> list[tuple[int, str]]:
        """Id and name of each event; id 0 of a touch."""
        if self.events is None:
            return []
        return [(number, EVENTS[event]) for _, number, event in self.events.tolist()]

    def columns(self) -> dict[str, AnyArray]:
        """Arrays with an entry for each contact, by the names of the columns of a table: `row` and
        `col` of `centre`, `x_mm`, ... of a place. What is not known is NaN.
        """
        n = self.id.size
        columns: dict[str, AnyArray] = {"stamp_ns": np.full(n, self.stamp_ns)}
        for name, sides in _SIDES.items():
            if name == "patch_of":
                continue
            values = self.__dict__[name]
            # A table has the columns of a message whose pitch is not known, too.
            if values is None:
                values = np.full((n, *sides), np.nan, np.float32)
            # A column of a table for each of those of a field of rows.
            if not sides:
                columns[name] = values
            else:
                columns |= dict(zip(_COLUMNS[name], values.T, strict=True))
        columns["trusted"] = np.full(n, self.trusted[0])
        return columns


def summary(n: int, total: float, unit: str) -> str:
    """Number of contacts and their total force, in a few words."""
    if not n:
        return "no contact"
    contacts = "contacts"
    if n == 1:
        contacts = "contact"
    return f"{n} {contacts}, {total:.3g} {sum_unit(unit)}"


def sum_unit(unit: str) -> str:
    """Unit of a sum of readings: one of pressures is no pressure, and no force without an area."""
    if _PRESSURE.fullmatch(unit):
        return f"{unit} x taxels"
    return unit


_PRESSURE = re.compile(r"[kMhm]?(Pa|bar)|mmHg|psi|(N|k?gf?|lbf?)/[cm]?(m|in)[2²]?")
_COLUMNS = {
    "centre": ("row", "col"),
    "centre_sd": ("row_sd", "col_sd"),
    "velocity": ("row_velocity", "col_velocity"),
    "place_mm": ("x_mm", "y_mm", "z_mm"),
    "place_sd_mm": ("x_sd_mm", "y_sd_mm", "z_sd_mm"),
    "velocity_mm_s": ("x_mm_s", "y_mm_s", "z_mm_s"),
    "normal": ("x_normal", "y_normal", "z_normal"),
}
_SCALARS = (
    *("id", "total", "total_sd", "peak", "area", "age_s"),
    *("over", "sliding", "area_mm2", "patch_of"),
)
_SIDES: dict[str, tuple[int, ...]] = dict.fromkeys(_SCALARS, ())
_SIDES |= {name: (len(columns),) for name, columns in _COLUMNS.items()}
"""Sides of the fields behind the first one, the contacts."""


def _within(values: Integers, n: int) -> bool:
    # numpy has no least of none.
    if not values.size:
        return True
    return bool(values.min() >= 0 and values.max() < n)
