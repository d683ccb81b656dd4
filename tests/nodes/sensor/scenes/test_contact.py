"""The bed of spring-dampers and its integrator against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.sensor.scenes.contact import GRAVITY_M_S2, Bed, RigidBody

MASS_KG = 0.5
N_SIDE = 10
N_CELLS = N_SIDE**2
PITCH_M = 0.005


def square_bed(stiffness: float, damping: float, with_pitch: bool = False) -> Bed:
    """N_SIDE x N_SIDE equal cells about the origin, under a flat sole."""
    x = (np.arange(N_SIDE) - (N_SIDE - 1) / 2) * PITCH_M
    columns = [np.ones(N_CELLS)]
    if with_pitch:
        columns.append(-np.tile(x, N_SIDE))
    return Bed(
        stiffness=np.full(N_CELLS, stiffness),
        damping=np.full(N_CELLS, damping),
        gap=np.zeros(N_CELLS),
        jacobian=np.stack(columns, axis=1),
    )


def falling_body(inertia_kg_m2: float | None = None, off_centre_m: float = 0.0) -> RigidBody:
    weight = MASS_KG * GRAVITY_M_S2
    if inertia_kg_m2 is None:
        return RigidBody(np.array([MASS_KG]), np.array([-weight]))
    return RigidBody(np.array([MASS_KG, inertia_kg_m2]), np.array([-weight, weight * off_centre_m]))


def bed_of(omega: float, zeta: float) -> Bed:
    """A bed on which MASS_KG has the given frequency (rad/s) and damping ratio."""
    return square_bed(MASS_KG * omega**2 / N_CELLS, 2 * zeta * omega * MASS_KG / N_CELLS)


def run(
    body: RigidBody, bed: Bed, q: list[float], v: list[float], dt_s: float, n_steps: int
) -> tuple[Doubles, Doubles]:
    """Coordinates and rates at steps 0..n_steps, each of shape (n_steps + 1, n_dof)."""
    qs, vs = [np.array(q)], [np.array(v)]
    for _ in range(n_steps):
        q_next, v_next = body.step(bed, qs[-1], vs[-1], dt_s)
        qs.append(q_next)
        vs.append(v_next)
    return np.array(qs), np.array(vs)


def test_free_fall_is_a_parabola() -> None:
    q, v = run(falling_body(), square_bed(100.0, 1.0), [2.0], [0.0], 0.01, 60)
    t = 0.01 * np.arange(61)
    np.testing.assert_allclose(q[:, 0], 2.0 - GRAVITY_M_S2 * t**2 / 2, rtol=1e-9)
    np.testing.assert_allclose(v[:, 0], -GRAVITY_M_S2 * t, rtol=1e-9, atol=1e-12)


def test_undamped_release_swings_to_twice_the_weight_in_half_a_period() -> None:
    omega = 50.0
    dt_s = 0.02 / omega
    bed = bed_of(omega, 0.0)
    q, v = run(falling_body(), bed, [0.0], [0.0], dt_s, 500)
    force = np.array([bed.forces(qi, vi).sum() for qi, vi in zip(q, v, strict=True)])
    assert force.max() == pytest.approx(2 * MASS_KG * GRAVITY_M_S2, rel=0.01)
    assert force.argmax() * dt_s == pytest.approx(math.pi / omega, rel=0.01)


@pytest.mark.parametrize("zeta", [0.05, 0.2, 0.5])
def test_damped_release_has_the_period_overshoot_and_decay_of_the_closed_form(
    zeta: float,
) -> None:
    omega = 50.0
    damped = omega * math.sqrt(1 - zeta**2)
    dt_s = 0.01 / omega
    q, _ = run(falling_body(), bed_of(omega, zeta), [0.0], [0.0], dt_s, 1000)
    static = GRAVITY_M_S2 / omega**2
    depth = -q[:, 0] / static
    extrema = 1 + np.flatnonzero(np.diff(np.sign(np.diff(depth))))
    first, second = extrema[0], extrema[1]
    assert first * dt_s == pytest.approx(math.pi / damped, rel=0.01)
    assert (second - first) * dt_s == pytest.approx(math.pi / damped, rel=0.01)
    decay = math.exp(-math.pi * zeta * omega / damped)
    assert depth[first] - 1 == pytest.approx(decay, rel=0.01)
    assert 1 - depth[second] == pytest.approx(decay**2, rel=0.01)


def test_impact_has_the_peak_force_and_contact_time_of_the_closed_form() -> None:
    omega, height, speed = 300.0, 0.002, 3.0
    dt_s = 0.01 / omega
    bed = bed_of(omega, 0.0)
    q, v = run(falling_body(), bed, [height], [-speed], dt_s, 600)
    force = np.array([bed.forces(qi, vi).sum() for qi, vi in zip(q, v, strict=True)])
    static = GRAVITY_M_S2 / omega**2
    swing = math.sqrt(speed**2 + 2 * GRAVITY_M_S2 * height) / omega
    assert force.max() == pytest.approx(
        MASS_KG * omega**2 * (static + math.hypot(static, swing)), rel=0.01
    )
    assert np.count_nonzero(force) * dt_s == pytest.approx(
        (math.pi + 2 * math.atan2(static, swing)) / omega, rel=0.01
    )


def test_forces_at_rest_carry_the_weight() -> None:
    bed = square_bed(122.24, 0.4)
    q, v = run(falling_body(), bed, [0.05], [0.0], 1e-3, 3000)
    assert bed.forces(q[-1], v[-1]).sum() == pytest.approx(MASS_KG * GRAVITY_M_S2, rel=0.01)


def test_off_centre_mass_tilts_to_the_closed_form() -> None:
    stiffness, off_centre_m = 122.24, 0.002
    bed = square_bed(stiffness, 2.0, with_pitch=True)
    body = falling_body(inertia_kg_m2=1e-3, off_centre_m=off_centre_m)
    q, v = run(body, bed, [0.0, 0.0], [0.0, 0.0], 1e-3, 6000)
    weight = MASS_KG * GRAVITY_M_S2
    moment_of_bed = stiffness * float(np.sum(bed.jacobian[:, 1] ** 2))
    forces = bed.forces(q[-1], v[-1])
    assert forces.min() > 0.0
    assert q[-1, 0] == pytest.approx(-weight / (stiffness * N_CELLS), rel=0.01)
    assert q[-1, 1] == pytest.approx(weight * off_centre_m / moment_of_bed, rel=0.01)
    centre_of_force = -float(forces @ bed.jacobian[:, 1]) / forces.sum()
    assert centre_of_force == pytest.approx(off_centre_m, rel=0.01)


def test_cells_push_and_never_pull() -> None:
    bed = square_bed(100.0, 10.0)
    assert not bed.forces(np.array([1e-4]), np.array([-1.0])).any()  # above, and approaching
    assert not bed.forces(np.array([-1e-4]), np.array([1.0])).any()  # within, and leaving fast
    np.testing.assert_allclose(bed.forces(np.array([-0.01]), np.array([-0.1])), 100 * 0.01 + 1.0)


@pytest.mark.parametrize("omega_dt", [2.0, 10.0, 100.0, 1e4])
def test_oscillation_faster_than_the_step_only_loses_energy(omega_dt: float) -> None:
    omega = 1000.0
    dt_s = omega_dt / omega
    static = -GRAVITY_M_S2 / omega**2
    # Half the static depth off the balance: the contact lasts, and the bed is linear.
    q, v = run(falling_body(), bed_of(omega, 0.0), [0.5 * static], [0.0], dt_s, 1000)
    energy = (omega * (q[:, 0] - static)) ** 2 + v[:, 0] ** 2
    falling = energy > 1e-20 * energy[0]
    assert np.all(np.diff(energy)[falling[:-1]] < 0.0)
    assert q[-1, 0] == pytest.approx(static, rel=1e-6)


@pytest.mark.parametrize("c_dt_over_m", [2.0, 10.0, 100.0, 1e4])
def test_damping_faster_than_the_step_only_slows_the_body(c_dt_over_m: float) -> None:
    dt_s, speed = 1e-3, 1e-3
    bed = square_bed(1e-6, c_dt_over_m * MASS_KG / dt_s / N_CELLS)
    body = RigidBody(np.array([MASS_KG]), np.array([0.0]))
    q, v = run(body, bed, [-1e-3], [-speed], dt_s, 50)
    assert np.all(np.abs(np.diff(q[:, 0])) <= speed * dt_s)
    moving = np.flatnonzero(np.abs(v[:, 0]) > 1e-6 * speed)
    assert moving.size == moving[-1] + 1 < 50
    assert np.all(np.diff(v[moving, 0]) > 0.0)
    assert v[:, 0].max() < 1e-6 * speed


@pytest.mark.parametrize("omega_dt", [2.0, 10.0, 100.0])
def test_drop_on_a_bed_far_too_stiff_for_the_step_comes_to_rest(omega_dt: float) -> None:
    dt_s = 1e-3
    omega = omega_dt / dt_s
    bed = bed_of(omega, 0.05)
    q, v = run(falling_body(), bed, [0.05], [0.0], dt_s, 2000)
    assert q[:, 0].max() <= 0.05
    assert bed.forces(q[-1], v[-1]).sum() == pytest.approx(MASS_KG * GRAVITY_M_S2, rel=0.01)


@pytest.mark.parametrize("dt_s", [1e-4, 1e-3, 1e-2])
def test_bouncing_and_tipping_body_never_gains_energy(dt_s: float) -> None:
    inertia, stiffness = 1e-4, 500.0
    bed = square_bed(stiffness, 0.0, with_pitch=True)
    body = falling_body(inertia_kg_m2=inertia)
    q, v = run(body, bed, [0.02, 0.3], [0.0, 0.0], dt_s, 1500)
    depth = np.maximum(-(q @ bed.jacobian.T), 0.0)
    energy = (
        MASS_KG * GRAVITY_M_S2 * q[:, 0]
        + 0.5 * MASS_KG * v[:, 0] ** 2
        + 0.5 * inertia * v[:, 1] ** 2
        + 0.5 * stiffness * (depth**2).sum(axis=1)
    )
    partly = depth.any(axis=1) & ~depth.all(axis=1)
    assert partly.any()
    assert np.diff(energy).max() <= 1e-9 * energy[0]


def test_a_body_over_one_cell_sinks_until_that_cell_carries_it() -> None:
    omega, zeta = 50.0, 0.3
    bed = Bed(
        stiffness=np.array([MASS_KG * omega**2]),
        damping=np.array([2 * zeta * omega * MASS_KG]),
        gap=np.array([0.002]),
        jacobian=np.ones((1, 1)),
    )
    q, v = run(falling_body(), bed, [0.0], [0.0], 1e-3, 800)
    static_m = GRAVITY_M_S2 / omega**2
    assert q[-1, 0] == pytest.approx(-0.002 - static_m, rel=1e-3)
    forces = bed.forces(q[-1], v[-1])
    assert forces.shape == (1,)
    assert forces[0] == pytest.approx(MASS_KG * GRAVITY_M_S2, rel=1e-3)
    # Landed at v0 = sqrt(2 g h): the deepest point of the damped oscillation from there.
    landing_m_s = math.sqrt(2 * GRAVITY_M_S2 * 0.002)
    damped = omega * math.sqrt(1 - zeta**2)
    b = (landing_m_s - zeta * omega * static_m) / damped
    t = np.linspace(0.0, 2 * math.pi / omega, 20_000)
    decaying = np.exp(-zeta * omega * t)
    depth = static_m + decaying * (b * np.sin(damped * t) - static_m * np.cos(damped * t))
    assert -q[:, 0].min() - 0.002 == pytest.approx(depth.max(), rel=0.01)


def test_a_body_held_by_one_cell_of_many_rests_on_that_cell_alone() -> None:
    bed = square_bed(100.0, 10.0)
    bed.gap[1:] = 1.0
    q, v = run(falling_body(), bed, [0.0], [0.0], 1e-3, 2000)
    forces = bed.forces(q[-1], v[-1])
    assert np.count_nonzero(forces) == 1
    assert forces[0] == pytest.approx(MASS_KG * GRAVITY_M_S2, rel=1e-3)


def test_a_step_is_of_second_order_on_a_bed_that_stays_loaded() -> None:
    omega = 100.0
    bed = bed_of(omega, 0.2)
    static = GRAVITY_M_S2 / omega**2
    errors = []
    for n_steps in (20, 40):
        q, _ = run(falling_body(), bed, [-0.5 * static], [0.0], 0.01 / n_steps, n_steps)
        damped, t = omega * math.sqrt(1 - 0.2**2), 0.01
        exact = -static + 0.5 * static * math.exp(-0.2 * omega * t) * (
            math.cos(damped * t) + 0.2 * omega / damped * math.sin(damped * t)
        )
        errors.append(abs(q[-1, 0] - exact))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] < 1e-4 * static


def test_step_leaves_its_arguments_alone() -> None:
    q, v = np.array([-1e-3]), np.array([-0.5])
    falling_body().step(square_bed(100.0, 1.0), q, v, 1e-3)
    assert (q[0], v[0]) == (-1e-3, -0.5)


@pytest.mark.parametrize("height_m", [0.05, 0.5])
def test_bounce_is_as_high_with_long_steps_as_with_short_ones(height_m: float) -> None:
    bed = square_bed(122.24, 0.4)

    def rebound_m(dt_s: float) -> float:
        fall_s = math.sqrt(2 * height_m / GRAVITY_M_S2)
        q, v = run(falling_body(), bed, [height_m], [0.0], dt_s, round(2 * fall_s / dt_s))
        left = np.flatnonzero((q[:, 0] > 0.0) & (v[:, 0] > 0.0))
        assert left.size > 0
        return float(v[left[0], 0] ** 2 / (2 * GRAVITY_M_S2) + q[left[0], 0])

    assert rebound_m(1e-3) == pytest.approx(rebound_m(4e-5), rel=0.02)
