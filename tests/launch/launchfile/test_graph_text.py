"""A graph as text and as a picture: every node, link and host is there."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.graph_text import dot_of, graph_text
from sparseskin.launch.launchfile.load import load

HOSTS = """
[hosts.edge]
address = "127.0.0.1"
key = "edge"
[hosts.desk]
address = "127.0.0.1"
base_port = 5800
[nodes.sensor]
type = "sensor"
host = "edge"
source = "scene:path_40"
[nodes.compressor]
type = "compressor"
host = "edge"
[nodes.reconstructor]
type = "reconstructor"
host = "desk"
[nodes.monitor]
type = "monitor"
host = "desk"
"""


def boxes_and_links(dot: str) -> tuple[dict[str, str], dict[tuple[str, str], str]]:
    """Label of each node and of each link of a text in DOT."""
    text = r'("(?:[^"\\]|\\.)*")'
    boxes = re.findall(rf"^{text} \[label={text}\]$", dot, re.MULTILINE)
    links = re.findall(rf"^{text} -> {text} \[label={text}\]$", dot, re.MULTILINE)
    return (
        {json.loads(name): json.loads(label) for name, label in boxes},
        {(json.loads(a), json.loads(b)): json.loads(label) for a, b, label in links},
    )


@pytest.mark.parametrize("name", ["path_40", "two_patches"])
def test_dot_has_every_node_and_every_topic_on_the_link_of_its_ends(
    name: str, tmp_path: Path
) -> None:
    launch = load(name, record=str(tmp_path / "out.mcap"))
    boxes, links = boxes_and_links(dot_of(launch))
    assert list(boxes) == list(launch.nodes)
    assert set(links) == {(link.writer, link.reader) for link in launch.links}
    for link in launch.links:
        patch, schema = link.topic[1:].split("/")
        (line,) = (
            line
            for line in links[link.writer, link.reader].split("\n")
            if line.startswith(f"/{patch}/ ")
        )
        assert schema in line.removeprefix(f"/{patch}/ ").split(", ")


def test_a_host_is_a_box_around_its_nodes(tmp_path: Path) -> None:
    path = tmp_path / "two.toml"
    path.write_text(HOSTS)
    launch = load(str(path))
    for of in (launch, launch.part("edge")):  # of a part all hosts are drawn
        dot = dot_of(of)
        _, *clusters = re.split(r'^subgraph "cluster_', dot, flags=re.MULTILINE)
        assert [one.partition('"')[0] for one in clusters] == ["edge", "desk"]
        assert '"sensor" [' in clusters[0].partition("\n}")[0]
        assert '"monitor" [' in clusters[1].partition("\n}")[0]


def test_a_dry_run_shows_the_graph_and_writes_dot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dot = tmp_path / "g.dot"
    assert main(["launch", "path_40", "--dry-run", "--dot", str(dot)]) == 0
    assert dot.read_text() == dot_of(load("path_40"))
    out = capsys.readouterr().out
    assert out.rstrip() == graph_text(load("path_40"))
    (line,) = (line for line in out.splitlines() if line.startswith("/skin/measurements "))
    assert line.split() == ["/skin/measurements", "compressor", "reconstructor,", "monitor"]


def test_a_graph_states_its_transport_and_how_its_nodes_are_scheduled() -> None:
    assert "\ntransport ipc\n" in graph_text(load("path_40"))
    changes = ["graph.transport=tcp", "graph.cpus=[1, 0]", "sensor.priority=7"]
    text = " ".join(graph_text(load("path_40", changes)).split())
    assert " transport tcp " in text
    assert text.count("cpus = [0, 1]") == 4
    assert text.count("priority = 7") == 1
