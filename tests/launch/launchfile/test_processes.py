"""The key `process`: which nodes share one, and combinations that are refused."""

from dataclasses import fields

import pytest
from damaged import launch_faults
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.commands.launch import graph_text
from sparseskin.launch.launchfile.load import BUNDLED, load
from sparseskin.launch.launchfile.processes import by_process
from sparseskin.launch.run.restarts import RestartPolicy
from sparseskin.nodes.process.scheduling import Scheduling

NODES = ("sensor", "compressor", "reconstructor", "monitor")
OTHER = {"cpus": "[0]", "priority": "7", "restart": '"on-failure"'}
HOSTS = '[hosts.edge]\naddress = "127.0.0.1"\n[hosts.desk]\naddress = "127.0.0.2"\n'


@given(st.lists(st.sampled_from(["", "a", "b"]), min_size=4, max_size=4))
def test_nodes_that_name_one_process_share_it_and_one_alone_is_refused(names):
    changes = [f"{n}.process={p}" for n, p in zip(NODES, names, strict=True) if p]
    alone = [n for n, p in zip(NODES, names, strict=True) if p and names.count(p) == 1]
    if alone:
        lines = launch_faults("path_40", changes)
        assert [line.partition(".")[0] for line in lines] == [
            f"--set {n}" for n in alone
        ]
        assert all("has this node alone" in line for line in lines)
        return
    groups = by_process(load("path_40", changes).nodes.values())
    assert sorted(spec.name for group in groups for spec in group) == sorted(NODES)
    shared = {frozenset(spec.name for spec in group) for group in groups}
    for node, process in zip(NODES, names, strict=True):
        same = {n for n, p in zip(NODES, names, strict=True) if p == process}
        assert frozenset(same if process else {node}) in shared


def test_the_graph_states_one_for_all_but_a_recorder_of_the_command_line():
    launch = load(
        "path_40", ["graph.process=all", "monitor.process="], record="run.mcap"
    )
    groups = [
        [spec.name for spec in group] for group in by_process(launch.nodes.values())
    ]
    assert groups == [
        ["sensor", "compressor", "reconstructor"],
        ["monitor"],
        ["recorder"],
    ]
    assert "process = 'all'" in graph_text(launch)


@given(
    st.sampled_from(
        [f.name for kind in (Scheduling, RestartPolicy) for f in fields(kind)]
    ),
    st.sampled_from(NODES[1:]),
)
def test_what_is_of_the_process_is_the_same_for_its_nodes(key, node):
    change = f"{node}.{key}={OTHER.get(key, '9')}"
    (line,) = launch_faults("path_40", ["graph.process=all", change])
    assert line.startswith(f"--set {change}: ")
    assert line.endswith(" of sensor in process 'all' (allowed: the same)")
    assert load("path_40", [change, f"{node}.process="])


def test_nodes_on_different_hosts_share_no_process(tmp_path):
    text = (BUNDLED / "path_40.toml").read_text()
    for node in NODES:
        host = "edge" if node in NODES[:2] else "desk"
        text = text.replace(f"[nodes.{node}]", f'[nodes.{node}]\nhost = "{host}"')
    path = tmp_path / "hosts.toml"
    path.write_text(text + HOSTS)
    changes = [
        f"{node}.process={'edge' if node in NODES[:2] else 'desk'}" for node in NODES
    ]
    assert [
        len(group) for group in by_process(load(str(path), changes).nodes.values())
    ] == [2, 2]
    of_graph = load(str(path), ["graph.process=all"]).nodes
    assert [len(group) for group in by_process(of_graph.values())] == [2, 2]
    changes[2] = "reconstructor.process=edge"
    assert launch_faults(str(path), changes) == [
        "--set reconstructor.process=edge: 'edge' is on edge (sensor), this node on desk",
        "--set monitor.process=desk: 'desk' has this node alone "
        "(allowed: a process that other nodes state too)",
    ]


@pytest.mark.parametrize("name", ["a/b", "Edge", "1"])
def test_a_name_that_could_name_no_node_is_refused(name):
    (line,) = launch_faults("path_40", [f"graph.process={name}"])
    assert line.startswith(f"--set graph.process={name}: ")
