"""Presses of twelve shapes on a square skin, at any angle and place, with forces of one decade."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy import ndimage

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.sensor.noise import NoiseModel

SIDE = 32
"""Rows and columns of the skin. Chosen: a palm, and 16 measurements at N/64."""
RADII = (7.0, 9.0)
"""Radius of a shape, taxels. Chosen: the thinnest parts are 3 taxels wide, the largest touch a
quarter of the skin."""
REACH = 3.0
"""Distance from the middle to which the centre of a shape moves along rows and columns, taxels."""
PEAKS_N = (0.25, 2.5)
"""Largest force of a press, newtons, drawn evenly in its logarithm: one decade, up to the range."""
TILT = 0.3
"""Part of the force by which it differs at most between the middle and the rim of a shape."""
BLUR = 0.6
"""Standard deviation of the softness of the skin, taxels. Chosen: an edge covers two taxels."""

Distance: TypeAlias = Callable[[Doubles, Doubles], Doubles]
"""Signed distance from the edge of a shape, inside below 0, at (u, v) in radii from its centre."""


class Shape(NamedTuple):
    """A shape: its distance, and the number of angles of a full turn at which it looks the same (0:
    all).
    """

    distance: Distance
    symmetry: int


def _box(a: float, b: float, u0: float = 0.0, v0: float = 0.0) -> Distance:
    """A rectangle of half sides a and b, its centre at (u0, v0)."""

    def distance(u: Doubles, v: Doubles) -> Doubles:
        beyond_u = np.abs(u - u0) - a
        beyond_v = np.abs(v - v0) - b
        return np.maximum(beyond_u, beyond_v)

    return distance


def _disc(radius: float, u0: float = 0.0, v0: float = 0.0) -> Distance:
    return lambda u, v: np.hypot(u - u0, v - v0) - radius


def _union(*parts: Distance) -> Distance:
    def distance(u: Doubles, v: Doubles) -> Doubles:
        nearest: Doubles = np.minimum.reduce([part(u, v) for part in parts])
        return nearest

    return distance


def _without(outer: Distance, inner: Distance) -> Distance:
    return lambda u, v: np.maximum(outer(u, v), -inner(u, v))


def _pads(count: int) -> Distance:
    """Discs on a circle."""
    pads = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        u0 = 0.65 * math.cos(angle)
        v0 = 0.65 * math.sin(angle)
        pads.append(_disc(0.33, u0, v0))
    return _union(*pads)


def _triangle(u: Doubles, v: Doubles) -> Doubles:
    sides = []
    for k in range(3):
        angle = 2 * math.pi * k / 3
        outward = u * math.cos(angle) + v * math.sin(angle)
        sides.append(outward - 0.5)
    distance: Doubles = np.maximum.reduce(sides)
    return distance


def _beyond_half(u: Doubles, v: Doubles) -> Doubles:
    """All that is above u = 0.1."""
    return 0.1 - u


_WIDE = _disc(0.95)
_SHORT_BAR = _box(0.8, 0.2)
SHAPES: dict[str, Shape] = {
    "disc": Shape(_disc(0.75), 0),
    "ring": Shape(_without(_WIDE, _disc(0.55)), 0),
    "bar": Shape(_box(1.0, 0.25), 2),
    "square": Shape(_box(0.68, 0.68), 4),
    "frame": Shape(_without(_box(0.8, 0.8), _box(0.45, 0.45)), 4),
    "triangle": Shape(_triangle, 3),
    "cross": Shape(_union(_box(0.95, 0.2), _box(0.2, 0.95)), 4),
    "tee": Shape(_union(_box(0.2, 0.9, -0.6), _SHORT_BAR), 1),
    "ell": Shape(_union(_box(0.2, 0.8, -0.6), _box(0.8, 0.2, 0.0, -0.6)), 1),
    "crescent": Shape(_without(_WIDE, _union(_disc(0.5), _beyond_half)), 1),
    "two pads": Shape(_pads(2), 2),
    "three pads": Shape(_pads(3), 3),
}
"""The twelve shapes by name."""
NAMES = tuple(SHAPES)


class Presses(NamedTuple):
    """Presses, one frame each: readings, float32 (n, SIDE, SIDE), newtons; number of the shape in
    `NAMES`, (n,); angle, radians, (n,); place of the centre in taxels, row and column, (n, 2).
    """

    frames: Floats
    labels: np.ndarray[tuple[int], np.dtype[np.intp]]
    angles: Doubles
    places: Doubles


def draw(count: int, seed: int) -> Presses:
    """Draw presses with the noise of the paper; as many of each shape, to within one."""
    rng = np.random.default_rng([seed, 56])
    noise = NoiseModel.for_range(PAPER_F_MAX_N)
    labels = rng.permutation(np.arange(count) % len(NAMES))
    angles = rng.uniform(0, 2 * math.pi, count)
    places = (SIDE - 1) / 2 + rng.uniform(-REACH, REACH, (count, 2))

    frames = np.empty((count, SIDE, SIDE), dtype=np.float32)
    for k, label in enumerate(labels):
        shape = SHAPES[NAMES[label]]
        truth = _forces(shape, angles[k], places[k], rng)
        frames[k] = noise.apply(truth, rng)
    return Presses(frames, labels, angles, places)


def draw_forces(count: int, rng: np.random.Generator) -> Floats:
    """True forces of drawn presses, float32 (count, SIDE, SIDE), the largest of each 1 N."""
    forces = np.empty((count, SIDE, SIDE), dtype=np.float32)
    for k in range(count):
        shape = SHAPES[NAMES[k % len(NAMES)]]
        place = (SIDE - 1) / 2 + rng.uniform(-REACH, REACH, 2)
        angle = rng.uniform(0, 2 * math.pi)
        forces[k] = _forces(shape, angle, place, rng)
        forces[k] /= forces[k].max()
    return forces


def _forces(
    shape: Shape, angle: float, place: Doubles, rng: np.random.Generator
) -> Floats:
    """True forces of a press, float32 (SIDE, SIDE), newtons."""
    radius = rng.uniform(*RADII)
    peak = math.exp(rng.uniform(*np.log(PEAKS_N)))
    slope_along, slope_across = rng.uniform(-TILT, TILT, 2)

    # Coordinates of the taxels in the frame of the shape, in its radii.
    row, col = np.indices((SIDE, SIDE)) - place[:, None, None]
    cos = math.cos(angle)
    sin = math.sin(angle)
    along = (cos * row + sin * col) / radius
    across = (cos * col - sin * row) / radius

    # A taxel on the edge is covered in part; the skin is soft.
    from_edge = radius * shape.distance(along, across)
    cover = np.clip(0.5 - from_edge, 0, 1)
    level = 1 + slope_along * along + slope_across * across
    pressure = cover * np.maximum(level, 0)
    soft = ndimage.gaussian_filter(pressure, BLUR)
    forces: Floats = (peak * soft / soft.max()).astype(np.float32)
    return forces
