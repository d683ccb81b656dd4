"""Commands that list what there is, end a graph, watch it, or show a source; graphs with keys."""

import contextlib
import json
import re
import signal
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import PATIENCE_S, Program, free_port, note_of_graph, wait_until
from processes import LOOP, announced, words

from sparseskin.launch.commands import observers
from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile import bundled_names
from sparseskin.launch.run.running import RunningGraph, RunningNode
from sparseskin.nodes import extensions
from sparseskin.nodes.network.keys import make_key_files
from sparseskin.nodes.recorder.bag.reader import BagReader

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
            {"name": "path_40", "pid": p, "nodes": ["sensor"], "starting": False}
            for p in (7, 8)
        ]
        assert main(["graph", "list"]) == 0
        assert capsys.readouterr().out.splitlines()[1].split() == [
            "path_40",
            "7",
            "sensor",
        ]
        for stated, line in (
            ([], "several graphs run; choose one: path_40-7, path_40-8"),
            (
                ["path_40-9"],
                "path_40-9: no such graph runs (did you mean 'path_40-8'?)",
            ),
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


def test_patches_of_a_batch_are_those_of_the_settings_of_its_writer(monkeypatch):
    writers = {
        "/body/skin": "sensor",
        "/body/taxels": "sensor",
        "/body/reconstruction": "reconstructor",
        "/hand/taxels": "other",
    }
    graph = SimpleNamespace(writers=lambda: writers)
    asked = []

    def describe(_, node):
        asked.append(node)
        patches = {
            "key": "patches",
            "value": ("a", "b") if node == "reconstructor" else (),
        }
        return {"settings": [{"key": "seed", "value": 0}, patches]}

    monkeypatch.setattr(observers, "describe_node", describe)
    assert observers.batches_of(graph) == {"body": ["a", "b"]}
    assert asked == ["reconstructor", "other"]
    del writers["/body/taxels"], writers["/body/reconstruction"]
    assert observers.batches_of(graph) == {}


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


def test_scope_prints_figures_where_the_output_is_no_terminal(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    np.save("step.npy", np.arange(60, dtype=np.float32).reshape(5, 3, 4))
    stated = ["--set", "unit=kPa", "--set", "axes=frames,rows,cols"]
    assert main(["scope", "file:step.npy", *stated]) == 0
    assert (
        capsys.readouterr().out.splitlines()[-1] == "step: 5 frames; min 0, max 59 kPa"
    )


GRAPH = """\
hosts.edge = {{ address = "127.0.0.1", base_port = {edge_port} }}
hosts.desk.address = "127.0.0.1"
security.keys = "keys"
[nodes]
sensor = {{ type = "sensor", source = "loop:path_40", rate_hz = 50, host = "edge" }}
compressor = {{ type = "compressor", host = "edge" }}
reconstructor = {{ type = "reconstructor", host = "edge" }}
recorder = {{ type = "recorder", out = "desk.mcap", topics = ["/skin/taxels"], host = "desk" }}
"""
N_BYTES = 50_000


@pytest.mark.slow
def test_every_tool_beside_a_secured_graph_is_served(tmp_path):
    for name in ("edge", "desk"):
        make_key_files(name, tmp_path / "keys")
        (tmp_path / name).mkdir()
    (tmp_path / "loop.py").write_text(LOOP)
    (tmp_path / "graph.toml").write_text(
        GRAPH.format(edge_port=min(free_port(), 65000))
    )
    with contextlib.ExitStack() as stack:

        def start(host, *arguments):
            return stack.enter_context(Program(*arguments, cwd=tmp_path / host))

        for part in [
            start(h, "launch", "../graph.toml", "--host", h) for h in ("edge", "desk")
        ]:
            part.wait_for("[launch] ready")
        note_of_graph(tmp_path / "edge/graphs")
        code, out, _ = start(
            "edge", "topic", "echo", "/skin/taxels", "-n", "3"
        ).finish()
        assert code == 0
        assert out.count("---\n") == 3
        monitor = start("edge", "monitor", "--text")
        monitor.wait_for("[launch] ready")
        recorded = start(
            "edge", "record", "/skin/measurements", "/skin/phi", "--out", "a.mcap"
        )
        path = tmp_path / "edge/a.mcap.part"
        wait_until(
            lambda: path.exists() and path.stat().st_size > N_BYTES, "a recording"
        )
        for program in (recorded, monitor):
            program.process.send_signal(signal.SIGINT)
        assert recorded.finish()[0] == 0
        with BagReader(path.with_suffix("")) as bag:
            assert bag.topics["/skin/phi"].n_messages == 1
            assert bag.topics["/skin/measurements"].n_messages > 0
        out, _ = monitor.ended()
        assert re.search(r"reconstructed [1-9]", out)
