"""The cells under a body: the taxels of the skin, and the lower ground around them."""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sparseskin.nodes.numerics.arrays import Doubles, Indices

from .bodies import FAR_M, Sole
from .contact import Bed

Place = tuple[float, float]
_Value = TypeVar("_Value", float, Doubles)


@dataclass(frozen=True)
class Surface:
    """The constants of the skin as a bed, and of the ground beside it."""

    pitch_m: float  # distance of neighbouring taxels, and of the ground's cells
    stiffness: float  # k in N/m of a taxel
    damping: float  # c in N s/m of a taxel
    #: Depth below the tops of the taxels; None: no ground.
    ground_drop_m: float | None = None
    ground_stiffness: float = 1.0e4  # the same of a cell of the ground
    ground_damping: float = 100.0


class Terrain:
    """Finds the cells under a sole at any place of the body.

    The tops of the unloaded taxels are at height 0. Coordinates are in m from the middle of the
    skin, x along a row and y along a column. A cell at (x, y) in body coordinates has the gap
    sole(x, y) + depth of the ground, and the Jacobian (1, -x, y) for (z, pitch, roll).

    `dof` are the free coordinates, ("z",), ("z", "pitch") or ("z", "pitch", "roll"), in the order
    of the bed's Jacobian. Pitch is the rotation about the body's y axis; positive lowers points of
    positive x. Roll is that about its x axis; positive lifts points of positive y. The rotation of
    the body about the vertical, `yaw_rad`, is constant.
    """

    def __init__(
        self,
        surface: Surface,
        shape: tuple[int, int],
        sole: Sole,
        yaw_rad: float,
        dof: tuple[str, ...],
    ) -> None:
        self._surface = surface
        self._shape = shape
        self._sole = sole
        self._dof = dof
        self._yaw = (math.cos(yaw_rad), math.sin(yaw_rad))
        self._searched_at: Place | None = None

        # 1 within one pitch of the body, and a little more for the rotated grid.
        margin = math.ceil(1.1 * surface.pitch_m / sole.grid_m)
        window = 2 * margin + 1
        near = np.pad(sole.heights < FAR_M, window)
        for axis in (0, 1):
            near = sliding_window_view(near, window, axis=axis).max(axis=-1)
        self._vicinity = Sole(
            near.astype(np.float64),
            sole.x_min - (margin + 1) * sole.grid_m,
            sole.y_min - (margin + 1) * sole.grid_m,
            sole.grid_m,
        )

    def under(self, place: Place) -> tuple[Bed, Indices]:
        """The cells under the body with its centre of mass over `place`, taxels first, some beside
        it, out of its reach; and the indices of these taxels in the flattened frame.
        """
        at = self._searched_at
        if at is None or math.dist(place, at) > self._surface.pitch_m:
            self._search(place)
        # In body coordinates the sole is one fixed height map.
        x, y = self._to_body(*place)
        body_x = self._body_x - x
        body_y = self._body_y - y
        gap = self._sole.sample(body_x, body_y)
        gap += self._depth

        jacobian = np.ones((gap.size, len(self._dof)))
        if "pitch" in self._dof:
            np.negative(body_x, out=jacobian[:, self._dof.index("pitch")])
        if "roll" in self._dof:
            jacobian[:, self._dof.index("roll")] = body_y
        return Bed(self._stiffness, self._damping, gap, jacobian), self._taxels

    def _to_body(self, x: _Value, y: _Value) -> tuple[_Value, _Value]:
        cos, sin = self._yaw
        return cos * x + sin * y, cos * y - sin * x

    def _search(self, place: Place) -> None:
        """Find the cells that the body can cover while within one pitch of `place`."""
        surface = self._surface
        n_rows, n_cols = self._shape
        # At any yaw: the farthest corner of the sole, and two pitches more.
        x_min, x_max, y_min, y_max = self._sole.bounds
        farthest = math.hypot(max(-x_min, x_max), max(-y_min, y_max))
        reach = farthest + 2 * surface.pitch_m
        cols = self._indices(place[0], reach, n_cols)
        rows = self._indices(place[1], reach, n_rows)
        col, row = (index.ravel() for index in np.meshgrid(cols, rows))

        # Places of their centres, and which of them the body can cover.
        from_middle_x = col - (n_cols - 1) / 2
        from_middle_y = row - (n_rows - 1) / 2
        body_x, body_y = self._to_body(
            np.asarray(from_middle_x * surface.pitch_m, dtype=np.float64),
            np.asarray(from_middle_y * surface.pitch_m, dtype=np.float64),
        )
        x, y = self._to_body(*place)
        near = self._vicinity.sample(body_x - x, body_y - y) > 0.0
        on_skin = (col >= 0) & (col < n_cols)
        on_skin &= (row >= 0) & (row < n_rows)

        # Taxels first, as the bed has them.
        skin = np.flatnonzero(near & on_skin)
        ground = np.flatnonzero(near & ~on_skin)
        order = np.concatenate([skin, ground])
        sizes = [skin.size, ground.size]

        self._taxels = (row * n_cols + col)[skin]
        self._body_x = body_x[order]
        self._body_y = body_y[order]
        self._stiffness = np.repeat(
            [surface.stiffness, surface.ground_stiffness], sizes
        )
        self._damping = np.repeat([surface.damping, surface.ground_damping], sizes)
        self._depth = np.repeat([0.0, surface.ground_drop_m or 0.0], sizes)
        self._searched_at = place

    def _indices(self, middle: float, reach: float, count: int) -> Indices:
        """Return the indices of the rows or columns of cells within `reach` of `middle`."""
        pitch = self._surface.pitch_m
        index_of_middle = (count - 1) / 2
        start = math.floor((middle - reach) / pitch + index_of_middle)
        stop = math.ceil((middle + reach) / pitch + index_of_middle) + 1
        # Without ground around the skin there are no cells beyond its sides.
        if self._surface.ground_drop_m is None:
            start = max(start, 0)
            stop = min(stop, count)
        return np.arange(start, max(start, stop), dtype=np.intp)
