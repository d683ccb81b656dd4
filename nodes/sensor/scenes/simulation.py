"""The simulation of a scene: a body is dropped on the skin and then moved by a prescribed motion.

In each time step the body moves by `RigidBody.step` along its free coordinates and by its course
along the skin; the forces of the taxels are the average of the last 10 steps, clipped to f_max.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ, Source

from .bodies import Body
from .contact import GRAVITY_M_S2, Bed, RigidBody
from .terrain import Place, Surface, Terrain

SMOOTHING_STEPS = 10
"""Width of the moving average over the forces, in time steps. Source: paper, section II-B."""


@dataclass(frozen=True)
class Lift:
    """Lifted straight up at constant speed, in m/s, from `at_s` seconds on, tilts held constant.

    Source: paper, section II-B: 0.1 m/s.
    """

    at_s: float
    speed_m_s: float = 0.1

    def place(self, t_s: float) -> Place:
        """Return (0, 0): it is not moved along the skin."""
        return (0.0, 0.0)


@dataclass(frozen=True)
class Drag:
    """Dragged parallel to the skin at constant velocity (x, y), in m/s, from `at_s` seconds on.

    Source: paper, section II-B: 0.05 m/s.
    """

    at_s: float
    velocity_m_s: Place

    def place(self, t_s: float) -> Place:
        """Return the offset (x, y) in m from the place of the drop."""
        moved_s = max(0.0, t_s - self.at_s)
        return (self.velocity_m_s[0] * moved_s, self.velocity_m_s[1] * moved_s)


@dataclass(frozen=True)
class RandomPath:
    """Moved at constant speed, in m/s, between random places, from `at_s` seconds on."""

    at_s: float
    speed_m_s: float = 0.05

    def draw(
        self,
        rng: np.random.Generator,
        half_width_m: float,
        half_height_m: float,
        end_s: float,
    ) -> "tuple[Place, PolygonalCourse]":
        """Draw the place of the drop, in m from the middle of the skin, and a course from there
        until `end_s`. Places are uniform in a rectangle about that middle.
        """
        half = np.array([half_width_m, half_height_m])
        start = rng.uniform(-half, half)
        corner = start
        time_s = self.at_s
        times = [time_s]
        offsets = [(0.0, 0.0)]
        # One corner beyond the end, so that the body still moves at it.
        while time_s <= end_s:
            next_corner = rng.uniform(-half, half)
            length = float(np.hypot(*(next_corner - corner)))
            time_s += length / self.speed_m_s
            corner = next_corner
            times.append(time_s)
            x, y = corner - start
            offsets.append((float(x), float(y)))

        start_x, start_y = start
        course = PolygonalCourse(tuple(times), tuple(offsets))
        return (float(start_x), float(start_y)), course


@dataclass(frozen=True)
class PolygonalCourse:
    """Straight lines between corners, reached at given times; the body rests before and after."""

    times_s: tuple[float, ...]
    offsets_m: tuple[Place, ...]  # from the place of the drop

    def place(self, t_s: float) -> Place:
        """Return the offset (x, y) in m from the place of the drop."""
        x, y = (
            np.interp(t_s, self.times_s, along)
            for along in zip(*self.offsets_m, strict=True)
        )
        return (float(x), float(y))


Course = Lift | Drag | PolygonalCourse
"""The place of a body over the skin at each time."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """Parameters of a simulated scene; the defaults are those of most scenes of the paper."""

    name: str
    shape: tuple[int, int] = (40, 40)  # rows and columns of taxels
    n_steps: int  # number of frames
    dt_ns: int = 1_000_000  # from one frame to the next
    body: Body
    surface: Surface
    #: Above the skin, from which the body falls at the first frame.
    drop_height_m: float = 0.5
    motion: Lift | Drag | RandomPath
    #: Free coordinates, as of `Terrain`.
    dof: tuple[Literal["z", "pitch", "roll"], ...] = ("z",)
    #: Of the drop, from the middle; `RandomPath` draws its own.
    place_m: Place = (0.0, 0.0)
    yaw_rad: float = 0.0  # rotation of the body about the vertical
    f_max_n: float = PAPER_F_MAX_N


@dataclass(frozen=True, eq=False)
class State:
    """State of the simulation at one time step."""

    bed: Bed  # the cells under the body, and indices of the taxels, as of `Terrain.under`
    taxels: Indices
    q: Doubles  # coordinates of the body, (n_dof,), in m and rad
    v: Doubles  # and their rates

    def write_forces(self, out: Floats) -> None:
        """Write the taxels' forces, in N, to out, float32 of shape (n_rows, n_cols)."""
        # Cells of the ground come behind those of the skin.
        forces = self.bed.forces(self.q, self.v)[: self.taxels.size]
        out.fill(0.0)
        out.reshape(-1)[self.taxels] = forces


