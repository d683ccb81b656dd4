"""The scenes: their physics, the bodies in them, tiled skins, and contact of bodies."""

import itertools
import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages.skin import CONTACT_FRACTION, PAPER_F_MAX_N, Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.scenes.bodies import build_sole, slab, wooden_cube
from sparseskin.nodes.sensor.scenes.contact import GRAVITY_M_S2, Bed, RigidBody
from sparseskin.nodes.sensor.scenes.scenes import SKIN as GRID_SKIN
from sparseskin.nodes.sensor.scenes.scenes import TAXEL_RADIUS_M, open_scene
from sparseskin.nodes.sensor.scenes.terrain import Terrain
from sparseskin.nodes.sensor.scenes.tiled import TILED, TiledScene

TABLE = {
    "lift_box_40": (40, 700, 1_000_000),
    "lift_wrench_40": (40, 3000, 1_000_000),
    "drag_wrench_40": (40, 5000, 1_000_000),
    "path_40": (40, 12200, 1_000_000),
    "lift_box_64": (64, 7600, 100_000),
    "drag_wrench_64": (64, 12600, 100_000),
}


REST = {"lift_box_40": 670, "lift_box_64": 7500, "path_40": 990}


@cache
def played(name):
    """Largest force and sum of each frame of a scene, and one frame of the body at rest."""
    side, n_steps, _ = TABLE[name]
    peak = np.empty(n_steps)
    total = np.empty(n_steps)
    at_rest = np.empty(0, np.float32)
    for step, (_, forces) in enumerate(open_scene(name, 0)):
        assert forces.dtype == np.float32
        assert forces.shape == (side, side)
        assert forces.min() >= 0.0
        peak[step] = forces.max()
        total[step] = forces.sum(dtype=float)
        if step == REST.get(name):
            at_rest = forces
    assert step == n_steps - 1
    return SimpleNamespace(peak=peak, total=total, at_rest=at_rest)


