"""The bed of spring-dampers and its integrator against closed forms."""

import math

import numpy as np
import pytest

from sparseskin.nodes.sensor.scenes.bodies import wooden_cube
from sparseskin.nodes.sensor.scenes.contact import GRAVITY_M_S2, Bed, RigidBody
from sparseskin.nodes.sensor.scenes.scenes import SKIN, TAXEL_RADIUS_M
from sparseskin.nodes.sensor.scenes.terrain import Terrain

MASS_KG = 0.5
N_SIDE = 10
N_CELLS = N_SIDE**2
PITCH_M = 0.005


def square_bed(stiffness, damping, with_pitch=False):
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


def falling_body(*inertia_kg_m2):
    forces = np.zeros(1 + len(inertia_kg_m2))
    forces[0] = -MASS_KG * GRAVITY_M_S2
    return RigidBody(np.array([MASS_KG, *inertia_kg_m2]), forces)


def bed_of(omega, zeta):
    """A bed on which MASS_KG has the given frequency (rad/s) and damping ratio."""
    return square_bed(MASS_KG * omega**2 / N_CELLS, 2 * zeta * omega * MASS_KG / N_CELLS)


def run(body, bed, q, v, dt_s, n_steps):
    """Coordinates and rates at steps 0..n_steps, each of shape (n_steps + 1, n_dof)."""
    qs, vs = [np.array(q)], [np.array(v)]
    for _ in range(n_steps):
        q_next, v_next = body.step(bed, qs[-1], vs[-1], dt_s)
        qs.append(q_next)
        vs.append(v_next)
    return np.array(qs), np.array(vs)


def test_cells_push_and_never_pull():
    bed = square_bed(100.0, 10.0)
    assert not bed.forces(np.array([1e-4]), np.array([-1.0])).any()  # above, and approaching
    assert not bed.forces(np.array([-1e-4]), np.array([1.0])).any()  # within, and leaving fast
    np.testing.assert_allclose(bed.forces(np.array([-0.01]), np.array([-0.1])), 100 * 0.01 + 1.0)


def test_drop_on_a_bed_far_too_stiff_for_the_step_comes_to_rest():
    dt_s, omega = 1e-3, 1e5
    bed = bed_of(omega, 0.05)
    q, v = run(falling_body(), bed, [0.05], [0.0], dt_s, 2000)
    assert q[:, 0].max() <= 0.05
    assert bed.forces(q[-1], v[-1]).sum() == pytest.approx(MASS_KG * GRAVITY_M_S2, rel=0.01)


def test_bouncing_and_tipping_body_never_gains_energy():
    inertia, stiffness, dt_s = 1e-4, 500.0, 1e-2
    bed = square_bed(stiffness, 0.0, with_pitch=True)
    q, v = run(falling_body(inertia), bed, [0.02, 0.3], [0.0, 0.0], dt_s, 1500)
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


def test_a_step_is_of_second_order_on_a_bed_that_stays_loaded():
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


SHAPE = (40, 40)


@pytest.mark.parametrize(("axis", "sign"), [("pitch", -1.0), ("roll", 1.0)])
def test_a_tilt_lifts_one_side_of_the_body_and_lowers_the_other(axis, sign):
    yaw_rad = 0.7
    sole = wooden_cube(TAXEL_RADIUS_M).sole
    bed, taxels = Terrain(SKIN, SHAPE, sole, yaw_rad, ("z", "pitch", "roll")).under((0.01, -0.02))
    rows, cols = np.divmod(taxels, SHAPE[1])
    x = (cols - 19.5) * SKIN.pitch_m - 0.01
    y = (rows - 19.5) * SKIN.pitch_m + 0.02
    along = x if axis == "pitch" else y
    across = y if axis == "pitch" else -x
    place = np.cos(yaw_rad) * along + np.sin(yaw_rad) * across
    column = bed.jacobian[:, 1 if axis == "pitch" else 2]
    np.testing.assert_allclose(column, sign * place, atol=1e-12)
    np.testing.assert_array_equal(bed.jacobian[:, 0], 1.0)
