"""Nodes that are late as a graph starts or ends, and what each one waits for."""

import os
import signal
from types import SimpleNamespace

import pytest
from conftest import wait_until
from fake_node import FakeNode

from sparseskin.launch.launchfile.hosts import Host
from sparseskin.launch.launchfile.spec import LaunchFile, NodeSpec
from sparseskin.launch.run.state import hosts_state
from sparseskin.launch.run.waiting import AFTER_S, AGAIN_S, LateLog, late_at_end, waits_for
from sparseskin.nodes.graph import Link
from sparseskin.nodes.node import Node
from sparseskin.nodes.player.node import PlayerSettings

LINKS = [
    Link("/skin/taxels", "sensor", "compressor"),
    Link("/skin/taxels", "sensor", "monitor"),
    Link("/skin/measurements", "compressor", "monitor"),
]


PART = LaunchFile(
    *("drag", "", "ipc", {}, []),
    hosts={name: Host("127.0.0.1") for name in ("edge", "desk", "wall")},
    host="edge",
    elsewhere={
        name: NodeSpec(name, "none", Node, {}, None, host=host)
        for name, host in (("echo", "desk"), ("screen", "wall"))
    },
)


def test_each_node_that_is_not_ready_reports_what_it_waits_for():
    made = (
        FakeNode("sensor", endpoint=""),
        FakeNode("compressor", lacks=["echo", "monitor", "reconstructor"]),
        FakeNode("recorder"),
        FakeNode("monitor", SimpleNamespace(settings=None), ready=True),
        FakeNode("player", failed=True),
    )
    assert [waits_for(node, PART) for node in made] == [
        "sensor has not started: it imports, compiles, or opens its device",
        "compressor waits for a subscription from echo on desk, monitor, reconstructor",
        "recorder has not answered yet",
        "",
        "",
    ]


def test_a_host_is_heard_where_all_that_is_read_there_is_and_its_best_known_clock_is_reported():
    desk, wall = hosts_state(
        PART,
        [
            FakeNode(heard={"echo": True, "screen": False}, clocks={"desk": (3_000_000, 900_000)}),
            FakeNode(heard={"echo": True}, clocks={"desk": (2_500_000, 400_000)}),
        ],
    ).values()
    assert (desk["heard"], desk["silent"]) == (True, [])
    assert (wall["heard"], wall["silent"]) == (False, ["screen"])
    assert desk["clock_offset_ms"] == pytest.approx(2.5)
    assert desk["clock_uncertainty_ms"] == pytest.approx(0.4)
    assert wall["clock_offset_ms"] is None


def test_who_has_not_ended_waits_for_those_before_it():
    sensor, compressor, monitor = FakeNode("sensor"), FakeNode("compressor"), FakeNode("monitor")
    assert late_at_end([sensor, compressor, monitor], LINKS) == [
        "sensor (has not ended its stream)",
        "compressor (waits for sensor)",
        "monitor (waits for compressor, sensor)",
    ]
    sensor.ended = True
    assert late_at_end([sensor, compressor, monitor], LINKS) == [
        "compressor (has not ended its stream)",
        "monitor (waits for compressor)",
    ]


def test_what_is_late_is_logged_after_a_while_and_again_now_and_then():
    now_s, logged, late = [100.0], list[str](), ["a"]
    log = LateLog(lambda: list(late), logged.append, now_s=lambda: now_s[0])
    for step_s, changed, n in (
        (0.0, ["a"], 0),
        (AFTER_S - 0.1, ["a"], 0),
        (0.2, ["a"], 1),
        (AGAIN_S - 0.2, ["a"], 1),
        (0.3, ["a"], 2),
        (AGAIN_S, ["b"], 2),
        (AFTER_S, ["b"], 3),
        (2 * AGAIN_S, [], 3),
    ):
        now_s[0], late[:] = now_s[0] + step_s, changed
        log.look()
        assert len(logged) == n, (step_s, changed)
    assert logged == ["[launch] a", "[launch] a", "[launch] b"]


LATCHED, SENT = ({"published": {topic: 1}} for topic in ("/skin/skin", "/skin/taxels"))
WAITS = "from another terminal: sparseskin monitor --graph drag, or sparseskin record --graph drag"


@pytest.mark.parametrize(
    ("stated", "fields", "line"),
    [
        ({"lockstep": True}, {}, f"player waits for a reader; {WAITS}"),
        ({"wait": 1}, {"counts": LATCHED}, f"player waits for a reader; {WAITS}"),
        ({"wait": 1}, {"counts": SENT}, ""),
        ({"lockstep": True}, {"state": {"paused": True}}, ""),
        ({"lockstep": True}, {"ended": True}, ""),
        ({}, {}, ""),
    ],
)
def test_a_player_that_has_sent_no_frame_reports_which_readers_it_waits_for(stated, fields, line):
    spec = SimpleNamespace(settings=PlayerSettings(**stated))
    assert waits_for(FakeNode("player", spec, ready=True, **fields), PART) == line


@pytest.mark.slow
def test_who_holds_up_the_end_is_named_with_what_waits_for_it(start):
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
