"""Who is late as a graph starts or ends, and what each one waits for."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass, field
from typing import Any

from conftest import StartProgram, wait_until

from sparseskin.launch import late
from sparseskin.launch.late import late_at_end, late_at_start, or_tell
from sparseskin.nodes.graph import Link

LINKS = [
    Link("/skin/taxels", "sensor", "compressor"),
    Link("/skin/taxels", "sensor", "monitor"),
    Link("/skin/measurements", "compressor", "monitor"),
]


@dataclass
class Node:
    name: str
    endpoint: str = "tcp://127.0.0.1:1"
    ready: bool = False
    ended: bool = False
    lacks: list[str] = field(default_factory=list)


def nodes(*made: Node) -> Any:
    return list(made)


def test_each_node_that_is_not_ready_says_what_it_waits_for() -> None:
    made = nodes(
        Node("sensor", endpoint=""),
        Node("compressor", lacks=["monitor", "reconstructor"]),
        Node("recorder"),
        Node("monitor", ready=True),
    )
    assert [late_at_start(node) for node in made] == [
        "sensor has not started: it imports, or opens its device",
        "compressor waits for a subscription from monitor, reconstructor",
        "recorder has not answered yet",
        "",
    ]


def test_who_has_not_ended_waits_for_those_before_it() -> None:
    sensor, compressor, monitor = Node("sensor"), Node("compressor"), Node("monitor")
    assert late_at_end(nodes(sensor, compressor, monitor), LINKS) == [
        "sensor (has not ended its stream)",
        "compressor (waits for sensor)",
        "monitor (waits for compressor, sensor)",
    ]
    sensor.ended = True
    assert late_at_end(nodes(sensor, compressor, monitor), LINKS) == [
        "compressor (has not ended its stream)",
        "monitor (waits for compressor)",
    ]


def test_a_start_is_told_of_once_it_is_slow_and_once_only() -> None:
    now_s, is_done, lines = 100.0, False, []
    check = or_tell(
        lambda: is_done, nodes(Node("sensor", endpoint="")), lines.append, lambda: now_s
    )
    assert (check(), lines) == (False, [])
    now_s += late.SLOW_S
    for _ in range(3):
        assert not check()
    assert lines == ["[launch] sensor has not started: it imports, or opens its device (5 s)"]
    is_done = True
    assert check()


def test_who_holds_up_the_end_is_named_with_what_waits_for_it(start: StartProgram) -> None:
    program = start("launch", "path_40", "--set", "monitor.page=false")
    program.wait_for("[launch] ready")
    os.kill(program.pid_of("compressor"), signal.SIGSTOP)
    program.process.send_signal(signal.SIGINT)
    told = program.wait_for("[launch] not drained after 5 s: ")
    assert told.startswith("compressor (has not ended its stream), reconstructor (waits for comp")
    assert "monitor (waits for compressor, reconstructor)" in told
    program.wait_for("[launch] compressor does not end: SIGTERM")
    program.wait_for("[launch] compressor does not end: SIGKILL")
    program.finish()
    wait_until(lambda: program.survivors() == {}, "the end of all processes")


def test_a_driver_that_takes_its_time_is_named(start: StartProgram, tmp_path: Any) -> None:
    (tmp_path / "slow.py").write_text(
        "import time\nimport numpy as np\ndef frames():\n    time.sleep(7)\n"
        "    yield 0, np.zeros((8, 8))\n"
    )
    (tmp_path / "g.toml").write_text('[nodes.sensor]\ntype = "sensor"\nsource = "slow:frames"\n')
    program = start("launch", "g.toml")
    program.wait_for("[launch] sensor has not started: it imports, or opens its device (5 s)")
    program.wait_for("[launch] ready")
    program.finish()
