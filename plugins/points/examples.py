"""Layouts that are computed: a torso and a grip."""

import math
from collections.abc import Callable

import numpy as np
from scipy.interpolate import PchipInterpolator

from sparseskin.nodes.numerics.arrays import Doubles, Indices

Layout = tuple[Doubles, Doubles]
"""Places in metres and unit normals, float64 (n, 3) each."""

TORSO_POINTS = 4000
_TORSO = np.array(
    [
        (0.00, 0.150, 0.100),
        (0.15, 0.155, 0.105),
        (0.32, 0.190, 0.125),
        (0.43, 0.205, 0.120),
        (0.50, 0.165, 0.100),
        (0.54, 0.075, 0.065),
    ]
)
"""Elliptic sections of the torso from waist to neck: height, half width and half depth, metres.
Chosen: about those of an adult."""
_AROUND = np.linspace(-np.pi, np.pi, 721)
"""Angles at which the way around a ring is summed."""
GRIP_RADIUS_M = 0.035
GRIP_LENGTH_M = 0.1
GRIP_PITCH_M = 0.005


def torso(n: int = TORSO_POINTS) -> Layout:
    """A torso, rings of taxels from waist to neck, open at both ends: n taxels.

    All taxels are about equally far apart, so that rings have different numbers of them, as many
    as their length holds: where it changes, the lattice has dislocations.
    """
    # The largest pitch at which there are n, to a nanometre.
    low = 0.002
    high = 0.1
    for _ in range(30):
        pitch = 0.5 * (low + high)
        _, counts, _ = _rings(pitch)
        if counts.sum() >= n:
            low = pitch
        else:
            high = pitch
    heights, counts, ways = _rings(low)

    # Taxels at equal steps of the way around their ring.
    rings = []
    for count, way in zip(counts, ways, strict=True):
        steps = np.arange(count) / count * way[-1]
        rings.append(np.interp(steps, way, _AROUND))

    # The last rings, at the neck, lose what is too much.
    angles = np.concatenate(rings)[:n]
    z = np.repeat(heights, counts)[:n]

    widths, depths = _sections()
    a = widths(z)
    b = depths(z)
    cos = np.cos(angles)
    sin = np.sin(angles)
    places = np.stack([b * cos, a * sin, z], axis=1)

    # The normal is perpendicular to the ring and to the line upwards.
    around = np.stack([-b * sin, a * cos, np.zeros(n)], axis=1)
    upward = np.stack([depths(z, 1) * cos, widths(z, 1) * sin, np.ones(n)], axis=1)
    normals = np.cross(around, upward)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return places, normals / lengths


def _sections() -> tuple[PchipInterpolator, PchipInterpolator]:
    """Half width and half depth of the torso by its height, metres."""
    heights, widths, depths = _TORSO.T
    return PchipInterpolator(heights, widths), PchipInterpolator(heights, depths)


def _rings(pitch: float) -> tuple[Doubles, Indices, Doubles]:
    """Heights of the rings, a pitch apart, their taxels, and the way around each at `_AROUND`."""
    widths, depths = _sections()

    # The way up the skin, the mean of that at the side and that in front.
    z = np.linspace(_TORSO[0, 0], _TORSO[-1, 0], 2000)
    rise = np.diff(z)
    side_steps = np.hypot(np.diff(widths(z)), rise)
    front_steps = np.hypot(np.diff(depths(z)), rise)
    steps = (side_steps + front_steps) / 2
    way_up = np.concatenate([[0.0], np.cumsum(steps)])
    stops = np.arange(0, way_up[-1], pitch)
    heights = np.interp(stops, way_up, z)

    # A ring has three taxels at least.
    ways = _around_ellipses(widths(heights), depths(heights))
    counts = np.maximum(3, (ways[:, -1] / pitch).astype(np.intp))
    return heights, counts, ways


def _around_ellipses(a: Doubles, b: Doubles) -> Doubles:
    """The way around ellipses of half axes a and b at each angle of `_AROUND`, (n_rings, 721)."""
    x_steps = np.diff(b[:, None] * np.cos(_AROUND))
    y_steps = np.diff(a[:, None] * np.sin(_AROUND))
    ring_steps = np.hypot(x_steps, y_steps)
    return np.pad(np.cumsum(ring_steps, axis=1), ((0, 0), (1, 0)))


def grip() -> Layout:
    """A cylinder of the size of a hand's grip, taxels on a square lattice: 44 x 21."""
    # As many as fit around: the pitch differs from the stated one by a part of a taxel.
    n = round(2 * math.pi * GRIP_RADIUS_M / GRIP_PITCH_M)
    n_rings = round(GRIP_LENGTH_M / GRIP_PITCH_M) + 1
    k, i = np.meshgrid(np.arange(n), np.arange(n_rings))
    angle = 2 * np.pi * k.ravel() / n
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(angle.size)], axis=1)

    # The rings stand one above the other.
    places = GRIP_RADIUS_M * normals
    places[:, 2] = GRIP_PITCH_M * i.ravel()
    return places, normals


EXAMPLES: dict[str, Callable[[], Layout]] = {"torso": torso, "grip": grip}
