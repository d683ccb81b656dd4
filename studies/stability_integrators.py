"""Time integrators of a mass on a spring-damper, and where theory says they are stable.

Explicit Euler, semi-implicit Euler and implicit Euler are here for comparison alone; what the
scenes use is `RigidBody.step`. One coordinate, unit mass: x'' = g - w^2 x - c x' where x > 0, x
being the depth in the bed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.sensor.contact import GRAVITY_M_S2, Bed, RigidBody

Matrix = npt.NDArray[np.float64]
Grid = npt.NDArray[np.float64]
State = tuple[float, float]


@dataclass(frozen=True)
class Mass:
    """A unit mass over a bed.

    Attributes
    ----------
    omega : float
        Natural frequency on the bed, rad/s.
    damping : float
        c / m in 1/s.
    unilateral : bool
        True: the bed pushes only where x > 0 and never pulls. False: it is always attached.
    """

    omega: float
    damping: float
    unilateral: bool

    @property
    def static_depth(self) -> float:
        """Depth at rest, m."""
        return GRAVITY_M_S2 / self.omega**2

    def acceleration(self, x: float, v: float) -> float:
        """Downward acceleration in m/s2 at depth x (m) and downward speed v (m/s)."""
        push = self.omega**2 * x + self.damping * v
        if self.unilateral:
            push = max(push, 0.0) if x > 0.0 else 0.0
        return GRAVITY_M_S2 - push

    def energy(self, x: float, v: float) -> float:
        """Kinetic, potential and elastic energy in J/kg, 0 at rest in the bed."""
        pressed = max(x, 0.0) if self.unilateral else x
        rest = 0.5 * GRAVITY_M_S2 * self.static_depth
        return 0.5 * (v**2 + (self.omega * pressed) ** 2) - GRAVITY_M_S2 * x + rest


def explicit_euler(mass: Mass, x: float, v: float, dt_s: float) -> State:
    """Position and speed both from the rates at the start."""
    return x + dt_s * v, v + dt_s * mass.acceleration(x, v)


def semi_implicit_euler(mass: Mass, x: float, v: float, dt_s: float) -> State:
    """Speed from the forces at the start, position from the new speed."""
    v += dt_s * mass.acceleration(x, v)
    return x + dt_s * v, v


def implicit_euler(mass: Mass, x: float, v: float, dt_s: float) -> State:
    """Rates at the end of the step."""
    free = v + dt_s * GRAVITY_M_S2
    pressed = (free - dt_s * mass.omega**2 * x) / (
        1 + dt_s * mass.damping + (dt_s * mass.omega) ** 2
    )
    # As in `RigidBody`: what free motion does not bring into the bed within the step is not
    # touched by it, and what is touched is pushed or left alone.
    in_reach = max(x, x + dt_s * free) > 0.0
    pushes = mass.omega**2 * (x + dt_s * pressed) + mass.damping * pressed > 0.0
    v = pressed if not mass.unilateral or (in_reach and pushes) else free
    return x + dt_s * v, v


def sdirk2(mass: Mass, x: float, v: float, dt_s: float) -> State:
    """What the scenes use: `RigidBody.step` (depth is counted downwards here)."""
    bed = Bed(np.array([mass.omega**2]), np.array([mass.damping]), np.zeros(1), np.ones((1, 1)))
    body = RigidBody(np.ones(1), np.array([-GRAVITY_M_S2]))
    q, rate = body.step(bed, np.array([-x]), np.array([-v]), dt_s)
    return -float(q[0]), -float(rate[0])


def exact(mass: Mass, x: float, v: float, dt_s: float) -> State:
    """The flow of the attached bed itself, by the matrix exponential; no unilateral bed."""
    away, v_dt = propagator(mass.omega * dt_s, mass.damping * dt_s) @ np.array(
        [x - mass.static_depth, v * dt_s]
    )
    return mass.static_depth + float(away), float(v_dt) / dt_s


INTEGRATORS: dict[str, Callable[[Mass, float, float, float], State]] = {
    "explicit Euler": explicit_euler,
    "semi-implicit Euler": semi_implicit_euler,
    "implicit Euler": implicit_euler,
    "SDIRK2 (the scenes)": sdirk2,
    "exact": exact,
}


def propagator(omega_dt: float, c_dt_over_m: float) -> Matrix:
    """Exact motion over one step of (x - static depth, v dt), float64 of shape (2, 2)."""
    half = c_dt_over_m / 2
    rate2 = omega_dt**2 - half**2
    # cos and sin r / r, of a real or an imaginary r; scaled so that nothing overflows.
    if rate2 >= 0:
        rate = math.sqrt(rate2)
        cosine, sine = math.cos(rate), math.sin(rate) / rate if rate > 0 else 1.0
        decay = math.exp(-half)
        cosine, sine = decay * cosine, decay * sine
    else:
        rate = math.sqrt(-rate2)
        grows, falls = math.exp(rate - half), math.exp(-rate - half)
        cosine, sine = (grows + falls) / 2, (grows - falls) / (2 * rate)
    return np.array([[cosine + half * sine, sine], [-(omega_dt**2) * sine, cosine - half * sine]])


def amplification(method: str, omega_dt: float, c_dt_over_m: float) -> Matrix:
    """What one step does to (x - static depth, v dt) on an attached bed, shape (2, 2).

    Raises
    ------
    KeyError
        If no integrator is called that.
    """
    a, b = omega_dt**2, c_dt_over_m
    rates: Matrix = np.array([[0.0, 1.0], [-a, -b]])
    one: Matrix = np.eye(2)
    if method == "explicit Euler":
        return one + rates
    if method == "semi-implicit Euler":
        return np.array([[1.0 - a, 1.0 - b], [-a, 1.0 - b]])
    if method == "implicit Euler":
        return np.asarray(np.linalg.inv(one - rates))
    if method == "SDIRK2 (the scenes)":
        gamma = 1.0 - 1.0 / math.sqrt(2.0)
        stage = np.linalg.inv(one - gamma * rates)
        return np.asarray((one + (1.0 - 2.0 * gamma) * rates) @ stage @ stage)
    if method == "exact":
        return propagator(omega_dt, c_dt_over_m)
    raise KeyError(method)


def growth(method: str, omega_dt: float, c_dt_over_m: float) -> float:
    """Largest factor by which an amplitude grows in a step: the spectral radius."""
    eigenvalues = np.linalg.eigvals(amplification(method, omega_dt, c_dt_over_m))
    return float(np.abs(eigenvalues).max())


def stability_margin(method: str, omega_dt: Grid, c_dt_over_m: Grid) -> Grid | None:
    """A function that is positive where the method is stable: its zero is the boundary drawn.

    The conditions of Jury for both eigenvalues to lie within the unit circle: explicit Euler
    (w dt)^2 < c dt / m < 2 + (w dt)^2 / 2, semi-implicit Euler (w dt)^2 + 2 c dt / m < 4. None
    for a method that is stable everywhere.
    """
    a, b = omega_dt**2, c_dt_over_m
    if method == "explicit Euler":
        return np.minimum(b - a, 2.0 + a / 2.0 - b)
    if method == "semi-implicit Euler":
        return np.asarray(4.0 - a - 2.0 * b)
    return None
