"""Wires by their formulas, against cases that are counted by hand."""

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.plugins.wiring import study as wiring
from sparseskin.plugins.wiring.study import array_wiring, count_crossings, sbhe_wiring, star_wiring


def test_a_star_is_as_long_as_the_distances_from_its_median():
    cells = np.arange(9)  # 3 x 3: the median is the middle
    one = star_wiring([np.arange(9)], cells, 3, conversions=4)
    assert (one.length, one.crossings, one.lines, one.conversions) == (12.0, 0, 9, 4)
    rows = star_wiring([np.arange(3), np.arange(3, 6), np.arange(6, 9)], cells, 3, 9)
    assert (rows.length, rows.crossings) == (6.0, 0)


def test_crossings_of_a_grid_of_lines_are_counted():
    k = np.arange(1.0, 5.0)
    begins = np.concatenate([np.stack([k, 0 * k], 1), np.stack([0 * k, k + 0.5], 1)])
    ends = np.concatenate([np.stack([k, 0 * k + 9], 1), np.stack([0 * k + 9, k + 0.5], 1)])
    each_its_own = np.arange(8)
    assert count_crossings(begins, ends, each_its_own) == 16
    assert count_crossings(begins, ends, np.repeat([0, 1], 4)) == 16
    assert count_crossings(begins, ends, np.zeros(8, np.intp)) == 0
    assert count_crossings(begins[:4], ends[:4], each_its_own[:4]) == 0


def test_a_row_column_array_is_as_its_formulas():
    one = array_wiring(3, 5, 15)
    assert (one.length, one.crossings, one.conversions) == (3 * 4 + 5 * 2, 15, 15)
    assert one.lines == 8


def test_smaller_neighbourhoods_have_shorter_wires_that_cross_less():
    exists = np.ones((32, 32), dtype=np.bool_)
    found = []
    for kind in ("local:4", "local:8", "local:16", "sbhe"):
        phi = make_phi(kind, 1024, 341, 0)
        phi.lay_out(exists)
        found.append(sbhe_wiring(phi, exists))
    assert [w.length for w in found] == sorted(w.length for w in found)
    assert [w.crossings for w in found] == sorted(w.crossings for w in found)
    assert (found[0].crossings, {w.conversions for w in found}) == (0, {341})
    # 8 x 4 cells about their middle: 2 columns of 4 and 1 row of 8 away in the mean.
    assert found[0].length == 32 * (8 * 4 * (2 + 1))


def test_the_study_writes_its_page(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(wiring, "SHAPE", (16, 16))
    monkeypatch.setattr(wiring, "QUICK_FRAMES", 3)
    monkeypatch.setattr(wiring, "BODIES", ("gaussian",))
    words = ["--quick", "--executor", "serial", "--out", str(tmp_path)]
    assert main(["study", "wiring", *words]) == 0
    page = (tmp_path / "wiring.md").read_text()
    assert "| local:4 |" in page
    assert "nan" not in page
    assert (tmp_path / "wiring.csv").stat().st_size > 50
