"""The commands `graph list`, `stop` and `help`."""

import json

import pytest
from conftest import PATIENCE_S
from processes import announced
from shells import words

from sparseskin.launch.commands.cli import main
from sparseskin.launch.run.running import RunningGraph, RunningNode

NODES = {"sensor": RunningNode("sensor", "ipc://none", ["/skin/skin"])}


@pytest.fixture(autouse=True)
def runtime_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    monkeypatch.setattr("sparseskin.launch.attach.client.PATIENCE_S", PATIENCE_S)


def test_graphs_are_listed_and_which_to_stop_has_to_be_said(capsys):
    assert main(["graph", "list"]) == 0
    assert capsys.readouterr().out == "no graph runs on this host\n"
    one, other = (RunningGraph("path_40", pid, 0, "", NODES) for pid in (7, 8))
    with announced(one), announced(other):
        assert main(["graph", "list", "--json"]) == 0
        graphs = json.loads(capsys.readouterr().out)["graphs"]
        assert graphs == [
            {"name": "path_40", "pid": p, "nodes": ["sensor"], "starting": False} for p in (7, 8)
        ]
        assert main(["graph", "list"]) == 0
        assert capsys.readouterr().out.splitlines()[1].split() == ["path_40", "7", "sensor"]
        for stated, line in (
            ([], "several graphs run; choose one: path_40-7, path_40-8"),
            (["path_40-9"], "path_40-9: no such graph runs (did you mean 'path_40-8'?)"),
        ):
            assert main(["stop", *stated]) == 2
            assert capsys.readouterr().err == f"{line}\n"
        assert words("stop pa") == ["path_40-7", "path_40-8"]


@pytest.mark.parametrize("command", [[], ["recording", "info"]])
def test_help_describes_a_command_as_its_option_does(command, capsys):
    texts = []
    for line in (["help", *command], [*command, "--help"]):
        with pytest.raises(SystemExit) as ended:
            main(line)
        assert ended.value.code == 0
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1]