@pytest.mark.parametrize(
    "name",
    [
        n if n == "lift_box_40" else pytest.param(n, marks=pytest.mark.slow)
        for n in TABLE
    ],
)
def test_whole_scene_starts_untouched_touches_stays_in_range_and_all_but_path_ends_untouched(
    name,
):
    peak = played(name).peak
    assert np.isfinite(played(name).total).all()
    assert peak.max() <= 2.5
    assert peak[0] == 0.0
    # The run ends as the contact does, and not a tenth of it later.
    assert (peak[-1] > 0.0) == (name == "path_40")
    assert peak[-len(peak) // 10 :].any()


def test_a_seed_gives_the_same_frames_at_each_playing_another_one_drops_the_peg_elsewhere():
    source = open_scene("path_40", 7)
    first, again = ([f for _, f in itertools.islice(source, 991)] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    other = next(itertools.islice(open_scene("path_40", 1), 990, None))[1]
    assert first[-1].any() and other.any()  # noqa: PT018
    assert not np.array_equal(first[-1] > 0, other > 0)


@given(first=st.integers(0, 480), every=st.integers(1, 30))
def test_a_part_of_a_scene_has_the_bits_of_all_its_frames(first, every):
    source = open_scene("lift_box_40", 0)
    source.read_part(first, every)
    expected = all_frames()[first::every][:4]
    for stamp_ns, forces in expected:
        part_ns, part = source.next_frame(0.0)
        assert part_ns == stamp_ns
        np.testing.assert_array_equal(part, forces)


@cache
def all_frames():
    """Frames of a scene, some of them in contact."""
    return list(itertools.islice(open_scene("lift_box_40", 0), 600))


@pytest.mark.parametrize(
    ("name", "mass_kg"),
    [
        ("lift_box_40", 0.5167),
        pytest.param("lift_box_64", 0.5167, marks=pytest.mark.slow),
        pytest.param(
            "path_40", 2700 * math.pi * 0.01**2 * 0.06, marks=pytest.mark.slow
        ),
    ],
)
def test_forces_at_rest_carry_the_weight_and_those_of_the_box_evenly(name, mass_kg):
    forces = played(name).at_rest
    assert forces.sum(dtype=float) == pytest.approx(mass_kg * GRAVITY_M_S2, rel=0.01)
    if name != "path_40":
        rows, cols = np.nonzero(forces)
        assert np.count_nonzero(forces) == 400
        assert np.ptp(rows) == np.ptp(cols) == 19
        assert np.ptp(forces[forces > 0]) <= 1e-6


@pytest.mark.slow
def test_ground_takes_its_part_as_the_wrench_leaves_the_skin():
    weight = 1.0 * GRAVITY_M_S2
    assert 0.0 < played("drag_wrench_40").total[4700:4900].mean() < 0.5 * weight


SKIN = Skin(12, 16, PAPER_F_MAX_N, pitch_m=0.005)
STEP_S = 0.05


def touched(scene, seconds):
    """True where a patch is touched, (n_frames, n_patches)."""
    frames = [scene.forces(k * STEP_S) for k in range(round(seconds / STEP_S))]
    return np.array(
        [f.max(axis=(1, 2)) > CONTACT_FRACTION * PAPER_F_MAX_N for f in frames]
    )


@pytest.mark.parametrize("name", TILED)
def test_as_many_patches_are_pressed_as_stated_and_the_others_are_idle(name):
    ever = touched(TiledScene(name, SKIN, 20), TILED[name].period_s).any(axis=0)
    assert np.count_nonzero(ever) == np.ceil(TILED[name].active * 20)


@pytest.mark.parametrize("name", TILED)
@pytest.mark.parametrize("shape", [(16, 5), (1, 16)])
def test_forces_are_within_the_range_and_each_press_ends(name, shape):
    scene = TiledScene(name, Skin(*shape, PAPER_F_MAX_N, pitch_m=0.005), 3, active=0.3)
    peaks = [
        scene.forces(k * STEP_S).max()
        for k in range(round(TILED[name].period_s / STEP_S))
    ]
    assert 0.1 < max(peaks) < 0.9
    assert scene.forces(TILED[name].pressed_s + 1e-6)[0].max() == 0.0


def test_a_walking_and_a_lying_body_press_patches_in_turn():
    pressed = touched(TiledScene("walk", SKIN, 8), 4 * TILED["walk"].period_s)
    left = pressed[:, 0]
    right = pressed[:, 1]
    assert not pressed[:, 2:].any()
    half = round(TILED["walk"].period_s / 2 / STEP_S)
    np.testing.assert_array_equal(left[:-half], right[half:])
    assert left.any()
    assert not left.all()
    pressed = touched(TiledScene("lying", SKIN, 6), 2 * TILED["lying"].period_s)
    first, second = np.array_split(pressed, 2)
    np.testing.assert_array_equal(first.any(axis=0), ~second.any(axis=0))


def test_patches_bear_the_weight_and_differ_by_mirroring_alone_on_skins_with_a_pitch():
    scene = TiledScene("hug", SKIN, 1)
    body = TILED["hug"].body(SKIN.shape, 0.005)
    total = float(scene.forces(2.2)[0].sum(dtype=np.float64))
    assert total == pytest.approx(9.81 * body.mass_kg, rel=0.02)
    forces = TiledScene("hug", SKIN, 4, active=1.0).forces(2.2)
    for other, mirrored in ((1, forces[0, ::-1]), (3, forces[0, ::-1, ::-1])):
        np.testing.assert_allclose(forces[other], mirrored, rtol=1e-3)
    with pytest.raises(SourceError, match="pitch"):
        TiledScene("hug", Skin(4, 4, 2.5), 4)


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
    return square_bed(
        MASS_KG * omega**2 / N_CELLS, 2 * zeta * omega * MASS_KG / N_CELLS
    )


def run(body, bed, q, v, dt_s, n_steps):
    """Coordinates and rates at steps 0..n_steps, each of shape (n_steps + 1, n_dof)."""
    qs = [np.array(q)]
    vs = [np.array(v)]
    for _ in range(n_steps):
        q_next, v_next = body.step(bed, qs[-1], vs[-1], dt_s)
        qs.append(q_next)
        vs.append(v_next)
    return np.array(qs), np.array(vs)


def test_cells_push_and_never_pull():
    bed = square_bed(100.0, 10.0)
    assert not bed.forces(
        np.array([1e-4]), np.array([-1.0])
    ).any()  # above, and approaching
    assert not bed.forces(
        np.array([-1e-4]), np.array([1.0])
    ).any()  # within, and leaving fast
    np.testing.assert_allclose(
        bed.forces(np.array([-0.01]), np.array([-0.1])), 100 * 0.01 + 1.0
    )


def test_drop_on_a_bed_far_too_stiff_for_the_step_comes_to_rest():
    dt_s = 1e-3
    omega = 1e5
    bed = bed_of(omega, 0.05)
    q, v = run(falling_body(), bed, [0.05], [0.0], dt_s, 2000)
    assert q[:, 0].max() <= 0.05
    assert bed.forces(q[-1], v[-1]).sum() == pytest.approx(
        MASS_KG * GRAVITY_M_S2, rel=0.01
    )


def test_bouncing_and_tipping_body_never_gains_energy():
    inertia = 1e-4
    stiffness = 500.0
    dt_s = 1e-2
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
        damped = omega * math.sqrt(1 - 0.2**2)
        t = 0.01
        exact = -static + 0.5 * static * math.exp(-0.2 * omega * t) * (
            math.cos(damped * t) + 0.2 * omega / damped * math.sin(damped * t)
        )
        errors.append(abs(q[-1, 0] - exact))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] < 1e-4 * static


SHAPE = (40, 40)


@given(
    st.floats(0.01, 0.15),
    st.floats(0.01, 0.15),
    *[st.floats(-0.08, 0.08)] * 2,
    st.floats(-math.pi, math.pi),
)
def test_each_taxel_over_which_a_body_is_belongs_to_its_bed(
    length_m, width_m, x_m, y_m, yaw_rad
):
    # Off its middle: the ends of a body are as far as its longer half.
    bounds = (-0.2 * length_m, 0.8 * length_m, -0.7 * width_m, 0.3 * width_m)
    sole = build_sole([slab(*bounds, 0.0)], bounds, 0.0)
    terrain = Terrain(GRID_SKIN, SHAPE, sole, yaw_rad, ("z",))
    _, taxels = terrain.under((x_m, y_m))
    rows, cols = np.divmod(np.arange(math.prod(SHAPE)), SHAPE[1])
    x = (cols - 19.5) * GRID_SKIN.pitch_m - x_m
    y = (rows - 19.5) * GRID_SKIN.pitch_m - y_m
    along = math.cos(yaw_rad) * x + math.sin(yaw_rad) * y
    across = math.cos(yaw_rad) * y - math.sin(yaw_rad) * x
    is_under = (along > bounds[0]) & (along < bounds[1])
    is_under &= (across > bounds[2]) & (across < bounds[3])
    assert set(np.flatnonzero(is_under)) <= set(taxels)


@pytest.mark.parametrize(("axis", "sign"), [("pitch", -1.0), ("roll", 1.0)])
def test_a_tilt_lifts_one_side_of_the_body_and_lowers_the_other(axis, sign):
    yaw_rad = 0.7
    sole = wooden_cube(TAXEL_RADIUS_M).sole
    terrain = Terrain(GRID_SKIN, SHAPE, sole, yaw_rad, ("z", "pitch", "roll"))
    bed, taxels = terrain.under((0.01, -0.02))
    rows, cols = np.divmod(taxels, SHAPE[1])
    x = (cols - 19.5) * GRID_SKIN.pitch_m - 0.01
    y = (rows - 19.5) * GRID_SKIN.pitch_m + 0.02
    along = x if axis == "pitch" else y
    across = y if axis == "pitch" else -x
    place = np.cos(yaw_rad) * along + np.sin(yaw_rad) * across
    column = bed.jacobian[:, 1 if axis == "pitch" else 2]
    np.testing.assert_allclose(column, sign * place, atol=1e-12)
    np.testing.assert_array_equal(bed.jacobian[:, 0], 1.0)
