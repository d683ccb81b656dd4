"""One graph at 1 kHz: when each of its frames was where."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .graph_run import GraphRun, wait_until
from .latency_nodes import WATCH

Times = npt.NDArray[np.int64]

STAGES = (
    *("sensor", "wire to the edge", "queue at the edge", "edge"),
    *("wire to the host", "queue at the host", "host", "solve"),
)
WARM_UP = 500
"""Frames that are left out: processes that have just begun find caches and memory cold."""
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
_GRAPH = """
[nodes.sensor]
type = "sparseskin.studies.latency_nodes:TimedSensor"
source = "sparseskin.studies.latency_nodes:{scene}"
rate_hz = {rate_hz}

[nodes.compressor]
type = "sparseskin.studies.latency_nodes:TimedCompressor"

[nodes.reconstructor]
type = "sparseskin.studies.latency_nodes:TimedReconstructor"
preset = "{preset}"
depth = {depth}
"""
_MONITOR = """
[nodes.monitor]
type = "monitor"
page = false
"""


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Run one graph and say how old its frames were when they were restored, and where they had
    been.

    Parameters
    ----------
    point : dict
        scene, preset, depth, rate_hz, n_frames, monitor (whether one watches).

    Returns
    -------
    dict
        Of each quantile, total_ms and stages_ms: the mean, over the frames around that quantile,
        of the time in each of `STAGES`. Further n_frames, skipped, lost, and others: how many
        cores other work on the host had meanwhile.
    """
    folder = Path(tempfile.mkdtemp(prefix="sparseskin-latency-"))
    graph = _GRAPH.format(**point) + _MONITOR * point["monitor"]
    busy_s, before = os.times().elapsed, _host_busy_s()
    try:
        with GraphRun(folder / "graph", graph, "--frames", str(point["n_frames"])) as run:
            pids = run.nodes().values()
            own_s = 0.0

            def ended() -> bool:
                nonlocal own_s
                own_s = max(own_s, sum(map(_cpu_s, [*pids, run.process.pid])))
                return run.process.poll() is not None

            wait_until(ended, "the end of the graph", 10.0 * point["n_frames"] / point["rate_hz"])
            nodes = run.summary()["nodes"]
    finally:
        shutil.rmtree(folder)
    took_s = os.times().elapsed - busy_s
    sensor, edge, host = (
        np.array(nodes[name][WATCH], dtype=np.int64)
        for name in ("sensor", "compressor", "reconstructor")
    )
    stages = stages_ns(sensor, edge, host)[WARM_UP:]
    skipped = sum(nodes["reconstructor"]["skipped"].values())
    return {
        **figures(stages / 1e6),
        "n_frames": len(stages),
        "skipped": skipped,
        "lost": len(sensor) - len(host) - skipped,
        "others": round((_host_busy_s() - before - own_s) / took_s, 2),
    }


def stages_ns(sensor: Times, edge: Times, host: Times) -> Times:
    """The time of each frame in each of `STAGES`, ns; a row's sum is the frame's age when it was
    restored.

    A message waits in a queue for as long as its reader was still busy with the one before it
    after it had been sent; what else it takes on its way is the wire: ZeroMQ, the wake-up of the
    reader, decoding.

    Parameters
    ----------
    sensor : ndarray of int64, shape (n, 2)
        stamp_ns, and from there until sent.
    edge : ndarray of int64, shape (n, 3)
        stamp_ns; until the message came, until the measurements were sent.
    host : ndarray of int64, shape (n, 5)
        stamp_ns; until the message came, the solver was called, was done, the result was sent.

    Returns
    -------
    ndarray of int64, shape (m, 8)
        Of the frames that came to the end.
    """
    common = np.intersect1d(np.intersect1d(sensor[:, 0], edge[:, 0]), host[:, 0])
    s, e, h = (times[np.searchsorted(times[:, 0], common)] for times in (sensor, edge, host))
    edge_queue = _waited(e, sent=s[:, 1], came=e[:, 1], free=e[:, 2])
    host_queue = _waited(h, sent=e[:, 2], came=h[:, 1], free=h[:, 4])
    columns = [
        *(s[:, 1], e[:, 1] - s[:, 1] - edge_queue, edge_queue, e[:, 2] - e[:, 1]),
        *(h[:, 1] - e[:, 2] - host_queue, host_queue, h[:, 2] - h[:, 1], h[:, 3] - h[:, 2]),
    ]
    return np.stack(columns, axis=1)


def _waited(reader: Times, sent: Times, came: Times, free: Times) -> Times:
    """How long each message had been sent while its reader was busy with the one before, ns."""
    gap = np.diff(reader[:, 0], prepend=reader[0, 0])
    free_before = np.concatenate([[0], free[:-1]]) - gap  # from this frame's stamp on
    free_before[0] = sent[0]
    waited: Times = np.clip(np.minimum(free_before, came) - sent, 0, None)
    return waited


def figures(stages_ms: npt.NDArray[np.float64]) -> dict[str, Any]:
    """Quantiles of the sum of the stages, and the mean of each stage around each quantile, ms."""
    total = stages_ms.sum(axis=1)
    order = np.argsort(total)
    n = len(order)
    found: dict[str, Any] = {}
    for name, quantile in QUANTILES.items():
        centre, half = round(quantile * (n - 1)), max(1, round(min(0.05, 1 - quantile) / 2 * n))
        around = order[max(0, centre - half) : centre + half + 1]
        found[name] = {
            "total_ms": round(float(np.quantile(total, quantile)), 4),
            "stages_ms": [round(float(ms), 4) for ms in stages_ms[around].mean(axis=0)],
        }
    return found


def _cpu_s(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _host_busy_s() -> float:
    """Seconds of processor time that all of the host has used."""
    ticks = [int(field) for field in Path("/proc/stat").read_text().split("\n")[0].split()[1:]]
    idle = ticks[3] + ticks[4]
    return (sum(ticks[:8]) - idle) / os.sysconf("SC_CLK_TCK")
