"""The messages of one frame, in the order in which the nodes send them.

A message of frames holds those of equal patches of skin that were acquired together; a patch that
is served alone is one of them. Arrays are of shape (n_patches, ...), numbers of a patch are tuples.
"""

import math
from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from .arrays import Bytes, Floats, Mask
from .base import Message, once_a_class, wire_fields
from .errors import FieldError, ShapeError
from .fields import (
    Array,
    Each,
    FieldKind,
    Flag,
    Integer,
    Names,
    Real,
    Samples,
    Text,
    Words,
    omitted,
    wire,
)

FINGERPRINT_PATTERN = r"[0-9a-f]{16}"

MAPS = Array("<f4", 3, patches=True)
"""A value for each cell of each patch."""
BITS = Array("|u1", 1, optional=True)
"""Bits of one patch, eight a byte."""
REASONS = Words(Text(16, "[a-z]*"), unstated=("",))
ERRORS = Each(Real(0.0, optional=True), unstated=(None,))
TRUSTED = Each(Flag(), unstated=(True,))
UNCHANGED = Each(Flag(), unstated=(False,))
"""Values of each patch, and that of one for which none is stated."""


@once_a_class
def of_patches(cls: type[Message]) -> dict[str, Each | Array]:
    """Kinds of the fields that hold something for each patch, by name, numbers first."""
    numbers: dict[str, Each | Array] = {}
    arrays: dict[str, Each | Array] = {}
    for name, kind in wire_fields(cls).items():
        if isinstance(kind, Each):
            numbers[name] = kind
        elif isinstance(kind, Array) and kind.patches:
            arrays[name] = kind
    return numbers | arrays


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames(Message):
    """Base of the messages of frames. `names` are those of the patches in the order of the arrays,
    1 to 256; `patch` is then the name under which they are published together. (): one patch, of
    the name `patch`.
    """

    version: ClassVar[int] = 2

    names: tuple[str, ...] = omitted(Names(), ())

    @property
    def patches(self) -> tuple[str, ...]:
        """Names of the patches."""
        return self.names or (self.patch,)

    def validate(self) -> None:
        values = self.__dict__
        n = len(self.names) or 1
        for name, kind in of_patches(type(self)).items():
            if isinstance(kind, Each) and not values[name]:
                # A number that is not stated is that of each patch.
                values[name] = kind.unstated * n

            # Fields are of this message alone: `Each` and `Array` have checked each for itself.
            rows = values[name]
            # An optional array that is not sent has no rows.
            if rows is None or len(rows) == n:
                continue
            if not self._may_have(name, len(rows)):
                raise ShapeError(f"{name}: {len(rows)} rows for {n} patches")

    def _may_have(self, name: str, n_rows: int) -> bool:
        """True if a field may have so many rows, another number than there are patches."""
        return False

    def split(
        self, last_forces: MutableMapping[str, Floats] | None = None
    ) -> list[Self]:
        """Messages of the single patches, arrays being views. `last_forces` keeps the last forces
        of each patch by its name, for those that a later `Reconstruction` does not send; a patch
        of which nothing is known is left out.
        """
        # It has the form of a single patch already.
        if not self.names:
            return [self]
        return [self._single(k) for k in range(len(self.names))]

    def _single(self, k: int, **changes: Any) -> Self:
        """Message of patch k alone."""
        values = self.__dict__
        parts = {}
        for name in of_patches(type(self)):
            # A slice keeps the axis of patches, and is a view.
            if name not in changes and values[name] is not None:
                parts[name] = values[name][k : k + 1]
        patch = self.patches[k]
        return self._copy(patch=patch, names=(), **parts, **changes)


def kinds_alone(cls: type[Message]) -> dict[str, FieldKind]:
    """Kinds of the fields of a message of one patch as `values_alone` returns them, by name."""
    kinds = dict(wire_fields(cls))
    # It is (): the name of the patch is `patch`.
    kinds.pop("names", None)
    for name, kind in kinds.items():
        if isinstance(kind, Each):
            kinds[name] = kind.kind
    return kinds


