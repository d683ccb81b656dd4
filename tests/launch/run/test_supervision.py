"""Nodes that fail and are started again: when, how often, and what becomes of the graph."""

import json
import os
import signal
from pathlib import Path

import pytest
from conftest import wait_until
from damaged import launch_faults

from sparseskin.launch.launchfile.load import BUNDLED, load
from sparseskin.launch.run.restarts import NEVER, ON_FAILURE, RestartPolicy
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.process.control import ControlClient

#: Frames of which each is a byte more in a file before it is delivered: their true number.
COUNTED = """
import os
import numpy as np
def frames():
    with open("acquired", "ab", buffering=0) as acquired:
        for k in range(1000):
            acquired.write(b".")
            yield k, np.full((8, 8), 1 + k / 1000)
"""
GRAPH = (BUNDLED / "path_40.toml").read_text()


def with_keys(graph="", **nodes):
    """A launch file with keys more in [graph] and in [nodes.NAME]."""
    text = GRAPH.replace("[graph]", f"[graph]\n{graph}")
    for name, keys in nodes.items():
        text = text.replace(f"[nodes.{name}]", f"[nodes.{name}]\n{keys}")
    return text


def policy_of(path, text):
    path.write_text(text)
    return {name: spec.restart for name, spec in load(str(path)).nodes.items()}


def test_what_the_graph_states_holds_for_all_nodes_that_state_nothing(tmp_path):
    text = with_keys(
        'restart = "on-failure"\nmax_restarts = 3\nhang_s = 4',
        sensor='restart = "never"',
        compressor="restart_delay_s = 0\nrestart_window_s = 5.5\nrestart_max_delay_s = 1",
    )
    policies = policy_of(tmp_path / "g.toml", text)
    shared = RestartPolicy(ON_FAILURE, max_restarts=3, hang_s=4)
    assert policies["monitor"] == policies["reconstructor"] == shared
    assert policies["sensor"] == RestartPolicy(NEVER, max_restarts=3, hang_s=4)
    assert policies["compressor"] == RestartPolicy(ON_FAILURE, 3, 5.5, 0, 1, 4)
    assert set(policy_of(tmp_path / "h.toml", GRAPH).values()) == {RestartPolicy()}


def test_a_wrong_key_is_named_with_its_line_and_what_is_allowed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = with_keys("restart_delay_s = nan", sensor='restart = "always"')
    Path("f.toml").write_text(text)
    of_graph, of_node = (
        text.splitlines().index(key) + 1
        for key in ("restart_delay_s = nan", 'restart = "always"')
    )
    not_known = "'always' is not allowed; allowed: never, on-failure"
    assert set(launch_faults("f.toml", ["monitor.max_restarts=0"])) == {
        "--set monitor.max_restarts=0: 0 is outside 1..1000",
        f"f.toml:{of_node}: nodes.sensor.restart: {not_known}",
        f"f.toml:{of_graph}: graph.restart_delay_s: nan is outside 0.0..60.0",
    }


def launched(start, tmp_path, keys, *arguments):
    """A graph of 1000 frames, 5 s, that runs; what it says goes to out.json."""
    (tmp_path / "graph.toml").write_text(with_keys(keys))
    program = start(
        *("launch", "graph.toml", "--frames", "1000", "--summary", "out.json"),
        *(
            "--set",
            "monitor.page=false",
            "--set",
            "reconstructor.iterations=3",
            *arguments,
        ),
        *("--set", "reconstructor.depth=0"),
    )
    program.wait_for("[launch] ready")
    return program


def connected(program):
    """Connect to the control socket of a graph as soon as its launcher listens there."""
    path = program.cwd / "graphs" / f"{program.process.pid}.sock"
    found = []

    def listens():
        try:
            found.append(ControlClient(str(path)))
        except SparseskinError:
            return False
        return True

    wait_until(listens, "the control socket")
    return found[0]


def killed(program, node):
    """Kill a node that is there, and wait until the launcher says so."""
    wait_until(lambda: node in program.nodes(), f"the {node}")
    os.kill(program.pid_of(node), signal.SIGKILL)
    program.wait_for(f"[launch] {node} ended too early: killed by SIGKILL")


