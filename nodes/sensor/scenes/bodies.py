"""The bodies laid on the skin: the height map of their underside (sole), mass and inertia.

A sole is the lowest of a few primitives, eroded by the sphere of a taxel of radius r: over the
point p it is felt at the height

    felt(p) = min over |d| < r of  height(p + d) + r - sqrt(r^2 - |d|^2).

Limit. The map is eroded on a grid of 0.5 mm and interpolated between its points, so r = 2.5 mm is
felt up to 2.0 mm beyond a straight edge and 1.6 to 2.0 mm beyond a round one: an edge that sinks
deeper than 1 mm misses taxels. The cube is exact. tests/nodes/sensor/scenes/test_exact.py has the
errors: 51 dB and more (PSNR), where the noise has 47 to 48 dB.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles

Primitive = Callable[[Doubles, Doubles], Doubles]
"""Height of an underside above the body's lowest point, in m, over body coordinates x, y in m."""

FAR_M = 1.0
"""Height of the underside where there is no body, in m: out of reach of every taxel."""
GRID_M = 0.0005
"""Spacing of height maps, in m: a tenth of the pitch of the taxels."""
_ROUNDING_M = 1e-9
"""Tolerance of edges, in m: a grid point on an edge belongs to the body."""


@dataclass(frozen=True, eq=False)
class Sole:
    """The underside of a body as a height map."""

    heights: Doubles  # (n_y, n_x), m above its lowest point; FAR_M beside it, at all edges too
    #: Body coordinates of heights[0, 0], m; the centre of mass is at (0, 0).
    x_min: float
    y_min: float
    grid_m: float = GRID_M

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max of the map in m."""
        n_y, n_x = (self.grid_m * (n - 1) for n in self.heights.shape)
        return self.x_min, self.x_min + n_x, self.y_min, self.y_min + n_y

    def sample(self, x: Doubles, y: Doubles) -> Doubles:
        """Heights in m at points of the body, float64 (n,), interpolated bilinearly; outside the
        map FAR_M.
        """
        n_y, n_x = self.heights.shape
        # Just inside the last point, which has no next neighbour.
        col = np.minimum(np.maximum((x - self.x_min) / self.grid_m, 0.0), n_x - 1.001)
        row = np.minimum(np.maximum((y - self.y_min) / self.grid_m, 0.0), n_y - 1.001)
        j = col.astype(np.intp)
        i = row.astype(np.intp)
        # Parts of the grid that a point is beyond the one below it.
        col -= j
        row -= i

        flat = self.heights.reshape(-1)
        at = i * n_x + j
        lower: Doubles = flat.take(at)
        lower += (flat.take(at + 1) - lower) * col
        at += n_x
        upper = flat.take(at)
        upper += (flat.take(at + 1) - upper) * col

        # lower + (upper - lower) * row, in place.
        upper -= lower
        upper *= row
        lower += upper
        return lower


def slab(
    x_min: float, x_max: float, y_min: float, y_max: float, height: float
) -> Primitive:
    """A flat, axis-parallel underside at one height; all in m."""

    def underside(x: Doubles, y: Doubles) -> Doubles:
        inside = (x >= x_min - _ROUNDING_M) & (x <= x_max + _ROUNDING_M)
        inside &= (y >= y_min - _ROUNDING_M) & (y <= y_max + _ROUNDING_M)
        return np.where(inside, height, FAR_M)

    return underside


def disc(radius: float) -> Primitive:
    """A flat round underside about the origin, its lowest part; in m."""

    def underside(x: Doubles, y: Doubles) -> Doubles:
        return np.where(np.hypot(x, y) <= radius, 0.0, FAR_M)

    return underside


def roller(
    x_min: float, x_max: float, y_axis: float, radius: float, slope: float
) -> Primitive:
    """A cylinder lying along x; in m. It touches at x_max and rises by `slope` towards x_min."""

    def underside(x: Doubles, y: Doubles) -> Doubles:
        across = np.abs(y - y_axis)
        inside = (x >= x_min) & (x <= x_max) & (across <= radius)
        drop = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
        height = radius - drop + slope * (x_max - x)
        return np.where(inside, height, FAR_M)

    return underside


def capsule(
    start: tuple[float, float],
    end: tuple[float, float],
    radius: float,
) -> Primitive:
    """A rounded bead along a segment, its lowest line that of the body; all in m."""

    def underside(x: Doubles, y: Doubles) -> Doubles:
        away = _distance(x, y, start, end)
        drop = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
        return np.where(away <= radius, radius - drop, FAR_M)

    return underside


def bar(
    start: tuple[float, float],
    end: tuple[float, float],
    half_width: float,
    height: float,
) -> Primitive:
    """A flat-bottomed bar with round ends along a segment; all in m."""

    def underside(x: Doubles, y: Doubles) -> Doubles:
        return np.where(_distance(x, y, start, end) <= half_width, height, FAR_M)

    return underside


def _distance(
    x: Doubles, y: Doubles, start: tuple[float, float], end: tuple[float, float]
) -> Doubles:
    """Distance of points from a segment."""
    start_x, start_y = start
    along = np.array(end) - np.array(start)
    along_x, along_y = along
    from_x = x - start_x
    from_y = y - start_y

    # Share of the segment at the point of it that is nearest.
    projection = from_x * along_x + from_y * along_y
    share = np.clip(projection / float(along @ along), 0.0, 1.0)
    away: Doubles = np.hypot(from_x - share * along_x, from_y - share * along_y)
    return away


def build_sole(
    primitives: Sequence[Primitive],
    bounds: tuple[float, float, float, float],
    taxel_radius_m: float,
) -> Sole:
    """The lowest of the primitives, eroded by the sphere of a taxel, of radius 0 for needles.

    An edge of the body meets the flank of a sphere before its top: while it slides across, the
    force grows over a radius, where it would jump on a needle. `bounds` are those of the body.
    """
    body_x_min, body_x_max, body_y_min, body_y_max = bounds
    # As far as a taxel feels the body, and an edge of the map that is all FAR_M.
    margin = taxel_radius_m + 2 * GRID_M
    x_min = body_x_min - margin
    y_min = body_y_min - margin
    n_x = math.ceil((body_x_max + margin - x_min) / GRID_M) + 1
    n_y = math.ceil((body_y_max + margin - y_min) / GRID_M) + 1
    along_x = x_min + GRID_M * np.arange(n_x)
    along_y = y_min + GRID_M * np.arange(n_y)
    x, y = np.meshgrid(along_x, along_y)

    heights = np.full((n_y, n_x), FAR_M)
    for underside in primitives:
        np.minimum(heights, underside(x, y), out=heights)
    return Sole(_eroded(heights, taxel_radius_m), x_min, y_min)


def _eroded(heights: Doubles, radius_m: float) -> Doubles:
    """Return a height map as a sphere feels it; see the module. A needle feels the map itself."""
    reach = int(radius_m / GRID_M + 1e-9)
    offsets = GRID_M * np.arange(-reach, reach + 1)
    distance2 = offsets[:, None] ** 2 + offsets[None, :] ** 2
    within = distance2 <= 0.0
    if reach:
        # Strictly inside the radius: at the radius itself the sphere is touched on its equator.
        within = distance2 < radius_m**2 * (1 - 1e-9)
    # Of the sphere's surface over its top, 0 or less.
    lift = np.sqrt(np.maximum(radius_m**2 - distance2, 0.0)) - radius_m

    n_y, n_x = heights.shape
    padded = np.pad(heights, reach, constant_values=FAR_M)
    felt = np.full(heights.shape, FAR_M)
    for i, j in np.argwhere(within):
        shifted = padded[i : i + n_y, j : j + n_x]
        np.minimum(felt, shifted - lift[i, j], out=felt)
    return felt


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body."""

    sole: Sole  # as taxels of one radius feel it
    mass_kg: float
    inertia_kg_m2: float  # about each horizontal axis through the centre of mass


