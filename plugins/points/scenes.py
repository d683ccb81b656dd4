"""Scenes on a skin of points: a finger, a ball or a limb presses it and moves over it.

The contact model is that of all scenes (`scenes.contact`): each taxel a unilateral spring-damper
with k and c of `scenes.scenes.SKIN`, one rigid body, free along the normal of the skin where it
presses, pushed against it by a constant force, and guided along the skin. A taxel is a sphere of
half their distance, r, whose top is at its place p: its middle is m = p - r n with the normal n.
With c the middle, or the nearest point of the axis, of a body of radius R, its gap is

    g = |c - m| - R - r,        J = dg/dq = a . (c - m) / |c - m|,

where a is the outward normal along which the body is free, q its height. A taxel that faces away
from the body is not touched. The course is a shortest way over neighbours between places drawn at
random, smoothed. A frame is the mean of `STEPS` steps: 10 ms.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices
from sparseskin.nodes.sensor.scenes.contact import Bed, RigidBody
from sparseskin.nodes.sensor.scenes.scenes import SKIN
from sparseskin.nodes.sensor.source import Source

from .placing import Placement
from .surface import neighbours

DT_S = 0.002
STEPS = 5
"""Time step, and steps of a frame."""
N_FRAMES = 1000
SPEED_M_S = 0.1
DROP_M = 0.002
"""Height from which a body is pushed against the skin."""
REST_S = 0.3
"""Time before a body moves along the skin: the oscillation of its landing decays."""
HELD_S = 0.6
LIFTED_S = 0.2
"""Time for which a press lasts, and in which the body is lifted at `SPEED_M_S`."""
SMOOTHED = 1.5
"""Standard deviation of the smoothing of a course, in the distance of taxels."""
_NEAR = 6
"""Taxels whose mean place and normal are those of the skin between them."""
_REACH_M = 0.01
"""Gap beyond which a taxel is not touched within a step: at 5 m/s."""


@dataclass(frozen=True)
class Scene:
    """A body, a sphere where its length is 0; a limb moves across its length, at 0.1 m/s as all."""

    radius_m: float
    mass_kg: float
    push_n: float
    length_m: float = 0.0
    presses: bool = False

    def about(self) -> str:
        """Body, push and course in a line."""
        size = f"{1000 * self.radius_m:g} mm radius"
        if self.length_m:
            size += f", {1000 * self.length_m:g} mm long"
        course = "presses at place by place" if self.presses else "moves over the skin"
        return f"a body of {size}, {self.push_n:g} N, {course}"


SCENES: dict[str, Scene] = {
    "finger_path": Scene(0.010, 0.05, 1.0),
    "ball_presses": Scene(0.040, 0.3, 6.0, presses=True),
    "limb_path": Scene(0.035, 1.0, 15.0, length_m=0.16),
}


@dataclass(frozen=True, eq=False)
class _Course:
    """Places on the skin, their normals and the directions across, float64 (k, 3) each."""

    places: Doubles
    normals: Doubles
    across: Doubles


class PointScene(Source):
    """A scene of `SCENES` on a placement as a source of true forces, endlessly repeatable; `seed`:
    of the places on the course.
    """

    delivers = "truth"
    simulates = True
    on_points = True

    def __init__(self, name: str, placement: Placement, seed: int) -> None:
        self.name = name
        self.skin = placement.skin(PAPER_F_MAX_N, "N")
        self.rate_hz: float | None = 1 / (DT_S * STEPS)
        self.n_frames: int | None = N_FRAMES
        self._scene = SCENES[name]
        self._placement = placement
        self._seed = seed
        points = placement.points
        self._radius = 0.5 * placement.pitch_m
        self._middles = points.places - self._radius * points.normals
        self._tree = cKDTree(self._middles)

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield (stamp_ns, forces): true forces in N in [0, f_max], float32 (n_rows, n_cols)."""
        scene = self._scene
        points = self._placement.points
        courses = self._courses()
        body = RigidBody(np.array([scene.mass_kg]), np.array([-scene.push_n]))
        course = next(courses)
        start_s = 0.0
        q = np.array([DROP_M])
        v = np.zeros(1)
        for frame in range(N_FRAMES):
            total = np.zeros(points.n)
            candidates: Indices | None = None
            for step in range(STEPS):
                t_s = (frame * STEPS + step) * DT_S - start_s
                # The next press begins at another place.
                if scene.presses and t_s >= HELD_S + LIFTED_S:
                    course = next(courses)
                    start_s += t_s
                    q = np.array([DROP_M])
                    v = np.zeros(1)
                    t_s = 0.0
                    candidates = None

                k = 0
                if not scene.presses:
                    k = round(max(0.0, t_s - REST_S) / DT_S) % len(course.places)
                # Within a frame, a body moves by less than a millimetre.
                if candidates is None:
                    candidates = self._candidates(course, k)
                bed, touched = self._bed(course, k, q, candidates)
                total[touched] += bed.forces(q, v)
                # A press ends with a body that is lifted at a constant speed.
                if scene.presses and t_s >= HELD_S:
                    v = np.array([SPEED_M_S])
                    q = q + DT_S * v
                else:
                    q, v = body.step(bed, q, v, DT_S)

            stamp_ns = round(frame * STEPS * DT_S * 1e9)
            forces = np.minimum(total / STEPS, self.skin.f_max)
            yield stamp_ns, self._placement.on_grid(forces.astype(np.float32))

    def _candidates(self, course: _Course, k: int) -> Indices:
        """Taxels that a body at place k may touch."""
        scene = self._scene
        middle = course.places[k] + scene.radius_m * course.normals[k]
        reach = scene.radius_m + self._radius + 0.5 * scene.length_m
        # Within a frame the body comes nearer by less than the second one.
        reach += 2 * _REACH_M
        taxels = self._tree.query_ball_point(middle, reach)
        return np.array(taxels, dtype=np.intp)

    def _bed(
        self, course: _Course, k: int, q: Doubles, candidates: Indices
    ) -> tuple[Bed, Indices]:
        """Those of the candidates that are near the body, and their numbers."""
        scene = self._scene
        normals = self._placement.points.normals[candidates]
        normal = course.normals[k]
        middle = course.places[k] + (scene.radius_m + q[0]) * normal
        off = middle - self._middles[candidates]

        # From the nearest point of the axis of a body that has a length.
        if scene.length_m:
            half = 0.5 * scene.length_m
            along = np.clip(-off @ course.across[k], -half, half)
            off = off + along[:, None] * course.across[k]
        distance = np.linalg.norm(off, axis=1)
        faces = np.einsum("ij,ij->i", off, normals) > 0
        touching = scene.radius_m + self._radius
        near = np.flatnonzero((distance < touching + _REACH_M) & faces)

        # Gap and its derivative by the height of the body, linear about this height.
        jacobian = (off[near] @ normal / distance[near])[:, None]
        gap = distance[near] - touching - jacobian[:, 0] * q[0]
        stiffness = np.full(near.size, SKIN.stiffness)
        damping = np.full(near.size, SKIN.damping)
        return Bed(stiffness, damping, gap, jacobian), candidates[near]

    def _courses(self) -> Iterator[_Course]:
        """A course for a path, as long as the scene; place after place for presses."""
        rng = np.random.default_rng(self._seed)
        points = self._placement.points
        edges = neighbours(points.places, points.normals)
        graph = edges.matrix(points.n)
        _, label = connected_components(graph, directed=False)
        largest = np.flatnonzero(label == np.argmax(np.bincount(label)))
        if self._scene.presses:
            while True:
                yield self._course(points.places[rng.choice(points.n)][None])

        # Shortest ways to places drawn at random, one after another.
        length = SPEED_M_S * N_FRAMES * STEPS * DT_S
        corners = [int(rng.choice(largest))]
        walked = 0.0
        while walked < length and largest.size > 1:
            distances, predecessors = dijkstra(
                graph,
                directed=False,
                indices=corners[-1],
                return_predecessors=True,
            )
            goal = int(rng.choice(largest))
            way_back = []
            point = goal
            while point != corners[-1]:
                way_back.append(point)
                point = int(predecessors[point])
            corners += way_back[::-1]
            walked += float(distances[goal])
        yield self._course(points.places[corners])

    def _course(self, corners: Doubles) -> _Course:
        """Places on the skin along a way, `SPEED_M_S` times `DT_S` apart, smoothed."""
        points = self._placement.points
        step_m = SPEED_M_S * DT_S
        places = _equidistant(corners, step_m)
        n = len(places)

        # The skin at a place is the mean of the taxels around it.
        _, nearest = cKDTree(points.places).query(places, k=min(_NEAR, points.n))
        nearest = nearest.reshape(n, -1)
        normals = points.normals[nearest].mean(axis=1)
        middles = points.places[nearest].mean(axis=1)

        # A body cannot follow the steps from taxel to taxel.
        width = SMOOTHED * self._placement.pitch_m / step_m
        places, normals, middles = (
            gaussian_filter1d(along_way, width, axis=0, mode="nearest")
            for along_way in (places, normals, middles)
        )
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= np.maximum(lengths, 1e-9)

        # Smoothing cuts corners: back to the mean plane of the taxels there.
        heights = np.einsum("ij,ij->i", middles - places, normals)
        places += normals * heights[:, None]

        # Of a single place any direction will do.
        ahead = np.array([[1.0, 0.3, 0.2]])
        if n > 1:
            ahead = np.gradient(places, axis=0)
        across = np.cross(normals, ahead)
        lengths = np.linalg.norm(across, axis=1, keepdims=True)
        across /= np.maximum(lengths, 1e-12)
        return _Course(places, normals, across)


def _equidistant(corners: Doubles, step_m: float) -> Doubles:
    """Places on the straight lines between corners, a step apart, float64 (k, 3)."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    stops = np.arange(0.0, along[-1] + step_m / 2, step_m)
    return np.stack([np.interp(stops, along, x) for x in corners.T], axis=1)
