"""Points on a virtual grid: each has a cell of its own, and neighbours remain neighbours."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.errors import SourceError
from sparseskin.plugins.points.examples import grip, torso
from sparseskin.plugins.points.files import Points, estimated_normals
from sparseskin.plugins.points.placing import place

UP = np.array([0.0, 0.0, 1.0])


def points(places, normals=None):
    n = len(places)
    return Points("test", places, estimated_normals(places) if normals is None else normals,
                  np.arange(n), n)  # fmt: skip


def adjacent(placement):
    """Distances in space of all pairs in neighbouring cells, in those of neighbours on the skin."""
    number = np.full(placement.shape, -1)
    number.reshape(-1)[placement.cells] = np.arange(placement.points.n)
    found = []
    for a, b in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1])):
        both = (a >= 0) & (b >= 0)
        steps = placement.points.places[a[both]] - placement.points.places[b[both]]
        found.append(np.linalg.norm(steps, axis=1))
    return np.concatenate(found) / placement.pitch_m


def turned(places, seed):
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return places @ (axes * [np.sign(np.linalg.det(axes)), 1, 1]).T


@given(st.integers(1, 120), st.integers(0, 1000), st.sampled_from(["line", "plane", "space"]))
def test_each_point_has_a_cell_of_its_own(n, seed, form):
    places = np.random.default_rng(seed).uniform(-0.1, 0.1, (n, 3))
    places[:, {"line": [1, 2], "plane": [2], "space": []}[form]] = 0.0
    places[n // 2] = places[0]  # two at one place
    found = place(points(places))
    assert len(np.unique(found.cells)) == n
    skin = found.skin(2.5, "N")
    assert skin.n_taxels == n
    # The state's rows are those of the cells, in their order.
    assert np.array_equal(skin.points[:, :3], places[np.argsort(found.cells)].astype(np.float32))
    assert skin.point_rows is not None
    assert np.array_equal(skin.points[:, :3], places[skin.point_rows].astype(np.float32))
    values = np.arange(1.0, n + 1)
    assert np.array_equal(found.on_grid(values).reshape(-1)[found.cells], values)
    assert np.count_nonzero(found.on_grid(values)) == n


@pytest.mark.parametrize("removed", [0.0, 0.3])
def test_a_grid_with_cells_removed_is_found_again(removed):
    rng = np.random.default_rng(4)
    rows, cols = np.nonzero(rng.random((24, 30)) >= removed)
    places = np.stack([0.004 * cols, 0.004 * rows, 0.0 * rows], axis=1)
    order = rng.permutation(len(rows))
    found = place(points(turned(places[order], 5), np.tile(turned(UP[None], 5), (len(rows), 1))))
    assert sorted(found.shape) == [24, 30]
    assert np.allclose(adjacent(found), 1)
    assert found.pitch_m == pytest.approx(0.004)


def hexagonal():
    """Rows of taxels half a pitch apart in turn, on a part of a cylinder."""
    row, col = (k.ravel() for k in np.indices((16, 24)))
    angle = 0.1 * (col + 0.5 * (row % 2))
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    places = 0.06 * normals
    places[:, 2] = 0.006 * np.sqrt(0.75) * row
    return places, normals


@pytest.mark.parametrize("layout", [grip(), hexagonal()], ids=["square", "hexagonal"])
def test_a_lattice_on_a_cylinder_is_found_again(layout):
    found = place(points(*layout))
    assert found.n_parts == 1
    assert np.abs(adjacent(found) - 1).max() < 0.01


def test_neighbours_on_a_torso_are_near_each_other():
    found = place(points(*torso(1200)))
    away = adjacent(found)
    assert found.n_parts == 1
    assert away.mean() < 1.25
    assert np.quantile(away, 0.9) < 1.6
    # Row 0 is at the neck: seen from outside, the grid is upright.
    rows = found.cells // found.shape[1]
    assert np.corrcoef(rows, found.points.places[:, 2])[0, 1] < -0.95


def test_the_sides_of_a_thin_plate_are_no_neighbours():
    rows, cols = (k.ravel() for k in np.indices((12, 16)))
    side = np.stack([0.005 * cols, 0.005 * rows, 0.0 * rows], axis=1)
    places = np.concatenate([side, side - [0, 0, 0.001]])
    normals = np.concatenate([np.tile(UP, (192, 1)), np.tile(-UP, (192, 1))])
    found = place(points(places, normals))
    assert found.n_parts == 2
    assert np.allclose(adjacent(found), 1)


def test_readings_of_another_number_are_refused():
    found = place(Points("hand", np.eye(3), np.eye(3), np.array([0, 2, 5]), 8))
    assert found.on_grid(np.arange(8)).max() == 5
    with pytest.raises(SourceError, match="hand: a frame has 4 readings; expected 3 or 8"):
        found.on_grid(np.arange(4))
