"""Simulated bodies and scenes against exact solutions of the same equations, written anew here.

The accuracy that docs/explanation/scenes.md and the docstrings of `contact`, `scenes` and `bodies`
state is asserted here to its digits.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes import bodies
from sparseskin.nodes.sensor.scenes.bodies import (
    FAR_M,
    Body,
    Sole,
    build_sole,
    metal_peg,
)
from sparseskin.nodes.sensor.scenes.contact import Bed, RigidBody
from sparseskin.nodes.sensor.scenes.scenes import (
    SCENES,
    SKIN,
    TAXEL_RADIUS_M,
    open_scene,
)
from sparseskin.nodes.sensor.scenes.simulation import Drag, Scene, SceneSource

G_M_S2 = 9.81
#: Frames so near to a limit that the rounding of another processor decides how they are counted.
TIES = 2
F_MAX_N = 2.5


def press(k, c, depth, rate):
    """Forces of unilateral spring-dampers in N, from penetrations in m and their rates in m/s."""
    return np.where(depth > 0.0, np.maximum(0.0, k * depth + c * rate), 0.0)


def exact(acceleration, q0, times_s, method="DOP853", rtol=1e-10):
    """Coordinates and rates of a body that starts at rest; each of shape (n_dof, n_times)."""
    n = len(q0)
    found = solve_ivp(
        lambda t, y: [*y[n:], *acceleration(t, y[:n], y[n:])],
        (times_s[0], times_s[-1]),
        [*q0, *np.zeros(n)],
        method=method,
        t_eval=times_s,
        rtol=rtol,
        atol=1e-12,
        max_step=5e-3,  # not to step over a short contact
    )
    assert found.success
    return found.y[:n], found.y[n:]


def psnr_db(squares):
    return float(10.0 * np.log10(F_MAX_N**2 / np.mean(squares)))


def published(raw):
    """Frames as a sensor publishes them: mean of the last 10, limited to the range."""
    padded = np.concatenate([np.zeros((9, raw.shape[1])), raw])
    mean = np.stack([padded[i : i + 10].mean(axis=0) for i in range(len(raw))])
    return np.minimum(mean, F_MAX_N)


def compare(frames, expected):
    """Mean squared difference and mean square of the noise, in N^2, of each frame in contact."""
    noisy = NoiseModel().apply(frames.astype(np.float32), np.random.default_rng(0))
    touched = np.maximum(frames, expected).max(axis=1) > CONTACT_FRACTION * F_MAX_N
    return (
        ((frames - expected) ** 2).mean(axis=1)[touched],
        ((noisy - frames) ** 2).mean(axis=1)[touched],
    )


def counts(change, noise):
    """Frames that differ by more than their noise, and all in contact."""
    return np.count_nonzero(change > noise), change.size


def frames_of(source, n_frames):
    return np.stack([f.ravel() for _, f in itertools.islice(source, n_frames)]).astype(
        np.float64
    )


@pytest.mark.parametrize(
    (
        "name",
        "n_frames",
        "method",
        "change_db",
        "worst_db",
        "noise_db",
        "n_above",
        "n_contact",
    ),
    [
        ("lift_box_40", 685, "DOP853", 73.4, 63.6, 46.6, 0, 139),
        pytest.param(
            *("lift_wrench_40", 2951, "LSODA", 59.0, 40.8, 47.3, 50, 2325),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_body_lands_well(
    name, n_frames, method, change_db, worst_db, noise_db, n_above, n_contact
):
    source = open_scene(name, 0)
    body = source.scene.body
    state = next(source.states())
    reached = state.bed.gap < 0.1
    k, c, gap = (
        a[reached] for a in (state.bed.stiffness, state.bed.damping, state.bed.gap)
    )
    jacobian = state.bed.jacobian[reached]
    inertia = np.array([body.mass_kg, body.inertia_kg_m2])[: jacobian.shape[1]]

    def forces(q, v):
        return press(k, c, -gap - jacobian @ q, -jacobian @ v)

    def acceleration(t, q, v):
        found = jacobian.T @ forces(q, v) / inertia
        found[0] -= G_M_S2
        return list(found)

    start = [0.5, 0.0][: inertia.size]
    rtol = 1e-10 if method == "DOP853" else 1e-9
    q, v = exact(acceleration, start, 1e-3 * np.arange(n_frames), method, rtol)
    on_skin = np.flatnonzero(reached)
    taxels = state.taxels[on_skin[on_skin < state.taxels.size]]
    raw = np.zeros((n_frames, 1600))
    for i in range(n_frames):
        raw[i, taxels] = forces(q[:, i], v[:, i])[: taxels.size]
    change, noise = compare(frames_of(source, n_frames), published(raw))
    assert counts(change, noise) == pytest.approx((n_above, n_contact), abs=TIES)
    assert psnr_db(change) == pytest.approx(change_db, abs=0.1)
    assert psnr_db(noise) == pytest.approx(noise_db, abs=0.1)
    assert psnr_db(change.max()) == pytest.approx(worst_db, abs=0.1)


def test_tilted_body_lands_and_rocks_as_the_exact_solution():
    mass_kg = 0.5
    inertia_kg_m2 = 2e-4
    off_m = 0.004
    k = 122.24
    c = 0.4
    x = np.tile((np.arange(10) - 4.5) * 0.005, 10)
    body = RigidBody(
        np.array([mass_kg, inertia_kg_m2]),
        np.array([-mass_kg * G_M_S2, mass_kg * G_M_S2 * off_m]),
    )
    bed = Bed(
        np.full(100, k),
        np.full(100, c),
        np.zeros(100),
        np.stack([np.ones(100), -x], axis=1),
    )

    def acceleration(t, q, v):
        f = press(k, c, x * q[1] - q[0], x * v[1] - v[0])
        moment = mass_kg * G_M_S2 * off_m - f @ x
        return [f.sum() / mass_kg - G_M_S2, moment / inertia_kg_m2]

    dt_s = 5e-5
    n_steps = 4000
    expected, _ = exact(acceleration, [0.02, 0.2], dt_s * np.arange(n_steps + 1))
    q = np.array([0.02, 0.2])
    v = np.zeros(2)
    path = [q]
    for _ in range(n_steps):
        q, v = body.step(bed, q, v, dt_s)
        path.append(q)
    rebounds = np.flatnonzero(np.diff(np.sign(np.diff(expected[1]))))
    assert rebounds.size >= 2  # it has tipped from one side to the other and back
    error = np.abs(np.array(path).T - expected).max(axis=1)
    assert error[0] < 1e-6  # m, of 20 mm
    assert error[1] < 2.5e-5  # rad, of 0.35


def test_body_dragged_over_the_skin_follows_the_exact_solution():
    slope = 0.1
    speed_m_s = 0.05
    side_m = 0.07
    mass_kg = 0.3
    half = side_m / 2

    def wedge(x, y):
        inside = np.maximum(np.abs(x), np.abs(y)) <= half
        return np.where(inside, slope * (x + half), FAR_M)

    sole = build_sole([wedge], (-half, half, -half, half), 0.0)
    scene = Scene(
        name="wedge",
        shape=(6, 6),
        n_steps=6000,
        dt_ns=100_000,
        body=Body(sole, mass_kg, 1.0),
        surface=SKIN,
        drop_height_m=0.0,
        motion=Drag(at_s=0.1, velocity_m_s=(speed_m_s, 0.0)),
        place_m=(-0.01, 0.0),
    )
    x = np.tile((np.arange(6) - 2.5) * 0.005, 6)
    times_s = 1e-4 * np.arange(scene.n_steps)

    def acceleration(t, q, v):
        middle = -0.01 + speed_m_s * max(0.0, t - 0.1)
        depth = -(q[0] + slope * (x - middle + half))
        return [press(122.24, 0.4, depth, np.full(36, -v[0])).sum() / mass_kg - G_M_S2]

    expected, _ = exact(acceleration, [0.0], times_s)
    heights = [state.q[0] for state in SceneSource(scene, 0).states()]
    # one step of the drag
    assert np.abs(heights - expected[0]).max() < slope * speed_m_s * 1e-4
    assert expected[0].min() < -6e-3


@pytest.mark.parametrize(
    ("name", "n_steps", "deepest_mm", "largest_n", "published_n"),
    [
        ("lift_box_40", 400, 5.55, 1.21, 0.50),
        pytest.param(*("lift_box_64", 3400, 5.59, 1.25, 1.24), marks=pytest.mark.slow),
        ("lift_wrench_40", 400, 12.17, 2.06, 1.54),
        pytest.param(
            *("drag_wrench_64", 2400, 10.13, 1.47, 1.46), marks=pytest.mark.slow
        ),
    ],
)
def test_first_landing_is_as_stated(name, n_steps, deepest_mm, largest_n, published_n):
    source = open_scene(name, 0)
    deepest = 0.0
    largest = 0.0
    for state in itertools.islice(source.states(), n_steps):
        n = state.taxels.size
        deepest = max(
            deepest, -(state.bed.gap + state.bed.jacobian @ state.q)[:n].min()
        )
        largest = max(largest, state.bed.forces(state.q, state.v)[:n].max())
    assert 1e3 * deepest == pytest.approx(deepest_mm, abs=0.01)
    assert largest == pytest.approx(largest_n, abs=0.01)
    assert frames_of(source, n_steps).max() == pytest.approx(published_n, abs=0.01)


class ExactDisc(Sole):
    """The sole of the peg by exact distances: a disc of 10 mm radius, felt by spheres."""

    def sample(self, x, y):
        beyond = np.maximum(np.hypot(x, y) - 0.010, 0.0)
        flank = TAXEL_RADIUS_M - np.sqrt(np.maximum(TAXEL_RADIUS_M**2 - beyond**2, 0.0))
        return np.where(beyond < TAXEL_RADIUS_M, flank, FAR_M)


@pytest.mark.parametrize(
    ("n_frames", "change_db", "n_above", "n_contact"),
    [
        (1000, 49.5, 49, 341),
        pytest.param(12200, 64.5, 49, 11541, marks=pytest.mark.slow),
    ],
)
def test_height_map_of_the_peg_lacks_one_taxel_of_19(
    n_frames, change_db, n_above, n_contact
):
    scene = SCENES["path_40"]()
    sole = metal_peg(TAXEL_RADIUS_M).sole
    body = replace(scene.body, sole=ExactDisc(sole.heights, sole.x_min, sole.y_min))
    frames = frames_of(open_scene("path_40", 0), n_frames)
    expected = frames_of(SceneSource(replace(scene, body=body), 0), n_frames)
    pressed = [
        np.count_nonzero(f.max(axis=0)) for f in (frames[320:330], expected[320:330])
    ]
    assert pressed == [18, 19]
    change, noise = compare(frames, expected)
    assert counts(change, noise) == pytest.approx((n_above, n_contact), abs=TIES)
    assert psnr_db(change) == pytest.approx(change_db, abs=0.1)
    assert psnr_db(change.max()) == pytest.approx(37.1, abs=0.1)
    assert psnr_db(noise) == pytest.approx(47.9, abs=0.1)


@pytest.mark.slow
def test_height_map_of_the_wrench_on_a_finer_grid_changes_214_frames_of_2362(
    monkeypatch,
):
    monkeypatch.setattr(bodies, "GRID_M", 0.000125)
    wrench = bodies.monkey_wrench.__wrapped__(TAXEL_RADIUS_M)
    body = replace(wrench, sole=replace(wrench.sole, grid_m=0.000125))
    source = open_scene("lift_wrench_40", 0)
    finer = SceneSource(replace(source.scene, body=body), 0)
    change, noise = compare(frames_of(source, 3000), frames_of(finer, 3000))
    assert counts(change, noise) == pytest.approx((214, 2362), abs=TIES)
    assert psnr_db(change) == pytest.approx(51.3, abs=0.1)
    assert psnr_db(noise) == pytest.approx(47.3, abs=0.1)
