"""Readers of layouts: what they read, and what they refuse in one line."""

import numpy as np
import pytest

from sparseskin.nodes.errors import SourceError
from sparseskin.plugins.points.files import load_points

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
    assert np.allclose(found.places, [[0, 0, 0.001], [0.005, 0, 0.001], [0, -0.005, 0.001]])
    assert np.allclose(found.normals, [[0, 0, 1]] * 3)
    assert (found.name, found.n_slots, found.notes) == ("skin", 3, ())
    again = load_points(saved(tmp_path, "x_m,y_m,z_m\n0,0,0\n0.1,0,0\n0,0.1,0\n0.1,0.1,0\n"))
    assert np.allclose(again.normals, [[0, 0, 1]] * 4)
    assert again.notes == ("the normals are estimated from the places of neighbours",)


def test_estimated_normals_are_those_of_a_ball(tmp_path):
    k = np.arange(600) + 0.5
    polar, angle = np.arccos(1 - 2 * k / 600), np.pi * (1 + 5**0.5) * k
    normals = np.stack(
        [np.cos(angle) * np.sin(polar), np.sin(angle) * np.sin(polar), np.cos(polar)], axis=1
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
    older = ICUB.replace("(-1 0 1 -2 2 3)", "(-1 0 1 -2 2 3 4)").replace("-1.0", "0.0")
    found = load_points(saved(tmp_path, older, "l_hand.txt"))
    assert found.slots.tolist() == [1, 2, 4, 5]
    assert "is not used" in found.notes[0]
    assert "estimated" in found.notes[-1]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (CSV.replace("_mm", ""), "line 2: header 'x,y,z,nx,ny,nz'; expected x_mm,y_mm,z_mm .or in"),
        (CSV.replace("5,0,1,0", "nan,0,1,0"), "line 4: 'nan' is not a finite number"),
        (CSV.replace("5,0,1,0", "0,0,1,0"), "taxel 1 .from 0. stands where another does"),
        (CSV.replace("5,0,1,0", "1e160,0,1,0"), "taxel 1 is not within 1000 m"),
        (CSV.replace("0.99", "0.2"), "the normal of taxel 1 .from 0. has length 0.2; expected 1"),
        (CSV.replace("5,0", "5e6,0"), "taxel 1 is not within 1000 m; is its unit right"),
        ("", "the file is empty"),
        (ICUB.replace("name  ", "robot "), "line 1: 'robot' is no key of an iCub's"),
        (ICUB.partition("[cal")[0], "holds no taxel after"),
        (ICUB.replace("-2 2", "-x 2"), "taxel2Repr: 'x' is not a whole number"),
        (ICUB.replace("(-1 0 1 -2 2 3)", "(-1 -1 -1 -2 -1 -1)"), "no reading has a place"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(tmp_path, text, what):
    name = "hand.txt" if "spatial_sampling" in text else "skin.csv"
    with pytest.raises(SourceError, match=what) as error:
        load_points(saved(tmp_path, text, name))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("layout", "what"),
    [
        ("example:torsp", "no such example .did you mean 'torso'"),
        ("skin.stl", "suffix '.stl' is not known; allowed are .csv, .txt, and example"),
    ],
)
def test_a_layout_that_is_not_there_is_refused(layout, what):
    with pytest.raises(SourceError, match=what):
        load_points(layout)
