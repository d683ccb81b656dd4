"""Skins of points: their files, and the grid on which they are placed."""

import re

import numpy as np
import pytest
from damaged import refusal
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.errors import SourceError
from sparseskin.plugins.points.examples import grip, torso
from sparseskin.plugins.points.files import Points, estimated_normals, load_points
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


@given(
    st.integers(1, 120),
    st.integers(0, 1000),
    st.sampled_from(["line", "plane", "space"]),
)
def test_each_point_has_a_cell_of_its_own(n, seed, form):
    places = np.random.default_rng(seed).uniform(-0.1, 0.1, (n, 3))
    places[:, {"line": [1, 2], "plane": [2], "space": []}[form]] = 0.0
    places[n // 2] = places[0]  # two at one place
    found = place(points(places))
    assert len(np.unique(found.cells)) == n
    skin = found.skin(2.5, "N")
    assert skin.n_taxels == n
    # The state's rows are those of the cells, in their order.
    assert np.array_equal(
        skin.points[:, :3], places[np.argsort(found.cells)].astype(np.float32)
    )
    assert skin.point_rows is not None
    assert np.array_equal(
        skin.points[:, :3], places[skin.point_rows].astype(np.float32)
    )
    values = np.arange(1.0, n + 1)
    assert np.array_equal(found.on_grid(values).reshape(-1)[found.cells], values)
    assert np.count_nonzero(found.on_grid(values)) == n


@pytest.mark.parametrize("removed", [0.0, 0.3])
def test_a_grid_with_cells_removed_is_found_again(removed):
    rng = np.random.default_rng(4)
    rows, cols = np.nonzero(rng.random((24, 30)) >= removed)
    places = np.stack([0.004 * cols, 0.004 * rows, 0.0 * rows], axis=1)
    order = rng.permutation(len(rows))
    found = place(
        points(turned(places[order], 5), np.tile(turned(UP[None], 5), (len(rows), 1)))
    )
    with pytest.raises(
        SourceError, match=f"a frame has 1 readings; expected {len(rows)}"
    ):
        found.on_grid(np.ones(1))
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


def plate():
    """Both sides of a thin plate, which are no neighbours."""
    rows, cols = (k.ravel() for k in np.indices((12, 16)))
    side = np.stack([0.005 * cols, 0.005 * rows, 0.0 * rows], axis=1)
    normals = np.repeat([UP, -UP], 192, axis=0)
    return np.concatenate([side, side - [0, 0, 0.001]]), normals


@pytest.mark.parametrize(
    ("layout", "n_parts"), [(grip(), 1), (hexagonal(), 1), (plate(), 2)]
)
def test_a_lattice_on_a_cylinder_or_a_plate_is_found_again(layout, n_parts):
    found = place(points(*layout))
    assert found.n_parts == n_parts
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


CSV = "# a hand\nx_mm,y_mm,z_mm,nx,ny,nz\n0,0,1,0,0,1\n5,0,1,0,0,0.99\n0,-5,1,0,0,1\n"
ICUB = """name                l_hand
spatial_sampling    taxel
taxel2Repr          (-1 0 1 -2 2 3)
[calibration]
0.0  0.0  0.0  0.0  0.0  0.0
-0.0094 0.0062  0.0  0.0  0.0  -1.0
-0.0049 0.0062  0.0  0.0  0.0  -1.0
0.0  0.0  0.0  0.0  0.0  0.0

-0.0049\t0.0012\t0.0\t0.0\t0.0\t-1.0
-0.0049 0.0012  0.0  0.0  0.0  -1.0
"""


def saved(folder, text, name="skin.csv"):
    path = folder / name
    path.write_text(text)
    return str(path)


def test_a_csv_states_places_normals_and_unit(tmp_path):
    found = load_points(saved(tmp_path, CSV))
    assert np.allclose(
        found.places, [[0, 0, 0.001], [0.005, 0, 0.001], [0, -0.005, 0.001]]
    )
    assert np.allclose(found.normals, [[0, 0, 1]] * 3)
    assert found.name == "skin"
    assert found.n_slots == 3
    assert found.notes == ()
    again = load_points(
        saved(tmp_path, "x_m,y_m,z_m\n0,0,0\n0.1,0,0\n0,0.1,0\n0.1,0.1,0\n")
    )
    assert np.allclose(again.normals, [[0, 0, 1]] * 4)
    assert again.notes == ("the normals are estimated from the places of neighbours",)


def test_estimated_normals_are_those_of_a_ball(tmp_path):
    k = np.arange(600) + 0.5
    polar = np.arccos(1 - 2 * k / 600)
    angle = np.pi * (1 + 5**0.5) * k
    normals = np.stack(
        [np.cos(angle) * np.sin(polar), np.sin(angle) * np.sin(polar), np.cos(polar)],
        axis=1,
    )
    lines = "\n".join(",".join(map(repr, row)) for row in (50.0 * normals).tolist())
    found = load_points(saved(tmp_path, f"x_mm,y_mm,z_mm\n{lines}\n"))
    assert np.einsum("ij,ij->i", found.normals, normals).min() > 0.99


def test_an_icubs_file_has_readings_without_a_taxel(tmp_path):
    found = load_points(saved(tmp_path, ICUB, "l_hand.txt"))
    assert found.slots.tolist() == [1, 2, 4, 5]
    assert found.n_slots == 6
    assert np.allclose(found.places[0], [-0.0094, 0.0062, 0])
    assert found.notes == ("1 of 4 taxels stand where another does",)
    with pytest.raises(
        SourceError, match="l_hand: a frame has 5 readings; expected 4 or 6"
    ):
        place(found).on_grid(np.arange(5))
    older = ICUB.replace("(-1 0 1 -2 2 3)", "(-1 0 1 -2 2 3 4)").replace("-1.0", "0.0")
    found = load_points(saved(tmp_path, older, "l_hand.txt"))
    assert found.slots.tolist() == [1, 2, 4, 5]
    assert "is not used" in found.notes[0]
    assert "estimated" in found.notes[-1]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (
            CSV.replace("_mm", ""),
            "line 2: header 'x,y,z,nx,ny,nz'; expected x_mm,y_mm,z_mm .or in",
        ),
        (CSV.replace("5,0,1,0", "nan,0,1,0"), "line 4: 'nan' is not a finite number"),
        (
            CSV.replace("5,0,1,0", "0,0,1,0"),
            "taxel 1 .from 0. stands where another does",
        ),
        (CSV.replace("5,0,1,0", "1e160,0,1,0"), "taxel 1 is not within 1000 m"),
        (
            CSV.replace("0.99", "0.2"),
            "the normal of taxel 1 .from 0. has length 0.2; expected 1",
        ),
        (
            CSV.replace("5,0", "5e6,0"),
            "taxel 1 is not within 1000 m; is its unit right",
        ),
        ("", "the file is empty"),
        (ICUB.replace("name  ", "robot "), "line 1: 'robot' is no key of an iCub's"),
        (ICUB.partition("[cal")[0], "holds no taxel after"),
        (ICUB.replace("-2 2", "-x 2"), "taxel2Repr: 'x' is not a whole number"),
        (
            ICUB.replace("(-1 0 1 -2 2 3)", "(-1 -1 -1 -2 -1 -1)"),
            "no reading has a place",
        ),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(tmp_path, text, what):
    name = "hand.txt" if "spatial_sampling" in text else "skin.csv"
    assert re.search(
        what, refusal(lambda: load_points(saved(tmp_path, text, name)), SourceError)
    )
    for layout, line in (
        ("example:torsp", "no such example .did you mean 'torso'"),
        ("skin.stl", "suffix '.stl' is not known; allowed are .csv, .txt, and example"),
    ):
        with pytest.raises(SourceError, match=line):
            load_points(layout)
