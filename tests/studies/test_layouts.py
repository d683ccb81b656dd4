"""The study of skins of points: within 1 dB of the grid, and its page."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.nodes.sensor.layouts.files import load_points
from sparseskin.studies.layouts.study import conclusion, grid_figures, grid_points
from sparseskin.studies.layouts.ways import WAYS, bisected, placed_by, shuffled

pd = pytest.importorskip("pandas")


def test_points_of_a_small_grid_are_within_1_db_of_it() -> None:
    """Means over three draws: another Phi alone changes a figure by about 1 dB."""
    found = [
        grid_figures(
            {
                "side": 24,
                "removed": 0.2,
                "body": "plate",
                "ratio": 3,
                "n_frames": 50,
                "seed": seed,
            }
        )
        for seed in range(3)
    ]
    for preset in ("paper", "skin"):
        loss = np.mean([one["grid"][preset] - one["placed"][preset] for one in found])
        assert loss < 1
        alone = np.mean([one["grid"][preset] - one["file order"][preset] for one in found])
        assert alone > loss + 1


def test_each_way_gives_each_point_a_cell_of_its_own() -> None:
    points = load_points("example:triangles")
    for way in WAYS:
        placement = placed_by(way, points)
        assert len(np.unique(placement.cells)) == points.n
        assert placement.cells.max() < np.prod(placement.shape)


def test_halving_a_full_grid_finds_it_again() -> None:
    points = grid_points(16, np.ones((16, 16), np.bool_))
    found = bisected(points)
    assert found.shape == (16, 16)
    row, col = np.divmod(found.cells, 16)
    places = points.places[:, :2] / 0.005
    # Up to a turn by a quarter, cells are places.
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.allclose(np.hypot(np.diff(row), np.diff(col)), steps)


def test_shuffled_points_are_the_same_points_turned() -> None:
    points = load_points("example:grip")
    moved, order = shuffled(points, 3)
    assert sorted(order) == list(range(points.n))
    before = np.linalg.norm(points.places[order][0] - points.places[order], axis=1)
    assert np.allclose(np.linalg.norm(moved.places[0] - moved.places, axis=1), before)


def test_the_conclusion_states_the_loss_of_each_preset() -> None:
    keys = {"side": 40, "removed": 0.1, "body": "plate", "ratio": 3}
    values = {"grid": 40.0, "placed": 39.5, "bisected": 38.0, "file order": 30.0}
    rows = [
        {**keys, "seed": seed, "way": way, "paper": db, "skin": db + 5}
        for seed in (0, 1)
        for way, db in values.items()
    ]
    first, second = conclusion(pd.DataFrame(rows))
    assert "lose 0.50 dB (standard error 0.00)" in first
    assert "bisected 2.00 dB, in file order 10.00 dB" in second
