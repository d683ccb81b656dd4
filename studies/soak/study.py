"""A long run of a graph: memory, open files and processor time of each of its processes."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.process import proc
from sparseskin.studies.graph_run import GraphRun, launch_text
from sparseskin.studies.points import compute
from sparseskin.studies.report import Chart, fill_page, series_style, write_csv

RATE_HZ = 500
SIDE = 64
MINUTES, QUICK_MINUTES = 30.0, 1.0
LAUNCHER = "launcher"
MAX_SAMPLES = 300
WARM_UP_S = 70.0
"""The monitor keeps the figures of the last minute: it grows until then."""
FLAT = 0.02
"""Relative change of the memory after the warm-up that still counts as flat."""


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Run a graph for a while, sample its processes at intervals, and end it.

    `point`: seconds, rate_hz, side (taxels a side: 40 or 64).

    Returns
    -------
    dict
        samples: time_s, and of each process, by name, memory_mb (resident), files (open
        descriptors) and cpu_s. frames: the monitor's count of sensed, reconstructed and lost.
        lost: messages that each node missed on its inputs. restarts, exit_code.
    """
    launch = launch_text(
        {
            "sensor": {
                "source": f"sparseskin.studies.looped:truth_{point['side']}",
                "rate_hz": point["rate_hz"],
            },
            "compressor": {"rows": FIXED},
            "reconstructor": {"preset": "skin"},
            "monitor": {"port": 0},
            "recorder": {
                "out": "soak.mcap",
                "topics": ["/skin/skin", "/skin/phi", "/skin/measurements"],
            },
        }
    )
    with GraphRun(launch) as graph:
        pids = {LAUNCHER: graph.process.pid, **graph.nodes()}
        times_s: list[float] = []
        found: dict[str, list[dict[str, float]]] = {name: [] for name in pids}
        began_s = time.monotonic()
        while (now_s := time.monotonic() - began_s) < point["seconds"]:
            times_s.append(round(now_s, 2))
            for name, pid in pids.items():
                found[name].append(_sample(pid))
            time.sleep(max(1.0, point["seconds"] / MAX_SAMPLES))
        code = graph.end()
        summary = graph.summary()
    samples = {
        name: {what: [sample[what] for sample in some] for what in some[0]}
        for name, some in found.items()
    }
    return {
        "samples": {"time_s": times_s, **samples},
        "frames": summary["patches"]["skin"]["frames"],
        "lost": {name: sum(node["lost"].values()) for name, node in summary["nodes"].items()},
        "restarts": sum(node["restarts"] for node in summary["nodes"].values()),
        "exit_code": code,
    }


def _sample(pid: int) -> dict[str, float]:
    return {
        "memory_mb": round(proc.resident_bytes(pid) / 1e6, 3),
        "files": proc.n_files(pid),
        "cpu_s": proc.cpu_s(pid),
    }


def verdict(samples: dict[str, Any], name: str) -> dict[str, Any]:
    """Figures of one process after the warm-up.

    Returns
    -------
    dict
        before_mb, after_mb: medians over the first and the last fifth, which a queue that is long
        for some seconds does not change. highest_mb: such a queue included. growth: relative
        change of the memory. mb_per_hour: slope of a straight line. files_before, files_after:
        the most before the last fifth and in it; a file may be open for a moment. cpu: cores.
        warm_up_s: time left out, a third of a short run.
    """
    time_s = np.array(samples["time_s"])
    warm_up_s = min(WARM_UP_S, time_s[-1] / 3)
    after = time_s >= warm_up_s
    time_s = time_s[after]
    memory_mb, files, cpu_s = (
        np.array(samples[name][what])[after] for what in ("memory_mb", "files", "cpu_s")
    )
    fifth = max(1, len(time_s) // 5)
    before_mb, after_mb = (float(np.median(p)) for p in (memory_mb[:fifth], memory_mb[-fifth:]))
    return {
        "before_mb": before_mb,
        "after_mb": after_mb,
        "highest_mb": float(memory_mb.max()),
        "growth": after_mb / before_mb - 1,
        "mb_per_hour": float(np.polyfit(time_s, memory_mb, 1)[0]) * 3600,
        "files_before": int(files[:-fifth].max()),
        "files_after": int(files[-fifth:].max()),
        "cpu": float((cpu_s[-1] - cpu_s[0]) / (time_s[-1] - time_s[0])),
        "warm_up_s": float(warm_up_s),
    }


def run(out: Path, quick: bool, seed: int, executor: str, minutes: float | None = None) -> None:
    """Run one graph for `minutes` (default: 30, quick 1) and write its page; see `command.Study`.

    `seed` and `executor` are not used: it is one graph, with the scene's own seed.
    """
    if minutes is None:
        minutes = QUICK_MINUTES if quick else MINUTES
    load = os.getloadavg()[0]
    point = {"seconds": 60.0 * minutes, "rate_hz": RATE_HZ, "side": SIDE}
    (found,) = compute(measure, [point], out, "serial", "soak")
    samples = found["samples"]
    names = [name for name in samples if name != "time_s"]
    verdicts = {name: verdict(samples, name) for name in names}
    rows = pd.concat(
        pd.DataFrame({"time_s": samples["time_s"], "process": name, **samples[name]})
        for name in names
    )
    fill_page(
        out,
        "soak",
        conclusion=conclusion(found, verdicts, minutes),
        rate_hz=RATE_HZ,
        side=SIDE,
        minutes=minutes,
        warm_up_s=verdicts[LAUNCHER]["warm_up_s"],
        flat=FLAT,
        found=found,
        load=load,
        n_cores=os.cpu_count(),
        verdicts=verdicts,
        chart=_draw(out, samples, names),
        csv=write_csv(out, "soak", rows),
    )


def conclusion(
    found: dict[str, Any], verdicts: dict[str, dict[str, Any]], minutes: float
) -> list[str]:
    """Lost frames, and the processes whose memory and open files grew most."""
    frames = found["frames"]
    grown = max(verdicts, key=lambda name: verdicts[name]["growth"])
    opened = {name: v["files_after"] - v["files_before"] for name, v in verdicts.items()}
    most = max(opened, key=lambda name: opened[name])
    return [
        f"{minutes:g} minutes at {RATE_HZ:g} Hz: {frames['lost']} of {frames['sensed']} frames "
        f"were lost, {found['restarts']} nodes started again.",
        f"Memory grew most in the {grown}: by {100 * verdicts[grown]['growth']:.1f} % after the "
        f"warm-up, {verdicts[grown]['mb_per_hour']:.1f} MB an hour.",
        f"Open files grew most in the {most}, by {opened[most]}."
        if opened[most] > 0
        else "In no process did the number of open files grow.",
    ]


def _draw(out: Path, samples: dict[str, Any], names: list[str]) -> str:
    caption = "Resident memory of each process over time"
    with Chart(out, "soak", caption, size_in=(7.5, 4.0), legend_columns=3) as chart:
        (axes,) = chart.panels
        minutes = np.array(samples["time_s"]) / 60
        for k, name in enumerate(names):
            style = {**series_style(k), "marker": ""}
            axes.plot(minutes, samples[name]["memory_mb"], label=name, **style)
        axes.set(xlabel="minutes", ylabel="resident memory, MB", ylim=(0, None))
    return chart.markdown
