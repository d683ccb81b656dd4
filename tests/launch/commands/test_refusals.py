"""What a command refuses: exit code 2, one line that names the fault, and no file."""

import os
import shlex

import numpy as np
import pytest
from bags import frames, make_bag

from sparseskin.launch.commands.cli import main

LINES = {
    "launch path_4": "no launch file of that name (did you mean 'path_40'?)",
    "launch none.csv": "none.csv: no such file",
    "launch none.toml": "none.toml: no such launch file",
    "launch ./pipe.toml": "./pipe.toml: is no regular file",
    "recording info 'a\nb.mcap'": "a b.mcap: no such file",
    "launch replay --set sensor.source=file:all.npy --set sensor.n_rows=3": "of 3 x any taxels",
    "launch replay --set sensor.source=file:flat.npy": "3 x 2, 2 x 3, 1 x 6 or 6 x 1",
    "scope example:thumbs": "there is no such; allowed: fingers",
    "launch path_40 --set sensor.seed=-1": "--set sensor.seed=-1: -1 is outside",
    "launch path_40 --summary none/out.json": "--summary none/out.json: its folder does not exist",
    "launch path_40 --summary .": "--summary .: is a folder",
    "launch path_40 --record a.bag": "--record: a.bag: expected a name that ends in .mcap",
    "launch path_40 --set graph.log_dir=old.toml": "log_dir: old.toml: Not a directory",
    "launch path_40 --frames -4": "argument --frames",
    "launch path_40 --frame 4": "--frame (did you mean '--frames'?)",
    # What follows a misspelt option may be its value, and is not blamed.
    "launch --framse 3 path_40": "unrecognized arguments: --framse (did you mean '--frames'?) (see",
    "launch path_40 path_64": "unrecognized arguments: path_64 (see sparseskin launch --help)",
    "param set a b": "the following arguments are required: VALUE (see sparseskin param set --he",
    "topic hz /skin/taxels -n 0": "-n: '0': expected a whole number, 1 or more",
    "tropic": "argument COMMAND: invalid choice: 'tropic' (did you mean 'topic'?)",
    "help lanch": "(did you mean 'launch'?)",
    "scope scene:drag_wrench_41": "did you mean 'drag_wrench_40'?",
    "scope scene:path_40 --set n_row=3": "did you mean 'n_rows'?",
    "scope scene:path_40 --set n_rows": "--set n_rows: expected KEY=VALUE",
    "scope scene:path_40 --set n_rows=x": "--set n_rows: expected a whole number",
    "play some.mcap --open --topics /skin/taxels": "--topics: does not go with --open",
    "play some.mcap --no-token": "--no-token: goes with --open",
    "play some.mcap --rate 2000": "--rate: 2000.0 is outside 0.0..1000.0",
    "play some.mcap --start 100": "--start: 100: the recording lasts 0.",
    "play some.mcap --topics /left": "--topics: /left: not in the file (known: /skin/",
    "study paper-table": "did you mean 'paper-tables'",
    "study paper-tables --seed -1": "argument --seed: ",
    "study paper-tables --seed 4294967296": "argument --seed: ",
    "study stability --out new --recordings .": "study 'stability' takes none; allowed: accuracy",
    "study stability --out new --constants": "study 'stability' takes none; allowed: accuracy",
    "reprocess some.mcap log.csv --out new": "log.csv: no recording (.mcap)",
    "reprocess some.mcap ./some.mcap --out new": "two of the files would become some.mcap",
    "reprocess some.mcap none.mcap --out new": "none.mcap: no such file",
    "recording import flat.npy --out c.mcap": "state --n-rows and --n-cols, 3 x 2",
    "launch flat.npy": "state --set sensor.n_rows=N and --set sensor.n_cols=N, 3 x 2",
    "scope file:flat.npy": "state --set n_rows=N and --set n_cols=N, 3 x 2",
    "recording import a.csv b.csv --out c.mcap": "--out c.mcap: several files need a folder",
    "calibrate scene:path_40 --out s.toml": "delivers true forces, which need no calibration",
}
"""Of each command line what its one line holds."""
FAULTS = {
    "reprocess some.mcap --from taxels --out out.mcap": {
        "--set reconstructor.solver=fist": "did you mean 'fista'",
        "--set sensor.seed=1": "unknown node 'sensor'",
        "--set compressor.m=99999": "m = 99999 is not allowed",
        "--from measurements --set compressor.ratio=2": "cannot be changed",
        "--executor proces:2": "did you mean 'process'",
        "--executor process:0": "expected 1..1024 workers",
        "--executor nowhere_at_all:make": "nowhere_at_all",
        "--out old.mcap": "old.mcap: exists already",
        "--out old.toml": "--out old.toml: expected a name that ends in .mcap",
        "--set compressor.patch=palm": "reads /palm/skin, which no node writes",
    },
    "calibrate file:all.npy --out palm.toml": {
        "--press 500g": "--press 500g: expected LOAD[@AREA]:WHERE",
        "--press 500x:3-4s": "--press 500x:3-4s: '500x' is no load",
        "--press 5N@9-9x0-0:3-4s": "is not on a skin of 4 x 6",
        "--press 5N:30-40s": "no frame of the recording, which lasts 6.99 s",
        "--untouched none.npy --no-questions": "none.npy: no such file",
        "--untouched 3 --no-questions": "3: expected seconds, as 3s, or a file; frames",
        "--out palm.txt": "--out palm.txt: expected a name that ends in .toml",
        "--out old.toml": "--out old.toml: exists already",
    },
}
"""Of a command with each of these options the same."""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    make_bag(folder / "some.mcap", frames(12))
    counts = 40 + np.random.default_rng(0).normal(0, 1, (700, 4, 6))
    np.save(folder / "all.npy", counts)
    np.save(folder / "flat.npy", counts.reshape(-1, 6))
    os.mkfifo(folder / "pipe.toml")
    for name in ("old.toml", "old.mcap", "log.csv"):
        (folder / name).write_text("mine")
    return folder


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        *LINES.items(),
        *(
            (f"{line} {more}", fault)
            for line, of in FAULTS.items()
            for more, fault in of.items()
        ),
    ],
)
def test_a_command_is_refused_in_one_line(line, fault, files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    before = sorted(files.iterdir())
    try:
        code = main(shlex.split(line))
    except SystemExit as ended:
        code = ended.code
    out, error = capsys.readouterr()
    (printed,) = error.splitlines()
    assert code == 2
    assert out == ""
    assert fault in printed
    assert sorted(files.iterdir()) == before
    assert (files / "old.mcap").read_text() == "mine"
