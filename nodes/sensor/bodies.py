"""The bodies laid on the skin: their undersides, masses and moments of inertia."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

from sparseskin.nodes.sensor.sole import Sole, bar, build_sole, capsule, disc, roller, slab


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body.

    Attributes
    ----------
    sole : Sole
        Its underside, as taxels of the given radius feel it.
    mass_kg : float
        Mass in kg.
    inertia_kg_m2 : float
        Moment of inertia about each horizontal axis through the centre of mass, in kg m2.
    """

    sole: Sole
    mass_kg: float
    inertia_kg_m2: float


@cache
def wooden_cube(taxel_radius_m: float) -> Body:
    """Gazebo's wooden cube: 10 cm, 0.5167 kg, face down."""
    side, mass = 0.1, 0.5167
    half = side / 2
    sole = build_sole(
        [slab(-half, half, -half, half, 0.0)], (-half, half, -half, half), taxel_radius_m
    )
    return Body(sole, mass, mass * side**2 / 6)


@cache
def metal_peg(taxel_radius_m: float) -> Body:
    """An aluminium peg of 20 mm diameter and 60 mm length, standing upright: 51 g."""
    radius, length, density = 0.01, 0.06, 2700.0
    mass = density * math.pi * radius**2 * length
    sole = build_sole([disc(radius, 0.0)], (-radius, radius, -radius, radius), taxel_radius_m)
    return Body(sole, mass, mass * (3 * radius**2 + length**2) / 12)


@cache
def monkey_wrench(taxel_radius_m: float) -> Body:
    """Gazebo's monkey wrench: 390.7 x 83.4 mm, 1 kg, 1 kg m2.

    Its model states no inertia, so that the defaults of SDF hold (1 kg, 1 kg m2 about each axis,
    centre of mass at the origin), and it tips very slowly. On a rigid plane it stands on the rim
    of the adjusting wheel and on the handle's end; the jaws are 2.6 mm and the flats of handle
    and shank 5 mm above that plane.
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
