"""The command `design` and the files that it reads; wires, counted by hand."""

import csv
import os
import re
from pathlib import Path

import numpy as np
import pytest
from damaged import refusal

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import SettingsError
from sparseskin.plugins.design import simulation
from sparseskin.plugins.design.models import Bus
from sparseskin.plugins.design.spec import make_design, read_file
from sparseskin.plugins.design.strategies import STRATEGIES
from sparseskin.plugins.wiring import study as wiring
from sparseskin.plugins.wiring.study import (
    array_wiring,
    count_crossings,
    sbhe_wiring,
    star_wiring,
)

PAD = ["design", "--n-rows", "8", "--n-cols", "8"]


def test_it_prints_a_line_for_each_strategy(capsys):
    assert main([*PAD, "--bus", "serial:115200", "--no-accuracy"]) == 0
    out = capsys.readouterr().out
    for name in STRATEGIES:
        assert re.search(rf"^{name} +\d", out, re.MULTILINE)
    # 64 readings of 10 bits and 15 bytes, 10 bits each, at 115200 baud
    assert "bus: 95 bytes take 8.25 ms (UART at 115.2 kbaud): 121 Hz" in out


@pytest.mark.slow
def test_it_prints_the_accuracy(capsys, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})  # in this process
    monkeypatch.setattr(simulation, "TRIALS", 2)
    assert main([*PAD, "--scenes", "2"]) == 0
    out, error = capsys.readouterr()
    assert re.search(r"^all taxels .* \d\d\.\d +\d\d\.\.\d\d ", out, re.MULTILINE)
    assert max(map(len, out.splitlines())) <= 100
    assert (
        error == "8 x 8 taxels, 10 ways to read them in 2 simulated scenes each ...\n"
    )


