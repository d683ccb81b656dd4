"""Nodes that are late as a graph starts or ends, and what each one waits for."""

from __future__ import annotations

import os
import signal
from types import SimpleNamespace
from typing import Any

import pytest
from conftest import StartProgram, wait_until
from fake_node import FakeNode

from sparseskin.launch.run.waiting import (
    LateLog,
    all_read,
    lacks_readers,
    late_at_end,
    late_at_start,
)
from sparseskin.nodes.graph import Link
from sparseskin.nodes.player.settings import PlayerSettings

LINKS = [
    Link("/skin/taxels", "sensor", "compressor"),
    Link("/skin/taxels", "sensor", "monitor"),
    Link("/skin/measurements", "compressor", "monitor"),
]


def says(node: FakeNode, received: int) -> None:
    """A heartbeat of a node comes."""
    node.heard_s += 0.5
    node.counts = {"received": received}


def nodes(*made: FakeNode) -> Any:
    return list(made)


def test_each_node_that_is_not_ready_reports_what_it_waits_for() -> None:
    made = nodes(
        FakeNode("sensor", endpoint=""),
        FakeNode("compressor", lacks=["monitor", "reconstructor"]),
        FakeNode("recorder"),
        FakeNode("monitor", ready=True),
    )
    assert [late_at_start(node, 5.0) for node in made] == [
        "sensor has not started: it imports, or opens its device (5 s)",
        "compressor waits for a subscription from monitor, reconstructor (5 s)",
        "recorder has not answered yet (5 s)",
        "",
    ]


def test_all_is_read_once_the_counts_are_the_same_over_two_heartbeats() -> None:
    recorder, monitor = FakeNode("recorder"), FakeNode("monitor")
    done = all_read(nodes(recorder, monitor, FakeNode("late", ended=True)))
    for received in (0, 64, 65):
        for node in (recorder, monitor):
            says(node, received)
        assert not done()
        assert not done()  # silence is no heartbeat
    for received, both in ((65, False), (65, True), (70, False)):
        says(monitor, 65)
        says(recorder, received)
        assert done() == both


def test_who_has_not_ended_waits_for_those_before_it() -> None:
    sensor, compressor, monitor = FakeNode("sensor"), FakeNode("compressor"), FakeNode("monitor")
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


def test_what_is_late_is_logged_once_after_a_while() -> None:
    now_s, lines, late = [100.0], list[str](), ["", "sensor has not answered yet"]
    log = LateLog(lambda: late, lines.append, 5.0, now_s=lambda: now_s[0])
    for now_s[0] in (100.0, 104.9):
        log.look()
        assert lines == []
    for now_s[0] in (105.0, 105.1, 200.0):
        log.look()
        late[0] = "another"
    assert lines == ["[launch] sensor has not answered yet"]


LATCHED, SENT = ({"published": {topic: 1}} for topic in ("/skin/skin", "/skin/taxels"))
WAITS = "from another terminal: sparseskin monitor --graph drag, or sparseskin record --graph drag"


@pytest.mark.parametrize(
    ("stated", "fields", "line"),
    [
        ({"lockstep": True}, {}, f"player waits for a reader; {WAITS}"),
        ({"wait": 2}, {}, f"player waits for 2 readers; {WAITS}"),
        ({"wait": 1}, {"counts": LATCHED}, f"player waits for a reader; {WAITS}"),
        ({"wait": 1}, {"counts": SENT}, ""),
        ({"lockstep": True}, {"state": {"paused": True}}, ""),
        ({"lockstep": True}, {"state": {}}, ""),
        ({"lockstep": True}, {"ended": True}, ""),
        ({}, {}, ""),
    ],
)
def test_a_player_that_has_sent_no_frame_reports_which_readers_it_waits_for(
    stated: dict[str, Any], fields: dict[str, Any], line: str
) -> None:
    spec = SimpleNamespace(settings=PlayerSettings(**stated))
    (node,) = nodes(FakeNode("player", spec, **fields))
    assert lacks_readers(node, "drag") == line


def test_what_is_no_player_waits_for_nobody() -> None:
    (node,) = nodes(FakeNode("sensor", SimpleNamespace(settings=None)))
    assert lacks_readers(node, "drag") == ""


@pytest.mark.slow
def test_who_holds_up_the_end_is_named_with_what_waits_for_it(start: StartProgram) -> None:
    program = start("launch", "path_40", "--set", "monitor.page=false", limits=True)
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
