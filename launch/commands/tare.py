"""The command `sparseskin tare`: the reading of an untouched skin becomes its zero."""

from __future__ import annotations

import argparse
import time
from typing import Any

from sparseskin.launch.attach.client import ask_node, describe, describe_node
from sparseskin.launch.run.running import GraphError, RunningGraph, choose_graph
from sparseskin.nodes.lookup import did_you_mean

from .options import add_graph, show, whole

COMMAND = "tare"
POLL_S = 0.1
PATIENCE_S = 60.0
"""Longest time without another frame of a tare, seconds; chosen."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `tare`."""
    parser.description = (
        "Take the next frames of the sensors of a running graph for the baseline; the skin must be "
        "untouched. Returns once it is done."
    )
    about = "names of sensors; all that have a calibration by default"
    parser.add_argument("nodes", metavar="NODE", nargs="*", help=about)
    about = "number of frames, whose median is taken (default: 30)"
    parser.add_argument("--frames", metavar="N", type=whole(1), help=about)
    add_graph(parser, "one JSON document")
    parser.set_defaults(run=_tare)


def _tare(arguments: argparse.Namespace) -> int:
    graph = choose_graph(arguments.graph)
    names = arguments.nodes or _calibrated(graph)
    for name in names:
        answer = ask_node(graph, name, COMMAND, arguments.frames)
        if not answer.done:
            raise GraphError(f"{name}: {answer.text.removeprefix(f'{name}: ')}")
    results = {name: _wait(graph, name) for name in names}
    lines = [f"{name}: {text}" for name, text in results.items()]
    return show(arguments, "tare-result", {"graph": graph.label, "tared": results}, lines)


def _calibrated(graph: RunningGraph) -> list[str]:
    nodes: list[dict[str, Any]] = describe(graph)["nodes"]
    sensors = [node["name"] for node in nodes if node["type"] == "sensor"]
    found = [node["name"] for node in nodes if "tare_left" in node["state"]]
    if not found:
        hint = "; state sensor.skin, or sensor.tare, in the launch file" if sensors else ""
        raise GraphError(f"{graph.label}: has no sensor with a calibration{hint}")
    return found


def _wait(graph: RunningGraph, name: str) -> str:
    """Wait for the end of a tare; return its result."""
    heard_s, before = time.monotonic(), None
    while time.monotonic() - heard_s < PATIENCE_S:
        state = describe_node(graph, name)["state"]
        left = state.get("tare_left")
        if left == 0:
            return str(state.get("tared", ""))
        if left is None:
            raise GraphError(f"{name}: has no calibration{did_you_mean(name, ())}")
        if left != before:
            heard_s, before = time.monotonic(), left
        time.sleep(POLL_S)
    raise GraphError(f"{name}: no frame for {PATIENCE_S:g} s; {before} frames are missing")