def test_options_replace_what_a_file_states_and_a_table_is_written(tmp_path, capsys):
    path = tmp_path / "design.toml"
    table = tmp_path / "palm.csv"
    path.write_text('n_rows = 8\nn_cols = 8\nbus = "can:1M"\nrate = 50\n')
    words = ["--rate", "20 Hz", "--taxels", "39", "--no-accuracy"]
    assert main(["design", str(path), *words, "--csv", str(table)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("39 points, 4 mm apart")
    assert "CAN at 1 Mbit/s" in out
    assert "asked 20 Hz" in out
    with table.open() as file:
        written = list(csv.DictReader(file))
    assert [row["strategy"] for row in written][::7] == [
        "all taxels",
        "N/4 adaptive sums",
    ]
    # 64 bytes are 8 CAN frames of 135 bits.
    assert written[0]["bytes"] == "64"
    assert float(written[0]["bus_s"]) == pytest.approx(8 * 135e-6)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["design"],
            "--n-rows: is missing; state n_rows and n_cols, taxels, or points",
        ),
        (["design", "none.toml"], "none.toml: No such file or directory"),
        (["design", "none.bin"], "none.bin: no TOML: "),
        (["design", "half.toml"], "half.toml: no TOML: "),
        (
            ["design", "bad.toml"],
            "bad.toml: 'colls': unknown key (did you mean 'n_cols'?)",
        ),
        ([*PAD, "--csv", "bad.toml"], "bad.toml: exists already"),
    ],
)
def test_bad_options_are_refused_in_one_line(
    words, line, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text("n_rows = 8\ncolls = 8\n")
    Path("half.toml").write_text("n_rows = ")
    Path("none.bin").write_bytes(b"\xff\xfe\x00rows")
    assert main(words) == 2
    shown = capsys.readouterr().err
    assert shown.startswith(line)
    assert shown.count("\n") == 1


def test_all_faults_of_a_file_are_reported_and_name_it(tmp_path, capsys):
    path = tmp_path / "design.toml"
    path.write_text('"a\\nb" = 1\nn_rows = "x"\nn_cols = 5000\nsums = "both"\n')
    assert main(["design", str(path), "--edge", "arm"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    for key in ("'a\\nb'", "n_rows", "n_cols", "sums"):
        assert sum(line.startswith(f"{path}: {key}: ") for line in lines) == 1
    assert (
        sum(
            line.startswith("--edge: 'arm': expected cortex-m4@168MHz")
            for line in lines
        )
        == 1
    )


SIZE = {"n_rows": 12, "n_cols": 32}


def test_a_design_has_defaults_and_units():
    d = make_design(
        {**SIZE, "pitch": "0.3cm", "noise": "20mN", "rate": "1kHz", "bus": "can-fd"}
    )
    assert d.n_rows == 12
    assert d.n_cols == 32
    assert d.n_taxels == 384
    assert d.size == "12 x 32 taxels"
    assert (d.pitch_m, d.noise_n, d.rate_hz) == pytest.approx((0.003, 0.02, 1000.0))
    assert d.noise == pytest.approx(0.02 / 2.5)
    assert d.bus == Bus("can-fd", (1e6, 5e6))
    assert d.adc.bits == 10
    assert d.adc.rate_hz == 200e3
    assert d.bits == 8
    assert d.cores == 4
    assert d.sums == "digital"
    # Numbers of a file are those of options.
    numbers = {**SIZE, "rate": 500, "host": 2, "bits": 6}
    texts = {
        "n_rows": "12",
        "n_cols": " 32",
        "rate": "500 Hz",
        "host": "2 cores",
        "bits": "6 ",
    }
    assert make_design(numbers) == make_design(texts)


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"n_rows": 12}, "n_cols: is missing; state n_rows and n_cols"),
        ({**SIZE, "taxels": 99}, "taxels: states the size once more; leave out n_rows"),
        ({"n_rows": 1, "n_cols": 2}, "n_rows: 1 x 2 are 2 taxels; allowed: 16..65536"),
        (
            {**SIZE, "noise": "1N"},
            "noise: 1 N is not allowed for a range of 2.5 N; allowed: 0.000",
        ),
        ({**SIZE, "rate": "0"}, "rate: '0': is outside 1 .. 10000"),
        (
            {**SIZE, "host": "4 core s"},
            "host: '4 core s': expected such as 4cores, 1..4096",
        ),
        (
            {**SIZE, "sums": "analogue"},
            "sums: 'analogue' is not allowed (did you mean 'analog'?)",
        ),
        ({"points": "few.csv"}, "points: few.csv: 2 points; allowed: 16..65536"),
    ],
)
def test_a_wrong_key_is_refused_in_one_line(keys, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("few.csv").write_text("x_mm,y_mm,z_mm\n0,0,0\n5,0,0\n")
    assert refusal(lambda: make_design(keys), SettingsError).startswith(line)


def test_points_stand_beside_the_file_that_names_them(tmp_path):
    lines = [f"{x},{y},0,0,0,1" for x in range(0, 25, 5) for y in range(0, 25, 5)]
    (tmp_path / "pad.csv").write_text(
        "\n".join(["x_mm,y_mm,z_mm,nx,ny,nz", *lines, ""])
    )
    (tmp_path / "design.toml").write_text('points = "pad.csv"\n')
    d = make_design(read_file(tmp_path / "design.toml"))
    assert d.n_taxels == 25
    assert d.n_rows is None
    assert d.pitch_m == pytest.approx(0.005)
    assert int(d.mask.sum()) == 25


def test_stars_and_arrays_are_as_their_formulas():
    cells = np.arange(9)  # 3 x 3: the median is the middle
    one = star_wiring([np.arange(9)], cells, 3, conversions=4)
    assert one.length == 12.0
    assert one.crossings == 0
    assert one.lines == 9
    assert one.conversions == 4
    rows = star_wiring([np.arange(3), np.arange(3, 6), np.arange(6, 9)], cells, 3, 9)
    assert rows.length == 6.0
    assert rows.crossings == 0
    one = array_wiring(3, 5, 15)
    assert one.length == 3 * 4 + 5 * 2
    assert one.crossings == 15
    assert one.conversions == 15
    assert one.lines == 8


def test_crossings_of_a_grid_of_lines_are_counted():
    k = np.arange(1.0, 5.0)
    begins = np.concatenate([np.stack([k, 0 * k], 1), np.stack([0 * k, k + 0.5], 1)])
    ends = np.concatenate(
        [np.stack([k, 0 * k + 9], 1), np.stack([0 * k + 9, k + 0.5], 1)]
    )
    each_its_own = np.arange(8)
    assert count_crossings(begins, ends, each_its_own) == 16
    assert count_crossings(begins, ends, np.repeat([0, 1], 4)) == 16
    assert count_crossings(begins, ends, np.zeros(8, np.intp)) == 0
    assert count_crossings(begins[:4], ends[:4], each_its_own[:4]) == 0


def test_smaller_neighbourhoods_have_shorter_wires_that_cross_less():
    exists = np.ones((32, 32), dtype=np.bool_)
    found = []
    for kind in ("local:4", "local:8", "local:16", "sbhe"):
        phi = make_phi(kind, 1024, 341, 0)
        phi.lay_out(exists)
        found.append(sbhe_wiring(phi, exists))
    assert [w.length for w in found] == sorted(w.length for w in found)
    assert [w.crossings for w in found] == sorted(w.crossings for w in found)
    assert found[0].crossings == 0
    assert {w.conversions for w in found} == {341}
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
