"""Where integrators of the contact fail: growth, chatter and rebound over w dt and c dt / m."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sparseskin.nodes.sensor.contact import GRAVITY_M_S2
from sparseskin.nodes.sensor.scenes import SCENES
from sparseskin.nodes.sensor.simulation import Scene, SceneSource
from sparseskin.studies.stability_integrators import INTEGRATORS, Mass, growth

LOW, HIGH = 0.015, 30.0
N_SIDE, N_SIDE_QUICK = 25, 11
DT_S = 1e-3
#: Steps of a swing that are looked at for chatter, and then for growth.
N_CHATTER, N_GROWTH = 40, 60
LOG_GONE = math.log(0.01)
N_DROP = 400
#: Where an energy is called overflowed.
OVERFLOW = 1e6
#: Speed of the impact over that at which the static depth would stop it: g / w.
IMPACT = 10.0


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """One point for each integrator and each c dt / m, over all w dt; and one for each scene."""
    axis = np.geomspace(LOW, HIGH, N_SIDE_QUICK if quick else N_SIDE).tolist()
    maps = [
        {"method": method, "c_dt_over_m": b, "omega_dts": axis}
        for method in INTEGRATORS
        for b in axis
    ]
    return [*maps, *({"scene": name} for name in SCENES)]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Figures of one point: of a row of the maps, or where a scene lies in them."""
    if "scene" in point:
        return place_of_scene(SCENES[point["scene"]]())
    method, b = point["method"], point["c_dt_over_m"]
    masses = [Mass(a / DT_S, b / DT_S, unilateral=False) for a in point["omega_dts"]]
    attached = [swing(method, mass) for mass in masses]
    figures = {
        "growth": [factor for factor, _ in attached],
        "reversals": [share for _, share in attached],
        "theory": [growth(method, a, b) for a in point["omega_dts"]],
    }
    if method != "exact":
        figures["rebound"] = [
            rebound(method, Mass(mass.omega, mass.damping, unilateral=True)) for mass in masses
        ]
    return figures


def swing(method: str, mass: Mass) -> tuple[float, float]:
    """Let a mass swing on an attached bed, its amplitude set back to the same after each step.

    Returns
    -------
    growth : float
        Factor by which the amplitude grows in a step, in the geometric mean.
    reversals : float
        Share of the first steps at which the speed changes its sign while more than a hundredth
        of the swing is left, 0..1.
    """
    step = INTEGRATORS[method]
    # Amplitudes in the norm of the energy, of which a damped swing never gains.
    size = 1e-3 * mass.static_depth * mass.omega
    x, v = 0.0, size
    log_growth, log_size, n_reversed = 0.0, 0.0, 0
    for k in range(N_CHATTER + N_GROWTH):
        x_next, v_next = step(mass, mass.static_depth + x, v, DT_S)
        x_next -= mass.static_depth
        length = math.hypot(mass.omega * x_next, v_next)
        if length == 0.0:
            return 0.0, n_reversed / N_CHATTER
        # What has died away does not chatter.
        if k < N_CHATTER and log_size > LOG_GONE:
            n_reversed += v_next * v < 0.0
        log_size += math.log(length / size)
        if k >= N_CHATTER:
            log_growth += math.log(length / size)
        x, v = x_next * size / length, v_next * size / length
    return math.exp(log_growth / N_GROWTH), n_reversed / N_CHATTER


def rebound(method: str, mass: Mass) -> float:
    """Drop a mass on an unilateral bed; the largest energy after first touch over that before.

    Not more than 1 where the integrator makes no energy; at most `OVERFLOW`.
    """
    step = INTEGRATORS[method]
    x, v = 0.0, IMPACT * GRAVITY_M_S2 / mass.omega
    # A little before the bed, by a third of a step, so that contact starts within a step.
    x -= v * DT_S / 3.0
    before = mass.energy(x, v)
    largest = 0.0
    for k in range(N_DROP):
        x, v = step(mass, x, v, DT_S)
        energy = mass.energy(x, v)
        if not energy < OVERFLOW * before:
            return OVERFLOW
        if k > 0:
            largest = max(largest, energy)
    return largest / before


def place_of_scene(scene: Scene) -> dict[str, Any]:
    """Largest w dt and c dt / m that a scene reaches, ground and tilt included."""
    inertia = np.full(len(scene.dof), scene.body.inertia_kg_m2)
    inertia[0] = scene.body.mass_kg
    dt_s = scene.dt_ns * 1e-9
    omega2 = rate = 0.0
    for state in SceneSource(scene, seed=0).states():
        loaded = state.bed.forces(state.q, state.v) > 0.0
        if not loaded.any():
            continue
        jacobian = state.bed.jacobian[loaded] / np.sqrt(inertia)
        stiffness, damping = state.bed.stiffness[loaded], state.bed.damping[loaded]
        omega2 = max(omega2, float(np.linalg.norm(jacobian.T * stiffness @ jacobian, 2)))
        rate = max(rate, float(np.linalg.norm(jacobian.T * damping @ jacobian, 2)))
    return {"omega_dt": math.sqrt(omega2) * dt_s, "c_dt_over_m": rate * dt_s}
