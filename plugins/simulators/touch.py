"""Forces of the taxels of a skin in a MuJoCo simulation, by the force law of the scenes.

Each taxel is a needle along the normal of the skin: a surface, found by rays against the geoms
themselves, that has passed the plane of the unloaded taxels by d > 0 at the rate d' of its material
point presses with f = max(0, k d + c d'), as in `scenes.contact`. All rays of a frame are one call
of MuJoCo: they start at one point, 1 km behind the skin, so that they are parallel to 0.1 mrad on a
skin of 0.2 m; at a penetration of 10 mm that is 1 um aside.

Limits: an edge is felt where it is, not a taxel's radius before; there is no friction; a body
thinner than its penetration, or deeper than `depth_m`, reads `depth_m`.
"""

import copy
from typing import Any

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Integers

from .model import Pad, bears_load, touching_geoms

APEX_M = 1000.0
"""Distance of the common start of all rays behind the skin, metres. Chosen: rays are parallel to
1 um, and double precision resolves 1e-9 m."""
_SEEN = 5
_UNSEEN = 4
"""Groups of geoms that rays meet, and do not."""


class Touch:
    """The taxels of one skin in a simulation. Raises SourceError if no geom can touch the skin.

    `read` and `press` expect positions and velocities of one state in `data`, as after `mj_step1`
    or `mj_forward`. `presses`: True if the taxels bear the load: no geom of the skin's body
    collides.
    """

    def __init__(self, model: Any, data: Any, pad: Pad, path: str = "model") -> None:
        self._model = model
        self._data = data
        self._pad = pad
        self._geoms = touching_geoms(model, pad, path)
        self.presses = not bears_load(model, pad)

        # Rays look at a copy: visual groups and transparency decide what they meet.
        self._seen = copy.copy(model)
        self._seen.geom_rgba[:, 3] = 1.0
        self._seen.geom_matid[:] = -1
        self._group = np.zeros(6, np.uint8)
        self._group[_SEEN] = 1

        # Rays from the apex to the taxels.
        self._places = _places_on(pad)
        reach = self._places + np.array([0.0, 0.0, APEX_M])
        self._lengths = np.linalg.norm(reach, axis=1)
        self._rays = reach / self._lengths[:, None]

        # Of the circle around all taxels.
        self._radius = 0.5 * pad.pitch_m * float(np.hypot(*pad.shape))
        #: Wrench that the taxels apply to each body.
        self._applied: dict[int, Doubles] = {}

    def read(self) -> Floats:
        """Forces of the taxels, newtons, float32 of shape (n_rows, n_cols); not clipped above."""
        forces, _, _ = self._forces()
        return forces.reshape(self._pad.shape).astype(np.float32)

    def press(self) -> Floats:
        """As `read`; the forces, and no longer those of the last call, act on the bodies in the
        next `mj_step2`: they are added to `xfrc_applied`, which others may use too.
        """
        forces, points, bodies = self._forces()
        _, axes = self._frame()
        normal = axes[:, 2]

        # The forces of the last call act no longer.
        for body, wrench in self._applied.items():
            self._data.xfrc_applied[body] -= wrench
        self._applied = {}

        pressed = forces > 0
        for body in set(bodies[pressed].tolist()):
            # The sum of its forces, and of their moments; the skin feels the opposite.
            on_it = pressed & (bodies == body)
            total = float(forces[on_it].sum())
            moment = forces[on_it] @ points[on_it]
            self._apply(body, total, moment, normal)
            self._apply(self._pad.body, -total, -moment, normal)
        return forces.reshape(self._pad.shape).astype(np.float32)

    def contact_force(self) -> float:
        """Sum of the normal forces of MuJoCo's own contacts on the skin's body, newtons."""
        import mujoco

        model = self._model
        data = self._data
        # A contact's force is along its own axes: the first is its normal.
        total = 0.0
        wrench = np.zeros(6)
        for k in range(data.ncon):
            bodies = model.geom_bodyid[data.contact.geom[k]]
            if self._pad.body in bodies:
                mujoco.mj_contactForce(model, data, k, wrench)
                total += float(wrench[0])
        return total

    def _apply(self, body: int, total: float, moment: Doubles, normal: Doubles) -> None:
        """Apply forces along the normal; `moment` is the sum of force times place."""
        # MuJoCo applies a wrench at the centre of mass of a body.
        torque = _cross(moment - total * self._data.xipos[body], normal)
        wrench = np.concatenate([total * normal, torque])
        self._applied[body] = self._applied.get(body, np.zeros(6)) + wrench
        self._data.xfrc_applied[body] += wrench

    def _frame(self) -> tuple[Doubles, Doubles]:
        """Middle of the plane of the taxels, and the axes of the site as columns."""
        axes = self._data.site_xmat[self._pad.site].reshape(3, 3)
        middle = self._data.site_xpos[self._pad.site] + self._pad.top_m * axes[:, 2]
        return middle, axes

    def _near(self, middle: Doubles, normal: Doubles) -> Indices:
        """Geoms whose bounding sphere reaches the taxels; planes have none."""
        model = self._seen
        geoms = self._geoms
        offsets = self._data.geom_xpos[geoms] - middle
        radius = model.geom_rbound[geoms]
        height = offsets @ normal
        aside = np.sqrt(np.maximum((offsets**2).sum(axis=1) - height**2, 0.0))

        is_plane = radius == 0
        is_at_height = (height - radius < 0) & (height + radius > -self._pad.depth_m)
        is_over_taxels = aside < self._radius + radius
        within_reach: Indices = geoms[is_plane | (is_at_height & is_over_taxels)]
        return within_reach

    def _forces(self) -> tuple[Doubles, Doubles, Indices]:
        """Forces, points where they act, and bodies that they act on, one of each a taxel."""
        n = len(self._places)
        forces = np.zeros(n)
        points = np.zeros((n, 3))
        bodies = np.zeros(n, np.intp)

        middle, axes = self._frame()
        near = self._near(middle, axes[:, 2])
        taxels = self._under(near, middle, axes)
        if not taxels.size:
            return forces, points, bodies

        depths, hit, tops = self._depths(near, taxels, middle, axes)
        is_deep = depths > 0
        depths = depths[is_deep]
        touched = taxels[is_deep]
        normal = axes[:, 2]
        places = tops[is_deep] - depths[:, None] * normal
        touching = self._seen.geom_bodyid[hit[is_deep]]

        # Rates at which the bodies press into the skin.
        pad = self._pad
        speeds = -self._speeds(pad.body, places, normal)
        for body in set(touching.tolist()):
            on_it = touching == body
            speeds[on_it] += self._speeds(body, places[on_it], normal)
        # A taxel pushes, and never pulls.
        pressures = pad.stiffness * depths - pad.damping * speeds
        forces[touched] = np.maximum(pressures, 0.0)
        points[touched] = places
        bodies[touched] = touching
        return forces, points, bodies

    def _under(self, near: Indices, middle: Doubles, axes: Doubles) -> Indices:
        """Taxels under the bounding spheres of geoms."""
        under = np.zeros(len(self._places), np.bool_)
        for geom in near:
            radius = self._seen.geom_rbound[geom]
            # A plane has no bounding sphere, and may be over all taxels.
            if radius == 0:
                return np.arange(len(under))

            x, y, _ = (self._data.geom_xpos[geom] - middle) @ axes
            distance2 = (self._places[:, 0] - x) ** 2 + (self._places[:, 1] - y) ** 2
            under |= distance2 <= radius**2
        return np.flatnonzero(under)

    def _depths(
        self, near: Indices, taxels: Indices, middle: Doubles, axes: Doubles
    ) -> tuple[Doubles, Integers, Doubles]:
        """Penetrations in m, the geoms that penetrate (-1: none), and the tops of some taxels."""
        import mujoco

        normal = axes[:, 2]
        n = len(taxels)
        self._seen.geom_group[:] = _UNSEEN
        self._seen.geom_group[near] = _SEEN

        hit = np.full(n, -1, np.int32)
        distance = np.empty(n)
        lengths = self._lengths[taxels]
        mujoco.mj_multiRay(
            self._seen,
            self._data,
            middle - APEX_M * normal,
            (self._rays[taxels] @ axes.T).ravel(),
            self._group,
            True,
            -1,
            hit,
            distance,
            None,
            n,
            APEX_M + 1.0,
        )

        # Along the normal, in proportion to the ray.
        depths = (lengths - distance) * (APEX_M / lengths)
        depths[hit < 0] = 0.0
        tops = middle + self._places[taxels] @ axes.T

        # Where the first surface is deeper than is read, a shorter ray looks again.
        for k in np.flatnonzero(depths > self._pad.depth_m):
            depths[k], hit[k] = self._deep(tops[k], normal)
        return depths, hit, tops

    def _deep(self, top: Doubles, normal: Doubles) -> tuple[float, int]:
        """Penetration and geom where the first surface is deeper than is read; or none."""
        import mujoco

        depth = self._pad.depth_m
        hit = np.full(1, -1, np.int32)
        outward = np.zeros(3)
        start = top - depth * normal
        distance = mujoco.mj_ray(
            self._seen, self._data, start, normal, self._group, True, -1, hit, outward
        )
        if hit[0] < 0:
            return 0.0, -1
        # The ray leaves the body that it started in.
        if outward @ normal > 0:
            return depth, int(hit[0])
        return max(depth - distance, 0.0), int(hit[0])

    def _speeds(self, body: int, points: Doubles, normal: Doubles) -> Doubles:
        """Velocity of the material points of a body along the normal, in m/s, shape (n,)."""
        # Rotation first, then the velocity at the centre of mass of the whole tree.
        rates = self._data.cvel[body]
        centre = self._data.subtree_com[self._model.body_rootid[body]]
        across = _cross(normal, rates[:3])
        speeds: Doubles = (points - centre) @ across + rates[3:] @ normal
        return speeds


def _places_on(pad: Pad) -> Doubles:
    """Places of the taxels from the middle of their plane, metres, float64 (n, 3)."""
    # x runs along the columns, y along the rows, as in a skin of a graph.
    n_rows, n_cols = pad.shape
    col, row = np.meshgrid(np.arange(n_cols), np.arange(n_rows))
    x = (col.ravel() - (n_cols - 1) / 2) * pad.pitch_m
    y = (row.ravel() - (n_rows - 1) / 2) * pad.pitch_m
    return np.stack([x, y, np.zeros(x.size)], axis=1)


def _cross(a: Doubles, b: Doubles) -> Doubles:
    """Cross product of two vectors of three; numpy's takes 20 times as long for so few."""
    x, y, z = a.tolist()
    u, v, w = b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])
