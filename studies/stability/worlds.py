"""Worlds drawn at random: a skin, its noise and rows, a load that comes and goes, and a fault.

All of a world follows from one seed, on any machine. Each part has a generator of its own, so that
a stated part replaces a drawn one and leaves all others as they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.sensor.noise import NoiseModel

from .faults import Fault, Skin, Spoiler, draw_fault
from .loads import Load, draw_load

SIDES = (8, 10, 12, 16, 20, 24, 32, 40, 48)
LEAST_M = 32
"""Fewest measurements of a frame, unless they are half of the taxels. Chosen."""


class Times(NamedTuple):
    """Frames of a world: first one of the load, first one after its release, number of frames; and
    those between which a fault begins.
    """

    touch: int = 12
    release: int = 110
    end: int = 140
    earliest_fault: int = 6
    latest_fault: int = 80


TIMES = Times()


class Noise(NamedTuple):
    """Noise of the readings: `kind`; standard deviations at mid-range and at both ends, newtons;
    True if the reconstruction is given them. Only "unclipped" noise leaves readings below 0.
    """

    kind: str
    sigma_mid: float
    sigma_end: float
    is_stated: bool

    def apply(self, forces: Floats, rng: np.random.Generator) -> Floats:
        """Readings of forces."""
        if self.kind == "unclipped":
            noise = rng.standard_normal(forces.shape, dtype=np.float32)
            return forces + np.float32(self.sigma_end) * noise
        model = NoiseModel(PAPER_F_MAX_N, self.sigma_mid, self.sigma_end)
        return model.apply(forces, rng)

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of `Stream` that state the noise."""
        if not self.is_stated:
            return {}
        if self.kind == "unclipped":
            return {"noise_sd": self.sigma_end}
        return {"sigmas": (self.sigma_mid, self.sigma_end)}

    def describe(self) -> str:
        """Kind, deviation of an untouched taxel, and if it is stated."""
        text = f"{self.kind} noise of {1000 * self.sigma_end:.0f} mN"
        return f"{text}, {'' if self.is_stated else 'not '}stated"


class Frame(NamedTuple):
    """Forces that act; what all taxels read without a fault, and with it; True if that holds
    nothing of the skin.
    """

    truth: Floats
    healthy: Floats
    readings: Floats
    is_empty: bool


@dataclass(frozen=True, eq=False)
class World:
    """A skin that a load presses for a while. `mask`: None if all taxels exist; `ratio`: N/M."""

    seed: int
    shape: tuple[int, int]
    mask: Mask | None
    load: Load
    ratio: float
    rows: str
    noise: Noise
    fault: Fault | None
    times: Times

    @property
    def exists(self) -> Mask:
        """True where a taxel exists."""
        if self.mask is None:
            return np.ones(self.shape, dtype=np.bool_)
        return self.mask

    @property
    def first_judged(self) -> int:
        """First frame with the fault; 0 where there is none."""
        if self.fault is None:
            return 0
        return self.fault.begins

    def describe(self) -> str:
        """The world in one line."""
        n_rows, n_cols = self.shape
        skin = f"{n_rows} x {n_cols} taxels"
        if self.mask is not None:
            skin += f" without {np.count_nonzero(~self.mask)}"
        rows = f"{self.rows} rows, N/{self.ratio:.3g}"
        parts = [skin, rows, self.noise.describe(), self.load.describe()]
        if self.fault is not None:
            parts.append(self.fault.describe())
        return f"world {self.seed}: {'; '.join(parts)}"

    def truth(self, k: int) -> Floats:
        """Forces that act in frame k, newtons, float32."""
        n_pressed = self.times.release - self.times.touch
        since_touch = k - self.times.touch
        if not 0 <= since_touch < n_pressed:
            return np.zeros(self.shape, dtype=np.float32)
        return self.load.forces(since_touch, n_pressed) * self.exists

    def frames(self) -> Iterator[Frame]:
        """Frames in order, the same each time."""
        rng = np.random.default_rng((self.seed, 1))
        spoiler = self.spoiler(of_taxels=True)
        for k in range(self.times.end):
            # Cells without a taxel read 0, noise included.
            truth = self.truth(k)
            healthy = self.noise.apply(truth, rng) * self.exists
            readings = spoiler.spoil(healthy)
            # No fault of taxels loses frames.
            assert readings is not None
            yield Frame(truth, healthy, readings, spoiler.is_empty)

    def spoiler(self, of_taxels: bool) -> Spoiler:
        """The fault as it acts on readings, or on measurements."""
        fault = self.fault
        if fault is not None and fault.of_taxels != of_taxels:
            fault = None
        return Spoiler(fault)