@cache
def wooden_cube(taxel_radius_m: float) -> Body:
    """Gazebo's wooden cube: 10 cm, 0.5167 kg, face down."""
    side = 0.1
    mass = 0.5167
    half = side / 2
    bounds = (-half, half, -half, half)
    sole = build_sole([slab(*bounds, 0.0)], bounds, taxel_radius_m)
    # Of a solid cube.
    return Body(sole, mass, mass * side**2 / 6)


@cache
def metal_peg(taxel_radius_m: float) -> Body:
    """An aluminium peg of 20 mm diameter and 60 mm length, standing upright: 51 g."""
    radius = 0.01
    length = 0.06
    density = 2700.0
    mass = density * math.pi * radius**2 * length
    bounds = (-radius, radius, -radius, radius)
    sole = build_sole([disc(radius)], bounds, taxel_radius_m)
    # Of a solid cylinder, about an axis across it.
    return Body(sole, mass, mass * (3 * radius**2 + length**2) / 12)


@cache
def monkey_wrench(taxel_radius_m: float) -> Body:
    """Gazebo's monkey wrench: 390.7 x 83.4 mm, 1 kg, 1 kg m2.

    The Gazebo model states no inertia, so the defaults of SDF hold (1 kg, 1 kg m2 about each
    axis, centre of mass at the origin), and it tips very slowly. On a rigid plane it stands on
    the rim of the adjusting wheel and on the handle's end; the jaws are 2.6 mm and the flats of
    handle and shank 5 mm above that plane.
    """
    bounds = (-0.2028, 0.1879, -0.0294, 0.0540)
    primitives = [
        # Adjusting wheel: the rim towards the handle, (-75.8, -5.8) mm, is its lowest point.
        roller(-0.0940, -0.0758, -0.0058, 0.0134, slope=0.02),
        # Bead at the end of the handle, through (179.6, 10.1) and (184.0, 14.1) mm.
        capsule((0.1796, 0.0101), (0.1840, 0.0141), 0.0039),
        # Handle, widening a little to its end, and the shank that carries the jaws.
        bar((-0.0600, 0.0), (0.1730, 0.0040), 0.0130, 0.0050),
        slab(-0.1900, -0.0600, -0.0180, 0.0050, 0.0050),
        # Fixed jaw at the far end with the head's back, and the moving jaw next to the wheel.
        slab(-0.2028, -0.1680, -0.0294, 0.0540, 0.0026),
        slab(-0.1330, -0.1000, -0.0180, 0.0540, 0.0026),
    ]
    return Body(build_sole(primitives, bounds, taxel_radius_m), 1.0, 1.0)
