"""The messages of one frame, in the order in which the nodes send them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from .base import Message
from .errors import FieldError, ShapeError
from .fields import Array, Flag, Integer, Real, Samples, Text, wire

Floats = npt.NDArray[np.float32]
FINGERPRINT_PATTERN = r"[0-9a-f]{16}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Taxels(Message):
    """Readings of the taxels, noise included: forces of shape (n_rows, n_cols), float32, in
    [0, f_max], in the skin's unit; 0 in masked cells.
    """

    schema: ClassVar[str] = "taxels"

    forces: Floats = wire(Array("<f4", 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth(Message):
    """True forces, where a simulation or a recording knows them: shape (n_rows, n_cols),
    float32, in [0, f_max], in the skin's unit; 0 in masked cells.
    """

    schema: ClassVar[str] = "truth"

    forces: Floats = wire(Array("<f4", 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurements(Message):
    """Measurements y = Phi x, shape (M,), float32, in the skin's unit; `Quantised` where they
    are sent in fewer bits.

    `phi` is the fingerprint of their Phi, 16 hex digits. `places` marks the taxels read, where
    the edge chooses them anew each frame: one bit for each existing taxel, the highest bit first,
    uint8, shape (N / 8,), rounded up. `nodes` states the nodes of a quad tree that are measured,
    where the edge chooses those anew: uint8, as the tree codes them.
    """

    schema: ClassVar[str] = "measurements"

    y: Floats = wire(Samples())
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))
    places: npt.NDArray[np.uint8] | None = wire(
        Array("|u1", 1, optional=True), default=None, omitted=True
    )
    nodes: npt.NDArray[np.uint8] | None = wire(
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
    """Forces reconstructed from the measurements.

    Attributes
    ----------
    forces : ndarray of float32, shape (n_rows, n_cols)
        In the skin's unit, 0 or more; 0 in masked cells.
    phi : str
        Fingerprint of the Phi that was inverted.
    iterations : int
        Number of iterations of the solver.
    residual : float
        ||Phi x - y|| / sqrt(M), in the skin's unit.
    solve_ns : int
        Duration of the solver, nanoseconds.
    done_ns : int
        Time of the reconstruction on the graph's clock, nanoseconds.
    sd : ndarray of float32, shape (n_rows, n_cols), or None
        Standard deviation of each force, in the skin's unit, where it is computed: 90 % of the
        true forces lie within 1.645 of it.
    skipped : int
        Number of frames skipped since the last reconstruction because newer ones waited.
    error : float or None
        Estimated RMS error of a taxel, in the skin's unit, where the solver estimates it.
    trusted : bool
        False if that error is a large part of the forces; True also where it is not estimated.
    unchanged : bool
        True if the measurements changed by no more than their noise: the frame was not solved, and
        its forces are those of the frame before.
    """

    schema: ClassVar[str] = "reconstruction"
    times: ClassVar[tuple[str, ...]] = ("stamp_ns", "done_ns")

    forces: Floats = wire(Array("<f4", 2))
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))
    iterations: int = wire(Integer(0, 1_000_000))
    residual: float = wire(Real(0.0))
    solve_ns: int = wire(Integer())
    done_ns: int = wire(Integer())
    sd: Floats | None = wire(Array("<f4", 2, optional=True), default=None, omitted=True)
    skipped: int = wire(Integer(), default=0, omitted=True)
    error: float | None = wire(Real(0.0, optional=True), default=None, omitted=True)
    trusted: bool = wire(Flag(), default=True, omitted=True)
    unchanged: bool = wire(Flag(), default=False, omitted=True)

    def validate(self) -> None:
        if self.sd is not None and self.sd.shape != self.forces.shape:
            raise ShapeError(f"sd: shape {self.sd.shape}, but forces {self.forces.shape}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Resultant(Message):
    """Total force and centre of pressure, estimated from the measurements alone.

    Attributes
    ----------
    total, total_sd : float
        Sum of all forces, in the skin's unit, 0 or more, and its standard deviation.
    row, col, row_sd, col_sd : float or None
        Centre of pressure, in rows and columns from the middle of taxel (0, 0), and standard
        deviations; None where no contact is detected.
    done_ns : int
        Time of the estimate on the graph's clock, nanoseconds.
    """

    schema: ClassVar[str] = "resultant"
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
