"""State messages: descriptions of the nodes, latched so that late subscribers receive them."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from .arrays import Floats, Integers, Mask
from .base import Message
from .errors import MessageError, ShapeError
from .fields import (
    MAX_ELEMENTS,
    MAX_SIDE,
    Array,
    Flag,
    Integer,
    Real,
    Text,
    omitted,
    wire,
)
from .frames import FINGERPRINT_PATTERN
from .skin import Skin
from .topics import MAX_NAME, NAME_PATTERN, topic_of

MASK = Array("|b1", 2, optional=True)
POINTS = Array("<f4", 2, optional=True, longest=MAX_ELEMENTS // 6)
POINT_ROWS = Array("<i4", 1, optional=True)
CLIP_SD = 0.584
"""Standard deviation of an untouched taxel's noise that the range clips at 0, in that of the noise.
Derived: of max(0, z), z normal, sqrt(1/2 - 1/(2 pi))."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinState(Message):
    """The skin of a patch, as `Skin`, and the source of its frames: name of the scene, recording or
    driver, seed of scene and noise, frame rate that the sensor is asked for (0: as fast as
    possible), and if /PATCH/truth and /PATCH/taxels are published (not those of a skin that is
    compressed outside the graph).

    `live` is True where a clock sets the pace of frames that are no recorded ones, as those of a
    board, a driver or a scene: who is behind uses the newest one. Recorded frames wait.

    `sigma_mid` and `sigma_end` are the standard deviations of the noise at mid-range and at both
    ends, `f_min` the lower end of the range, 0 or less: below 0, noise around 0 is not clipped.
    """

    schema: ClassVar[str] = "skin"
    latched: ClassVar[bool] = True

    n_rows: int = wire(Integer(1, MAX_SIDE))
    n_cols: int = wire(Integer(1, MAX_SIDE))
    f_max: float = wire(Real(0.0))
    unit: str = wire(Text(32))
    pitch_m: float | None = wire(Real(0.0, optional=True))
    mask: Mask | None = wire(MASK)
    source: str = wire(Text())
    seed: int = wire(Integer())
    rate_hz: float = wire(Real(0.0))
    has_truth: bool = wire(Flag())
    sigma_mid: float = wire(Real(0.0))
    sigma_end: float = wire(Real(0.0))
    has_taxels: bool = omitted(Flag(), True)
    f_min: float = omitted(Real(high=0.0), 0.0)
    live: bool = omitted(Flag(), False)
    points: Floats | None = omitted(POINTS)
    point_rows: Integers | None = omitted(POINT_ROWS)

    def validate(self) -> None:
        # To make it raises where the mask or the points do not fit the grid.
        _ = self.skin

    @property
    def skin(self) -> Skin:
        """The skin itself."""
        return Skin(
            n_rows=self.n_rows,
            n_cols=self.n_cols,
            f_max=self.f_max,
            unit=self.unit,
            pitch_m=self.pitch_m,
            mask=self.mask,
            points=self.points,
            point_rows=self.point_rows,
        )

    @property
    def clips_noise(self) -> bool:
        """True if the range clips more than a fortieth of the noise of an untouched taxel."""
        # Below -2 standard deviations lie 2.3 % of it. Noise that is not stated may have any size.
        return self.f_min > -2 * self.sigma_end or not self.f_min

    @property
    def clip_bias(self) -> float:
        """Mean force of an untouched taxel, in `unit`, as the range clips its stated noise at the
        lower end; 0 where it does not.
        """
        if not self.clips_noise or not self.sigma_end:
            return 0.0
        # Mean of max(-c, z), z normal: p(c) - c P(z < -c); the range ends c deviations below 0.
        c = -self.f_min / self.sigma_end
        density = math.exp(-c * c / 2) / math.sqrt(2 * math.pi)
        below = math.erfc(c / math.sqrt(2)) / 2
        return min(self.sigma_end * (density - c * below), self.f_max)

    @property
    def least_sd(self) -> float:
        """Least standard deviation of the stated noise of a taxel, in `unit`: that of an untouched
        one where the range clips it; 0 where no noise is stated.
        """
        # It is the least bound that holds for every taxel, whatever force is on it.
        sd = min(self.sigma_mid, self.sigma_end)
        # Half of the noise around 0 lies below the range, and is clipped.
        if self.clips_noise:
            sd *= CLIP_SD
        return sd


