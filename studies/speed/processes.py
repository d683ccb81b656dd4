"""The nodes of a graph in one process, in two and in four: processor time and age of a frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import latency
from .beside import ages_ms, per_frame_us
from .stopwatch import PROCESSOR, WATCH

EDGE, HOST, ALL = "edge", "host", "all"
PROCESSES: dict[str, dict[str, str]] = {
    "four": {},
    "two": {"sensor": EDGE, "compressor": EDGE, "reconstructor": HOST, "monitor": HOST},
    "one": dict.fromkeys(("sensor", "compressor", "reconstructor", "monitor"), ALL),
}
"""Name of the process of each node that shares one, by the number of processes."""
SCENE = "drag_wrench_40"
RATES_HZ, QUICK_RATES_HZ = (1000, 300, 100), (1000,)
SECONDS, SLICES = 3.0, 3
"""Length of a slice, and number of slices of each; as in `beside`, their medians count."""
STEPS = 1
"""Steps of the solver in a frame: the pace of 1 kHz on a small host; of more steps the solver,
which is the same everywhere, would hide the difference."""


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """One graph with a monitor, at 1 kHz, and if not quick at lower rates, too."""
    common = {"scene": SCENE, "preset": "skin", "depth": 0, "iterations": STEPS, "monitor": True}
    common |= {"seed": seed, "slices": SLICES, "seconds": SECONDS}
    rates_hz = QUICK_RATES_HZ if quick else RATES_HZ
    return [{**common, "rate_hz": rate_hz} for rate_hz in rates_hz]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Run the graph of a point with its nodes in four, two and one process, in turn.

    `point`: scene, rate_hz, preset, depth, iterations, monitor, slices, seconds of each. Returns
    medians over the slices, by the number of processes: "N cpu_us", processor time of all nodes for
    a frame; "N p50_ms" and "N p99_ms" of the age of a frame when it is reconstructed; "N hz", the
    rate that the sensor reached; "N lost"; and of "two" and "one" the ratios "N cpu ratio",
    "N p50 ratio" and "N p99 ratio" to four, of one slice. Raises StudyError if a node fails.
    """
    n_frames = round(point["seconds"] * point["rate_hz"])
    slices = []
    for _ in range(point["slices"]):
        figures = {
            number: _figures(
                latency.run_graph({**point, "n_frames": n_frames, "processes": processes}),
                processes,
            )
            for number, processes in PROCESSES.items()
        }
        slices.append(with_ratios(figures))
    return {name: round(float(np.median([s[name] for s in slices])), 4) for name in slices[0]}


def with_ratios(figures: dict[str, dict[str, float]]) -> dict[str, float]:
    """Figures of a slice by the number of processes, and their ratios to those of four."""
    four = figures["four"]
    flat = {f"{number} {key}": value for number, of in figures.items() for key, value in of.items()}
    for number in ("two", "one"):
        for name, key in (("cpu", "cpu_us"), ("p50", "p50_ms"), ("p99", "p99_ms")):
            flat[f"{number} {name} ratio"] = figures[number][key] / four[key]
    return flat


def _figures(reports: dict[str, dict[str, Any]], processes: dict[str, str]) -> dict[str, float]:
    """Figures of one run by its reports; each process is counted once, by its last node."""
    last = {processes.get(node, node): node for node in reports}
    used_ns = (np.array(reports[node][PROCESSOR], dtype=np.int64) for node in last.values())
    sensor, host = (
        np.array(reports[node][WATCH], dtype=np.int64) for node in ("sensor", "reconstructor")
    )
    passed_s = (sensor[-1, 0] - sensor[0, 0]) / 1e9
    return {
        "cpu_us": sum(map(per_frame_us, used_ns)),
        **ages_ms(host[:, 3]),
        "hz": (len(sensor) - 1) / passed_s,
        "lost": len(sensor) - len(host),
    }
