"""The six simulated scenes of the paper, by name.

The skin is one and the same in all of them: a pitch of 5 mm, taxels that are spheres of 2.5 mm
radius and whose tops stand 10 mm above the ground, and

- k = 122.24 N/m a taxel, the default of SkinSim's plugin. With it the box stays in contact for
  8 ms, nearly as long as the moving average at 1 ms steps is wide: on a stiffer skin that average
  would leave little of an impact's peak.
- c = 0.4 N s/m a taxel. The box then bounces twice, 0.18 and 0.05 s long, and lies still before
  its 0.7 s are over. SkinSim's default, 1.83 N s/m, would answer the box's 3.1 m/s with
  5.7 N a taxel, beyond the range.
- the drop: 0.5 m (3.1 m/s) where nothing else is said. The box's peak is then 1.2 N a taxel, at
  mid-range, where the noise is largest: what the lower end of the paper's noisy PSNR asks for.
- the ground: hard (10 kN/m a cell) and deadened (100 N s/m), so that a wrench that sticks out
  over the edge of the skin does not drum on it. It lies 10 mm down, a sphere's height and
  as much for the spring: the box sinks by 5.5 mm at most. The springs have no stop; the wheel of
  the wrench alone goes deeper, to 12 mm, for some milliseconds of its impact.

Source: paper, section II-B and table I for bodies, motions, numbers and lengths of steps.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import replace

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.bodies import metal_peg, monkey_wrench, wooden_cube
from sparseskin.nodes.sensor.motion import Drag, Lift, RandomPath
from sparseskin.nodes.sensor.simulation import Scene, SceneSource
from sparseskin.nodes.sensor.source import Source
from sparseskin.nodes.sensor.terrain import Surface

TAXEL_RADIUS_M = 0.0025
SKIN = Surface(pitch_m=2 * TAXEL_RADIUS_M, stiffness=122.24, damping=0.4)
SKIN_ON_GROUND = replace(SKIN, ground_drop_m=0.010, ground_stiffness=1.0e4, ground_damping=100.0)
DROP_HEIGHT_M = 0.5
MS = 1_000_000  # nanoseconds
DRAG_M_S = 0.05


def lift_box_40() -> Scene:
    """LIFT BOX on 40 x 40 taxels.

    - in the middle and face parallel: 20 x 20 taxels, 12.7 mN each at rest
    - z alone is free: a cube that lands flat has nothing to tilt it
    - lifted at 0.685 s, 0.12 s after it touched down for the last time; contact ends 1 ms later,
      the smoothed forces 10 ms after that, and the scene soon after
    """
    return Scene(
        name="lift_box_40",
        shape=(40, 40),
        n_steps=700,
        dt_ns=MS,
        body=wooden_cube(TAXEL_RADIUS_M),
        surface=SKIN,
        drop_height_m=DROP_HEIGHT_M,
        motion=Lift(at_s=0.685),
    )


def lift_box_64() -> Scene:
    """LIFT BOX on 64 x 64 taxels: as on 40 x 40, lifted at 0.755 s of 0.76 s."""
    return Scene(
        name="lift_box_64",
        shape=(64, 64),
        n_steps=7600,
        dt_ns=MS // 10,
        body=wooden_cube(TAXEL_RADIUS_M),
        surface=SKIN,
        drop_height_m=DROP_HEIGHT_M,
        motion=Lift(at_s=0.755),
    )


def lift_wrench_40() -> Scene:
    """LIFT WRENCH on 40 x 40 taxels.

    - along the skin's diagonal, centre of mass in the middle: the most of its 391 mm that 200 mm
      square can hold, so that it lies on the skin and not on the ground around it
    - z and pitch are free: its rests, the wheel and the handle's end, lie on either side of the
      centre of mass, and it rocks over them. Roll changes the forces by less than the noise
      (51 dB against 47 dB) and is left out
    - with 1 kg m2 on a skin this soft it rocks about once a second, and the skin damps that only
      slowly: it no longer bounces, but has not come to a full rest, when it is lifted
    - lifted at 2.95 s; it lies deeper than the box and leaves within the 50 ms that are left
    """
    return Scene(
        name="lift_wrench_40",
        shape=(40, 40),
        n_steps=3000,
        dt_ns=MS,
        body=monkey_wrench(TAXEL_RADIUS_M),
        surface=SKIN_ON_GROUND,
        drop_height_m=DROP_HEIGHT_M,
        motion=Lift(at_s=2.95),
        dof=("z", "pitch"),
        yaw_rad=math.pi / 4,
    )


def drag_wrench_40() -> Scene:
    """DRAG WRENCH on 40 x 40 taxels.

    - dropped as in LIFT WRENCH, and dragged across its length, jaws ahead, over a corner: the
      way off the skin that 5 s at 0.05 m/s are enough for
    - the drag begins at 1.94 s, when the worst of the bouncing is over, and ends off the skin
    - as it leaves, jaws and handle's end drop to the ground, 10 mm lower, which takes its share
    """
    across = DRAG_M_S * math.sqrt(0.5)
    return Scene(
        name="drag_wrench_40",
        shape=(40, 40),
        n_steps=5000,
        dt_ns=MS,
        body=monkey_wrench(TAXEL_RADIUS_M),
        surface=SKIN_ON_GROUND,
        drop_height_m=DROP_HEIGHT_M,
        motion=Drag(at_s=1.94, velocity_m_s=(-across, across)),
        dof=("z", "pitch"),
        yaw_rad=math.pi / 4,
    )


def drag_wrench_64() -> Scene:
    """DRAG WRENCH on 64 x 64 taxels.

    - 1.26 s at 0.05 m/s are 5 cm: it is dropped along an edge of the skin, centre of mass 3 cm
      inside, jaws outwards, and dragged over that edge
    - from 0.2 m (2 m/s), for the fall to leave time for the drag; the jaws are already out
    - the drag begins at 0.25 s, while it still bounces
    """
    return Scene(
        name="drag_wrench_64",
        shape=(64, 64),
        n_steps=12600,
        dt_ns=MS // 10,
        body=monkey_wrench(TAXEL_RADIUS_M),
        surface=SKIN_ON_GROUND,
        drop_height_m=0.2,
        motion=Drag(at_s=0.25, velocity_m_s=(-DRAG_M_S, 0.0)),
        dof=("z", "pitch"),
        place_m=(-0.128, 0.0),
        yaw_rad=math.pi / 2,
    )


def path_40() -> Scene:
    """PATH on 40 x 40 taxels.

    - an aluminium peg of 20 mm diameter: about 14 taxels, 40 mN each, a light touch
    - z alone is free, as it is kept vertical
    - dropped at a random place, and from 1 s on moved between random places at the 0.05 m/s of
      DRAG WRENCH, always with its whole sole on the skin
    """
    return Scene(
        name="path_40",
        shape=(40, 40),
        n_steps=12200,
        dt_ns=MS,
        body=metal_peg(TAXEL_RADIUS_M),
        surface=SKIN,
        drop_height_m=DROP_HEIGHT_M,
        motion=RandomPath(at_s=1.0, speed_m_s=DRAG_M_S),
    )


SCENES: dict[str, Callable[[], Scene]] = {
    "lift_box_40": lift_box_40,
    "lift_wrench_40": lift_wrench_40,
    "drag_wrench_40": drag_wrench_40,
    "path_40": path_40,
    "lift_box_64": lift_box_64,
    "drag_wrench_64": drag_wrench_64,
}


def open_scene(name: str, seed: int) -> Source:
    """Open a scene as a source of true forces.

    Parameters
    ----------
    name : str
        One of `SCENES`.
    seed : int
        Seed of the scene's random choices, 0 or more: place and path of the peg in path_40. In
        the other scenes nothing is random.

    Returns
    -------
    Source
        Delivers "truth": frames of float32 forces in [0, 2.5] N, one a time step.

    Raises
    ------
    SourceError
        There is no scene of that name, or the seed is negative.
    """
    if name not in SCENES:
        close = difflib.get_close_matches(name, SCENES, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(SCENES)}"
        raise SourceError(f"no scene is called {name!r}; {hint}")
    if seed < 0:
        raise SourceError(f"scene {name}: seed is {seed!r}; allowed is an integer of 0 or more")
    return SceneSource(SCENES[name](), seed)