class SceneSource(Source):
    """A simulated scene as a source of true forces. Every iteration runs it from its beginning;
    the same seed, that of a random path, gives the same frames.
    """

    delivers = "truth"
    simulates = True

    def __init__(self, scene: Scene, seed: int) -> None:
        self.scene = scene
        self.seed = seed
        self.name = scene.name
        self.skin = Skin(
            *scene.shape, f_max=scene.f_max_n, pitch_m=scene.surface.pitch_m
        )
        self.rate_hz: float | None = 1e9 / scene.dt_ns
        self.n_frames: int | None = scene.n_steps

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """As of `Source`, computed on demand: true forces in N, smoothed over 10 steps."""
        return self._frames_of(first=0, every=1)

    def read_part(self, first: int, every: int) -> None:
        super().read_part(first, every)
        self._frames = self._frames_of(first, every)

    def _frames_of(self, first: int, every: int) -> Iterator[tuple[int, Floats]]:
        """Frames first, first + every, ...: of the steps between, only those are computed in whose
        average they are.
        """
        scene = self.scene
        average = MovingAverage(SMOOTHING_STEPS, scene.shape)
        for step, state in enumerate(self.states()):
            n_until_next = first - step
            if step >= first:
                n_until_next %= every

            # A slot of the average that is not written holds forces that no mean reads.
            if n_until_next < SMOOTHING_STEPS:
                state.write_forces(average.newest)
            if n_until_next > 0:
                average.skip()
                continue
            forces = average.step()
            np.minimum(forces, np.float32(scene.f_max_n), out=forces)
            yield step * scene.dt_ns, forces

    @property
    def pace_hz(self) -> float:
        return DEFAULT_RATE_HZ  # a skin is not read at every time step

    def states(self) -> Iterator[State]:
        """Yield the state at each time step, the first one at rest in the air."""
        scene = self.scene
        n_dof = len(self.scene.dof)
        place, course = self._course()
        terrain = Terrain(
            scene.surface, scene.shape, scene.body.sole, scene.yaw_rad, scene.dof
        )

        # Coordinate 0 is z; the others are tilts, of which gravity has no moment.
        mass_kg = scene.body.mass_kg
        inertia = np.full(n_dof, scene.body.inertia_kg_m2)
        inertia[0] = mass_kg
        load = np.zeros(n_dof)
        load[0] = -mass_kg * GRAVITY_M_S2
        body = RigidBody(inertia, load)

        # At rest in the air.
        q = np.zeros(n_dof)
        q[0] = scene.drop_height_m
        v = np.zeros(n_dof)

        dt_s = scene.dt_ns * 1e-9
        motion = scene.motion
        drop_x, drop_y = place
        offset = course.place(0.0)
        bed, taxels = terrain.under((drop_x + offset[0], drop_y + offset[1]))
        for step in range(scene.n_steps):
            yield State(bed, taxels, q, v)
            t_s = step * dt_s

            # A body that is lifted moves as prescribed, whatever the skin does.
            if isinstance(motion, Lift) and t_s >= motion.at_s:
                v = np.zeros(n_dof)
                v[0] = motion.speed_m_s
                q = q + dt_s * v
            else:
                q, v = body.step(bed, q, v, dt_s)

            # The cells under the body are found anew only where it has moved along the skin.
            next_offset = course.place(t_s + dt_s)
            if next_offset != offset:
                offset = next_offset
                bed, taxels = terrain.under((drop_x + offset[0], drop_y + offset[1]))

    def _course(self) -> tuple[Place, Course]:
        """Return the place of the drop and the course from there."""
        scene = self.scene
        if not isinstance(scene.motion, RandomPath):
            return scene.place_m, scene.motion
        n_rows, n_cols = scene.shape
        # The whole sole stays on the skin at any yaw.
        reach = max(abs(bound) for bound in scene.body.sole.bounds)
        pitch = scene.surface.pitch_m
        return scene.motion.draw(
            np.random.default_rng(self.seed),
            n_cols * pitch / 2 - reach,
            n_rows * pitch / 2 - reach,
            scene.n_steps * scene.dt_ns * 1e-9,
        )


class MovingAverage:
    """Mean of the newest `width` frames; frames before the first count as 0.

    Source: paper, section II-B: "a moving average filter with a width of 10 time-steps".
    """

    def __init__(self, width: int, shape: tuple[int, int]) -> None:
        self._ring = np.zeros((width, *shape), dtype=np.float32)
        self._oldest = 0

    @property
    def newest(self) -> Floats:
        """Array for the next frame, float32 of `shape`, to be written before `step`."""
        slot: Floats = self._ring[self._oldest]
        return slot

    def skip(self) -> None:
        """Go on to the next frame without the mean."""
        self._oldest = (self._oldest + 1) % len(self._ring)

    def step(self) -> Floats:
        """The mean with the frame written to `newest`, a fresh float32 array. It is summed anew
        each time: a taxel that was not touched during `width` frames is exactly 0.
        """
        width = len(self._ring)
        self.skip()
        mean: Floats = self._ring.sum(axis=0)
        mean *= np.float32(1.0 / width)
        return mean