@pytest.mark.slow
def test_killed_nodes_are_started_again_and_the_graph_goes_on_to_its_end(
    start, tmp_path
):
    (tmp_path / "counted.py").write_text(COUNTED)
    source = (
        "--set",
        "sensor.source=counted:frames",
        "--set",
        "reconstructor.preset=paper",
    )
    program = launched(start, tmp_path, 'restart = "on-failure"', *source)
    client = connected(program)
    client.send({"watch": True})
    acquired = tmp_path / "acquired"
    wait_until(
        lambda: acquired.stat().st_size > 1, "a frame after that which shows the shape"
    )

    def wait_for(node, **wanted):
        """Wait for news of a node in which it is as stated."""

        def has_come():
            news = [
                fields["graph"]
                for fields in client.receive() or ()
                if "graph" in fields
            ]
            nodes = [
                state
                for graph in news
                for state in graph["nodes"]
                if state["name"] == node
            ]
            return any(wanted.items() <= state.items() for state in nodes)

        wait_until(has_come, f"{node}: {wanted}")

    # A pause holds the graph's end off, however long the first restart takes.
    client.send({"id": "1", "node": "sensor", "command": "pause", "value": True})
    wait_for("sensor", condition="paused")
    # Several at once: each has to find the other where it was, while that one is still starting.
    for node in ("compressor", "reconstructor", "monitor"):
        os.kill(program.pid_of(node), signal.SIGKILL)
    wait_for("reconstructor", condition="running", restarts=1)
    killed(program, "sensor")
    # A pause outlives the process that was told to make it.
    wait_for("sensor", condition="paused", restarts=1)
    client.send({"id": "2", "node": "sensor", "command": "pause", "value": False})
    wait_for("sensor", condition="running", restarts=1)
    client.close()

    stdout, stderr = program.ended()
    # The end states it, as the exit code does not.
    for node in ("sensor", "compressor", "reconstructor"):
        cause = "ended too early: killed by SIGKILL"
        assert (
            f"\n{node}: restarted 1 time after a failure; the last: {cause}\n" in stdout
        )
    assert "[launch] reconstructor is started again (restart 1)" in stderr
    assert "[launch] sensor is started again (restart 1)" in stderr
    summary = json.loads((tmp_path / "out.json").read_text())
    restarts = {name: node["restarts"] for name, node in summary["nodes"].items()}
    assert restarts == {"sensor": 1, "compressor": 1, "reconstructor": 1, "monitor": 1}
    assert summary["nodes"]["sensor"]["failures"] == [
        "ended too early: killed by SIGKILL"
    ]
    patch, nodes = summary["patches"]["skin"], summary["nodes"]
    frames = patch["frames"]
    # The second sensor goes through all its frames, whatever the first one had sent. The monitor,
    # which was restarted, has not seen the frames of the first one, nor all reconstructions.
    assert frames["sensed"] == acquired.stat().st_size > 1000
    assert (
        frames["reconstructed"]
        == nodes["reconstructor"]["published"]["/skin/reconstruction"]
    )
    assert frames["lost"] == frames["sensed"] - frames["reconstructed"]
    assert 0 < patch["compared"] <= 1000
    assert f"figures of {patch['compared']} since " in stdout
    assert patch["since_ns"] > 0
    assert program.survivors() == {}


@pytest.mark.slow
def test_a_node_that_fails_too_often_ends_the_graph(start, tmp_path):
    keys = 'restart = "on-failure"\nrestart_delay_s = 0\nmax_restarts = 1'
    program = launched(start, tmp_path, keys)
    killed(program, "compressor")
    program.wait_for("[launch] compressor is started again (restart 1)")
    killed(program, "compressor")
    _, stderr = program.ended(1)
    told = "[launch] compressor ended too early: killed by SIGKILL"
    assert f"{told} (1 restarts within 60 s: given up)" in stderr
    assert program.survivors() == {}


@pytest.mark.slow
def test_a_node_that_hangs_is_killed_and_started_again(start, tmp_path):
    program = launched(
        start, tmp_path, 'restart = "on-failure"\nrestart_delay_s = 0\nhang_s = 1'
    )
    os.kill(program.pid_of("reconstructor"), signal.SIGSTOP)
    program.wait_for("[launch] reconstructor has been silent for 1 s: SIGKILL")
    program.wait_for("[launch] reconstructor is started again (restart 1)")
    program.process.terminate()
    program.ended(143)
    assert program.survivors() == {}
