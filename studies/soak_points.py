"""One graph that runs for long: the memory, files and processor time of each of its processes."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .graph_run import GraphRun

LAUNCHER = "launcher"
MAX_SAMPLES = 300
WARM_UP_S = 70.0
"""The monitor keeps the figures of the last minute; until then it grows, as it should."""
_GRAPH = """
[nodes.sensor]
type = "sensor"
source = "sparseskin.studies.soak_driver:frames_{side}"
rate_hz = {rate_hz}

[nodes.compressor]
type = "compressor"

[nodes.reconstructor]
type = "reconstructor"
preset = "skin"

[nodes.monitor]
type = "monitor"
port = 0

[nodes.recorder]
type = "recorder"
out = "soak.mcap"
topics = ["/skin/skin", "/skin/phi", "/skin/measurements"]
"""


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Run a graph for a while, look at its processes again and again, and end it.

    Parameters
    ----------
    point : dict
        seconds, rate_hz, side (taxels a side: 40 or 64).

    Returns
    -------
    dict
        samples: time_s, and of each process, by name, memory_mb (resident), files (open
        descriptors) and cpu_s. frames: the monitor's own count of sensed, reconstructed and lost.
        lost: what each node misses on its inputs. restarts, exit_code.
    """
    folder = Path(tempfile.mkdtemp(prefix="sparseskin-soak-"))
    try:
        with GraphRun(folder / "graph", _GRAPH.format(**point)) as graph:
            pids = {LAUNCHER: graph.process.pid, **graph.nodes()}
            samples: dict[str, Any] = {"time_s": []}
            for name in pids:
                samples[name] = {"memory_mb": [], "files": [], "cpu_s": []}
            began_s = time.monotonic()
            every_s = max(1.0, point["seconds"] / MAX_SAMPLES)
            while (now_s := time.monotonic() - began_s) < point["seconds"]:
                samples["time_s"].append(round(now_s, 2))
                for name, pid in pids.items():
                    for what, value in looked_at(pid).items():
                        samples[name][what].append(value)
                time.sleep(every_s)
            code = graph.end()
            summary = graph.summary()
    finally:
        shutil.rmtree(folder)
    return {
        "samples": samples,
        "frames": summary["patches"]["skin"]["frames"],
        "lost": {name: sum(node["lost"].values()) for name, node in summary["nodes"].items()},
        "restarts": sum(node["restarts"] for node in summary["nodes"].values()),
        "exit_code": code,
    }


def looked_at(pid: int) -> dict[str, float]:
    """What a process has just now."""
    process = Path(f"/proc/{pid}")
    pages = int((process / "statm").read_text().split()[1])
    fields = (process / "stat").read_text().rpartition(")")[2].split()
    return {
        "memory_mb": round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 3),
        "files": len(list((process / "fd").iterdir())),
        "cpu_s": (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"),
    }


def verdict(samples: dict[str, Any], name: str) -> dict[str, Any]:
    """What became of one process after the warm-up.

    Returns
    -------
    dict
        before_mb, after_mb: medians over the first and the last fifth, for a queue that is long for
        some seconds is no growth. highest_mb: such a queue included. growth: of the memory, as a
        part. mb_per_hour: slope of a straight line. files_before, files_after: the most in those
        fifths. cpu: cores. warm_up_s: what was left out, a third of a short run.
    """
    time_s = np.array(samples["time_s"])
    warm_up_s = min(WARM_UP_S, time_s[-1] / 3)
    after = time_s >= warm_up_s
    time_s = time_s[after]
    memory_mb = np.array(samples[name]["memory_mb"])[after]
    files = np.array(samples[name]["files"])[after]
    cpu_s = np.array(samples[name]["cpu_s"])[after]
    fifth = max(1, len(time_s) // 5)
    before_mb, after_mb = (float(np.median(p)) for p in (memory_mb[:fifth], memory_mb[-fifth:]))
    return {
        "before_mb": before_mb,
        "after_mb": after_mb,
        "highest_mb": float(memory_mb.max()),
        "growth": after_mb / before_mb - 1,
        "mb_per_hour": float(np.polyfit(time_s, memory_mb, 1)[0]) * 3600,
        "files_before": int(files[:fifth].max()),
        "files_after": int(files[-fifth:].max()),
        "cpu": float((cpu_s[-1] - cpu_s[0]) / (time_s[-1] - time_s[0])),
        "warm_up_s": float(warm_up_s),
    }
