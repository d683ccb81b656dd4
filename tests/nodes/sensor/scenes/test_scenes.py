"""The six scenes: their table, their physics, and the bodies in them."""

import itertools
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from sparseskin.nodes.sensor.scenes.contact import GRAVITY_M_S2
from sparseskin.nodes.sensor.scenes.scenes import SCENES, open_scene

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
    """Largest force and sum of each frame of a scene, and one frame of the body at rest."""

    peak: npt.NDArray[np.float64]
    total: npt.NDArray[np.float64]
    at_rest: npt.NDArray[np.float32]


REST = {"lift_box_40": 670, "lift_box_64": 7500, "path_40": 990}


@cache
def played(name):
    side, n_steps, _ = TABLE[name]
    peak, total, at_rest = np.empty(n_steps), np.empty(n_steps), np.empty(0, np.float32)
    for step, (_, forces) in enumerate(open_scene(name, 0)):
        assert (forces.dtype, forces.shape) == (np.float32, (side, side))
        assert forces.min() >= 0.0
        peak[step], total[step] = forces.max(), forces.sum(dtype=float)
        if step == REST.get(name):
            at_rest = forces
    assert step == n_steps - 1
    return Played(peak, total, at_rest)


@pytest.mark.parametrize("name", SCENES)
def test_scene_has_the_properties_of_the_table(name):
    side, n_steps, dt_ns = TABLE[name]
    source = open_scene(name, 0)
    assert source.skin.shape == (side, side)
    assert (source.skin.f_max, source.skin.unit, source.skin.pitch_m) == (2.5, "N", 0.005)
    assert (source.name, source.delivers, source.n_frames) == (name, "truth", n_steps)
    assert source.rate_hz == pytest.approx(1e9 / dt_ns)
    stamps = [stamp for stamp, _ in itertools.islice(source, 5)]
    assert stamps == [dt_ns * step for step in range(5)]


@pytest.mark.parametrize(
    "name", [n if n == "lift_box_40" else pytest.param(n, marks=pytest.mark.slow) for n in TABLE]
)
def test_whole_scene_starts_untouched_touches_stays_in_range_and_all_but_path_ends_untouched(name):
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


@pytest.mark.parametrize(
    ("name", "mass_kg"),
    [
        ("lift_box_40", 0.5167),
        pytest.param("lift_box_64", 0.5167, marks=pytest.mark.slow),
        pytest.param("path_40", 2700 * math.pi * 0.01**2 * 0.06, marks=pytest.mark.slow),
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
