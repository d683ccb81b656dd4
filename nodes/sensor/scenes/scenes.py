"""The six simulated scenes of the paper, by name: docs/explanation/scenes.md has their table.

Each body is dropped on the skin; then its motion along the skin, or its lift, is prescribed. All
scenes have the same skin, and

- k = 122.24 N/m a taxel, the default of SkinSim's plugin. With it the box stays in contact for
  8 ms, nearly the 10 ms of the moving average: on a stiffer skin that average would leave little
  of the peak of an impact.
- c = 0.4 N s/m a taxel, chosen: the box bounces twice and lies still before its 0.7 s are over.
  SkinSim's default, 1.83 N s/m, would answer the box's 3.1 m/s with 5.7 N a taxel, beyond the
  range.
- a ground that is hard and damped, so that a wrench that sticks out over the edge of the skin does
  not drum on it.

Source: paper, section II-B and table I for bodies, motions, numbers and lengths of steps.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import did_you_mean

from .bodies import metal_peg, monkey_wrench, wooden_cube
from .simulation import Drag, Lift, RandomPath, Scene, SceneSource
from .terrain import Surface

TAXEL_RADIUS_M = 0.0025
SKIN = Surface(pitch_m=2 * TAXEL_RADIUS_M, stiffness=122.24, damping=0.4)
SKIN_ON_GROUND = replace(
    SKIN, ground_drop_m=0.010, ground_stiffness=1.0e4, ground_damping=100.0
)
DRAG_M_S = 0.05
"""Speed of the wrench when dragged, in m/s. Source: paper, section II-B."""


def lift_box_40() -> Scene:
    """LIFT BOX on 40 x 40 taxels.

    In the middle and face parallel, on 20 x 20 taxels: it lands flat, and nothing tilts it. Lifted
    0.12 s after it touched down for the last time; contact ends 1 ms later.
    """
    return Scene(
        name="lift_box_40",
        n_steps=700,
        body=wooden_cube(TAXEL_RADIUS_M),
        surface=SKIN,
        motion=Lift(at_s=0.685),
    )


def lift_box_64() -> Scene:
    """LIFT BOX on 64 x 64 taxels: as on 40 x 40, lifted at 0.755 s of 0.76 s."""
    return replace(
        lift_box_40(),
        name="lift_box_64",
        shape=(64, 64),
        n_steps=7600,
        dt_ns=100_000,
        motion=Lift(at_s=0.755),
    )


def lift_wrench_40() -> Scene:
    """LIFT WRENCH on 40 x 40 taxels.

    Along the skin's diagonal, centre of mass in the middle: the most of its 391 mm that 200 mm
    square can hold. Its supports, the wheel and the handle's end, lie on either side of the centre
    of mass, and it rocks over them about once a second, which the skin damps only slowly. Roll
    changes the forces by less than the noise (51 dB against 47 dB) and is left out.
    """
    return Scene(
        name="lift_wrench_40",
        n_steps=3000,
        body=monkey_wrench(TAXEL_RADIUS_M),
        surface=SKIN_ON_GROUND,
        motion=Lift(at_s=2.95),
        dof=("z", "pitch"),
        yaw_rad=math.pi / 4,
    )


def drag_wrench_40() -> Scene:
    """DRAG WRENCH on 40 x 40 taxels.

    Dropped as in LIFT WRENCH, and dragged across its length, jaws ahead, over a corner, once the
    worst of the bouncing is over. As it leaves, jaws and handle's end drop to the ground.
    """
    # Across the diagonal, along which it lies: x and y change by as much.
    across = DRAG_M_S * math.sqrt(0.5)
    return replace(
        lift_wrench_40(),
        name="drag_wrench_40",
        n_steps=5000,
        motion=Drag(at_s=1.94, velocity_m_s=(-across, across)),
    )


def drag_wrench_64() -> Scene:
    """DRAG WRENCH on 64 x 64 taxels.

    1.26 s at 0.05 m/s are 5 cm: it is dropped along an edge of the skin, centre of mass 3 cm
    inside, jaws outwards, from 0.2 m, and dragged over that edge while it still bounces.
    """
    return replace(
        lift_wrench_40(),
        name="drag_wrench_64",
        shape=(64, 64),
        n_steps=12600,
        dt_ns=100_000,
        drop_height_m=0.2,
        motion=Drag(at_s=0.25, velocity_m_s=(-DRAG_M_S, 0.0)),
        place_m=(-0.128, 0.0),
        yaw_rad=math.pi / 2,
    )


def path_40() -> Scene:
    """PATH on 40 x 40 taxels.

    An aluminium peg of 20 mm diameter, kept vertical: 14 to 17 taxels, 36 to 29 mN each. Dropped at
    a random place, and moved between random places, always with its whole sole on the skin.
    """
    return replace(
        lift_box_40(),
        name="path_40",
        n_steps=12200,
        body=metal_peg(TAXEL_RADIUS_M),
        motion=RandomPath(at_s=1.0, speed_m_s=DRAG_M_S),
    )


_ALL = (
    lift_box_40,
    lift_wrench_40,
    drag_wrench_40,
    path_40,
    lift_box_64,
    drag_wrench_64,
)
SCENES: dict[str, Callable[[], Scene]] = {make.__name__: make for make in _ALL}


def check_scene(name: str, others: Iterable[str] = ()) -> None:
    """Raise SourceError if there is no scene of a name; `others` are known elsewhere."""
    if name not in SCENES:
        raise SourceError(
            f"no scene is called {name!r}{did_you_mean(name, (*SCENES, *others))}"
        )


def open_scene(name: str, seed: int) -> SceneSource:
    """Open a scene, one of `SCENES`, as a source of true forces: float32 in [0, 2.5] N, one a time
    step. `seed` is that of place and path in path_40; nothing is random in the other scenes.
    Raises SourceError as `check_scene`.
    """
    check_scene(name)
    # Made here, not at import: soles take a moment to compute.
    return SceneSource(SCENES[name](), seed)
