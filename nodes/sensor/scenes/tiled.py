"""Scenes of a body: many equal patches of skin, of which a part is pressed in turn.

docs/howto/patches.md has their table. A press is simulated once for each shape of patches, by the
contact model of `contact`: a limb (a round bead) or a sole (heel and ball) falls from 2 mm on the
skin, settles for 1.2 s, and is lifted at 0.1 m/s. Every press replays that simulation: the settled
frame is repeated for as long as the body rests, and patches differ by mirroring and by the time of
their press. Body sizes are those of the patch; their weights are such that the settled forces are
near 0.3 N a taxel.
"""

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.source import Source

from .bodies import Body, build_sole, capsule, slab
from .contact import GRAVITY_M_S2
from .scenes import SKIN
from .simulation import Lift, Scene, SceneSource

SETTLE_S = 1.2
LIFT_S = 0.2
"""Time from the fall to rest, and from the begin of the lift to the last contact; chosen: the
oscillation decays to e^(-4.9 x 1.2) = 0.3 %."""
FRAME_S = 0.002
"""Time between the frames of a press that are kept."""
DROP_M = 0.002
SINK_M = 0.003
"""Depth to which a settled body sinks, about: 122.24 N/m x 3 mm = 0.37 N a taxel at most."""


@dataclass(frozen=True)
class Tiling:
    """Times of the presses of a scene."""

    body: Callable[[tuple[int, int], float], Body]
    #: Part of the patches that are pressed in a period; all others are idle.
    active: float
    period_s: float
    pressed_s: float
    moves: bool = False  # other patches are pressed in each period
    spread_s: float = 0.0  # time over which the presses of one period begin
    alternate: bool = False  # every second one is half a period later

    @property
    def settle_s(self) -> float:
        """Time from the fall to rest."""
        return min(SETTLE_S, self.pressed_s - LIFT_S)


