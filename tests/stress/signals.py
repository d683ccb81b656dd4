"""Faults of single nodes: each is killed, crashes, or is stopped for a while, in turn."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from stress.graphs import ObservedGraph, graph_text, wait_until

from sparseskin.nodes.recorder.bag.reader import BagReader

NODES = ("sensor", "compressor", "reconstructor", "monitor", "recorder")
STREAM = ("sensor", "compressor", "reconstructor")
SETTLE_S = 0.4
"""Time for frames before and after a fault, to see that the graph runs as it should."""
BEFORE_NS = 100_000_000
"""Time before a fault from which frames are counted."""


def strike(
    graph: ObservedGraph, node: str, number: signal.Signals, point: dict[str, Any]
) -> dict[str, Any]:
    """Send a node a signal, and wait until the graph runs as before.

    Returns
    -------
    dict
        recover_s: from the signal, or from SIGCONT, until the reconstruction of a frame acquired
        after it came, half a second old at most; of a monitor or recorder, until it runs again.
        lost: frames acquired and not reconstructed. not_sensed: frames due by the sensor's rate
        and not acquired. stopped: other nodes that stopped too.

    Raises
    ------
    GraphError
        If the graph does not recover.
    """
    probe, before = graph.probe, graph.nodes()
    restarts = graph.state().get(node, {}).get("restarts", 0)
    probe.wait_for_frame()
    time.sleep(SETTLE_S)
    began_ns = ended_ns = probe.now_ns()
    os.kill(before[node], number)
    if number == signal.SIGSTOP:
        time.sleep(point["stop_s"])
        os.kill(before[node], signal.SIGCONT)
        ended_ns = probe.now_ns()
    if node in STREAM:
        recover_s = probe.wait_for_frame(ended_ns)
    if number != signal.SIGSTOP:
        wait_until(lambda: graph.state()[node]["restarts"] > restarts, f"a restart of the {node}")
    wait_until(lambda: graph.state()[node]["condition"] == "running", f"the {node} to run")
    if node not in STREAM:
        recover_s = (probe.now_ns() - ended_ns) / 1e9
    probe.wait_for_frame()
    time.sleep(SETTLE_S)
    since_ns = began_ns - BEFORE_NS
    until_ns = max(seen.stamp_ns for seen in list(probe.reconstructed))
    lost, n_sensed = probe.lost(since_ns)
    expected = round((until_ns - since_ns) / 1e9 * point["rate_hz"])
    return {
        "recover_s": recover_s,
        "lost": lost,
        "not_sensed": max(0, expected - n_sensed) if node == "sensor" else 0,
        "stopped": graph.stopped(before, node),
    }


def measure(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Send a signal `point["repeats"]` times to each node of one graph.

    `point`: signal: its name. repeats. stop_s: duration of SIGSTOP. rate_hz. transport: of the
        graph, None: the default.
    folder : Path
        Empty folder in which the graph runs.

    Returns
    -------
    dict
        struck: results of `strike`, by node. not_recorded: frames that are in no recording, a
        repeat. left: what the graph left behind.
    """
    number = signal.Signals[point["signal"]]
    graph_table = {"transport": point["transport"]}
    launch = graph_text(graph_table, sensor={"rate_hz": point["rate_hz"]})
    struck: dict[str, list[dict[str, Any]]] = {node: [] for node in NODES}
    with ObservedGraph(launch, "--record", "run.mcap", folder=folder) as graph:
        for _ in range(point["repeats"]):
            for node in NODES:
                struck[node].append(strike(graph, node, number, point))
        sensed = {seen.stamp_ns for seen in list(graph.probe.sensed)}
        in_memory = graph.shared_memory()
        graph.end()
        left = graph.left_behind() + in_memory
    return {
        "struck": struck,
        "not_recorded": not_recorded(folder, sensed) / point["repeats"],
        "left": [what for what in left if not what.endswith(".mcap.part")],
    }


def not_recorded(folder: Path, sensed: set[int]) -> int:
    """Number of frames that are in no recording, of those acquired between the first and the last
    that is in one; recordings that a killed recorder has left are read too.
    """
    recorded: set[int] = set()
    for path in folder.glob("run*.mcap*"):
        with BagReader(path) as bag:
            recorded |= {message.stamp_ns for message in bag.messages(["/skin/taxels"])}
    inside = {stamp for stamp in sensed if min(recorded) <= stamp <= max(recorded)}
    return len(inside - recorded)
