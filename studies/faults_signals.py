"""Faults of single nodes: each is killed, crashes, or is stopped for a while, in turn."""

from __future__ import annotations

import os
import signal
import statistics
import time
from pathlib import Path
from typing import Any

from sparseskin.nodes.recorder.bag_reader import BagReader

from .graph_probe import Probe
from .graph_run import GraphRun, wait_until

RATE_HZ = 100.0
NODES = ("sensor", "compressor", "reconstructor", "monitor", "recorder")
STREAM = ("sensor", "compressor", "reconstructor")
SETTLE_S = 0.4
"""Frames of before a fault, to know that the graph runs as it should."""
GRAPH = """
[graph]
restart = "on-failure"
restart_window_s = 1      # faults follow each other here; each is to count as the first
{graph}

[nodes.sensor]
type = "sensor"
source = "scene:path_40"
rate_hz = {rate_hz:g}

[nodes.compressor]
type = "compressor"

[nodes.reconstructor]
type = "reconstructor"
preset = "skin"

[nodes.monitor]
type = "monitor"
page = false
"""


def graph_text(graph: str = "", rate_hz: float = RATE_HZ) -> str:
    """The launch file of a study, with lines more in its table [graph]."""
    return GRAPH.format(graph=graph, rate_hz=rate_hz)


def strike(
    graph: GraphRun, probe: Probe, node: str, number: signal.Signals, point: dict[str, Any]
) -> dict[str, Any]:
    """Send a node a signal, wait until all is as before, and say what that took.

    Returns
    -------
    dict
        recover_s: from the signal, or from SIGCONT, until a frame acquired after it came out
        restored, half a second old at most; of a monitor or recorder, until it runs again. lost:
        frames that were sensed and not restored. not_sensed: frames that the sensor's rate asks
        for and that it did not acquire. stopped: other nodes that stopped too.

    Raises
    ------
    StudyError
        If the graph does not recover.
    """
    before = graph.nodes()
    restarts = graph.state().get(node, {}).get("restarts", 0)
    began_ns = probe.clock.now_ns()
    probe.wait_for_fresh(began_ns)
    time.sleep(SETTLE_S)
    began_ns = probe.clock.now_ns()
    os.kill(before[node], number)
    if number == signal.SIGSTOP:
        time.sleep(point["stop_s"])
        os.kill(before[node], signal.SIGCONT)
        ended_ns = probe.clock.now_ns()
    else:
        ended_ns = began_ns
    if node in STREAM:
        recover_s = (probe.wait_for_fresh(ended_ns) - ended_ns) / 1e9
    if number != signal.SIGSTOP:
        wait_until(lambda: graph.state()[node]["restarts"] > restarts, f"a restart of the {node}")
    wait_until(lambda: graph.state()[node]["condition"] == "running", f"the {node} to run")
    if node not in STREAM:
        recover_s = (probe.clock.now_ns() - ended_ns) / 1e9
    probe.wait_for_fresh(probe.clock.now_ns())
    time.sleep(SETTLE_S)
    since_ns, until_ns = began_ns - 100_000_000, max(probe.stamps("reconstruction"))
    lost, n_sensed = probe.lost(since_ns)
    expected = (until_ns - since_ns) / 1e9 * point["rate_hz"]
    return {
        "recover_s": recover_s,
        "lost": lost,
        "not_sensed": max(0, round(expected) - n_sensed) if node == "sensor" else 0,
        "stopped": graph.stopped(before, node),
    }


def measure(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The signal `point["signal"]`, `point["repeats"]` times to each node of one graph.

    Parameters
    ----------
    point : dict
        signal: its name. repeats: how often. stop_s: how long SIGSTOP lasts. rate_hz.
    folder : Path
        Empty folder in which the graph runs.

    Returns
    -------
    dict
        struck: what `strike` found of each node, by its name. not_recorded: frames that are in no
        recording, a repeat. left: what the graph left behind. took_s.
    """
    began_s = time.monotonic()
    number = signal.Signals[point["signal"]]
    struck: dict[str, list[dict[str, Any]]] = {node: [] for node in NODES}
    with GraphRun(folder, graph_text(rate_hz=point["rate_hz"]), "--record", "run.mcap") as graph:
        with Probe(graph, ("taxels", "reconstruction")) as probe:
            for _ in range(point["repeats"]):
                for node in NODES:
                    struck[node].append(strike(graph, probe, node, number, point))
            sensed = probe.stamps("taxels")
        in_memory = graph.shared_memory()
        graph.end()
        left = [what for what in graph.left() if not what.endswith(".mcap.part")] + in_memory
    return {
        "struck": struck,
        "not_recorded": not_recorded(folder, sensed) / point["repeats"],
        "left": left,
        "took_s": round(time.monotonic() - began_s, 1),
    }


def rows_of(signal_name: str, lots: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row a node, of all that was measured of a signal, lot by lot."""
    rows = []
    for node in NODES:
        found = [s for lot in lots for s in lot["struck"][node]]
        unrecorded = statistics.mean(lot["not_recorded"] for lot in lots)
        rows.append(
            {
                "fault": signal_name,
                "node": node,
                "recover_s": [round(s["recover_s"], 4) for s in found],
                "lost": statistics.median(s["lost"] for s in found),
                "not_sensed": statistics.median(s["not_sensed"] for s in found),
                "not_recorded": round(unrecorded, 1) if node == "recorder" else 0,
                "stopped": sorted({name for s in found for name in s["stopped"]}),
                "left": [what for lot in lots for what in lot["left"]],
            }
        )
    return rows


def not_recorded(folder: Path, sensed: set[int]) -> int:
    """How many of the frames that were sensed, from the first to the last that was recorded, are
    in none of the recordings: complete ones, and those that a killed recorder has left.
    """
    recorded: set[int] = set()
    for path in folder.glob("run*.mcap*"):
        with BagReader(path) as bag:
            recorded |= {message.stamp_ns for message in bag.messages(["/skin/taxels"])}
    inside = {stamp for stamp in sensed if min(recorded) <= stamp <= max(recorded)}
    return len(inside - recorded)
