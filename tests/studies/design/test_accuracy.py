"""Accuracy of a design: what is simulated, found lightly touched, and interpolated."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.studies.design.accuracy import accuracy, simulate
from sparseskin.studies.design.grid import GRID_FILE, stored_grid
from sparseskin.studies.design.simulation import (
    ACTIVE,
    F_MAX_N,
    N_SCENES,
    N_UNTOUCHED,
    SCENE_S,
    contact_db,
    light_touch,
    make_reader,
    presses,
)
from sparseskin.studies.design.strategies import STRATEGIES

ALL = np.ones((12, 12), dtype=np.bool_)


@pytest.mark.parametrize("rate_hz", [30.0, 300.0])
def test_a_body_touches_the_skin_in_every_scene_at_any_rate(rate_hz: float) -> None:
    for scene in range(N_SCENES):
        frames = [truth for truth, _ in presses(scene, ALL, 0.01, rate_hz, seed=0)]
        assert len(frames) == N_UNTOUCHED + round(SCENE_S * rate_hz)
        assert not np.any(frames[:N_UNTOUCHED])
        touched = [np.count_nonzero(truth) for truth in frames]
        assert 1 <= max(touched) <= 2.5 * ACTIVE[1] * ALL.size


def test_a_scene_takes_the_same_time_at_all_rates() -> None:
    slow, fast = (
        [truth.sum() for truth, _ in presses(1, ALL, 0.01, rate, seed=0)][N_UNTOUCHED:]
        for rate in (100.0, 1000.0)
    )
    # Ramped: the force rises within 50 ms, and is 0 again after 100.
    assert np.argmax(slow) == pytest.approx(4, abs=1)
    assert np.argmax(fast) == pytest.approx(49, abs=2)
    assert slow[10] == fast[101] == 0


def test_readings_held_in_turn_are_those_of_a_raster_once_all_taxels_were_read() -> None:
    taxels = np.random.default_rng(0).uniform(0, F_MAX_N, ALL.shape).astype(np.float32)
    raster = make_reader(STRATEGIES["full"], ALL, 0.01, 8, seed=0)
    held = make_reader(STRATEGIES["one_hot_rotating"], ALL, 0.01, 8, seed=0)
    whole = raster.read(taxels)
    parts = [held.read(taxels) for _ in range(4)]
    assert [np.count_nonzero(part) for part in parts] == [36, 72, 108, 144]
    np.testing.assert_array_equal(parts[-1], whole)
    # Steps of 1/255 of the range.
    assert np.abs(whole - taxels).max() <= 0.5 * F_MAX_N / 255 * 1.001
    assert raster.step_sd == pytest.approx(np.std(whole - taxels), rel=0.15)


@pytest.mark.parametrize("strategy", ["full", "sbhe_3_rotating", "adaptive"])
def test_many_bits_and_no_noise_leave_what_the_strategy_loses(strategy: str) -> None:
    frames = list(presses(1, ALL, 1e-4, 100.0, seed=0))
    db, rounding = contact_db(make_reader(STRATEGIES[strategy], ALL, 1e-4, 16, 0), iter(frames))
    coarse, coarser = contact_db(make_reader(STRATEGIES[strategy], ALL, 1e-4, 5, 0), iter(frames))
    assert np.mean(db) > np.mean(coarse)
    assert coarser > 1000 * rounding
    if strategy == "full":
        assert np.mean(db) > 75


def test_frames_without_contact_are_refused() -> None:
    reader = make_reader(STRATEGIES["full"], ALL, 0.01, 8, seed=0)
    frames = list(presses(0, ALL, 0.01, 100.0, seed=0))[:N_UNTOUCHED]
    with pytest.raises(SettingsError, match="nothing touches the skin"):
        contact_db(reader, frames)


def test_the_light_touch_of_a_raster_grows_with_the_noise() -> None:
    def found(noise: float) -> float:
        reader = make_reader(STRATEGIES["full"], ALL, noise, 24, seed=0)
        touch = light_touch(reader, ALL, noise, seed=0)
        assert touch is not None
        return touch

    # The same draws, and no rounding: in units of the noise it is the same.
    assert found(0.01) == pytest.approx(10 * found(0.001))
    # The mean of 9 readings has a third of their noise, and 3 x 3 untouched taxels reach some
    # standard deviations of it.
    assert 0.5 < found(0.01) / 0.01 < 3


def test_no_light_touch_is_found_by_a_reader_that_sees_nothing() -> None:
    class Blind:
        step_sd = 0.0

        def read(self, taxels: Floats) -> Floats:
            return np.zeros_like(taxels)

    assert light_touch(Blind(), ALL, 0.01, seed=0) is None


def test_the_grid_is_small_and_has_every_strategy() -> None:
    assert GRID_FILE.stat().st_size < 100_000
    assert set(stored_grid().tables) == set(STRATEGIES)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_at_points_of_the_grid_its_figures_are_returned(strategy: str) -> None:
    grid = stored_grid()
    axes, table = grid.axes, grid.tables[strategy]
    for i, n in enumerate(axes.n_taxels):
        for k, noise in enumerate(axes.noise):
            found = accuracy(strategy, n, noise, axes.bits, axes.rate_hz)
            assert found.psnr_db == pytest.approx(table.db[i, k], abs=1e-6)
            assert found.low_db == pytest.approx(table.low_db[i, k] - table.error_db, abs=1e-6)
            assert found.high_db == pytest.approx(table.high_db[i, k] + table.error_db, abs=1e-6)
            assert (found.interpolated, found.note) == (True, "")


def test_the_full_raster_has_the_error_of_clipped_noise() -> None:
    # Noise s clipped at 0 has a mean square of s^2 / 2 on untouched taxels, and s^2 on touched
    # ones: PSNR lies 0 to 3 dB above -20 log10(s).
    grid = stored_grid()
    for n in grid.axes.n_taxels:
        for noise in grid.axes.noise:
            found = accuracy("full", n, noise, 16, 100)
            above = found.psnr_db + 20 * math.log10(noise)
            assert 0 < above < 3.1


@pytest.mark.parametrize(
    "strategy",
    # Others lose so much to few measurements that a little noise makes no difference.
    ["full", "one_hot_rotating", "sbhe_3_fixed", "sbhe_3_rotating", "sbhe_4_rotating", "adaptive"],
)
def test_accuracy_falls_with_noise_and_with_fewer_bits(strategy: str) -> None:
    for n in (100, 1000, 4000):
        noises = np.geomspace(0.001, 0.03, 9)
        found = [accuracy(strategy, n, float(noise), 16, 100) for noise in noises]
        assert np.all(np.diff([one.psnr_db for one in found]) < 0)
        assert np.all(np.diff([one.light_touch for one in found]) > 0)
        dbs = [accuracy(strategy, n, 0.002, bits, 100).psnr_db for bits in range(6, 17)]
        assert np.all(np.diff(dbs) >= 0)


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_accuracy_falls_with_fewer_measurements(rows: str) -> None:
    for n in (256, 1024, 4096):
        dbs = [accuracy(f"sbhe_{k}_{rows}", n, 0.003, 16, 100).psnr_db for k in (3, 4, 8, 16)]
        assert np.all(np.diff(dbs) < 0)


@pytest.mark.parametrize("strategy", ["one_hot_rotating", "adaptive"])
def test_bodies_that_move_farther_from_frame_to_frame_are_followed_less(strategy: str) -> None:
    dbs = [accuracy(strategy, 1024, 0.003, 16, rate).psnr_db for rate in (30, 60, 100, 200, 300)]
    assert np.all(np.diff(dbs) > 0)


@pytest.mark.parametrize(
    ("n", "noise", "rate_hz", "named"),
    [
        (32, 0.01, 100.0, "taxels"),
        (10_000, 0.01, 100.0, "taxels"),
        (1024, 0.06, 100.0, "noise"),
        (1024, 0.0005, 100.0, "noise"),
        (1024, 0.01, 10.0, "Hz"),
        (1024, 0.01, 5000.0, "Hz"),
    ],
)
def test_what_lies_outside_the_grid_is_stated(
    n: int, noise: float, rate_hz: float, named: str
) -> None:
    found = accuracy("sbhe_4_rotating", n, noise, 16, rate_hz)
    assert found.note.startswith("extrapolated beyond")
    assert found.note.count(named) == 1
    assert found.low_db < found.psnr_db < found.high_db


@pytest.mark.parametrize(
    ("n", "noise", "rate_hz"), [(4, 0.01, 100.0), (100_000, 0.01, 100.0), (1024, 0.2, 100.0)]
)
def test_far_outside_the_grid_no_figure_is_stated(n: int, noise: float, rate_hz: float) -> None:
    found = accuracy("sbhe_4_rotating", n, noise, 16, rate_hz)
    assert found.note.startswith("not available")
    assert math.isnan(found.psnr_db)
    assert math.isnan(found.light_touch)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("sbhe_5_fixed", 1024, 0.01, 16, 100.0), "strategy"),
        (("full", 0, 0.01, 16, 100.0), "taxels"),
        (("full", 1024, math.nan, 16, 100.0), "noise"),
        (("full", 1024, 0.5, 16, 100.0), "noise"),
        (("full", 1024, 0.01, 1, 100.0), "bits"),
        (("full", 1024, 0.01, 16, 0.0), "rate"),
        (("full", 1024, 0.01, 16, 100.0, 0.0), "aspect"),
    ],
)
def test_an_argument_that_is_not_allowed_is_named(arguments: tuple[Any, ...], named: str) -> None:
    with pytest.raises(SettingsError, match=f"^{named}: .*(allowed|did you mean)") as caught:
        accuracy(*arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("strategy", ["full", "sbhe_4_rotating"])
def test_a_simulation_between_points_of_the_grid_lies_in_its_band(strategy: str) -> None:
    conditions = (0.005, 12, 80.0)
    found = simulate(strategy, 12, 12, *conditions, seed=1, scene="gaussian")
    stated = accuracy(strategy, 144, *conditions)
    assert stated.note == ""
    assert stated.low_db < found.psnr_db < stated.high_db
    assert (found.interpolated, found.note) == (False, "")
    assert 0.4 < found.light_touch / stated.light_touch < 2.5


@pytest.mark.slow
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_scenes_on_a_skin_that_is_not_square_lie_in_the_band_of_each_strategy(
    strategy: str,
) -> None:
    mask = np.ones((10, 20), dtype=np.bool_)
    stated = accuracy(strategy, mask.size, 0.005, 12, 80.0, aspect=2.0)
    for scene in (0, 1, 2):
        reader = make_reader(STRATEGIES[strategy], mask, 0.005, 12, seed=scene)
        dbs, _ = contact_db(reader, presses(scene, mask, 0.005, 80.0, seed=7))
        assert stated.low_db < np.mean(dbs) < stated.high_db


def test_a_recording_is_simulated_as_the_scene(tmp_path: Path) -> None:
    frames = np.zeros((40, 6, 6), dtype=np.float32)
    frames[10:, 2:4, 2:5] = 3.0
    np.savez(tmp_path / "press.npz", forces=frames, rate_hz=200.0, f_max=5.0)
    scene = f"file:{tmp_path / 'press.npz'}"
    found = simulate("full", 6, 6, 0.01, 16, 100.0, 0, scene)
    # Noise alone, clipped at 0 on 30 of 36 taxels.
    assert found.psnr_db == pytest.approx(40 - 10 * math.log10(1 - 0.5 * 30 / 36), abs=0.7)
    assert simulate("full", 6, 6, 0.01, 16, 500.0, 0, scene).note.startswith("the scene has 200 Hz")
    with pytest.raises(
        SettingsError, match="its skin has 36 taxels on 6 x 6; expected 42 on 6 x 7"
    ):
        simulate("full", 6, 7, 0.01, 16, 100.0, 0, scene)


@pytest.mark.parametrize(
    ("shape", "seed", "scene", "named"),
    [
        ((0, 5), 0, None, "taxels"),
        ((500, 500), 0, None, "taxels"),
        ((5, 5), -1, None, "seed"),
        ((5, 5), 0, "cube", "scene"),
    ],
)
def test_a_simulation_that_is_not_possible_is_refused(
    shape: tuple[int, int], seed: int, scene: str | None, named: str
) -> None:
    with pytest.raises(SettingsError, match=f"^{named}: "):
        simulate("full", *shape, 0.01, 16, 100.0, seed, scene)
