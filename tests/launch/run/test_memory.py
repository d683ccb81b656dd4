"""Memory of a queue that grew while a node was stopped is freed, by the node and its writer."""

from __future__ import annotations

import os
import platform
import re
import signal
from pathlib import Path

import pytest
from conftest import StartProgram, wait_until

MB = 1024
GRAPH = """
[nodes.sensor]
type = "sensor"
source = "endless:frames"
rate_hz = 300

[nodes.compressor]
type = "compressor"

[nodes.reconstructor]
type = "reconstructor"

[nodes.monitor]
type = "monitor"
page = false
"""
ENDLESS = """
import itertools
import numpy as np

def frames():
    forces = np.zeros((64, 64), np.float32)
    for k in itertools.count():
        yield k * 1_000_000, forces
"""


def resident_kb(pid: int) -> int:
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1])


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps it otherwise")
@pytest.mark.slow
def test_memory_of_a_queue_that_was_long_is_given_back(start: StartProgram, tmp_path: Path) -> None:
    (tmp_path / "endless.py").write_text(ENDLESS)
    (tmp_path / "graph.toml").write_text(GRAPH)
    graph = start("launch", "graph.toml")
    graph.wait_for("[launch] ready")
    monitor, sensor = graph.pid_of("monitor"), graph.pid_of("sensor")
    before, waiting = resident_kb(monitor), resident_kb(sensor)
    os.kill(monitor, signal.SIGSTOP)
    # What the stopped node does not read waits with its writer first.
    wait_until(lambda: resident_kb(sensor) > waiting + 8 * MB, "a queue at the sensor")
    os.kill(monitor, signal.SIGCONT)
    wait_until(lambda: resident_kb(monitor) > before + 12 * MB, "the queue at the monitor")
    wait_until(lambda: resident_kb(monitor) < before + 8 * MB, "its memory to be given back")
    wait_until(lambda: resident_kb(sensor) < waiting + 4 * MB, "that of the sensor, too")
    graph.process.send_signal(signal.SIGINT)
    assert graph.finish()[0] == 130
