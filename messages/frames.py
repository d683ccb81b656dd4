"""The messages of one frame, in the order in which it passes through the stations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from .base import Message
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

    `phi` is the fingerprint of the Phi that made them, 16 hex digits.
    """

    schema: ClassVar[str] = "measurements"
    version: ClassVar[int] = 1

    y: Floats = wire(Samples())
    phi: str = wire(Text(16, FINGERPRINT_PATTERN))


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
