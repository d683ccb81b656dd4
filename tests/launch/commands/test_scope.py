"""The commands `scenes`, `sources` and `scope`."""

import json
from pathlib import Path

import numpy as np

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile import bundled_names
from sparseskin.nodes import extensions


def test_scenes_names_every_launch_file(capsys):
    assert main(["scenes"]) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in bundled_names())
    assert max(map(len, out.splitlines())) <= 80


def test_sources_lists_what_there_is(tmp_path, monkeypatch, capsys, offering):
    monkeypatch.chdir(tmp_path)
    np.save("step.npy", np.zeros((2, 3, 4)))
    Path("notes.txt").touch()
    offering(extensions.DRIVERS, glove="my_glove:frames")
    assert main(["sources", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["source"] for one in found["files"]] == ["file:step.npy"]
    assert {"source": "my_glove:frames", "about": "glove"} in found["drivers"]
    assert "scene:path_40" in [one["source"] for one in found["scenes"]]
    assert main(["sources"]) == 0
    text = capsys.readouterr().out
    for word in ("file:step.npy", "my_glove:frames", "scene:path_40"):
        assert word in text


def test_scope_prints_figures_where_the_output_is_no_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("step.npy", np.arange(24, dtype=np.float32).reshape(2, 3, 4))
    assert main(["scope", "file:step.npy", "--set", "unit=kPa"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "step: 2 frames; min 0, max 23 kPa"