class TiledScene(Source):
    """A scene of a body: true forces on equal patches as a function of time. As a source, its
    frames are as far apart as the sensor reads them.

    `skin` is that of every patch; `active`, in [0, 1], the part of the patches that are pressed in
    a period, in place of the scene's; `seed` that of the order of the patches: walk presses the
    first ones; `sigmas` as of `Source`. Raises SourceError if the skin has no pitch or is none of
    newtons.
    """

    delivers = "truth"
    simulates = True
    on_points = True

    def __init__(
        self,
        name: str,
        skin: Skin,
        n_patches: int,
        active: float | None = None,
        seed: int = 0,
        sigmas: tuple[float, float] | None = None,
    ) -> None:
        if skin.pitch_m is None or skin.unit != "N":
            raise SourceError(
                f"scene {name}: the skin's pitch and forces in N have to be known"
            )
        self.name = name
        self.skin = skin
        self.sigmas = sigmas
        self.n_patches = n_patches
        self._tiling = TILED[name]
        if active is None:
            active = self._tiling.active
        self._n_active = min(n_patches, math.ceil(active * n_patches))
        self._order = np.random.default_rng(seed).permutation(n_patches)
        if self._tiling.alternate:
            self._order = np.arange(n_patches)
        self._press = _press(name, skin.shape, skin.pitch_m, skin.f_max)

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        # `period_s` may change meanwhile: the sensor sets it.
        t_s = 0.0
        while True:
            yield round(1e9 * t_s), self.forces(t_s)
            t_s += self.period_s

    def forces(self, t_s: float) -> Floats:
        """Return true forces in N, float32, shape (n_patches, n_rows, n_cols), a fresh array."""
        out = np.zeros((self.n_patches, *self.skin.shape), np.float32)
        for patch, since_s in self._pressed(t_s):
            # Mirrored in the rows, in the columns, or in both.
            row_step = -1 if patch % 2 else 1
            col_step = -1 if patch // 2 % 2 else 1
            frame = self._press[self._index(since_s)]
            out[patch] = frame[::row_step, ::col_step]
        if self.skin.mask is not None:
            out[:, ~self.skin.mask] = 0.0
        return out

    def _pressed(self, t_s: float) -> list[tuple[int, float]]:
        """Patches pressed at a time, each with the time since its press began."""
        tiling = self._tiling
        n = self._n_active
        pressed = []
        newest = int(t_s // tiling.period_s)
        # A press may last into the next period.
        for period in {newest, newest - 1} - {-1}:
            begin = period * n if tiling.moves else 0
            for k in range(n):
                # Evenly over `spread_s`, the first one at its begin and the last one at its end.
                late_s = tiling.spread_s * k / max(1, n - 1)
                if tiling.alternate and k % 2:
                    late_s += tiling.period_s / 2
                since_s = t_s - period * tiling.period_s - late_s
                if 0 <= since_s < tiling.pressed_s:
                    patch = int(self._order[(begin + k) % self.n_patches])
                    pressed.append((patch, since_s))
        return pressed

    def _index(self, since_s: float) -> int:
        """Number of the frame of the press."""
        remaining_s = self._tiling.pressed_s - since_s
        in_press_s = min(since_s, self._tiling.settle_s)
        # The lift ends with the press, however long the body has rested.
        if remaining_s < LIFT_S:
            in_press_s = self._tiling.settle_s + LIFT_S - remaining_s
        return min(len(self._press) - 1, int(in_press_s / FRAME_S))


@functools.lru_cache(maxsize=8)
def _press(name: str, shape: tuple[int, int], pitch_m: float, f_max: float) -> Floats:
    """Frames of one press, every `FRAME_S`: float32, shape (n_frames, n_rows, n_cols)."""
    tiling = TILED[name]
    scene = Scene(
        name=name,
        shape=shape,
        n_steps=round(1e3 * (tiling.settle_s + LIFT_S)),
        dt_ns=1_000_000,
        body=tiling.body(shape, pitch_m),
        surface=replace(SKIN, pitch_m=pitch_m),
        drop_height_m=DROP_M,
        motion=Lift(at_s=tiling.settle_s),
        f_max_n=f_max,
    )
    stride = round(1e3 * FRAME_S)  # the simulation has steps of 1 ms
    frames = islice(SceneSource(scene, 0), 0, None, stride)
    return np.stack([forces for _, forces in frames])


def _limb(shape: tuple[int, int], pitch_m: float) -> Body:
    """A round bead over half the longer side of a patch."""
    height = shape[0] * pitch_m
    width = shape[1] * pitch_m
    radius = 0.5 * max(min(height, width), 2 * pitch_m)
    end_x = 0.0
    end_y = 0.0
    if width >= height:
        end_x = 0.25 * width
    else:
        end_y = 0.25 * height

    # Half the width of the contact at that depth, of a circle that is large against it.
    half = math.sqrt(2 * radius * SINK_M)
    length = 2 * math.hypot(end_x, end_y) + 2 * half
    area = length * 2 * half
    bead = capsule((-end_x, -end_y), (end_x, end_y), radius)
    bounds = (-end_x - radius, end_x + radius, -end_y - radius, end_y + radius)

    # Under a round bead taxels sink less to its sides.
    mass = _mass(min(area, height * width), pitch_m, 0.6)
    sole = build_sole([bead], bounds, pitch_m / 2)
    return Body(sole, mass, mass * radius**2)


def _foot(shape: tuple[int, int], pitch_m: float) -> Body:
    """A sole: heel and ball, flat, along the longer side of a patch."""
    height = shape[0] * pitch_m
    width = shape[1] * pitch_m
    long = max(height, width)
    wide = min(height, width)
    # Begin and end of each along the foot, and half its width.
    heel = (-0.4 * long, -0.12 * long, 0.16 * wide)
    ball = (0.03 * long, 0.4 * long, 0.24 * wide)
    is_along_x = width >= height
    slabs = []
    area = 0.0
    for start, stop, half in (heel, ball):
        if is_along_x:
            slabs.append(slab(start, stop, -half, half, 0.0))
        else:
            slabs.append(slab(-half, half, start, stop, 0.0))
        area += (stop - start) * 2 * half

    reach_x = 0.24 * wide
    reach_y = 0.4 * long
    if is_along_x:
        reach_x = 0.4 * long
        reach_y = 0.24 * wide
    sole = build_sole(slabs, (-reach_x, reach_x, -reach_y, reach_y), pitch_m / 2)

    mass = _mass(area, pitch_m, 1.0)
    return Body(sole, mass, mass * long**2 / 12)


def _mass(area_m2: float, pitch_m: float, part: float) -> float:
    """Mass in kg under which the taxels of an area sink by `SINK_M`, `part` of it on average."""
    n = max(1.0, area_m2 / pitch_m**2)
    return n * part * SKIN.stiffness * SINK_M / GRAVITY_M_S2


TILED: dict[str, Tiling] = {
    "lying": Tiling(_limb, 1 / 2, 10.0, 9.0, moves=True, spread_s=0.8),
    "hug": Tiling(_limb, 2 / 5, 4.0, 2.5, spread_s=0.8),
    "walk": Tiling(_foot, 1 / 4, 1.1, 0.6, alternate=True),
}
