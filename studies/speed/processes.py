"""The nodes of a graph in four processes, and in fewer: processor time and age of a frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.process.scheduling import Scheduling

from . import latency
from .beside import WARM_UP, ages_ms, medians
from .stopwatch import PROCESSOR, WATCH

EDGE = "edge"
HOST = "host"
SHARED = "shared"
NODES = ("sensor", "compressor", "reconstructor", "monitor")
FOUR = "four"
PROCESSES: dict[str, dict[str, str]] = {
    FOUR: {},
    "two": dict(zip(NODES, (EDGE, EDGE, HOST, HOST), strict=True)),
    "monitor apart": dict.fromkeys(NODES[:-1], SHARED),
    "one": dict.fromkeys(NODES, SHARED),
}
"""Name of the process of each node that shares one, by the kind of graph."""
RATIOS = {
    "cpu": "cpu_us",
    "p50": "p50_ms",
    "p99": "p99_ms",
}
"""Figure of each ratio."""
SCENE = "drag_wrench_40"
RATES_HZ = (1000, 300, 100)
QUICK_RATES_HZ = (1000,)
SECONDS = 3.0
SLICES = 3
"""Length of a slice, and number of slices of each; as in `beside`, their medians count."""
STEPS = 1
"""Steps of the solver in a frame: the pace of 1 kHz on a small host; of more steps the solver,
which is the same everywhere, would hide the difference."""
PRIORITY = 5
"""Real-time priority of the nodes where it is permitted: four processes get more of a busy host
than one, which says nothing about either."""


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """One graph with a monitor, at 1 kHz, and if not quick at lower rates, too."""
    common: dict[str, Any] = {
        "scene": SCENE,
        "preset": "skin",
        "depth": 1,
        "iterations": STEPS,
        "monitor": True,
    }
    common |= {
        "seed": seed,
        "slices": SLICES,
        "seconds": SECONDS,
    }
    rates_hz = QUICK_RATES_HZ if quick else RATES_HZ
    # Stated in the point: figures with and without it are not mixed.
    try:
        Scheduling(priority=PRIORITY).check_permitted()
    except SettingsError:
        common["priority"] = 0
    else:
        common["priority"] = PRIORITY
    return [{**common, "rate_hz": rate_hz} for rate_hz in rates_hz]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Run the graph of a point with its nodes in each of `PROCESSES`, in turn.

    `point`: scene, rate_hz, priority, preset, depth, iterations, monitor, slices, seconds of each.
    Returns medians over the slices, by the kind of graph: "KIND cpu_us", processor time of all
    nodes for a frame of the sensor; "KIND p50_ms" and "KIND p99_ms" of the age of a frame when it
    is reconstructed; "KIND hz", the rate that the sensor reached; "KIND skipped", the part of its
    frames that was not reconstructed; and "KIND NAME ratio" of `RATIOS`, to four processes in the
    same slice. Raises StudyError if a node fails.
    """
    n_frames = round(point["seconds"] * point["rate_hz"])
    slices = []
    for _ in range(point["slices"]):
        figures = {}
        for kind, of_nodes in PROCESSES.items():
            graph = {
                **point,
                "n_frames": n_frames,
                "processes": of_nodes,
            }
            figures[kind] = _figures(latency.run_graph(graph), of_nodes)
        slices.append(with_ratios(figures))
    return medians(slices)


def with_ratios(figures: dict[str, dict[str, float]]) -> dict[str, float]:
    """Figures of a slice by the kind of graph, and their ratios to those of four processes."""
    flat: dict[str, float] = {}
    for kind, of_kind in figures.items():
        flat |= {f"{kind} {key}": value for key, value in of_kind.items()}
        for name, key in RATIOS.items():
            flat[f"{kind} {name} ratio"] = of_kind[key] / figures[FOUR][key]
    return flat


def _figures(
    reports: dict[str, dict[str, Any]], processes: dict[str, str]
) -> dict[str, float]:
    """Figures of one run by its reports; each process is counted once, by its last node."""
    node_of = {processes.get(node, node): node for node in reports}
    used_ns = 0
    for node in node_of.values():
        notes = reports[node][PROCESSOR]
        n_left_out = round(WARM_UP * len(notes))
        used_ns += notes[-1] - notes[n_left_out]
    sensor = np.array(reports["sensor"][WATCH], dtype=np.int64)
    host = np.array(reports["reconstructor"][WATCH], dtype=np.int64)
    # By the stamps of the first frame and the last one.
    passed_s = (sensor[-1, 0] - sensor[0, 0]) / 1e9
    n_counted = (1 - WARM_UP) * len(sensor)
    return {
        "cpu_us": used_ns / 1e3 / n_counted,
        **ages_ms(host[:, 3]),
        "hz": (len(sensor) - 1) / passed_s,
        "skipped": 1 - len(host) / len(sensor),
    }