def described(skin: Skin | SkinState, rate_hz: float | None) -> dict[str, Any]:
    """`f_max` and `unit` of a skin; `mask`, `points`, `point_rows`, `pitch_m` and `rate_hz` where
    known.
    """
    facts = {
        "f_max": skin.f_max,
        "unit": skin.unit,
        "mask": skin.mask,
        "points": skin.points,
        "point_rows": skin.point_rows,
        # 0 stands for a number that is not known, too.
        "pitch_m": skin.pitch_m or None,
        "rate_hz": rate_hz or None,
    }
    return {name: value for name, value in facts.items() if value is not None}


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration(Message):
    """The calibration of a skin in use, with which raw readings became forces.

    A raw reading c became clip(R(g (c - b)) - w, f_min, f_max): w is the drift that is followed,
    which is not published. Baseline b in raw readings and gains g are float32 (n_rows, n_cols),
    None: 0, and 1. R has K knots: readings (K, 1, 1) of all taxels or (K, n_rows, n_cols) of each,
    forces (K,) in the skin's unit, float32; None: R is the identity.
    """

    schema: ClassVar[str] = "calibration"
    latched: ClassVar[bool] = True

    name: str = wire(Text(64))
    baseline: Floats | None = wire(Array("<f4", 2, optional=True))
    gains: Floats | None = wire(Array("<f4", 2, optional=True))
    response_reading: Floats | None = wire(Array("<f4", 3, optional=True))
    response_force: Floats | None = wire(Array("<f4", 1, optional=True))

    def validate(self) -> None:
        reading = self.response_reading
        force = self.response_force
        if (reading is None) != (force is None):
            raise ShapeError(
                "response_reading, response_force: expected both of them or none"
            )
        # A knot has a reading and a force.
        if reading is not None and force is not None and len(reading) != len(force):
            raise ShapeError(
                f"response_reading: {len(reading)} knots, but {len(force)} forces"
            )

        # All of them are applied cell by cell.
        grids = (self.baseline, self.gains)
        shapes = {grid.shape for grid in grids if grid is not None}
        # A response of shape (K, 1, 1) is that of all taxels.
        if reading is not None and reading.shape[1:] != (1, 1):
            shapes.add(reading.shape[1:])
        if len(shapes) > 1:
            raise ShapeError("baseline, gains, response_reading: expected one shape")


@dataclass(frozen=True, kw_only=True, eq=False)
class PhiState(Message):
    """The measurement matrix Phi in use: its parameters, and its fingerprint to check them.

    `rows` "rotating": frames cycle through several row subsets of the same W, `m` rows each, or
    through the matrices of a file. The fingerprint is that of the first; each frame's measurements
    carry that of their own. `rule` is that by which the rows were chosen, see `SbhePhi`; a message
    that leaves it out is of rule 1.
    """

    schema: ClassVar[str] = "phi"
    latched: ClassVar[bool] = True

    kind: str = wire(Text())
    n: int = wire(Integer(1, MAX_ELEMENTS))
    m: int = wire(Integer(1, MAX_ELEMENTS))
    block: int = wire(Integer(1, MAX_ELEMENTS))
    seed: int = wire(Integer())
    fingerprint: str = wire(Text(16, FINGERPRINT_PATTERN))
    rows: str = omitted(Text(8, "fixed|rotating"), "fixed")
    rule: int = omitted(Integer(1, 3), 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class SolverState(Message):
    """The solver in use.

    `basis` is "" where the solver has its own. `iterations` is the number a frame where every taxel
    is pressed; `frame_ms` the time that they take on this host then, milliseconds, 0 where it is
    not known. Where fewer are pressed, a frame has up to `max_iterations`; 0: none has more. Their
    number follows from `frame_tiles` and `step_tiles`, as of `SkinSolver`.

    `noise_sum` is the sum of the readings of the untouched skin, in the mean, as noise is clipped
    at the lower end of the range: reconstructed forces have about as much of it; pressed taxels
    have none. 0 where the solver subtracts it.
    """

    schema: ClassVar[str] = "solver"
    latched: ClassVar[bool] = True

    solver: str = wire(Text())
    basis: str = wire(Text())
    preset: str = wire(Text())
    iterations: int = wire(Integer(0, 1_000_000))
    lambda_n: float = wire(Real(0.0))
    frame_ms: float = omitted(Real(0.0), 0.0)
    max_iterations: int = omitted(Integer(0, 1_000_000), 0)
    frame_tiles: int = omitted(Integer(), 0)
    step_tiles: int = omitted(Integer(), 0)
    noise_sum: float = omitted(Real(0.0), 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class End(Message):
    """The last message of a topic.

    `of` is the schema whose topic ends, `n_messages` the number of messages sent before this
    one: a consumer that received fewer knows how many it lost.
    """

    schema: ClassVar[str] = "end"

    of: str = wire(Text(MAX_NAME, NAME_PATTERN))
    n_messages: int = wire(Integer())

    def validate(self) -> None:
        # Its topic would end before it does.
        if self.of == self.schema:
            raise MessageError("of: an end cannot end itself")

    @property
    def topic(self) -> str:
        return topic_of(self.patch, self.of)
