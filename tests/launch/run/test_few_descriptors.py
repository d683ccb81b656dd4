"""A graph that is short of file descriptors goes on."""

from __future__ import annotations

import os
import resource
import signal
import socket
from pathlib import Path

import pytest
from conftest import StartProgram, note_of_graph

from sparseskin.launch.run.running import running_graphs
from sparseskin.nodes.process.memory import EVERY, FreeMemory

GRAPH = """
[graph]
transport = "tcp"
[nodes.sensor]
type = "sensor"
source = "scene:path_40"
rate_hz = 20
[nodes.compressor]
type = "compressor"
[nodes.reconstructor]
type = "reconstructor"
"""


def test_memory_is_not_looked_through_while_no_file_can_be_opened() -> None:
    free, limits = FreeMemory(), resource.getrlimit(resource.RLIMIT_NOFILE)
    free.trim()
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, limits[1]))
    try:
        for _ in range(EVERY):
            free.trim()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_half_open_connections_end_no_node(
    start: StartProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "graph.toml").write_text(GRAPH)
    limit = ("bash", "-c", 'ulimit -n 64; exec "$@"', "-")
    program = start("launch", "graph.toml", "--summary", "summary.json", prefix=limit)
    program.wait_for("[launch] ready")
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    note_of_graph(tmp_path / "graphs")
    nodes = running_graphs()[0].nodes
    strangers = []
    for node in nodes.values():
        address = ("127.0.0.1", int(node.endpoint.rpartition(":")[2]))
        strangers += [socket.create_connection(address) for _ in range(100)]
    for name in ("sensor", "compressor", "reconstructor"):
        program.wait_for("] turned away 127.0.0.1:")
        assert name in nodes
    pids = {name: program.pid_of(name) for name in nodes}
    for stranger in strangers:
        stranger.close()
    os.kill(program.process.pid, signal.SIGINT)
    code, _, stderr = program.finish()
    assert code == 128 + signal.SIGINT, stderr
    assert len(pids) == 3
    assert "ended too early" not in stderr
