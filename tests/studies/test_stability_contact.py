"""The integrators of the stability study against their theory and the exact motion."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.studies.stability.contact import (
    INTEGRATORS,
    Mass,
    amplification,
    growth,
    place_of_scene,
    rebound,
    stability_margin,
)

DT_S = 1e-3
decades = st.floats(-2.0, 1.4).map(lambda exponent: 10.0**exponent)


@pytest.mark.parametrize("method", INTEGRATORS)
@given(omega_dt=decades, c_dt_over_m=decades, angle=st.floats(0.0, 6.3))
def test_a_step_does_what_its_amplification_matrix_predicts(method, omega_dt, c_dt_over_m, angle):
    mass = Mass(omega_dt / DT_S, c_dt_over_m / DT_S, unilateral=False)
    # Near the balance, so that the bed of the scenes' integrator stays loaded.
    scale = 1e-3 * mass.static_depth
    away, v_dt = scale * math.cos(angle), scale * math.sin(angle)
    matrix = amplification(method, omega_dt, c_dt_over_m)
    if method.startswith("SDIRK2"):
        assume(c_dt_over_m * abs(v_dt) < 0.1 * omega_dt**2 * mass.static_depth)
    x, v = INTEGRATORS[method](mass, mass.static_depth + away, v_dt / DT_S, DT_S)
    expected = matrix @ (away, v_dt)
    size = np.abs(matrix).max() * scale
    np.testing.assert_allclose((x - mass.static_depth, v * DT_S), expected, atol=1e-6 * size)


@pytest.mark.parametrize("method", ["explicit Euler", "semi-implicit Euler"])
@given(omega_dt=decades, c_dt_over_m=decades)
def test_the_boundary_that_is_drawn_is_where_amplitudes_begin_to_grow(
    method, omega_dt, c_dt_over_m
):
    margin = stability_margin(method, np.array(omega_dt), np.array(c_dt_over_m))
    assert margin is not None
    assume(abs(float(margin)) > 1e-3)
    assert (growth(method, omega_dt, c_dt_over_m) < 1.0) == (float(margin) > 0.0)


@pytest.mark.parametrize("method", ["implicit Euler", "SDIRK2 (the scenes)"])
@given(omega_dt=decades, c_dt_over_m=decades)
def test_implicit_methods_are_stable_everywhere(method, omega_dt, c_dt_over_m):
    assert growth(method, omega_dt, c_dt_over_m) < 1.0
    assert stability_margin(method, np.array(1.0), np.array(1.0)) is None


@pytest.mark.parametrize("omega_dt", [0.3, 1.5, 6.0])
def test_on_a_bed_that_only_pushes_implicit_methods_make_no_energy(omega_dt):
    mass = Mass(omega_dt / DT_S, 0.0, unilateral=True)
    assert rebound("implicit Euler", mass) <= 1.0 + 1e-9
    assert rebound("SDIRK2 (the scenes)", mass) <= 1.0 + 1e-9
    assert rebound("explicit Euler", mass) > 1.5


def test_the_box_has_the_frequency_and_damping_of_its_400_taxels():
    scene = SCENES["lift_box_40"]()
    place = place_of_scene(scene)
    omega = math.sqrt(400 * scene.surface.stiffness / scene.body.mass_kg)
    assert place["omega_dt"] == pytest.approx(omega * 1e-3)
    assert place["c_dt_over_m"] == pytest.approx(400 * 0.4 / scene.body.mass_kg * 1e-3)
