"""The six scenes: their table, their physics, and the bodies in them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.scenes.bodies import FAR_M, build_sole, monkey_wrench, slab
from sparseskin.nodes.sensor.scenes.contact import GRAVITY_M_S2
from sparseskin.nodes.sensor.scenes.motion import RandomPath
from sparseskin.nodes.sensor.scenes.scenes import SCENES, open_scene
from sparseskin.nodes.sensor.scenes.simulation import MovingAverage

TABLE = {
    "lift_box_40": (40, 700, 1_000_000),
    "lift_wrench_40": (40, 3000, 1_000_000),
    "drag_wrench_40": (40, 5000, 1_000_000),
    "path_40": (40, 12200, 1_000_000),
    "lift_box_64": (64, 7600, 100_000),
    "drag_wrench_64": (64, 12600, 100_000),
}


@dataclass
class Played:
    """All frames of a scene: their largest force and their sum, each of shape (n_steps,), and one
    frame at which the body has come to rest, just before it is moved.
    """

    peak: npt.NDArray[np.float64]
    total: npt.NDArray[np.float64]
    at_rest: npt.NDArray[np.float32]


REST = {"lift_box_40": 670, "lift_box_64": 7500, "path_40": 990}


@cache
def played(name: str) -> Played:
    side, n_steps, _ = TABLE[name]
    peak, total, at_rest = np.empty(n_steps), np.empty(n_steps), np.empty(0, np.float32)
    for step, (_, forces) in enumerate(open_scene(name, 0)):
        assert forces.dtype == np.float32
        assert forces.shape == (side, side)
        assert forces.min() >= 0.0
        peak[step], total[step] = forces.max(), forces.sum(dtype=float)
        if step == REST.get(name):
            at_rest = forces
    assert step == n_steps - 1
    return Played(peak, total, at_rest)


def frames(name: str, start: int, stop: int, seed: int = 0) -> list[npt.NDArray[np.float32]]:
    return [f for _, f in itertools.islice(open_scene(name, seed), start, stop)]


@pytest.mark.parametrize("name", SCENES)
def test_scene_has_the_properties_of_the_table(name: str) -> None:
    side, n_steps, dt_ns = TABLE[name]
    source = open_scene(name, 0)
    assert source.skin.shape == (side, side)
    assert (source.skin.f_max, source.skin.unit, source.skin.pitch_m) == (2.5, "N", 0.005)
    assert (source.name, source.delivers, source.n_frames) == (name, "truth", n_steps)
    assert source.rate_hz == pytest.approx(1e9 / dt_ns)
    stamps = [stamp for stamp, _ in itertools.islice(source, 5)]
    assert stamps == [dt_ns * step for step in range(5)]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n == "drag_wrench_64" else n for n in TABLE]
)
def test_whole_scene_starts_untouched_touches_stays_in_range_and_all_but_path_ends_untouched(
    name: str,
) -> None:
    peak = played(name).peak
    assert np.isfinite(played(name).total).all()
    assert peak.max() <= 2.5
    assert peak[0] == 0.0
    # The run ends as the contact does, and not a tenth of it later.
    assert (peak[-1] > 0.0) == (name == "path_40")
    assert peak[-len(peak) // 10 :].any()


@pytest.mark.parametrize("name", ["lift_box_40", "path_40"])
def test_same_seed_gives_the_same_frames_at_each_playing(name: str) -> None:
    source = open_scene(name, 7)
    first = [f for _, f in itertools.islice(source, 400)]
    again = [f for _, f in itertools.islice(source, 400)]
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, frames(name, 0, 400, seed=7))


def test_another_seed_drops_the_peg_elsewhere() -> None:
    (first,), (other,) = (frames("path_40", 990, 991, seed=seed) for seed in (0, 1))
    assert first.any()
    assert other.any()
    assert not np.array_equal(first > 0, other > 0)


def test_a_yielded_frame_is_never_modified_later() -> None:
    kept, copies = [], []
    for _, forces in itertools.islice(open_scene("lift_box_40", 0), 310, 360):
        kept.append(forces)
        copies.append(forces.copy())
    np.testing.assert_array_equal(kept, copies)


@pytest.mark.parametrize(
    ("name", "mass_kg"),
    [
        ("lift_box_40", 0.5167),
        ("lift_box_64", 0.5167),
        ("path_40", 2700 * math.pi * 0.01**2 * 0.06),
    ],
)
def test_forces_at_rest_carry_the_weight_and_those_of_the_box_evenly(
    name: str, mass_kg: float
) -> None:
    forces = played(name).at_rest
    assert forces.sum(dtype=float) == pytest.approx(mass_kg * GRAVITY_M_S2, rel=0.01)
    if name != "path_40":
        rows, cols = np.nonzero(forces)
        assert np.count_nonzero(forces) == 400
        assert np.ptp(rows) == np.ptp(cols) == 19
        assert np.ptp(forces[forces > 0]) <= 1e-6


def test_ground_takes_its_part_as_the_wrench_leaves_the_skin() -> None:
    weight = 1.0 * GRAVITY_M_S2
    mean = played("drag_wrench_40").total[4700:4900].mean()
    assert 0.0 < mean < 0.5 * weight


def test_a_random_path_fills_its_rectangle_at_constant_speed_and_lasts_to_its_end() -> None:
    rng = np.random.default_rng(0)
    places = []
    for _ in range(200):
        place, course = RandomPath(at_s=0.0, speed_m_s=0.05).draw(rng, 0.09, 0.04, end_s=3.0)
        assert course.times_s[-1] > 3.0 >= course.times_s[-2]
        assert course.offsets_m[0] == (0.0, 0.0)
        places += [np.add(place, offset) for offset in course.offsets_m]
        lengths = np.hypot(*np.diff(course.offsets_m, axis=0).T)
        np.testing.assert_allclose(lengths, 0.05 * np.diff(course.times_s))
    assert (np.abs(places) <= [0.09, 0.04]).all()
    # Uniform: mean 0, and standard deviation half a side by sqrt(3).
    np.testing.assert_allclose(np.mean(places, axis=0), 0.0, atol=0.01)
    np.testing.assert_allclose(np.std(places, axis=0), np.array([0.09, 0.04]) / 3**0.5, rtol=0.1)


def test_wrench_has_the_extent_of_the_mesh() -> None:
    sole = monkey_wrench(0.0).sole
    rows, cols = np.nonzero(sole.heights < FAR_M)
    x = sole.x_min + sole.grid_m * cols
    y = sole.y_min + sole.grid_m * rows
    found = [x.min(), x.max(), y.min(), y.max()]
    np.testing.assert_allclose(found, [-0.2028, 0.1879, -0.0294, 0.0540], atol=0.001)


def test_wrench_stands_on_the_wheels_rim_and_the_handles_end() -> None:
    sole = monkey_wrench(0.0).sole
    x = np.array([-0.0763, 0.1796, 0.1840, -0.1850, -0.1150, 0.0])
    y = np.array([-0.0058, 0.0101, 0.0141, 0.0300, 0.0300, 0.0])
    heights = sole.sample(x, y)
    np.testing.assert_allclose(heights[:3], 0.0, atol=1e-4)
    np.testing.assert_allclose(heights[3:], [0.0026, 0.0026, 0.0050], atol=1e-6)
    assert sole.heights.min() >= 0.0
    lowest_rows, lowest_cols = np.nonzero(sole.heights < 1e-4)
    lowest_x = sole.x_min + sole.grid_m * lowest_cols
    assert np.all((np.abs(lowest_x + 0.0758) < 0.006) | (np.abs(lowest_x - 0.1818) < 0.004))
    assert lowest_rows.size > 0


def test_edge_of_a_body_is_felt_by_the_flank_of_a_taxel() -> None:
    radius = 0.0025
    sole = build_sole([slab(-0.01, 0.01, -0.01, 0.01, 0.0)], (-0.01, 0.01, -0.01, 0.01), radius)
    beyond = np.array([0.0, 0.0005, 0.0010, 0.0015, 0.0020])
    felt = sole.sample(0.01 + beyond, np.zeros(5))
    np.testing.assert_allclose(felt, radius - np.sqrt(radius**2 - beyond**2), atol=1e-9)
    assert sole.sample(np.array([0.0125, 0.02]), np.zeros(2)).min() > 0.1


def test_moving_average_of_a_taxel_let_go_is_exactly_zero() -> None:
    average = MovingAverage(3, (1, 1))
    for value in (0.1, 0.7, 1e-6, 0.0, 0.0, 0.0):
        average.newest[:] = value
        last = average.step()
    assert last[0, 0] == 0.0


@pytest.mark.parametrize(
    ("name", "hint"),
    [("lift_bx_40", "did you mean 'lift_box_40'?"), ("zzz", "(known: drag_wrench_40, ")],
)
def test_unknown_scene_is_an_error_with_a_hint(name: str, hint: str) -> None:
    with pytest.raises(SourceError) as error:
        open_scene(name, 0)
    assert repr(name) in str(error.value)
    assert hint in str(error.value)
