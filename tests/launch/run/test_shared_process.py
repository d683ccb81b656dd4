"""Nodes that share a process: the same messages, and what becomes of them together."""

import dataclasses
import os
import signal
import socket

import numpy as np
import pytest
from conftest import PATIENCE_S, note_of_graph, wait_until
from processes import SENSOR

from sparseskin.launch.attach.client import ask_node, describe, describe_node
from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import BUNDLED
from sparseskin.launch.run.running import choose_graph
from sparseskin.messages import decode
from sparseskin.nodes.network.keys import make_key_files
from sparseskin.nodes.recorder.bag.reader import BagReader

#: What differs between two runs: when, how long, and which run of a node.
OF_A_RUN = {"stamp_ns", "run_id", "solve_ns", "done_ns"}
EDGE = f'{SENSOR}process = "edge"\n[nodes.compressor]\ntype = "compressor"\nprocess = "edge"\n'
KEYS = '[security]\nkeys = "keys"\nkey = "own"\n'
DRAWN = """
import numpy as np
def frames():
    rng = np.random.default_rng(54)
    for k in range(12):
        forces = np.zeros((24, 20))
        i, j = rng.integers(0, 14, 2)
        forces[i : i + 6, j : j + 6] = rng.uniform(0, 2, (6, 6))
        yield k, forces
"""
ABRUPT = """
import os
import numpy as np
from sparseskin.nodes.node import Node
from sparseskin.nodes.settings import PatchSettings

def frames():
    print("a word of the driver")
    for k in range(1000):
        yield k, np.ones((8, 8))

class Abrupt(Node):
    Settings = PatchSettings

    @classmethod
    def inputs(cls, settings):
        return (f"/{settings.patch}/taxels",)

    def step(self, message):
        print("a word of the node")
        if message.seq == 3:
            raise SystemExit(3)
        return ()
"""

UNABLE = """
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.node import Node

class Unable(Node):
    def __init__(self, settings, context):
        raise SparseskinError("no device")
"""


def contents(path):
    """All messages of a recording by topic and number, without what differs between two runs."""
    with BagReader(path) as bag:
        messages = [
            decode(each.topic.encode(), each.payload) for each in bag.messages()
        ]
    found = {}
    for message in messages:
        fields = {
            field.name: getattr(message, field.name)
            for field in dataclasses.fields(message)
            if field.name not in OF_A_RUN
        }
        bits = [(name, _bits(value)) for name, value in sorted(fields.items())]
        found[message.topic, message.schema, message.seq] = bits
    return found


def _bits(value):
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return repr(value)


@pytest.mark.slow
def test_one_process_and_four_record_the_same_bits(start, tmp_path):
    """Over TCP with keys the nodes of one process share one gate, too."""
    make_key_files("own", tmp_path / "keys")
    text = (BUNDLED / "drag_wrench_40.toml").read_text()
    (tmp_path / "four.toml").write_text(text)
    (tmp_path / "one.toml").write_text(
        text.replace("[graph]", f'{KEYS}[graph]\ntransport = "tcp"\nprocess = "all"')
    )
    (tmp_path / "drawn.py").write_text(DRAWN)
    changes = (
        "sensor.source=drawn:frames",
        "sensor.rate_hz=0",
        "reconstructor.iterations=3",
    )
    changes += ("monitor.page=false",)
    for name in ("one", "four"):
        words = [word for change in changes for word in ("--set", change)]
        words += ["--frames", "12", "--record", f"{name}.mcap"]
        stdout, _ = start("launch", f"{name}.toml", *words).ended()
        assert "sensed 12, reconstructed 12, lost 0" in stdout
    one, four = (contents(tmp_path / f"{name}.mcap") for name in ("one", "four"))
    assert sum(schema == "reconstruction" for _, schema, _ in one) == 12
    assert one.keys() == four.keys()
    assert one == four


@pytest.fixture
def edge(start, tmp_path, monkeypatch):
    """A sensor and a compressor in one process, which is started again; the program, its graph."""
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    monkeypatch.setattr("sparseskin.launch.attach.client.PATIENCE_S", PATIENCE_S)
    cpu = max(os.sched_getaffinity(0))
    keys = f'restart = "on-failure"\nrestart_delay_s = 0\ncpus = [{cpu}]\n'
    (tmp_path / "edge.toml").write_text(f"[graph]\n{keys}{EDGE}")

    def started(*words):
        program = start("launch", "edge.toml", *words)
        program.wait_for("[launch] ready")
        note_of_graph(tmp_path / "graphs")
        pids = set(program.nodes().values())
        assert (len(program.nodes()), len(pids)) == (2, 1)
        assert os.sched_getaffinity(*pids) == {cpu}
        return program, choose_graph(None)

    return started


