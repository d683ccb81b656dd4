"""The grid of accuracy: interpolation, its file, and the study that makes it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparseskin.studies.design import grid_study
from sparseskin.studies.design.grid import (
    Axes,
    Grid,
    band,
    base_cells,
    made_grid,
    narrow_cells,
    rate_cells,
    steps,
    stored_grid,
    touch_cells,
    write_grid,
)
from sparseskin.studies.design.simulation import scene_accuracy
from sparseskin.studies.design.strategies import STRATEGIES

AXES = Axes(
    sides=(8, 16, 32),
    noise=(0.001, 0.01),
    rate_hz=100.0,
    bits=16,
    n_scenes=2,
    rate_sides=(8, 32),
    rate_noise=(0.001, 0.01),
    rates_hz=(20.0, 500.0),
    rate_scenes=1,
    touch_sides=(8, 32),
    touch_noise=(0.01,),
    narrow_sides=(8, 32),
    narrow_noise=(0.001, 0.01),
    narrow=4,
)
ROUNDING = 1e-6


def law_db(n: float, noise: float, rate_hz: float, aspect: float = 1.0) -> float:
    """A PSNR that is linear in the logarithms."""
    of_frames = 3 * math.log(rate_hz / 100) + 1.5 * math.log(aspect)
    return 10 + 2 * math.log(n) - 7 * math.log(noise) + of_frames


def law_touch(n: float, noise: float) -> float:
    return noise * n**0.2


def scenes_of(point: dict[str, Any]) -> dict[str, Any]:
    n = math.prod(point["shape"])
    aspect = point["shape"][1] / point["shape"][0]
    db = law_db(n, point["noise"], point["rate_hz"], aspect) + (1 if point["scene"] % 2 else -1)
    rounding = {
        name: ROUNDING * steps(name, point["bits"]) / steps(name, 16) for name in STRATEGIES
    }
    return {name: [db, rounding[name]] for name in STRATEGIES}


def touches_of(point: dict[str, Any]) -> dict[str, Any]:
    n = math.prod(point["shape"])
    return dict.fromkeys(STRATEGIES, law_touch(n, point["noise"]))


@pytest.fixture
def grid() -> Grid:
    return made_grid(
        AXES,
        [[scenes_of({**cell, "scene": k}) for k in range(2)] for cell in base_cells(AXES)],
        [[scenes_of({**cell, "scene": 0})] for cell in rate_cells(AXES)],
        [[scenes_of({**cell, "scene": 0})] for cell in narrow_cells(AXES)],
        [touches_of(cell) for cell in touch_cells(AXES)],
    )


@pytest.mark.parametrize(
    ("n", "noise", "rate_hz", "beyond"),
    [
        (64, 0.001, 100.0, ()),
        (500, 0.004, 50.0, ()),
        (900, 0.009, 400.0, ()),
        (3000, 0.002, 100.0, ("taxels",)),
        (100, 0.03, 100.0, ("noise",)),
        (100, 0.003, 7.0, ("rate",)),
        (20, 0.0005, 100.0, ("taxels", "noise")),
    ],
)
def test_a_law_linear_in_the_logarithms_is_interpolated_and_continued_exactly(
    grid: Grid, n: int, noise: float, rate_hz: float, beyond: tuple[str, ...]
) -> None:
    found = grid.at("sbhe_4_fixed", n, noise, 16, rate_hz)
    assert found is not None
    assert found.db == pytest.approx(law_db(n, noise, rate_hz), abs=1e-6)
    assert found.low_db + found.high_db == pytest.approx(2 * found.db)
    assert found.beyond == beyond
    if "taxels" not in beyond:
        assert found.touch == pytest.approx(law_touch(n, noise), rel=1e-6)


@pytest.mark.parametrize(
    ("aspect", "known", "beyond"),
    [
        (32 / 12, 32 / 12, ()),
        (0.25, 0.25, ()),
        (6.0, 6.0, ("shape",)),
        (1 / 128, 1 / 16, ("shape",)),
    ],
)
def test_a_narrow_skin_has_the_effect_of_its_shape_up_to_four_times_beyond_the_grid(
    grid: Grid, aspect: float, known: float, beyond: tuple[str, ...]
) -> None:
    found = grid.at("row_local", 384, 0.004, 16, 200.0, aspect)
    assert found is not None
    assert found.db == pytest.approx(law_db(384, 0.004, 200.0, known), abs=1e-6)
    assert found.beyond == beyond


@pytest.mark.parametrize("strategy", ["full", "sbhe_4_fixed"])
def test_rounding_counts_as_noise(grid: Grid, strategy: str) -> None:
    bits = 7
    rounding = ROUNDING * steps(strategy, bits) / steps(strategy, 16)
    effective = math.hypot(0.002, rounding)
    found = grid.at(strategy, 256, 0.002, bits, 100.0)
    assert found is not None
    assert found.db == pytest.approx(law_db(256, effective, 100.0), abs=1e-5)
    # A frame of a light touch alone has small steps where sums are scaled by their largest.
    rounded = effective if strategy == "full" else 0.002
    assert found.touch == pytest.approx(law_touch(256, rounded), rel=1e-5)


def test_more_than_four_times_outside_nothing_is_known_but_a_higher_rate_has_the_highest_ones(
    grid: Grid,
) -> None:
    assert grid.at("full", 15, 0.005, 16, 100.0) is None
    assert grid.at("full", 64, 0.05, 16, 100.0) is None
    assert grid.at("full", 64, 0.005, 16, 4.0) is None
    fast = grid.at("full", 64, 0.005, 16, 1e4)
    assert fast is not None
    assert fast.db == pytest.approx(law_db(64, 0.005, 500.0), abs=1e-6)
    assert fast.beyond == ("rate",)


def test_a_touch_of_more_than_the_range_or_one_never_found_is_not_stated(grid: Grid) -> None:
    table = replace(grid.tables["full"], touch=np.full((2, 1), 200.0))
    strong = replace(grid, tables={"full": table})
    found = strong.at("full", 64, 0.01, 16, 100.0)
    assert found is not None
    assert math.isnan(found.touch)
    lost = replace(grid, tables={"full": replace(table, touch=np.full((2, 1), math.nan))})
    found = lost.at("full", 64, 0.01, 16, 100.0)
    assert found is not None
    assert math.isnan(found.touch)


def test_the_band_holds_a_further_scene_in_nine_of_ten_cases() -> None:
    rng = np.random.default_rng(0)
    low, high = band(rng.normal(40, 3, (4000, 6)))
    further = rng.normal(40, 3, 4000)
    assert np.mean((low < further) & (further < high)) == pytest.approx(0.9, abs=0.02)


def test_a_grid_is_read_as_it_was_written(grid: Grid, tmp_path: Path) -> None:
    table = replace(grid.tables["full"], error_db=1.25, touch=np.array([[math.nan], [2.0]]))
    tables = {**grid.tables, "full": table}
    write_grid(tmp_path / "grid.json", Grid(AXES, tables))
    found = stored_grid(tmp_path / "grid.json")
    assert found.axes == AXES
    assert list(found.tables) == list(STRATEGIES)
    for name, one in tables.items():
        for key, value in vars(one).items():
            np.testing.assert_allclose(vars(found.tables[name])[key], value, rtol=1e-5)
    # Plain JSON, without NaN.
    json.loads((tmp_path / "grid.json").read_text(), parse_constant=pytest.fail)


def test_the_study_writes_grid_and_page_and_prints_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def computed(function: Any, points: list[Any], *_: Any) -> list[Any]:
        return [(scenes_of if function is scene_accuracy else touches_of)(one) for one in points]

    monkeypatch.setattr(grid_study, "compute", computed)
    grid_study.run(tmp_path, quick=False, seed=0, executor="serial")
    grid = stored_grid(tmp_path / "grid.json")
    assert grid.axes == grid_study.AXES
    # The simulated figures follow the law in noise, not in noise and rounding.
    assert all(table.error_db < 0.1 for table in grid.tables.values())
    # On 48 x 12 taxels the law lies 1.5 ln 4 below that of a square; on 12 x 32 it lies above.
    out = capsys.readouterr().out
    assert "0.0 dB in the mean, 0." in out
    lost = np.mean([1.5 * abs(math.log(b / a)) for (a, b), *_ in grid_study.HELD_OUT if a != b])
    assert f"not square: 0.0 dB in the mean; {lost:.1f} dB without" in out
    page = (tmp_path / "design-grid.md").read_text()
    for name in ("held_out.csv", "grid.png", "grid.svg", "grid.json"):
        assert (tmp_path / name).stat().st_size > 100
        assert name in page
    assert "48 x 48" in page