def draw_world(
    seed: int,
    has_fault: bool,
    *,
    load: str = "",
    motion: str = "",
    fault: str = "",
    rows: str = "",
    sides: Sequence[int] = SIDES,
    times: Times = TIMES,
) -> World:
    """Draw the world of a seed. Kinds of load, motion, fault and rows, "" if drawn; `sides`: those
    to draw from.
    """
    # A generator each: what is stated, or drawn in another number, changes nothing else.
    parts = np.random.SeedSequence(seed).spawn(5)
    of_skin, of_load, of_rows, of_noise, of_fault = map(np.random.default_rng, parts)
    shape = _draw_shape(of_skin, sides)
    mask = _draw_mask(of_skin, shape)
    exists = mask
    if exists is None:
        exists = np.ones(shape, dtype=np.bool_)
    drawn_fault = None
    if has_fault:
        begins = int(of_fault.integers(times.earliest_fault, times.latest_fault))
        drawn_fault = draw_fault(of_fault, Skin(exists, PAPER_F_MAX_N), begins, fault)
    drawn_rows = str(of_rows.choice([ROTATING, ROTATING, FIXED]))
    return World(
        seed=seed,
        shape=shape,
        mask=mask,
        load=draw_load(of_load, exists, PAPER_F_MAX_N, load, motion),
        ratio=_draw_ratio(of_rows, int(np.count_nonzero(exists))),
        rows=rows or drawn_rows,
        noise=_draw_noise(of_noise),
        fault=drawn_fault,
        times=times,
    )


def _draw_shape(rng: np.random.Generator, sides: Sequence[int]) -> tuple[int, int]:
    """Square as often as not."""
    n_rows = int(rng.choice(sides))
    widths = [n_rows, n_rows, rng.choice(sides), n_rows + rng.integers(1, 8)]
    return n_rows, int(rng.choice(widths))


def _draw_mask(rng: np.random.Generator, shape: tuple[int, int]) -> Mask | None:
    """A third of the skins lack cells: around an ellipse, in discs, or anywhere."""
    kind = str(rng.choice(["none"] * 4 + ["outline", "discs", "anywhere"]))
    rows, cols = np.indices(shape).astype(np.float64)
    if kind == "none":
        return None
    if kind == "outline":
        # Coordinates from -1 to 1; beyond 1 the ellipse is cut by the edges of the grid.
        down = 2 * rows / rows.max() - 1
        across = 2 * cols / cols.max() - 1
        ellipse: Mask = down**2 + across**2 <= rng.uniform(1.0, 1.5)
        return ellipse
    mask = np.ones(shape, dtype=np.bool_)
    if kind == "anywhere":
        return rng.random(shape) > rng.uniform(0.02, 0.3)
    for _ in range(int(rng.integers(1, 4))):
        row, col = rng.uniform(0, 1, 2) * shape
        radius = rng.uniform(0.1, 0.25) * min(shape)
        mask &= np.hypot(rows - row, cols - col) > radius
    return mask


def _draw_ratio(rng: np.random.Generator, n: int) -> float:
    """N/M, whole more often than not; small skins keep enough measurements."""
    whole = float(rng.choice([2, 3, 3, 4, 6, 8]))
    between = float(rng.uniform(2, 8))
    ratio = float(rng.choice([whole, whole, between]))
    return min(ratio, max(2.0, n / LEAST_M))


def _draw_noise(rng: np.random.Generator) -> Noise:
    """That of the paper, or plain normal noise of any size."""
    is_stated = bool(rng.random() < 0.6)
    kind = str(rng.choice(["paper", "paper", "paper", "plain", "unclipped"]))
    sigma = math.exp(rng.uniform(math.log(0.002), math.log(0.05)))
    if kind == "paper":
        model = NoiseModel()
        return Noise(kind, model.sigma_mid, model.sigma_end, is_stated)
    return Noise(kind, sigma, sigma, is_stated)