def in_time(graph, **conditions):
    """Wait until nodes have the conditions stated; their descriptions."""
    nodes = {}

    def has_come():
        nodes.update({node["name"]: node for node in describe(graph)["nodes"]})
        return all(
            nodes[name]["condition"] == each for name, each in conditions.items()
        )

    wait_until(has_come, str(conditions))
    return nodes


@pytest.mark.slow
def test_a_process_is_started_again_with_all_its_nodes_as_they_were(edge, capsys):
    program, graph = edge()
    ask_node(graph, "compressor", "set", {"ratio": 4})
    ask_node(graph, "sensor", "pause", True)
    in_time(graph, sensor="paused", compressor="running")
    capsys.readouterr()
    assert main(["node", "info", "sensor"]) == 0
    (line,) = [
        line for line in capsys.readouterr().out.splitlines() if " process " in line
    ]
    assert line.split() == [
        *("process", f"{program.pid_of('sensor')}", "on", f"{socket.gethostname()},"),
        *("with", "compressor"),
    ]

    os.kill(program.pid_of("sensor"), signal.SIGKILL)
    program.wait_for("[launch] sensor, compressor ended too early: killed by SIGKILL")
    program.wait_for("[launch] sensor is started again (restart 1)")
    program.wait_for("[launch] compressor is started again (restart 1)")
    nodes = in_time(graph, sensor="paused", compressor="running")
    assert {node["restarts"] for node in nodes.values()} == {1}
    assert {node["pid"] for node in nodes.values()} == {program.pid_of("compressor")}
    settings = describe_node(graph, "compressor")["settings"]
    assert {entry["key"]: entry["value"] for entry in settings}["ratio"] == 4

    os.kill(program.pid_of("compressor"), signal.SIGTERM)
    program.wait_for("error: terminated (SIGTERM) (of the same process: ")
    program.wait_for("[launch] compressor is started again (restart 2)")
    in_time(graph, sensor="paused", compressor="running")
    program.process.send_signal(signal.SIGINT)
    program.ended(130)
    assert program.survivors() == {}


@pytest.mark.slow
def test_a_process_that_hangs_is_killed_once_and_started_again(edge):
    program, _ = edge("--set", "graph.hang_s=1")
    os.kill(program.pid_of("sensor"), signal.SIGSTOP)
    program.wait_for("[launch] sensor, compressor have been silent for 1 s: SIGKILL")
    program.wait_for("[launch] compressor is started again (restart 1)")
    program.process.terminate()
    _, stderr = program.ended(143)
    assert stderr.count("have been silent") == 1
    assert program.survivors() == {}


def test_a_node_that_crashes_takes_its_process_along_and_words_have_their_speaker(
    start, tmp_path
):
    (tmp_path / "mine.py").write_text(ABRUPT)
    (tmp_path / "own.toml").write_text(
        '[graph]\nprocess = "all"\nlog_dir = "logs"\n'
        '[nodes.sensor]\ntype = "sensor"\nsource = "mine:frames"\nrate_hz = 100\n'
        '[nodes.abrupt]\ntype = "mine:Abrupt"\n'
    )
    _, stderr = start("launch", "own.toml").ended(1)
    assert "[launch] sensor, abrupt ended too early: exit code 3" in stderr
    assert "[sensor] a word of the driver" in stderr
    assert stderr.count("[abrupt] a word of the node") == 4


def test_a_node_that_cannot_start_is_named_with_those_of_its_process(start, tmp_path):
    (tmp_path / "mine.py").write_text(UNABLE)
    (tmp_path / "own.toml").write_text(
        f'{EDGE}[nodes.own]\ntype = "mine:Unable"\nprocess = "edge"\n'
    )
    _, stderr = start("launch", "own.toml").ended(2)
    (line,) = [line for line in stderr.splitlines() if " error: " in line]
    said = "error: no device (of the same process: sensor, compressor)"
    assert line.endswith(f"[own] {said}")
