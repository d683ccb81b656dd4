"""A file is looked at before it is imported, and launched by its name."""

import shlex

import numpy as np
import pytest

import sparseskin
from sparseskin.launch.commands.cli import main

TABLE = "time_s,s0,s1,s2,s3\n0.00,1,2,3,4\n0.02,5,-1,7,8\n0.04,90,80,70,60\n"


@pytest.fixture
def log(tmp_path, monkeypatch):
    """A table whose shape, unit and mark of missing readings have to be stated."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "glove log.csv").write_text(TABLE)
    return "glove log.csv"


def test_what_is_not_stated_is_named_and_nothing_is_chosen(log, capsys):
    assert main(["recording", "look", log]) == 2
    shown = capsys.readouterr()
    assert "4 columns (and 1 of times, counts or texts): s0, s1, s2, s3" in shown.out
    assert "column 'time_s' in s" in shown.out
    assert "state --n-rows and --n-cols, 2 x 2, 1 x 4 or 4 x 1" in shown.err


def test_columns_are_shown_where_the_times_are_not_clear(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines = [f"{20 * k},{k * k},{k % 3},{(k + 1) % 4}\n" for k in range(9)]
    (tmp_path / "log.csv").write_text("".join(lines))
    assert main(["recording", "look", "log.csv"]) == 2
    shown = capsys.readouterr()
    assert "4 columns" in shown.out
    assert (
        "state --time 1 or --time 2 or --time none, if these are no times" in shown.err
    )


def test_the_command_that_is_printed_imports_the_file_as_it_was_shown(log, capsys):
    stated = ["--n-rows", "2", "--n-cols", "2", "--unit", "counts", "--missing", "-1"]
    assert main(["recording", "look", log, *stated]) == 0
    shown = capsys.readouterr().out
    assert "first frame, up to " in shown
    assert "4 lines: 3 frames, 1 header" in shown
    command = shlex.split(shown.splitlines()[-1].partition("import it: ")[2])
    assert command[0] == "sparseskin"
    assert main(command[1:]) == 0
    recording = sparseskin.read_recording("glove log.mcap")
    assert np.isnan(recording["forces"][1, 0, 1])
    assert recording["forces"][2].tolist() == [[90, 80], [70, 60]]
    assert recording["stamp_ns"].tolist() == [0, 20_000_000, 40_000_000]


@pytest.mark.parametrize("form", ["{}", "file:{}"])
def test_a_recording_is_launched_by_its_name(form, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("log.npy", np.ones((60, 16, 16), np.uint8))
    assert main(["launch", form.format("log.npy"), "--dry-run"]) == 0
    assert "source = 'file:log.npy'" in capsys.readouterr().out


def test_an_error_spells_what_is_missing_as_an_option(log, capsys):
    stated = ["--n-rows", "2", "--n-cols", "2", "--unit", "counts"]
    assert main(["recording", "look", log, *stated]) == 2
    (tail,) = (line for line in capsys.readouterr().err.splitlines() if line)
    assert "-1 is below 0" in tail


def test_further_channels_are_kept_as_patches_with_their_sign(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [f"p{k}_{axis}" for k in range(4) for axis in "xyz"]
    rows = [
        [-k - 1.0, 0.5 * k, 10.0 * k + frame] for frame in range(3) for k in range(4)
    ]
    values = np.reshape(rows, (3, 12))
    header = ",".join(["time_s", *names])
    table = np.column_stack([0.02 * np.arange(3), values])
    np.savetxt("three.csv", table, delimiter=",", header=header, comments="")
    stated = ["--n-rows", "2", "--n-cols", "2", "--unit", "N", "--keep", "x,y"]
    assert (
        main(["recording", "import", "three.csv", "--out", "three.mcap", *stated]) == 0
    )
    for patch, channel in (("skin", 2), ("skin_x", 0), ("skin_y", 1)):
        read = sparseskin.read_recording("three.mcap", patch=patch)["forces"]
        np.testing.assert_allclose(read.reshape(3, 4), values[:, channel::3])


@pytest.mark.parametrize(("rest", "is_said"), [(3300, True), (0, False)])
def test_readings_that_rest_far_from_0_are_said_with_the_remedy(
    rest, is_said, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    noise = np.random.default_rng(0).normal(0, 4, (300, 4, 5))
    readings = rest + np.maximum(noise, 0)
    readings[:, 1, 1] += 900 * (np.arange(300) % 50 > 40)
    np.save("log.npy", readings.astype(np.float32))
    stated = ["--axes", "frames,rows,cols", "--unit", "counts"]
    assert main(["recording", "look", "log.npy", *stated]) == 0
    shown = capsys.readouterr().out
    assert ("add --tare 30 if nothing touched them" in " ".join(shown.split())) == (
        is_said
    )
    assert main(["recording", "look", "log.npy", *stated, "--tare", "30"]) == 0
    shown = capsys.readouterr().out
    assert "not trusted" not in shown
    command = shlex.split(shown.splitlines()[-1].partition("import it: ")[2])
    assert command[-1] == "--tare=30"
    assert main(command[1:]) == 0
