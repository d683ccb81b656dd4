"""The messages of one frame, in the order in which it passes through the stations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from .base import Message
from .errors import FieldError, ShapeError
from .fields import Array, Integer, Real, Samples, Text, wire

Floats = npt.NDArray[np.float32]
FINGERPRINT_PATTERN = r"[0-9a-f]{16}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Taxels(Message):
    """What the taxels read: forces of shape (n_rows, n_cols), float32, in [0, f_max] of the
    skin's unit, noise included; 0 in masked cells.
    """

    schema: ClassVar[str] = "taxels"
    version: ClassVar[int] = 1

    forces: Floats = wire(Array("<f4", 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth(Message):
    """The forces that really act, where a simulation or a recording knows them: shape
    (n_rows, n_cols), float32, in [0, f_max] of the skin's unit; 0 in masked cells.
    """

    schema: ClassVar[str] = "truth"
    version: ClassVar[int] = 1

    forces: Floats = wire(Array("<f4", 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurements(Message):
    """What the edge sends: y = Phi x, shape (M,), float32, in the skin's unit; `Quantised` where
    the edge sends fewer bits than float32 has.

    `phi` is the fingerprint of the Phi that made them, 16 hex digits. `places` says, where the
    edge chose anew for this frame which taxels it read, which these are: a bit for each existing
    taxel, the highest bit first, set where it was read; uint8, shape (N / 8,), rounded up.
    """

    schema: ClassVar[str] = "measurements"
    version: ClassVar[int] = 1

    y: Floats = wire(Samples())
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))
    places: npt.NDArray[np.uint8] | None = wire(
        Array("|u1", 1, optional=True), default=None, omitted=True
    )

    def validate(self) -> None:
        if self.places is None:
            return
        n_places = int(np.unpackbits(self.places).sum())
        if n_places != len(self.y):
            raise ShapeError(f"places: {n_places} of them for {len(self.y)} measurements")


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction(Message):
    """The forces restored from the measurements.

    Attributes
    ----------
    forces : ndarray of float32, shape (n_rows, n_cols)
        In the skin's unit, 0 or more; 0 in masked cells.
    phi : str
        Fingerprint of the Phi that was inverted.
    iterations : int
        Iterations spent on the frame.
    residual : float
        ||Phi x - y|| / sqrt(M), in the skin's unit.
    solve_ns : int
        Time spent in the solver, in nanoseconds.
    done_ns : int
        Time on the graph's clock when the frame was restored.
    sd : ndarray of float32, shape (n_rows, n_cols), or None
        Standard deviation of each force, in the skin's unit, where it was asked for: 90 % of the
        true forces lie within 1.645 of it.
    skipped : int
        Frames since the last reconstruction that were left out on purpose, because newer ones
        waited.
    """

    schema: ClassVar[str] = "reconstruction"
    version: ClassVar[int] = 1
    times: ClassVar[tuple[str, ...]] = ("stamp_ns", "done_ns")

    forces: Floats = wire(Array("<f4", 2))
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))
    iterations: int = wire(Integer(0, 1_000_000))
    residual: float = wire(Real(0.0))
    solve_ns: int = wire(Integer())
    done_ns: int = wire(Integer())
    sd: Floats | None = wire(Array("<f4", 2, optional=True), default=None, omitted=True)
    skipped: int = wire(Integer(), default=0, omitted=True)

    def validate(self) -> None:
        if self.sd is not None and self.sd.shape != self.forces.shape:
            raise ShapeError(f"sd: shape {self.sd.shape}, but forces {self.forces.shape}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Resultant(Message):
    """Total force and centre of pressure, told from the measurements before the frame is restored.

    Attributes
    ----------
    total : float
        Sum of all forces, in the skin's unit, 0 or more.
    total_sd : float
        Its standard deviation.
    row, col : float or None
        Centre of pressure, in rows and columns from the middle of taxel (0, 0); None where
        nothing is known to press.
    row_sd, col_sd : float or None
        Their standard deviations.
    done_ns : int
        Time on the graph's clock when it was known.
    """

    schema: ClassVar[str] = "resultant"
    version: ClassVar[int] = 1
    times: ClassVar[tuple[str, ...]] = ("stamp_ns", "done_ns")

    total: float = wire(Real(0.0))
    total_sd: float = wire(Real(0.0))
    row: float | None = wire(Real(optional=True), default=None)
    col: float | None = wire(Real(optional=True), default=None)
    row_sd: float | None = wire(Real(0.0, optional=True), default=None)
    col_sd: float | None = wire(Real(0.0, optional=True), default=None)
    done_ns: int = wire(Integer())

    def validate(self) -> None:
        known = {value is not None for value in (self.row, self.col, self.row_sd, self.col_sd)}
        if len(known) > 1:
            raise FieldError("row, col, row_sd, col_sd: expected all of them or none")
