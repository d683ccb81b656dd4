"""Notes of running graphs: there while the graph is, and no longer."""

import subprocess
import sys
from dataclasses import replace

import pytest
from processes import announced

from sparseskin.launch.commands.cli import main
from sparseskin.launch.run import running
from sparseskin.launch.run.running import (
    GraphError,
    RunningGraph,
    RunningNode,
    choose_graph,
    is_running,
    running_graphs,
    runtime_folder,
    write_note,
)


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))


def graph(name="path_40", pid=7):
    nodes = {"sensor": RunningNode("sensor", "ipc://@x", ["/skin/skin", "/skin/taxels"])}
    return RunningGraph(name, pid, 123, "[nodes]", nodes)


def test_a_graph_is_found_while_it_runs():
    assert running_graphs() == []
    with announced(graph()):
        assert running_graphs() == [graph()]
        assert choose_graph(None) == choose_graph("path_40") == choose_graph("path_40-7")
        assert is_running(graph())
    assert running_graphs() == []
    assert not is_running(graph())


@pytest.mark.parametrize("written", [0, 1])
def test_a_launcher_that_is_killed_as_it_writes_its_note_leaves_nothing(written):
    code = (
        "import os, pathlib, socket, sys\n"
        "from sparseskin.launch.run.running import RunningGraph, page_path, write_note\n"
        "graph = RunningGraph('dead', os.getpid(), 0, '', {})\n"
        "listener = socket.socket(socket.AF_UNIX)\n"
        "listener.bind(graph.control)\n"
        "listener.listen()\n"
        "pathlib.Path(page_path(0)).touch()\n"
        "if sys.argv[1] == '1': write_note(graph)\n"
        "pathlib.Path.replace = lambda *_: os._exit(9)\n"
        "write_note(graph)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(written)], check=False)
    assert (done.returncode, len(list(runtime_folder().iterdir()))) == (9, 3 + written)
    assert (running_graphs(), list(runtime_folder().iterdir())) == ([], [])


def test_which_of_several_graphs_has_to_be_said():
    with pytest.raises(GraphError, match="no graph runs"):
        choose_graph(None)
    with announced(graph()), announced(graph(pid=8)), announced(graph("lift", 9)):
        with pytest.raises(GraphError, match=r"several graphs run.*path_40-7, path_40-8"):
            choose_graph("path_40")
        assert choose_graph("lift").pid == 9
        assert choose_graph("path_40-8").pid == choose_graph("8").pid == 8
        with pytest.raises(GraphError, match="--graph lft: no such graph runs"):
            choose_graph("lft")


def test_a_graph_that_ends_as_it_is_joined_is_said_to_have_ended(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sparseskin.launch.commands.observers.choose_graph", lambda *_: graph())
    assert main(["record", "--out", "a.mcap"]) == 2
    assert capsys.readouterr().err == "path_40-7: has just ended\n"


def test_a_graph_that_is_starting_is_waited_for(monkeypatch, capsys):
    starting = replace(graph(), nodes={})
    with announced(starting):
        assert (running_graphs(), running_graphs(starting=True)) == ([], [starting])
        assert main(["graph", "list"]) == 0
        listed = " ".join(capsys.readouterr().out.split())
        assert listed == "GRAPH PID NODES path_40 7 (starting)"
        monkeypatch.setattr(running.time, "sleep", lambda _: write_note(graph()))
        assert choose_graph("path_40") == graph()
        assert capsys.readouterr().err == "path_40-7: is starting; waiting until it runs\n"
        assert running_graphs(starting=True) == [graph()]


def test_a_start_that_takes_too_long_is_named(monkeypatch):
    monkeypatch.setattr(running, "PATIENCE_S", 0.0)
    with announced(replace(graph(), nodes={})):
        with pytest.raises(GraphError, match="path_40-7: is still starting after 0 s"):
            choose_graph(None)
        with pytest.raises(GraphError, match="no graph runs"):
            choose_graph("lift")
        # One that runs is not held up by another that starts.
        with announced(graph("lift", 9)):
            assert choose_graph(None).pid == 9
