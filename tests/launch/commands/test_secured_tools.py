"""Tools beside a graph that is secured with keys, each as on a host of its own.

A host is its folder of notes: tools find there where the nodes are, and which key to present.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Program, StartProgram, free_port, wait_until
from processes import announced

from sparseskin.launch.run.running import RunningGraph, running_graphs
from sparseskin.nodes.network.keys import make_key_files, read_public_key
from sparseskin.nodes.recorder.bag.reader import BagReader

GRAPH = """\
[hosts.edge]
address = "127.0.0.1"
base_port = {edge_port}
[hosts.desk]
address = "127.0.0.1"
[security]
keys = "keys"
[nodes.sensor]
type = "sensor"
source = "sparseskin.studies.looped:truth_40"
rate_hz = 50
host = "edge"
[nodes.compressor]
type = "compressor"
host = "edge"
[nodes.reconstructor]
type = "reconstructor"
host = "edge"
[nodes.recorder]
type = "recorder"
out = "desk.mcap"
topics = ["/skin/taxels"]
host = "desk"
"""
COMMANDS = {
    "echo": ("topic", "echo", "/skin/taxels", "--field", "seq"),
    "record": ("record", "/skin/measurements", "/skin/phi", "--out", "some.mcap"),
    "monitor": ("monitor", "--text"),
}
N_BYTES = 50_000


class Secured:
    """A graph in two parts, both of which run; the one of the edge is looked at."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("edge", "desk"):
            make_key_files(name, folder / "keys")
        self.port = min(free_port(), 65000)
        (folder / "graph.toml").write_text(GRAPH.format(edge_port=self.port))
        self.parts: list[Program] = []
        for host in ("edge", "desk"):
            (folder / host).mkdir()
            arguments = ("launch", "../graph.toml", "--host", host)
            self.parts.append(Program(*arguments, cwd=folder / host))
        for part in self.parts:
            part.wait_for("[launch] ready")

    def seen_by_desk(self, note: RunningGraph) -> RunningGraph:
        """The note of the edge as the desk would have it: reached over TCP, with the desk's key."""
        public = read_public_key(self.folder / "keys/edge.pub")
        nodes = {
            name: replace(node, endpoint=f"tcp://127.0.0.1:{self.port + k}", key=public)
            for k, (name, node) in enumerate(note.nodes.items())
        }
        return replace(note, nodes=nodes, key_file=str(self.folder / "keys/desk.key"))

    def close(self) -> None:
        for program in self.parts:
            program.kill_all()
            program.process.communicate()


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    made = Secured(tmp_path_factory.mktemp("secured"))
    yield made
    made.close()


@pytest.fixture
def note(secured: Secured, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> RunningGraph:
    """The note of the edge; from now on, those that this process leaves are of another host."""
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(secured.folder / "edge/graphs"))
    wait_until(lambda: bool(running_graphs()), "the note of the graph")
    (note,) = running_graphs()
    control = Path(note.control)
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    Path(note.control).symlink_to(control)
    return note


def test_a_listed_host_is_served_by_every_tool(
    secured: Secured, note: RunningGraph, start: StartProgram, tmp_path: Path
) -> None:
    with announced(secured.seen_by_desk(note)):
        code, out, _ = start(*COMMANDS["echo"], "-n", "3").finish()
        assert (code, len(out.split())) == (0, 3)
        monitor = start(*COMMANDS["monitor"])
        monitor.wait_for("[launch] ready")
        recorded = start(*COMMANDS["record"])
        part = tmp_path / "some.mcap.part"
        wait_until(lambda: part.exists() and part.stat().st_size > N_BYTES, "a recording")
        for program in (recorded, monitor):
            program.process.send_signal(signal.SIGINT)
        assert recorded.finish()[0] == 0
        with BagReader(tmp_path / "some.mcap") as bag:
            assert bag.topics["/skin/phi"].n_messages == 1
            assert bag.topics["/skin/measurements"].n_messages > 0
        code, out, _ = monitor.finish()
        assert code == 0
        assert re.search(r"reconstructed [1-9]", out)


def test_beside_the_graph_the_tools_find_its_key_by_themselves(
    secured: Secured, tmp_path: Path
) -> None:
    echo = Program(*COMMANDS["echo"], "-n", "1", cwd=secured.folder / "edge")
    code, out, stderr = echo.finish()
    assert (code, len(out.split())) == (0, 1), stderr
