"""The command `design`, and the files that it reads."""

import csv
import os
import re
from pathlib import Path

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.errors import SettingsError
from sparseskin.plugins.design import simulation
from sparseskin.plugins.design.models import Bus
from sparseskin.plugins.design.spec import make_design, read_file
from sparseskin.plugins.design.strategies import STRATEGIES

PAD = ["design", "--rows", "8", "--cols", "8"]


def test_it_prints_a_line_for_each_strategy(capsys):
    assert main([*PAD, "--bus", "serial:115200", "--no-accuracy"]) == 0
    out = capsys.readouterr().out
    for name in STRATEGIES:
        assert re.search(rf"^{name} +\d", out, re.MULTILINE)
    # 64 readings of 10 bits and 15 bytes, 10 bits each, at 115200 baud
    assert "bus: 95 bytes take 8.25 ms (UART at 115.2 kbaud): 121 Hz" in out


def test_it_prints_the_accuracy(capsys, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})  # in this process
    monkeypatch.setattr(simulation, "TRIALS", 2)
    assert main([*PAD, "--scenes", "2"]) == 0
    out, error = capsys.readouterr()
    assert re.search(r"^all taxels .* \d\d\.\d +\d\d\.\.\d\d ", out, re.MULTILINE)
    assert max(map(len, out.splitlines())) <= 100
    assert error == "8 x 8 taxels, 9 ways to read them in 2 simulated scenes each ...\n"


def test_options_replace_what_a_file_states_and_a_table_is_written(tmp_path, capsys):
    path, table = tmp_path / "design.toml", tmp_path / "palm.csv"
    path.write_text('rows = 8\ncols = 8\nbus = "can:1M"\nrate = 50\n')
    words = ["--rate", "20 Hz", "--taxels", "39", "--no-accuracy"]
    assert main(["design", str(path), *words, "--csv", str(table)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("39 points, 4 mm apart")
    assert "CAN at 1 Mbit/s" in out
    assert "asked 20 Hz" in out
    with table.open() as file:
        written = list(csv.DictReader(file))
    assert [row["strategy"] for row in written][::6] == ["all taxels", "N/4 adaptive sums"]
    # 64 bytes are 8 CAN frames of 135 bits.
    assert (written[0]["bytes"], float(written[0]["bus_s"])) == ("64", pytest.approx(8 * 135e-6))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["design"], "--rows: is missing; state rows and cols, taxels, or points"),
        (["design", "none.toml"], "none.toml: No such file or directory"),
        (["design", "bad.toml"], "bad.toml: 'colls': unknown key (did you mean 'cols'?)"),
        ([*PAD, "--csv", "bad.toml"], "bad.toml: exists already"),
    ],
)
def test_bad_options_are_refused_in_one_line(words, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text("rows = 8\ncolls = 8\n")
    assert main(words) == 2
    shown = capsys.readouterr().err
    assert shown.startswith(line)
    assert shown.count("\n") == 1


def test_all_faults_of_a_file_are_reported_and_name_it(tmp_path, capsys):
    path = tmp_path / "design.toml"
    path.write_text('"a\\nb" = 1\nrows = "x"\ncols = 5000\nsums = "both"\n')
    assert main(["design", str(path), "--edge", "arm"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    for key in ("'a\\nb'", "rows", "cols", "sums"):
        assert sum(line.startswith(f"{path}: {key}: ") for line in lines) == 1
    assert sum(line.startswith("--edge: 'arm': expected cortex-m4@168MHz") for line in lines) == 1


SIZE = {"rows": 12, "cols": 32}


def test_a_design_has_defaults_and_units():
    d = make_design({**SIZE, "pitch": "0.3cm", "noise": "20mN", "rate": "1kHz", "bus": "can-fd"})
    assert (d.n_rows, d.n_cols, d.n_taxels, d.size) == (12, 32, 384, "12 x 32 taxels")
    assert (d.pitch_m, d.noise_n, d.rate_hz) == pytest.approx((0.003, 0.02, 1000.0))
    assert (d.noise, d.bus) == (pytest.approx(0.02 / 2.5), Bus("can-fd", (1e6, 5e6)))
    assert (d.adc.bits, d.adc.rate_hz, d.bits, d.cores, d.sums) == (10, 200e3, 8, 4, "digital")


@pytest.mark.parametrize(
    "keys",
    [
        {**SIZE, "rate": 500, "host": 2, "bits": 6},
        {"rows": "12", "cols": " 32", "rate": "500 Hz", "host": "2 cores", "bits": "6 "},
    ],
)
def test_numbers_of_a_file_are_those_of_options(keys):
    d = make_design(keys)
    assert (d.n_taxels, d.rate_hz, d.cores, d.bits) == (384, 500.0, 2, 6)


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"rows": 12}, "cols: is missing; state rows and cols"),
        ({**SIZE, "taxels": 99}, "taxels: states the size once more; leave out rows"),
        ({"rows": 1, "cols": 2}, "rows: 1 x 2 are 2 taxels; allowed: 16..65536"),
        (
            {**SIZE, "noise": "1N"},
            "noise: 1 N is not allowed for a range of 2.5 N; allowed: 0.000",
        ),
        ({**SIZE, "rate": "0"}, "rate: '0': is outside 1 .. 10000"),
        ({**SIZE, "host": "4 core s"}, "host: '4 core s': expected such as 4cores, 1..4096"),
        ({**SIZE, "sums": "analogue"}, "sums: 'analogue' is not allowed (did you mean 'analog'?)"),
        ({"points": "few.csv"}, "points: few.csv: 2 points; allowed: 16..65536"),
    ],
)
def test_a_wrong_key_is_refused_in_one_line(keys, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("few.csv").write_text("x_mm,y_mm,z_mm\n0,0,0\n5,0,0\n")
    with pytest.raises(SettingsError) as error:
        make_design(keys)
    assert str(error.value).startswith(line)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("raw", [b"rows = ", b"\xff\xfe\x00rows"])
def test_a_wrong_file_is_refused_in_one_line(raw, tmp_path):
    path = tmp_path / "design.toml"
    path.write_bytes(raw)
    with pytest.raises(SettingsError, match=r"design\.toml: no TOML: .*$"):
        read_file(path)


def test_points_stand_beside_the_file_that_names_them(tmp_path):
    lines = [f"{x},{y},0,0,0,1" for x in range(0, 25, 5) for y in range(0, 25, 5)]
    (tmp_path / "pad.csv").write_text("\n".join(["x_mm,y_mm,z_mm,nx,ny,nz", *lines, ""]))
    (tmp_path / "design.toml").write_text('points = "pad.csv"\n')
    d = make_design(read_file(tmp_path / "design.toml"))
    assert (d.n_taxels, d.n_rows, d.pitch_m) == (25, None, pytest.approx(0.005))
    assert int(d.mask.sum()) == 25
