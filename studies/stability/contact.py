"""Failures of contact integrators: growth and rebound over w dt and c dt / m.

One coordinate, unit mass: x'' = g - w^2 x - c x' where x > 0, x being the depth in the bed. The
scenes use `RigidBody.step`; explicit, semi-implicit and implicit Euler are for comparison alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm

from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.scenes.contact import GRAVITY_M_S2, Bed, RigidBody
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.nodes.sensor.scenes.simulation import Scene, SceneSource
from sparseskin.studies.points import compute
from sparseskin.studies.report import MARKERS, Chart, Page

State = tuple[float, float]
Places = Mapping[str, Mapping[str, float]]

LOW, HIGH, N_SIDE, N_SIDE_QUICK = 0.015, 30.0, 25, 11
"""Range of both axes of the maps, and points along each."""
DT_S = 1e-3
N_DROP = 400
"""Steps after a drop."""
OVERFLOW, NOTHING = 1e6, 1e-6
"""Ratio of energies at which a rebound ends as an overflow; growth or gain beyond rounding."""
IMPACT = 10.0
"""Speed of the impact over that at which the static depth would stop it: g / w."""
LABELS = {"growth": "growth a step", "rebound": "rebound"}
"""Figures that are drawn, and their labels."""
EXPLICIT = ("explicit Euler", "semi-implicit Euler")


@dataclass(frozen=True)
class Mass:
    """A unit mass over a bed of natural frequency `omega`, rad/s, and c / m `damping`, 1/s.

    `unilateral`: True: the bed pushes only where x > 0 and never pulls. False: always attached.
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
    """The step of the scenes, `RigidBody.step` (depth is counted downwards here)."""
    bed = Bed(np.array([mass.omega**2]), np.array([mass.damping]), np.zeros(1), np.ones((1, 1)))
    body = RigidBody(np.ones(1), np.array([-GRAVITY_M_S2]))
    q, rate = body.step(bed, np.array([-x]), np.array([-v]), dt_s)
    return -float(q[0]), -float(rate[0])


INTEGRATORS: dict[str, Callable[[Mass, float, float, float], State]] = {
    "explicit Euler": explicit_euler,
    "semi-implicit Euler": semi_implicit_euler,
    "implicit Euler": implicit_euler,
    "SDIRK2 (the scenes)": sdirk2,
}


def amplification(method: str, omega_dt: float, c_dt_over_m: float) -> Doubles:
    """Matrix of one step of (x - static depth, v dt) on an attached bed, float64, shape (2, 2)."""
    a, b = omega_dt**2, c_dt_over_m
    rates: Doubles = np.array([[0.0, 1.0], [-a, -b]])
    one: Doubles = np.eye(2)
    if method == "explicit Euler":
        return one + rates
    if method == "semi-implicit Euler":
        return np.array([[1.0 - a, 1.0 - b], [-a, 1.0 - b]])
    if method == "implicit Euler":
        return np.asarray(np.linalg.inv(one - rates))
    gamma = 1.0 - 1.0 / math.sqrt(2.0)
    stage = np.linalg.inv(one - gamma * rates)
    return np.asarray((one + (1.0 - 2.0 * gamma) * rates) @ stage @ stage)


def growth(method: str, omega_dt: float, c_dt_over_m: float) -> float:
    """Largest factor by which an amplitude grows in a step: the spectral radius."""
    eigenvalues = np.linalg.eigvals(amplification(method, omega_dt, c_dt_over_m))
    return float(np.abs(eigenvalues).max())


def stability_margin(method: str, omega_dt: Doubles, c_dt_over_m: Doubles) -> Doubles | None:
    """A function that is positive where the method is stable: its zero is the boundary drawn.

    The conditions of Jury for both eigenvalues to lie within the unit circle: explicit Euler
    (w dt)^2 < c dt / m < 2 + (w dt)^2 / 2, semi-implicit Euler (w dt)^2 + 2 c dt / m < 4. None
    for a method that is stable everywhere.
    """
    a, b = omega_dt**2, c_dt_over_m
    if method == "explicit Euler":
        return np.minimum(b - a, 2.0 + a / 2.0 - b)
    return np.asarray(4.0 - a - 2.0 * b) if method == "semi-implicit Euler" else None


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
    """Figures of one point: of a row of the maps, or the place of a scene in them."""
    if "scene" in point:
        return place_of_scene(SCENES[point["scene"]]())
    method, b = point["method"], point["c_dt_over_m"]
    omegas = [a / DT_S for a in point["omega_dts"]]
    return {
        "growth": [growth(method, a, b) for a in point["omega_dts"]],
        "rebound": [rebound(method, Mass(omega, b / DT_S, unilateral=True)) for omega in omegas],
    }