def values_alone(message: Message) -> dict[str, Any]:
    """Fields of a message of one patch by name, without the axis of patches: arrays of a frame, and
    numbers in place of tuples.
    """
    values = dict(message.__dict__)
    values.pop("names", None)
    if not isinstance(message, Frames):
        return values
    for name in of_patches(type(message)):
        if values[name] is not None:
            values[name] = values[name][0]
    return values


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensed(Frames):
    """Base of frames that come of readings, of which some may be missing.

    `missing` marks, in a frame of one patch, the taxels that gave no number, whose forces are
    filled in: one bit for each cell, row after row, the highest bit first, uint8, shape
    (n_rows n_cols / 8,), rounded up. None: all gave one.
    """

    missing: Bytes | None = omitted(BITS)
    reason: tuple[str, ...] = omitted(REASONS, ())
    """Why a patch is not trusted: a `Reason`, or a word that another version of this program wrote;
    "" else, or not stated. What the sensor states of its readings goes on with the frame."""

    def validate(self) -> None:
        super().validate()
        if self.missing is not None and len(self.patches) > 1:
            raise FieldError("missing: is that of one patch")

    def missing_cells(self, shape: tuple[int, ...]) -> Mask | None:
        """`missing` as bool of a shape (n_rows, n_cols). Raises ShapeError if it has another."""
        if self.missing is None:
            return None
        n = math.prod(shape)
        if self.missing.size != math.ceil(n / 8):
            raise ShapeError(f"missing: {self.missing.size} bytes for {n} cells")
        # Bits are bytes of 0 and 1, as those of bool.
        bits = np.unpackbits(self.missing, count=n)
        return bits.reshape(shape).view(np.bool_)


def known_forces(message: "Taxels | Truth | Reconstruction") -> Floats:
    """Forces of a message of one patch, float32 (n_rows, n_cols), NaN where the reading is missing.
    Raises ShapeError if `missing` is of another shape.
    """
    forces: Floats = message.forces[0]
    # A truth is complete.
    if isinstance(message, Truth):
        return forces
    missing = message.missing_cells(forces.shape)
    if missing is None:
        return forces
    return np.where(missing, np.float32(np.nan), forces)


