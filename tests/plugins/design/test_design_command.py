"""The command `sparseskin design`: what it prints and writes, and how it refuses."""

import csv
import re
from pathlib import Path

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.plugins.design.strategies import STRATEGIES

PAD = ["design", "--rows", "8", "--cols", "8"]


def test_it_prints_a_line_for_each_strategy(capsys):
    assert main([*PAD, "--bus", "serial:115200", "--no-accuracy"]) == 0
    out = capsys.readouterr().out
    for name in STRATEGIES:
        assert re.search(rf"^{name} +\d", out, re.MULTILINE)
    # 64 readings of 10 bits and 15 bytes, 10 bits each, at 115200 baud
    assert "bus: 95 bytes take 8.25 ms (UART at 115.2 kbaud): 121 Hz" in out


def test_it_prints_the_accuracy(capsys):
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
