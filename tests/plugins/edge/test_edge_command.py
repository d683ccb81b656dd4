"""The command `sparseskin edge`: what it writes, and how it refuses."""

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.plugins.edge.description import EdgeDescription

EXPORT = ["edge", "export", "--rows", "6", "--cols", "8"]


def test_it_writes_the_program_of_the_stated_matrix(tmp_path, capsys):
    out = tmp_path / "edge"
    options = ["--ratio", "4", "--bits", "10", "--rows-mode", "rotating", "--seed", "5"]
    assert main([*EXPORT, *options, "--adc-bits", "14", "--out", str(out)]) == 0
    made = EdgeDescription.read(out / "edge.toml")
    stated = (made.n_rows, made.n_cols, made.m, made.bits, made.rows, made.seed, made.full_scale)
    assert stated == (6, 8, 12, 10, "rotating", 5, 16383)
    assert "12 of 48 taxels, rows rotating, 10 bits, 30 bytes a frame" in capsys.readouterr().out
    assert "@" not in (out / "README.md").read_text()


def test_rows_columns_and_mask_are_those_of_a_skin(tmp_path):
    skin, out = tmp_path / "skin.toml", tmp_path / "edge"
    skin.write_text('rows = 2\ncols = 3\nf_max = 2.5\nmask = ["101", "111"]\n')
    assert main(["edge", "export", "--skin", str(skin), "--m", "2", "--out", str(out)]) == 0
    made = EdgeDescription.read(out / "edge.toml")
    assert (made.n_rows, made.n_cols, made.n_taxels, made.m) == (2, 3, 5, 2)
    assert made.mask == ("101", "111")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--bits", "3"], "--bits: 3 is outside 4..16"),
        (["--ratio", "50"], "--ratio: 50 leaves no measurement of 48 taxels; allowed: 1..48"),
        (["--m", "4", "--ratio", "2"], "--m: states the number of measurements; leave out --ratio"),
        (["--skin", "s.toml"], "--skin: states rows and columns; leave out --rows and --cols"),
        (["--out", "."], ".: exists already, and is not written over"),
        (["--out", "no/folder"], "no/folder: its folder does not exist"),
    ],
)
def test_bad_options_are_refused_in_one_line(words, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    out = [] if "--out" in words else ["--out", "edge"]
    assert main([*EXPORT, *words, *out]) == 2
    assert capsys.readouterr().err == f"{line}\n"
    assert list(tmp_path.iterdir()) == []