def rebound(method: str, mass: Mass) -> float:
    """Drop a mass on an unilateral bed; the largest energy after first touch over that before.

    Not more than 1 where the integrator makes no energy; at most `OVERFLOW`.
    """
    v = IMPACT * GRAVITY_M_S2 / mass.omega
    # A little before the bed, by a third of a step, so that contact starts within a step.
    x = -v * DT_S / 3.0
    before, largest = mass.energy(x, v), 0.0
    for k in range(N_DROP):
        x, v = INTEGRATORS[method](mass, x, v, DT_S)
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


def section(page: Page, quick: bool, seed: int, executor: str) -> pd.DataFrame:
    """Compute, draw and add the section; the table of integrators."""
    asked = points(quick, seed)
    pairs = list(zip(asked, compute(measure, asked, page.out, executor, "contact"), strict=True))
    scenes = {point["scene"]: figures for point, figures in pairs if "scene" in point}
    rows = pd.concat(
        pd.DataFrame({**point, **figures}).rename(columns={"omega_dts": "omega_dt"})
        for point, figures in pairs
        if "method" in point
    )
    page.csv("contact", rows)
    places = [
        {
            **{"": k, "scene": scene, "ω·dt": f"{at['omega_dt']:.3f}"},
            "c·dt/m": f"{at['c_dt_over_m']:.3f}",
            **{m: "holds" if growth(m, **at) <= 1 else "blows up" for m in EXPLICIT},
        }
        for k, (scene, at) in enumerate(scenes.items(), 1)
    ]
    table = pd.DataFrame([_line(*one) for one in rows.groupby("method", sort=False)])
    page.section(
        "Contact: time integrators",
        *(_chart(page.out, column, rows, scenes) for column in LABELS),
        table,
        "Places of the scenes, and whether an explicit method would hold there:",
        pd.DataFrame(places),
    )
    return table


def _line(method: Any, rows: pd.DataFrame) -> dict[str, str]:
    """One integrator in the table: where it is unstable and makes energy."""
    grown = rows["growth"] > 1 + NOTHING
    return {
        "integrator": method,
        "unstable": f"{grown.mean():.0%}",
        "from ω·dt": f"{rows.loc[grown, 'omega_dt'].min():.2f}" if grown.any() else "-",
        "makes energy": f"{(rows['rebound'] > 1 + NOTHING).mean():.0%}",
    }


def _chart(out: Path, column: str, rows: pd.DataFrame, scenes: Places) -> str:
    """Maps of one figure, a panel for each method."""
    caption = f"Contact: {LABELS[column]} over ω·dt and c·dt/m; black: edge of stability."
    fine = np.geomspace(LOW, HIGH, 400)
    name, n = f"contact_{column}", len(INTEGRATORS)
    with Chart(out, name, caption, n, 2, size_in=(6.6, 6.6), legend_columns=3) as chart:
        for axes, (method, some) in zip(
            chart.panels, rows.groupby("method", sort=False), strict=True
        ):
            grid = some.pivot(index="c_dt_over_m", columns="omega_dt", values=column)
            axis = grid.columns.to_numpy()
            half = np.sqrt(axis[1] / axis[0])
            edges = np.append(axis / half, axis[-1] * half)
            limits = (edges[0], edges[-1])
            axes.set(xscale="log", yscale="log", title=method, xlim=limits, ylim=limits)
            axes.grid(False)
            axes.minorticks_off()
            style: dict[str, Any] = {"cmap": "RdBu_r", "rasterized": True}
            shown = grid.clip(0.01, 100.0)
            mesh = axes.pcolormesh(edges, edges, shown, norm=LogNorm(0.01, 100.0), **style)
            margin = stability_margin(str(method), *np.meshgrid(fine, fine))
            if margin is not None:
                axes.contour(fine, fine, margin, levels=[0.0], colors="black", linewidths=1.6)
                axes.plot([], [], color="black", lw=1.6, label="edge of stability")
            for k, (scene, at) in enumerate(scenes.items()):
                mark: dict[str, Any] = {"color": "white", "markeredgecolor": "black"}
                place = ([at["omega_dt"]], [at["c_dt_over_m"]], MARKERS[k])
                axes.plot(*place, markersize=6, label=f"{k + 1} {scene}", **mark)
        chart.label("ω·dt", "c·dt/m")
        bar = f"{LABELS[column]} (white: 1)"
        chart.figure.colorbar(mesh, ax=chart.panels, label=bar, shrink=0.8)
    return chart.markdown
