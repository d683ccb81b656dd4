"""Memory of a queue that was long returns to the system, in the reader and in the writer."""

from __future__ import annotations

import platform
import re
import signal
from pathlib import Path

import pytest
from conftest import StartProgram, wait_until

KB_A_QUEUE = 12 * 1024
GRAPH = """
[nodes.sensor]
type = "sensor"
source = "held:frames"
rate_hz = 1000

[nodes.reader]
type = "held:Reader"
"""
HELD = """
import itertools
import pathlib
import time
import numpy as np
from sparseskin.nodes.node import Node
from sparseskin.nodes.settings import Settings

def frames():
    forces = np.zeros((64, 64), np.float32)
    for k in itertools.count():
        yield k * 1_000_000, forces

class Reader(Node):
    Settings = Settings

    @classmethod
    def inputs(cls, settings):
        return ("/skin/taxels",)

    def step(self, message):
        while pathlib.Path("hold").exists():
            time.sleep(0.01)
        return ()
"""


def resident_kb(pid: int) -> int:
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1])


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps it otherwise")
@pytest.mark.slow
def test_memory_of_a_queue_that_was_long_is_freed(start: StartProgram, tmp_path: Path) -> None:
    (tmp_path / "held.py").write_text(HELD)
    (tmp_path / "graph.toml").write_text(GRAPH)
    graph = start("launch", "graph.toml")
    graph.wait_for("[launch] ready")
    pids = {node: graph.pid_of(node) for node in ("reader", "sensor")}
    before = {node: resident_kb(pid) for node, pid in pids.items()}
    hold = tmp_path / "hold"
    hold.touch()
    # The queue of the reader fills first, then that of the writer.
    for node, pid in pids.items():
        wait_until(lambda: resident_kb(pid) > before[node] + KB_A_QUEUE, f"a queue at the {node}")  # noqa: B023
    hold.unlink()
    for node, pid in pids.items():
        wait_until(lambda: resident_kb(pid) < before[node] + KB_A_QUEUE / 2, f"less at the {node}")  # noqa: B023
    graph.process.send_signal(signal.SIGINT)
    assert graph.finish()[0] == 130
