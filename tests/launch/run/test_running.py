"""Notes of running graphs: there while the graph is, and no longer."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.run import running
from sparseskin.launch.run.running import (
    GraphError,
    RunningGraph,
    RunningNode,
    announced,
    choose_graph,
    is_running,
    running_graphs,
    runtime_folder,
)


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))


def graph(name: str = "path_40", pid: int = 7) -> RunningGraph:
    nodes = {"sensor": RunningNode("sensor", "ipc://@x", ["/skin/skin", "/skin/taxels"])}
    return RunningGraph(name, pid, 123, "[nodes]", nodes)


def test_a_graph_is_found_while_it_runs() -> None:
    assert running_graphs() == []
    with announced(graph()):
        assert running_graphs() == [graph()]
        assert choose_graph(None) == choose_graph("path_40") == choose_graph("path_40-7")
        assert is_running(graph())
    assert running_graphs() == []
    assert not is_running(graph())


@pytest.mark.parametrize("dies_in", ["rename", "pwrite", "second pwrite"])
def test_a_launcher_that_is_killed_as_it_writes_its_note_leaves_nothing(dies_in: str) -> None:
    code = (
        "import os, sys\n"
        "from dataclasses import replace\n"
        "from sparseskin.launch.run.running import Note, RunningGraph, socket_path\n"
        "graph = RunningGraph('dead', os.getpid(), 0, '', {})\n"
        "def die(*_): os._exit(9)\n"
        "if sys.argv[1] == 'rename': os.rename = die\n"
        "if sys.argv[1] == 'pwrite': os.pwrite = die\n"
        "note = Note(graph)\n"
        "os.close(os.open(socket_path(0)[:-5] + '.html', os.O_CREAT))\n"
        "os.pwrite = die\n"
        "note.announce(replace(graph, launch='x' * 5000))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, dies_in], check=False)
    assert done.returncode == 9
    assert list(runtime_folder().iterdir())
    assert running_graphs() == []
    assert list(runtime_folder().iterdir()) == []


def test_a_note_that_becomes_shorter_is_read_whole() -> None:
    with announced(replace(graph(), launch="x" * 1000)) as note:
        note.announce(graph())
        assert running_graphs() == [graph()]


def test_which_of_several_graphs_has_to_be_said() -> None:
    with pytest.raises(GraphError, match="no graph runs"):
        choose_graph(None)
    with announced(graph()), announced(graph(pid=8)), announced(graph("lift", 9)):
        with pytest.raises(GraphError, match=r"several graphs run.*path_40-7, path_40-8"):
            choose_graph("path_40")
        assert choose_graph("lift").pid == 9
        assert choose_graph("path_40-8").pid == choose_graph("8").pid == 8
        with pytest.raises(GraphError, match="--graph lft: no such graph runs"):
            choose_graph("lft")


def test_a_graph_that_ends_as_it_is_joined_is_said_to_have_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with announced(graph()):  # its control socket is gone
        assert main(["record", "--out", "a.mcap"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == "path_40-7: has just ended"


def test_a_graph_that_is_starting_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    starting = replace(graph(), nodes={}, starting=True)
    with announced(starting) as note:
        assert running_graphs() == []
        assert running_graphs(starting=True) == [starting]
        assert main(["graph", "list"]) == 0
        listed = " ".join(capsys.readouterr().out.split())
        assert listed == "GRAPH PID NODES path_40 7 (starting)"
        monkeypatch.setattr(running.time, "sleep", lambda _: note.announce(graph()))
        assert choose_graph("path_40") == graph()
        assert capsys.readouterr().err == "path_40-7: is starting; waiting until it runs\n"
        assert running_graphs(starting=True) == [graph()]


def test_a_start_that_takes_too_long_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "PATIENCE_S", 0.0)
    with announced(replace(graph(), nodes={}, starting=True)):
        with pytest.raises(GraphError, match="path_40-7: is still starting after 0 s"):
            choose_graph(None)
        with pytest.raises(GraphError, match="no graph runs"):
            choose_graph("lift")
        # One that runs is not held up by another that starts.
        with announced(graph("lift", 9)):
            assert choose_graph(None).pid == 9


def test_a_launcher_that_has_joined_another_graph_is_not_waited_for() -> None:
    with announced(replace(graph(), nodes={})), pytest.raises(GraphError, match="no graph runs"):
        choose_graph(None)
