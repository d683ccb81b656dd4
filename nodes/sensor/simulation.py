"""A scene played frame by frame: a body dropped on the skin and then manipulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sparseskin.nodes.sensor.bodies import Body
from sparseskin.nodes.sensor.contact import GRAVITY_M_S2, Array, Bed, Indices, RigidBody
from sparseskin.nodes.sensor.motion import Course, Drag, Lift, Place, RandomPath
from sparseskin.nodes.sensor.smoothing import MovingAverage
from sparseskin.nodes.sensor.source import Forces, Skin
from sparseskin.nodes.sensor.terrain import Surface, Terrain

SMOOTHING_STEPS = 10


@dataclass(frozen=True, eq=False)
class Scene:
    """All that a simulated scene is made of.

    Attributes
    ----------
    name : str
        Registered name, e.g. "lift_box_40".
    shape : (n_rows, n_cols)
        Grid of taxels.
    n_steps, dt_ns : int
        Number of frames and the time step between them in nanoseconds.
    body : Body
        What is dropped.
    surface : Surface
        Constants of the skin and of the ground beside it.
    drop_height_m : float
        Height above the skin at which the body is released at rest at the first frame, in m.
    motion : Lift, Drag or RandomPath
        What is done with it afterwards.
    dof : ("z",), ("z", "pitch") or ("z", "pitch", "roll")
        Free coordinates.
    place_m : (x, y)
        Where the centre of mass is dropped, from the middle of the skin, in m; RandomPath draws
        its own.
    yaw_rad : float
        Rotation of the body about the vertical.
    f_max_n : float
        Upper end of the taxels' range, in N.
    """

    name: str
    shape: tuple[int, int]
    n_steps: int
    dt_ns: int
    body: Body
    surface: Surface
    drop_height_m: float
    motion: Lift | Drag | RandomPath
    dof: tuple[Literal["z", "pitch", "roll"], ...] = ("z",)
    place_m: Place = (0.0, 0.0)
    yaw_rad: float = 0.0
    f_max_n: float = 2.5


@dataclass(frozen=True, eq=False)
class State:
    """What the simulation holds at one time step.

    Attributes
    ----------
    bed : Bed
        The cells under the body, taxels first.
    taxels : ndarray of intp, shape (n_taxels,)
        Where the bed's first n_taxels cells are in the flattened frame.
    q, v : ndarray of float64, shape (n_dof,)
        Coordinates (m, rad) and rates (m/s, rad/s) of the body.
    """

    bed: Bed
    taxels: Indices
    q: Array
    v: Array

    def write_forces(self, out: Forces) -> None:
        """Write the taxels' forces, in N, to out, float32 of shape (n_rows, n_cols)."""
        out.fill(0.0)
        out.reshape(-1)[self.taxels] = self.bed.forces(self.q, self.v)[: self.taxels.size]


class SceneSource:
    """A simulated scene as a source of true forces.

    Every iteration plays the scene from its beginning, and the same seed gives the same frames.

    Parameters
    ----------
    scene : Scene
        What to play.
    seed : int
        Seed of what the scene draws at random (the path of the peg; nothing in other scenes).
    """

    delivers: Literal["truth", "taxels"] = "truth"

    def __init__(self, scene: Scene, seed: int) -> None:
        self.scene = scene
        self.seed = seed
        self.name = scene.name
        self.skin = Skin(*scene.shape, f_max=scene.f_max_n, pitch_m=scene.surface.pitch_m)
        self.rate_hz: float | None = 1e9 / scene.dt_ns
        self.n_frames: int | None = scene.n_steps

    def __iter__(self) -> Iterator[tuple[int, Forces]]:
        """Yield (stamp_ns, forces), computed as they are asked for.

        Yields
        ------
        stamp_ns : int
            Time since the first frame.
        forces : ndarray of float32, shape (n_rows, n_cols)
            True forces in N in [0, f_max], smoothed over 10 steps; a fresh array each time.
        """
        scene = self.scene
        average = MovingAverage(SMOOTHING_STEPS, scene.shape)
        for step, state in enumerate(self.states()):
            state.write_forces(average.newest)
            forces = average.step()
            np.minimum(forces, np.float32(scene.f_max_n), out=forces)
            yield step * scene.dt_ns, forces

    def states(self) -> Iterator[State]:
        """Yield what the simulation holds at each time step, the first one at rest in the air."""
        scene = self.scene
        place, course = self._course()
        terrain = Terrain(scene.surface, scene.shape, scene.body.sole, scene.yaw_rad, scene.dof)
        n_dof = len(scene.dof)
        weight = scene.body.mass_kg * GRAVITY_M_S2
        inertia = np.full(n_dof, scene.body.inertia_kg_m2)
        inertia[0] = scene.body.mass_kg
        body = RigidBody(inertia, np.array([-weight] + [0.0] * (n_dof - 1)))
        q, v = np.zeros(n_dof), np.zeros(n_dof)
        q[0] = scene.drop_height_m

        dt_s = scene.dt_ns * 1e-9
        motion = scene.motion
        here = course.place(0.0)
        bed, taxels = terrain.under((place[0] + here[0], place[1] + here[1]))
        for step in range(scene.n_steps):
            yield State(bed, taxels, q, v)
            t_s = step * dt_s
            if isinstance(motion, Lift) and t_s >= motion.at_s:
                v = np.zeros(n_dof)
                v[0] = motion.speed_m_s
                q = q + dt_s * v
            else:
                q, v = body.step(bed, q, v, dt_s)
            there = course.place(t_s + dt_s)
            if there != here:
                here = there
                bed, taxels = terrain.under((place[0] + here[0], place[1] + here[1]))

    def _course(self) -> tuple[Place, Course]:
        scene = self.scene
        if not isinstance(scene.motion, RandomPath):
            return scene.place_m, scene.motion
        n_rows, n_cols = scene.shape
        # The whole sole stays on the skin, however the body is turned.
        reach = max(abs(bound) for bound in scene.body.sole.bounds)
        pitch = scene.surface.pitch_m
        return scene.motion.draw(
            np.random.default_rng(self.seed),
            n_cols * pitch / 2 - reach,
            n_rows * pitch / 2 - reach,
            scene.n_steps * scene.dt_ns * 1e-9,
        )