@dataclass(frozen=True, kw_only=True, eq=False)
class Taxels(Sensed):
    """Readings of the taxels, noise included: forces of shape (n_patches, n_rows, n_cols), float32,
    in [0, f_max], in the skin's unit; 0 in masked cells.
    """

    schema: ClassVar[str] = "taxels"

    forces: Floats = wire(MAPS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth(Frames):
    """True forces, where a simulation or a recording knows them: shape (n_patches, n_rows, n_cols),
    float32, in [0, f_max], in the skin's unit; 0 in masked cells.
    """

    schema: ClassVar[str] = "truth"

    forces: Floats = wire(MAPS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurements(Sensed):
    """Measurements y = Phi x of each patch, shape (n_patches, M), float32, in the skin's unit;
    `Quantised` where they are sent in fewer bits.

    `phi` is the fingerprint of their Phi, 16 hex digits. Of one patch alone, `places` marks the
    taxels read, where the edge chooses them anew each frame: one bit for each existing taxel, the
    highest bit first, uint8, shape (N / 8,), rounded up. `nodes` states the nodes of a quad tree
    that are measured, where the edge chooses those anew: uint8, as the tree codes them.

    Of patches that are `unchanged`, y is left out: nothing has changed since it was sent last.
    """

    schema: ClassVar[str] = "measurements"

    y: Floats = wire(Samples())
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))
    places: Bytes | None = omitted(BITS)
    nodes: Bytes | None = omitted(BITS)
    unchanged: tuple[bool, ...] = omitted(UNCHANGED, ())
    quiet: int = omitted(Integer(), 0)
    """Number of frames so far, of this run of the compressor, that it did not send because nothing
    had changed."""

    def validate(self) -> None:
        super().validate()
        if self.places is None and self.nodes is None:
            return
        if len(self.patches) > 1:
            raise FieldError("places, nodes: are those of one patch")
        if self.places is None:
            return

        # Each marked taxel gives one measurement.
        n_places = int(np.unpackbits(self.places).sum())
        if n_places != self.y.shape[1]:
            raise ShapeError(
                f"places: {n_places} of them for {self.y.shape[1]} measurements"
            )

    def _may_have(self, name: str, n_rows: int) -> bool:
        return name == "y" and n_rows == self.unchanged.count(False)

    @property
    def all_sent(self) -> bool:
        """True if y holds the measurements of all patches."""
        return len(self.y) == len(self.patches)

    def split(
        self, last_forces: MutableMapping[str, Floats] | None = None
    ) -> list[Self]:
        if not self.names or self.all_sent:
            return super().split(last_forces)

        # Measurements that are sent are in the order of the patches that have changed; the others
        # have no message, as a patch that is served alone has none.
        changed = [k for k, same in enumerate(self.unchanged) if not same]
        parts = []
        for row, k in enumerate(changed):
            y = self.y[row : row + 1]
            parts.append(self._single(k, y=y))
        return parts


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction(Sensed):
    """Forces reconstructed from the measurements; tuples hold a number for each patch."""

    schema: ClassVar[str] = "reconstruction"
    times: ClassVar[tuple[str, ...]] = ("stamp_ns", "done_ns")

    forces: Floats = wire(Array("<f4", 3, patches=True, sparse=True))
    """In the skin's unit, 0 or more; 0 in masked cells: (n_patches, n_rows, n_cols). Those of
    patches that are `unchanged` may be left out, all of them."""
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))
    """Fingerprint of the Phi that was inverted."""
    iterations: tuple[int, ...] = wire(Each(Integer(0, 1_000_000)))
    residual: tuple[float, ...] = wire(Each(Real(0.0)))
    """||Phi x - y|| / sqrt(M), in the skin's unit."""
    solve_ns: tuple[int, ...] = wire(Each(Integer()))
    done_ns: int = wire(Integer())
    """Duration of the solver, and time of the reconstruction on the graph's clock, nanoseconds."""
    sd: Floats | None = omitted(Array("<f4", 3, optional=True, patches=True))
    """Standard deviation of each force, in the skin's unit, where it is computed, of the shape of
    all forces: 90 % of the true ones lie within 1.645 of it."""
    skipped: int = omitted(Integer(), 0)
    """Number of frames skipped since the last reconstruction because newer ones waited."""
    error: tuple[float | None, ...] = omitted(ERRORS, ())
    """RMS error of a taxel, in the skin's unit, where the solver estimates it."""
    trusted: tuple[bool, ...] = omitted(TRUSTED, ())
    """False where forces are not to be acted on; True also where the error is not estimated."""
    unchanged: tuple[bool, ...] = omitted(UNCHANGED, ())
    """True where measurements changed by no more than their noise: the frame was not solved, and
    its forces are those of the frame before."""
    quiet: int = omitted(Integer(), 0)
    """That of the measurements."""

    def validate(self) -> None:
        super().validate()
        if self.sd is None:
            return
        # Of all patches, where forces may be of some.
        grid = self.forces.shape[1:]
        if self.sd.shape[1:] != grid:
            raise ShapeError(
                f"sd: shape {self.sd.shape}, but forces {self.forces.shape}"
            )

    def _may_have(self, name: str, n_rows: int) -> bool:
        return name == "forces" and n_rows == self.unchanged.count(False)

    def split(
        self, last_forces: MutableMapping[str, Floats] | None = None
    ) -> list[Self]:
        if last_forces is None:
            last_forces = {}

        # A frame that has not changed may leave its forces out.
        all_sent = len(self.forces) == len(self.patches)
        if all_sent and not self.names:
            last_forces[self.patch] = self.forces
            return [self]

        # Forces that are sent are in the order of the patches that have changed.
        row = 0
        parts = []
        for k, name in enumerate(self.patches):
            if all_sent or not self.unchanged[k]:
                last_forces[name] = self.forces[row : row + 1]
                row += 1
            if name in last_forces:
                parts.append(self._single(k, forces=last_forces[name]))
        return parts
