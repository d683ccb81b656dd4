"""Failures of contact integrators: growth, chatter and rebound over w dt and c dt / m.

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
from matplotlib.colors import LogNorm, Normalize

from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.scenes.contact import GRAVITY_M_S2, Bed, RigidBody
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.nodes.sensor.scenes.simulation import Scene, SceneSource
from sparseskin.studies.points import compute
from sparseskin.studies.report import MARKERS, Chart, write_csv

State = tuple[float, float]
Places = Mapping[str, Mapping[str, float]]

LOW, HIGH = 0.015, 30.0
"""Range of both axes of the maps."""
N_SIDE, N_SIDE_QUICK = 25, 11
DT_S = 1e-3
N_CHATTER, N_GROWTH = 40, 60
"""Steps of a swing that are checked for chatter, and then for growth."""
LOG_GONE = math.log(0.01)
N_DROP = 400
OVERFLOW = 1e6
"""Ratio of energies at which a rebound ends as an overflow."""
IMPACT = 10.0
"""Speed of the impact over that at which the static depth would stop it: g / w."""
NOTHING = 1e-6
"""Growth or energy gain beyond rounding."""
CHATTER = 0.25
LABELS = {"growth": "growth a step", "chatter": "chatter", "rebound": "rebound"}
"""Figures that are drawn, and their labels."""
EXPLICIT = ("explicit Euler", "semi-implicit Euler")


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
    """The step of the scenes, `RigidBody.step` (depth is counted downwards here)."""
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


def propagator(omega_dt: float, c_dt_over_m: float) -> Doubles:
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


def amplification(method: str, omega_dt: float, c_dt_over_m: float) -> Doubles:
    """Matrix of one step of (x - static depth, v dt) on an attached bed, float64, shape (2, 2).

    Raises
    ------
    KeyError
        If no integrator is called that.
    """
    a, b = omega_dt**2, c_dt_over_m
    rates: Doubles = np.array([[0.0, 1.0], [-a, -b]])
    one: Doubles = np.eye(2)
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


def stability_margin(method: str, omega_dt: Doubles, c_dt_over_m: Doubles) -> Doubles | None:
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
        # A swing that has died away does not chatter.
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


def section(out: Path, quick: bool, seed: int, executor: str) -> dict[str, Any]:
    """Compute and draw; the values for the page."""
    asked = points(quick, seed)
    pairs = list(zip(asked, compute(measure, asked, out, executor, "contact"), strict=True))
    scenes = {point["scene"]: figures for point, figures in pairs if "scene" in point}
    frame = pd.concat(
        pd.DataFrame({**point, **figures}).rename(columns={"omega_dts": "omega_dt"})
        for point, figures in pairs
        if "method" in point
    ).reset_index(drop=True)
    maps = ["method", "omega_dt", "c_dt_over_m", "growth", "reversals", "theory", "rebound"]
    csv = write_csv(out, "contact", frame[maps])
    # Beyond half a swing a step, the steps of the exact motion do not show its swing.
    exact = frame.loc[frame["method"] == "exact", "reversals"].tolist() * len(INTEGRATORS)
    frame["chatter"] = (frame["reversals"] - exact).where(frame["omega_dt"] < np.pi)
    return {
        "charts": [
            _chart(out, f"contact_{column}", label, frame, column, scenes)
            for column, label in LABELS.items()
        ],
        "table": pd.DataFrame([_line(*one) for one in frame.groupby("method", sort=False)]),
        **{"places": scenes, "explicit": EXPLICIT, "growth": growth},
        "csv": csv,
    }


def _line(method: Any, frame: pd.DataFrame) -> dict[str, str]:
    """One integrator in the table: where it is unstable, chatters and makes energy."""

    def percent(shares: pd.Series, digits: int = 0) -> str:
        return f"{100 * shares.mean():.{digits}f} %"

    grown, theory = (frame[name] > 1 + NOTHING for name in ("growth", "theory"))
    chatter = frame.loc[frame["omega_dt"] < np.pi, "chatter"] > CHATTER
    return {
        "integrator": method,
        "unstable": percent(grown),
        "as in theory": percent(grown == theory, 1),
        "from ω·dt": f"{frame.loc[grown, 'omega_dt'].min():.2f}" if grown.any() else "-",
        "chatters (ω·dt < π)": percent(chatter),
        "makes energy": "-" if method == "exact" else percent(frame["rebound"] > 1 + NOTHING),
    }


def _chart(
    out: Path, name: str, label: str, frame: pd.DataFrame, column: str, scenes: Places
) -> str:
    """Maps of one figure, a panel for each method that has it."""
    is_ratio = column != "chatter"
    frame = frame[frame["method"] != "exact"] if column == "rebound" else frame
    methods = list(frame["method"].unique())
    n_columns = 3 if len(methods) > 4 else 2
    chart = Chart(
        out,
        name,
        f"Contact: {label} over ω·dt and c·dt/m; black: where theory puts the boundary.",
        *(len(methods), n_columns),
        size_in=(3.3 * n_columns, 3.0 * -(-len(methods) // n_columns) + 0.6),
        legend_columns=3,
    )
    fine = np.geomspace(LOW, HIGH, 400)
    with chart:
        for axes, method in zip(chart.panels, methods, strict=True):
            grid = frame[frame["method"] == method].pivot(
                index="c_dt_over_m", columns="omega_dt", values=column
            )
            axis = grid.columns.to_numpy()
            half = np.sqrt(axis[1] / axis[0])
            edges = np.append(axis / half, axis[-1] * half)
            limits = (edges[0], edges[-1])
            axes.set(xscale="log", yscale="log", title=method, xlim=limits, ylim=limits)
            axes.grid(False)
            axes.minorticks_off()
            mesh = axes.pcolormesh(
                *(edges, edges, grid.clip(0.01, 100.0) if is_ratio else grid),
                norm=LogNorm(0.01, 100.0) if is_ratio else Normalize(-1.0, 1.0),
                cmap="RdBu_r",
                rasterized=True,
            )
            margin = stability_margin(method, *np.meshgrid(fine, fine))
            if margin is not None:
                style: dict[str, Any] = {"colors": "black", "linewidths": 1.6}
                axes.contour(fine, fine, margin, levels=[0.0], **style)
                axes.plot([], [], color="black", lw=1.6, label="edge of stability, in theory")
            for k, (scene, place) in enumerate(scenes.items()):
                axes.plot(
                    *([place["omega_dt"]], [place["c_dt_over_m"]], MARKERS[k]),
                    color="white",
                    markeredgecolor="black",
                    markersize=6,
                    label=f"{k + 1} {scene}",
                )
        chart.label("ω·dt", "c·dt/m")
        bar = label + (" (white: 1)" if is_ratio else "")
        chart.figure.colorbar(mesh, ax=chart.panels, label=bar, shrink=0.8)
    return chart.markdown
