"""Reports of a part about the hosts that it waits for, and about those that it hears."""

from __future__ import annotations

from typing import Any

import pytest
from fake_node import FakeNode

from sparseskin.launch.launchfile.hosts import Host
from sparseskin.launch.launchfile.spec import LaunchFile, NodeSpec
from sparseskin.launch.run.state import hosts_state
from sparseskin.launch.run.waiting import AGAIN_S, HOST_S, LateLog, missing_nodes
from sparseskin.nodes.node import Node


def spec(name: str, host: str) -> NodeSpec:
    return NodeSpec(name, "none", Node, {}, None, host=host)


PART = LaunchFile(
    *("two", "", "ipc", {}, []),
    hosts={name: Host("127.0.0.1") for name in ("edge", "desk", "wall")},
    host="edge",
    elsewhere={"echo": spec("echo", "desk"), "screen": spec("screen", "wall")},
)


def test_who_is_missing_is_named_after_a_while_then_now_and_then() -> None:
    said: list[str] = []
    lacking: Any = [FakeNode(lacks=["echo"]), FakeNode(lacks=["screen", "local"])]
    now_s = [0.0]
    log = LateLog(
        lambda: missing_nodes(lacking, PART), said.append, HOST_S, AGAIN_S, lambda: now_s[0]
    )
    now_s[0] = HOST_S - 0.1
    log.look()
    assert said == []
    for now_s[0] in (HOST_S, HOST_S + 0.1, HOST_S + AGAIN_S - 0.1):
        log.look()
    once = ["[launch] waits for echo on desk", "[launch] waits for screen on wall"]
    assert said == once
    now_s[0] = HOST_S + AGAIN_S
    log.look()
    assert said == 2 * once
    now_s[0], lacking[:] = now_s[0] + 0.1, [FakeNode(lacks=["screen"])]
    log.look()
    assert said[4:] == once[1:]
    now_s[0], lacking[:] = now_s[0] + 2 * AGAIN_S, [FakeNode()]
    log.look()
    assert len(said) == 5


def test_a_host_is_heard_where_all_that_is_read_there_is() -> None:
    nodes: Any = [FakeNode(heard={"echo": True, "screen": False}), FakeNode(heard={"echo": True})]
    state = hosts_state(PART, nodes)
    assert list(state) == ["desk", "wall"]
    assert (state["desk"]["heard"], state["desk"]["silent"]) == (True, [])
    assert (state["wall"]["heard"], state["wall"]["silent"]) == (False, ["screen"])


def test_the_clock_that_is_known_best_is_reported() -> None:
    nodes: Any = [
        FakeNode(clocks={"desk": (3_000_000, 900_000)}),
        FakeNode(clocks={"desk": (2_500_000, 400_000)}),
    ]
    desk = hosts_state(PART, nodes)["desk"]
    assert desk["clock_offset_ms"] == pytest.approx(2.5)
    assert desk["clock_uncertainty_ms"] == pytest.approx(0.4)
    assert hosts_state(PART, nodes)["wall"]["clock_offset_ms"] is None
