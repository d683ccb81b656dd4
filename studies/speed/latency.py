"""From acquisition to reconstruction at 1 kHz, and the time spent in each stage."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.studies.points import StudyError

from .host import host_busy_s
from .stopwatch import WATCH

Times = npt.NDArray[np.int64]

RATE_HZ = 1000
SCENES = {"40 x 40": "path_40", "64 x 64": "drag_wrench_64"}
STAGES = (
    "sensor",
    "wire to the edge",
    "queue at the edge",
    "edge",
    "wire to the host",
    "queue at the host",
    "host",
    "solve",
)
WARM_UP = 500
"""First frames of the sensor, left out: new processes start with cold caches and memory."""
QUANTILES = {
    "p50": 0.5,
    "p99": 0.99,
    "p99.9": 0.999,
}
GRAPHS = (
    ("skin", 0, False),
    ("skin", 0, True),
    ("skin", 1, False),
    ("paper", 0, False),
)
"""Preset, depth, and whether contacts are published."""
_NODES = "sparseskin.studies.speed.stopwatch:Timed"


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Both sizes, with and without a monitor: the default solver, with contacts and where it
    reconstructs the newest frames alone too, and the paper's.
    """
    n_frames = 3000 if quick else 12_000
    common = {
        "rate_hz": RATE_HZ,
        "n_frames": n_frames,
        "warm_up": WARM_UP,
        "seed": seed,
    }
    names = ("preset", "depth", "contacts")
    return [
        {
            **common,
            "monitor": monitor,
            **dict(zip(names, graph, strict=True)),
            "scene": scene,
        }
        for monitor, graph, scene in product((False, True), GRAPHS, SCENES.values())
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Age of the frames of one graph when they were reconstructed, and its stages.

    `point`: scene, preset, depth, contacts, rate_hz, n_frames, warm_up (frames that are left out),
    monitor. Returns of each quantile NAME_ms, and "NAME STAGE": the mean time in each of `STAGES`
    of the frames around it; frames, skipped, lost, and others: cores that other work of the host
    used. Raises StudyError if the graph fails, or reconstructs too few frames.
    """
    began_s = time.monotonic()
    busy_s = host_busy_s()
    own_s = _children_s()
    nodes = run_graph(point)
    # The nodes are children of this process: what they used is not other work.
    others_s = host_busy_s() - busy_s - (_children_s() - own_s)
    sensor = _times_of(nodes["sensor"])
    edge = _times_of(nodes["compressor"])
    host = _times_of(nodes["reconstructor"])
    stages = stages_ns(sensor[point["warm_up"] :], edge, host)
    if not len(stages):
        raise StudyError(
            f"no frame after the first {point['warm_up']} was reconstructed"
        )
    skipped = sum(nodes["reconstructor"]["skipped"].values())
    return {
        **figures(stages / 1e6),
        "frames": len(stages),
        "skipped": skipped,
        "lost": len(sensor) - len(host) - skipped,
        "others": round(others_s / (time.monotonic() - began_s), 2),
    }


def _times_of(report: dict[str, Any]) -> Times:
    """Notes of the stopwatch of a node."""
    return np.array(report[WATCH], dtype=np.int64)


def run_graph(
    point: dict[str, Any], environment: Mapping[str, str] | None = None
) -> dict[str, dict[str, Any]]:
    """Run a graph of nodes with stopwatches on the frames of a point, with some variables of the
    environment; return the report of each.

    `point` as of `measure`; and source, in place of frames of the scene that are computed before,
    iterations, where their number is stated, priority of all nodes,
    and processes, the name of the process of each node that shares one. Raises StudyError if the
    graph fails.
    """
    names: tuple[str, ...] = ("preset", "depth", "contacts", "iterations")
    solver = {name: point[name] for name in names if name in point}
    looped = f"sparseskin.studies.looped:{point['scene']}"
    nodes: dict[str, dict[str, Any]] = {
        "sensor": {
            "type": f"{_NODES}Sensor",
            "source": point.get("source", looped),
            "rate_hz": point["rate_hz"],
        },
        "compressor": {"type": f"{_NODES}Compressor", "rows": FIXED},
        "reconstructor": {"type": f"{_NODES}Reconstructor", **solver},
    }
    if point["monitor"]:
        nodes["monitor"] = {"type": f"{_NODES}Monitor", "page": False}
    for name, process in point.get("processes", {}).items():
        nodes[name]["process"] = process
    lines = ["[graph]", f"priority = {point.get('priority', 0)}"]
    for name, settings in nodes.items():
        lines.append(f"[nodes.{name}]")
        # These values are written in JSON as in TOML.
        lines += [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    with tempfile.TemporaryDirectory(prefix="sparseskin-speed-") as folder:
        Path(folder, "graph.toml").write_text("\n".join(lines))
        command = [sys.executable, "-m", "sparseskin", "launch", "graph.toml"]
        command += ["--frames", str(point["n_frames"]), "--summary", "summary.json"]
        done = subprocess.run(
            command,
            cwd=folder,
            env={**os.environ, **(environment or {})},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise StudyError(
                f"the graph ended with {done.returncode}: {done.stderr[-500:]}"
            )
        reports: dict[str, dict[str, Any]]
        reports = json.loads(Path(folder, "summary.json").read_text())["nodes"]
    return reports


def _children_s() -> float:
    """Processor time of the processes that this one has started and that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def stages_ns(sensor: Times, edge: Times, host: Times) -> Times:
    """Time of each frame in each of `STAGES`, ns; the sum of a row is the frame's age when it was
    reconstructed.

    A message waits in a queue while its reader is busy with the one before it; the rest of its way
    is the wire: ZeroMQ, the wake-up of the reader, decoding.

    Columns of the arguments, int64: stamp_ns, and the times from there until (sensor) it was sent;
    (edge) the message came, the measurements were sent; (host) the message came, the solver was
    called, was done, the result was sent. Returns rows of the frames that were reconstructed.
    """
    # A stamp identifies a frame; one that was skipped or lost on the way has no age.
    at_edge = np.intersect1d(sensor[:, 0], edge[:, 0])
    stamps = np.intersect1d(at_edge, host[:, 0])
    _, sensor_sent = _of_frames(sensor, stamps)
    _, edge_came, edge_sent = _of_frames(edge, stamps)
    _, host_came, called, solved, host_sent = _of_frames(host, stamps)
    edge_queue = _waited(
        stamps,
        sent=sensor_sent,
        came=edge_came,
        free=edge_sent,
    )
    host_queue = _waited(
        stamps,
        sent=edge_sent,
        came=host_came,
        free=host_sent,
    )
    columns = [
        sensor_sent,
        edge_came - sensor_sent - edge_queue,
        edge_queue,
        edge_sent - edge_came,
        host_came - edge_sent - host_queue,
        host_queue,
        called - host_came,
        solved - called,
    ]
    return np.stack(columns, axis=1)


def _of_frames(times: Times, stamps: Times) -> Times:
    """Columns of the rows with some stamps, which ascend."""
    return times[np.searchsorted(times[:, 0], stamps)].T


def _waited(stamps: Times, sent: Times, came: Times, free: Times) -> Times:
    """Time from sending each message until its reader was done with the one before, ns."""
    # Before the first frame a reader is free.
    gap = np.diff(stamps, prepend=stamps[:1])
    # Times are from each frame's stamp on: those of the one before are moved to this stamp.
    free_before = np.concatenate([[0], free[:-1]]) - gap
    free_before[:1] = sent[:1]
    waited: Times = np.clip(np.minimum(free_before, came) - sent, 0, None)
    return waited


def figures(stages_ms: npt.NDArray[np.float64]) -> dict[str, float]:
    """Quantiles of the sum of the stages, and the mean of each stage around each quantile, ms."""
    total = stages_ms.sum(axis=1)
    order = np.argsort(total)
    n = len(order)
    times_ms: dict[str, float] = {}
    for name, quantile in QUANTILES.items():
        # Stages of one frame are noise: a 20th of the frames are averaged, fewer near the end.
        centre = round(quantile * (n - 1))
        half = max(1, round(min(0.05, 1 - quantile) / 2 * n))
        around = order[max(0, centre - half) : centre + half + 1]
        times_ms[f"{name}_ms"] = round(float(np.quantile(total, quantile)), 4)
        means_ms = stages_ms[around].mean(axis=0)
        for stage, mean_ms in zip(STAGES, means_ms, strict=True):
            times_ms[f"{name} {stage}"] = round(float(mean_ms), 4)
    return times_ms
