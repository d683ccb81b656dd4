"""Loads drawn at random: what presses a skin, where, how hard, and how it moves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Mask

MOTIONS = ("still", "moves", "ramps", "comes and goes")
MARGIN = 0.15
"""Part of a side that the centre of a load keeps from the edges. Chosen."""


class Place(NamedTuple):
    """Where a load is, in taxels: distances of the taxels from its centre along a column and along
    a row, and its radius.
    """

    down: Doubles
    across: Doubles
    radius: float

    @property
    def distance(self) -> Doubles:
        """Distances of the taxels from the centre."""
        return np.hypot(self.down, self.across)

    def along(self, angle: float) -> Doubles:
        """Signed distances of the taxels from a straight line through the centre."""
        return self.down * math.cos(angle) + self.across * math.sin(angle)


Profile: TypeAlias = Callable[[np.random.Generator, Place], Doubles]
"""Forces of a load at a place, 0 or more, in any unit."""


def _even(rng: np.random.Generator, place: Place) -> Doubles:
    coverage = rng.uniform(0.7, 1.0)
    is_covered: Mask = rng.random(place.down.shape) < coverage
    return is_covered.astype(np.float64)


def _half(rng: np.random.Generator, place: Place) -> Doubles:
    angle = rng.uniform(0, 2 * math.pi)
    is_on_one_side: Mask = place.along(angle) < 0
    return is_on_one_side.astype(np.float64)


def _rough(rng: np.random.Generator, place: Place) -> Doubles:
    coverage = rng.uniform(0.3, 0.9)
    levels = 1 + 0.5 * rng.standard_normal(place.down.shape)
    is_covered = rng.random(place.down.shape) < coverage
    return np.where(is_covered, levels.clip(0), 0.0)


def _checkered(rng: np.random.Generator, place: Place) -> Doubles:
    side = int(rng.integers(1, 3))
    cells = np.floor(place.down / side) + np.floor(place.across / side)
    is_black = cells % 2 == 0
    is_inside = place.distance < max(2.0, place.radius)
    is_pressed: Mask = is_black & is_inside
    return is_pressed.astype(np.float64)


def _bumps(rng: np.random.Generator, place: Place, count: int, width: float) -> Doubles:
    """Sum of Gaussian bumps of one width at random taxels."""
    forces = np.zeros(place.down.shape)
    for _ in range(count):
        row = rng.uniform(place.down.min(), place.down.max())
        col = rng.uniform(place.across.min(), place.across.max())
        squares = (place.down - row) ** 2 + (place.across - col) ** 2
        height = rng.uniform(0.3, 1.0)
        forces += height * np.exp(-0.5 * squares / width**2)
    return forces


def _smooth(rng: np.random.Generator, place: Place) -> Doubles:
    width = max(1.5, min(place.down.shape) / 8)
    forces = _bumps(rng, place, 8, width)
    # What lies below the level is not touched.
    part_below = rng.uniform(0.3, 0.8)
    level = float(np.quantile(forces, part_below))
    return np.maximum(forces - level, 0)


def _sole(rng: np.random.Generator, place: Place) -> Doubles:
    count = int(rng.integers(2, 8))
    width = rng.uniform(1.0, 2.5)
    forces = _bumps(rng, place, count, width)
    # The tails of a bump touch nothing.
    return (forces - 0.05).clip(0)


def _disc(rng: np.random.Generator, place: Place) -> Doubles:
    # Pressure under a sphere (Hertz, 1881).
    depth = 1 - (place.distance / place.radius) ** 2
    forces: Doubles = np.sqrt(np.maximum(depth, 0))
    return forces


def _box(rng: np.random.Generator, place: Place) -> Doubles:
    height, width = place.radius * rng.uniform(0.3, 1.0, 2)
    is_in_rows = np.abs(place.down) <= max(1.0, height)
    is_in_cols = np.abs(place.across) <= max(1.0, width)
    is_pressed: Mask = is_in_rows & is_in_cols
    return is_pressed.astype(np.float64)


def _ring(rng: np.random.Generator, place: Place) -> Doubles:
    radius = max(2.0, place.radius)
    inner = rng.uniform(0.4, 0.8) * radius
    is_ring: Mask = (place.distance <= radius) & (place.distance >= inner)
    return is_ring.astype(np.float64)


def _edge(rng: np.random.Generator, place: Place) -> Doubles:
    angle = rng.uniform(0, math.pi)
    is_on_line = np.abs(place.along(angle)) < rng.uniform(0.6, 1.5)
    is_near = place.distance < max(3.0, 2 * place.radius)
    is_pressed: Mask = is_on_line & is_near
    return is_pressed.astype(np.float64)


def _taxel(rng: np.random.Generator, place: Place) -> Doubles:
    forces = np.zeros(place.down.shape)
    forces.reshape(-1)[place.distance.argmin()] = 1.0
    return forces


def _few(rng: np.random.Generator, place: Place) -> Doubles:
    count = int(rng.integers(2, 9))
    forces = np.zeros(place.down.size)
    # Forces are drawn before their places: an assignment draws its right side first.
    heights = rng.uniform(0.4, 1.0, count)
    cells = rng.choice(forces.size, count, replace=False)
    forces[cells] = heights
    return forces.reshape(place.down.shape)


KINDS: dict[str, Profile] = {
    "even": _even,
    "half": _half,
    "rough": _rough,
    "checkered": _checkered,
    "smooth": _smooth,
    "sole": _sole,
    "disc": _disc,
    "box": _box,
    "ring": _ring,
    "edge": _edge,
    "taxel": _taxel,
    "few taxels": _few,
}
"""Profiles of loads by name."""


@dataclass(frozen=True, eq=False)
class Load:
    """A load and its course. `press`: forces of the whole load where it first touches, newtons;
    `force`: largest of them; `roughness`: deviation of the forces from the profile, in parts of
    them; `rise`: frames until the load is there; `velocity`: taxels per frame along columns and
    rows; `reach`: frames after which it turns back; `period`: frames of coming and going.
    """

    kind: str
    motion: str
    force: float
    roughness: float
    press: Floats
    rise: int
    velocity: tuple[float, float]
    reach: int
    period: int

    def describe(self) -> str:
        """Kind, largest force, roughness and motion."""
        roughness = f", roughness {self.roughness:.2f}" if self.roughness else ""
        return f"load {self.kind} of {self.force:.2f} N{roughness}, {self.motion}"

    def forces(self, k: int, n_pressed: int) -> Floats:
        """Forces k frames after the first touch of `n_pressed` frames, newtons, float32."""
        share = min(1.0, (k + 1) / self.rise)
        if self.motion == "ramps":
            # It grows for 70 % of the time, and falls faster.
            rising = (k + 1) / (0.7 * n_pressed)
            falling = (n_pressed - k) / (0.3 * n_pressed)
            share = min(1.0, rising, falling)
        is_away = k % self.period >= 0.6 * self.period
        if self.motion == "comes and goes" and is_away:
            share = 0.0
        press = self.press
        if self.motion == "moves":
            # There and back again, so that it stays on the skin.
            n_away = self.reach - abs(self.reach - k % (2 * self.reach))
            press = shifted(press, [n_away * speed for speed in self.velocity])
        return np.asarray(share * press, dtype=np.float32)


def shifted(frame: Floats, distances: list[float]) -> Floats:
    """A frame moved along columns and rows by parts of taxels; 0 comes in over the edges."""
    for axis, distance in enumerate(distances):
        whole = math.floor(distance)
        part = distance - whole
        near = _rolled(frame, whole, axis)
        far = _rolled(frame, whole + 1, axis)
        frame = (1 - part) * near + part * far
    return frame


def _rolled(frame: Floats, n_taxels: int, axis: int) -> Floats:
    """A frame moved by whole taxels."""
    source = np.arange(frame.shape[axis]) - n_taxels
    inside = (source >= 0) & (source < frame.shape[axis])
    rolled = np.roll(frame, n_taxels, axis)
    return np.where(np.expand_dims(inside, 1 - axis), rolled, 0)


def draw_load(
    rng: np.random.Generator,
    exists: Mask,
    f_max: float,
    kind: str = "",
    motion: str = "",
) -> Load:
    """Draw a load on the taxels that exist. A stated kind or motion replaces the drawn one."""
    # What is stated is drawn, too: all else of a seed stays the same.
    drawn_kind = str(rng.choice(list(KINDS)))
    drawn_motion = str(rng.choice(MOTIONS))
    kind = kind or drawn_kind
    exponent = rng.uniform(math.log(0.08), math.log(0.96))
    force = f_max * math.exp(exponent)
    # Half of the loads are smooth.
    roughness = max(0.0, float(rng.uniform(-0.4, 0.4)))

    profile = np.zeros(exists.shape)
    # A small load may lie on a hole of the mask alone.
    while not profile.any():
        place = _draw_place(rng, exists.shape)
        profile = KINDS[kind](rng, place)
        levels = 1 + roughness * rng.standard_normal(exists.shape)
        profile *= levels.clip(0)
        profile *= exists
    press = force * profile / max(profile.max(), TINY)
    return Load(
        kind=kind,
        motion=motion or drawn_motion,
        force=force,
        roughness=roughness,
        press=press.astype(np.float32),
        rise=int(rng.integers(1, 9)),
        velocity=_draw_velocity(rng),
        reach=int(rng.integers(10, 60)),
        period=int(rng.integers(16, 50)),
    )


def _draw_place(rng: np.random.Generator, shape: tuple[int, ...]) -> Place:
    """A centre off the edges, and a radius of any size up to half the skin."""
    rows, cols = np.indices(shape).astype(np.float64)
    parts = rng.uniform(MARGIN, 1 - MARGIN, 2)
    centre_row, centre_col = parts * (np.array(shape) - 1)
    largest = max(2.0, min(shape) / 2)
    radius = math.exp(rng.uniform(math.log(1.2), math.log(largest)))
    return Place(rows - centre_row, cols - centre_col, radius)


def _draw_velocity(rng: np.random.Generator) -> tuple[float, float]:
    speed = rng.uniform(0.02, 0.3)
    angle = rng.uniform(0, 2 * math.pi)
    return float(speed * math.cos(angle)), float(speed * math.sin(angle))
