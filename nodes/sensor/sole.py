"""The underside of a body: a height map built from primitives and felt by spheres."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

Array = npt.NDArray[np.float64]
# Height of the underside above the body's lowest point, in m, over body coordinates x, y in m.
Primitive = Callable[[Array, Array], Array]

# Where there is no body, its underside is out of every taxel's reach.
FAR_M = 1.0
GRID_M = 0.0005
# A grid point on an edge belongs to the body, however its coordinate was rounded.
_ROUNDING_M = 1e-9


@dataclass(frozen=True, eq=False)
class Sole:
    """The underside of a body as a height map.

    Attributes
    ----------
    heights : ndarray of float64, shape (n_y, n_x)
        Height above the body's lowest point in m, 0 or more; FAR_M where there is no body. The
        outermost rows and columns are FAR_M.
    x_min, y_min : float
        Body coordinates of heights[0, 0] in m; the centre of mass is at (0, 0).
    grid_m : float
        Spacing of the map in m.
    """

    heights: Array
    x_min: float
    y_min: float
    grid_m: float = GRID_M

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max of the map in m."""
        n_y, n_x = self.heights.shape
        return (
            self.x_min,
            self.x_min + (n_x - 1) * self.grid_m,
            self.y_min,
            self.y_min + (n_y - 1) * self.grid_m,
        )

    def sample(self, x: Array, y: Array) -> Array:
        """Heights at points of the body, interpolated bilinearly.

        Parameters
        ----------
        x, y : ndarray of float64, shape (n,)
            Body coordinates in m; outside the map the height is FAR_M.

        Returns
        -------
        ndarray of float64, shape (n,)
            Heights in m.
        """
        n_y, n_x = self.heights.shape
        # A little inside the last point, which has no neighbour further on.
        col = np.minimum(np.maximum((x - self.x_min) / self.grid_m, 0.0), n_x - 1.001)
        row = np.minimum(np.maximum((y - self.y_min) / self.grid_m, 0.0), n_y - 1.001)
        j = col.astype(np.intp)
        i = row.astype(np.intp)
        col -= j
        row -= i
        i *= n_x
        i += j
        flat = self.heights.reshape(-1)
        near = flat.take(i)
        near += (flat.take(i + 1) - near) * col
        i += n_x
        far = flat.take(i)
        far += (flat.take(i + 1) - far) * col
        far -= near
        far *= row
        near += far
        heights: Array = near
        return heights


def slab(x_min: float, x_max: float, y_min: float, y_max: float, height: float) -> Primitive:
    """A flat, axis-parallel underside at one height; all in m."""

    def underside(x: Array, y: Array) -> Array:
        inside = (x >= x_min - _ROUNDING_M) & (x <= x_max + _ROUNDING_M)
        inside &= (y >= y_min - _ROUNDING_M) & (y <= y_max + _ROUNDING_M)
        return np.where(inside, height, FAR_M)

    return underside


def disc(radius: float, height: float) -> Primitive:
    """A flat round underside about the origin; all in m."""

    def underside(x: Array, y: Array) -> Array:
        return np.where(np.hypot(x, y) <= radius, height, FAR_M)

    return underside


def roller(
    x_min: float, x_max: float, y_axis: float, radius: float, slope: float = 0.0
) -> Primitive:
    """A cylinder lying along x; in m. It touches at x_max and rises by `slope` towards x_min."""

    def underside(x: Array, y: Array) -> Array:
        across = np.abs(y - y_axis)
        inside = (x >= x_min) & (x <= x_max) & (across <= radius)
        drop = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
        return np.where(inside, radius - drop + slope * (x_max - x), FAR_M)

    return underside


def capsule(
    start: tuple[float, float], end: tuple[float, float], radius: float, height: float = 0.0
) -> Primitive:
    """A rounded bead along a segment, its lowest line at `height`; all in m."""

    def underside(x: Array, y: Array) -> Array:
        away = _distance(x, y, start, end)
        drop = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
        return np.where(away <= radius, height + radius - drop, FAR_M)

    return underside


def bar(
    start: tuple[float, float], end: tuple[float, float], half_width: float, height: float
) -> Primitive:
    """A flat-bottomed bar with round ends along a segment; all in m."""

    def underside(x: Array, y: Array) -> Array:
        return np.where(_distance(x, y, start, end) <= half_width, height, FAR_M)

    return underside


def _distance(x: Array, y: Array, start: tuple[float, float], end: tuple[float, float]) -> Array:
    along = np.array(end) - np.array(start)
    share = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / float(along @ along)
    share = np.clip(share, 0.0, 1.0)
    away: Array = np.hypot(x - start[0] - share * along[0], y - start[1] - share * along[1])
    return away


def build_sole(
    primitives: Sequence[Primitive],
    bounds: tuple[float, float, float, float],
    taxel_radius_m: float,
) -> Sole:
    """The lowest of the primitives, felt by spheres.

    A taxel is a sphere and not a needle: a body's edge meets its flank before its top. What it
    feels is the underside eroded by the sphere, which makes a force grow over a radius, instead
    of jump, while an edge slides across.

    Parameters
    ----------
    primitives : sequence of callables
        The parts of the underside.
    bounds : (x_min, x_max, y_min, y_max)
        Extent of the body in m.
    taxel_radius_m : float
        Radius of a taxel's sphere in m; 0 for needles.

    Returns
    -------
    Sole
        The height map, on a grid of 0.5 mm.
    """
    margin = taxel_radius_m + 2 * GRID_M
    x_min, y_min = bounds[0] - margin, bounds[2] - margin
    n_x = math.ceil((bounds[1] + margin - x_min) / GRID_M) + 1
    n_y = math.ceil((bounds[3] + margin - y_min) / GRID_M) + 1
    x, y = np.meshgrid(x_min + GRID_M * np.arange(n_x), y_min + GRID_M * np.arange(n_y))
    heights = np.full((n_y, n_x), FAR_M)
    for underside in primitives:
        np.minimum(heights, underside(x, y), out=heights)
    reach = int(taxel_radius_m / GRID_M + 1e-9)
    offsets = GRID_M * np.arange(-reach, reach + 1)
    away2 = offsets[:, None] ** 2 + offsets[None, :] ** 2
    # Strictly inside the radius: at the radius itself the sphere is only touched on its equator.
    within = away2 < taxel_radius_m**2 * (1 - 1e-9) if reach else away2 <= 0.0
    lift = np.sqrt(np.maximum(taxel_radius_m**2 - away2, 0.0)) - taxel_radius_m
    heights = ndimage.grey_erosion(
        heights, footprint=within, structure=lift, mode="constant", cval=FAR_M
    )
    return Sole(np.minimum(heights, FAR_M), x_min, y_min)
