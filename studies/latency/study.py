"""From acquisition to reconstruction at 1 kHz, and the time spent in each stage."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.process.proc import cpu_s, host_busy_s
from sparseskin.studies.graph_run import GraphRun, launch_text, wait_until
from sparseskin.studies.points import StudyError, compute
from sparseskin.studies.report import PALETTE, Chart, fill_page, markdown, write_csv

from .nodes import WATCH

Times = npt.NDArray[np.int64]

RATE_HZ = 1000
WANTED_MS = 0.4
"""Median age that is wanted without a monitor."""
SCENES = {"40 x 40": "path_40", "64 x 64": "drag_wrench_64"}
FAR = 4.0
"""Multiple of the median above which a bar of the chart is cut off and labelled; chosen."""
QUIET = 0.1
"""Cores that other work may use before the host counts as busy."""
STAGES = (
    *("sensor", "wire to the edge", "queue at the edge", "edge"),
    *("wire to the host", "queue at the host", "host", "solve"),
)
WARM_UP = 500
"""Frames that are left out: new processes start with cold caches and memory."""
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
_NODES = "sparseskin.studies.latency.nodes:Timed"


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Age of the frames of one graph when they were reconstructed, and its stages.

    `point`: scene, preset, depth, rate_hz, n_frames, monitor (True: one subscribes).

    Returns
    -------
    dict
        Of each quantile, total_ms and stages_ms: the mean, over the frames around that quantile,
        of the time in each of `STAGES`. Further n_frames, skipped, lost, and others: cores that
        other work of the host used meanwhile.
    """
    source = f"sparseskin.studies.looped:{point['scene']}"
    solver = {"preset": point["preset"], "depth": point["depth"]}
    nodes: dict[str, dict[str, Any]] = {
        "sensor": {"type": f"{_NODES}Sensor", "source": source, "rate_hz": point["rate_hz"]},
        "compressor": {"type": f"{_NODES}Compressor", "rows": FIXED},
        "reconstructor": {"type": f"{_NODES}Reconstructor", **solver},
    }
    nodes |= {"monitor": {"page": False}} if point["monitor"] else {}
    launch = launch_text(nodes, {})
    began_s, before_s, own_s = time.monotonic(), host_busy_s(), 0.0
    with GraphRun(launch, "--frames", str(point["n_frames"])) as graph:
        pids = [graph.process.pid, *graph.nodes().values()]

        def ended() -> bool:
            nonlocal own_s
            own_s = max(own_s, sum(map(_cpu_s, pids)))
            return graph.process.poll() is not None

        wait_until(ended, "the end of the graph", 10.0 * point["n_frames"] / point["rate_hz"])
        nodes = graph.summary()["nodes"]
    others = (host_busy_s() - before_s - own_s) / (time.monotonic() - began_s)
    sensor, edge, host = (
        np.array(nodes[name][WATCH], dtype=np.int64)
        for name in ("sensor", "compressor", "reconstructor")
    )
    stages = stages_ns(sensor, edge, host)[WARM_UP:]
    if not len(stages):
        raise StudyError(f"{len(host)} frames were reconstructed; more than {WARM_UP} are needed")
    skipped = sum(nodes["reconstructor"]["skipped"].values())
    return {
        **figures(stages / 1e6),
        "n_frames": len(stages),
        "skipped": skipped,
        "lost": len(sensor) - len(host) - skipped,
        "others": round(others, 2),
    }


def _cpu_s(pid: int) -> float:
    try:
        return cpu_s(pid)
    except OSError:  # it has ended
        return 0.0


def stages_ns(sensor: Times, edge: Times, host: Times) -> Times:
    """Time of each frame in each of `STAGES`, ns; the sum of a row is the frame's age when it was
    reconstructed.

    A message waits in a queue while its reader is busy with the one before it; the rest of its way
    is the wire: ZeroMQ, the wake-up of the reader, decoding.

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
        Of the frames that were reconstructed.
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
    """Time from sending each message until its reader was done with the one before, ns."""
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


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Both sizes, the default solver and the paper's, with and without a monitor; the default
    solver also where it reconstructs the newest frames alone.
    """
    common = {"rate_hz": RATE_HZ, "n_frames": 3000 if quick else 12_000, "seed": seed}
    return [
        {"scene": scene, "preset": preset, "depth": depth, "monitor": monitor, **common}
        for monitor in (False, True)
        for preset, depth in (("skin", 0), ("skin", 1), ("paper", 0))
        for scene in SCENES.values()
    ]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Measure each graph, one after the other, and write the page; see `command.Study`.

    `executor` is not used: graphs at the same time would measure each other.
    """
    made = points(quick, seed)
    found = compute(measure, made, out, "serial", "latency")
    rows = pd.DataFrame(map(row_of, made, found), dtype=object)
    names = ["skin", "preset", "reconstructed", "monitor"]
    names += ["n_frames", "skipped", "lost"]
    headings = {"n_frames": "frames", **{f"{name}_ms": f"{name} ms" for name in QUANTILES}}
    headings |= {f"p50 {stage}_ms": stage for stage in STAGES}
    formats = {f"{name} ms": ".2f" for name in QUANTILES} | dict.fromkeys(STAGES, ".3f")
    table = rows[list(dict.fromkeys([*names, *headings]))].rename(columns=headings)
    busiest = rows["others_cores"].max()
    fill_page(
        out,
        "latency",
        conclusion=conclusion(rows),
        warm_up=WARM_UP,
        cores=len(os.sched_getaffinity(0)),
        busiest=busiest if busiest > QUIET else None,
        table=markdown(table, formats),
        chart=draw(out, rows),
        csv=write_csv(out, "latency", rows),
    )


def conclusion(rows: pd.DataFrame) -> list[str]:
    """The default solver without a monitor, all frames; and what was not reconstructed."""
    skin = rows[rows["preset"] == "skin"]
    alone = skin[(skin["reconstructed"] == "all") & (skin["monitor"] == "no")]
    lines = [
        f"Preset `skin`, all frames of {row['skin']} taxels: half of them are reconstructed "
        f"{row['p50_ms']:.2f} ms after their acquisition (wanted: {WANTED_MS:g} ms), 99 % within "
        f"{row['p99_ms']:.2f} ms."
        for row in alone.to_dict("records")
    ]
    n, lost = rows["n_frames"].sum(), rows["lost"].sum()
    return [*lines, f"Of all graphs' {n} frames that were timed, {lost} were lost."]


def row_of(point: dict[str, Any], figures: dict[str, Any]) -> dict[str, Any]:
    """One graph as a flat row: its quantiles, and its stages around each."""
    row: dict[str, Any] = {
        "skin": next(name for name, scene in SCENES.items() if scene == point["scene"]),
        "preset": point["preset"],
        "reconstructed": "newest" if point["depth"] else "all",
        "monitor": "yes" if point["monitor"] else "no",
        "rate_hz": point["rate_hz"],
        **{name: figures[name] for name in ("n_frames", "skipped", "lost")},
        "others_cores": figures["others"],
    }
    for name in QUANTILES:
        row[f"{name}_ms"] = figures[name]["total_ms"]
        stages_ms = zip(STAGES, figures[name]["stages_ms"], strict=True)
        row |= {f"{name} {stage}_ms": ms for stage, ms in stages_ms}
    return row


def _end_of(totals_ms: npt.NDArray[np.float64]) -> float:
    """End of a panel: beyond all bars that are not far longer than most."""
    usual = totals_ms <= FAR * np.median(totals_ms)
    return 1.05 * float(totals_ms[usual].max())


def draw(out: Path, rows: pd.DataFrame) -> str:
    """Chart of the stages: a bar a graph, for the median and both tails."""
    labels = rows["skin"] + ", " + rows["preset"]
    labels += rows["reconstructed"].map({"newest": ", newest", "all": ""})
    labels += rows["monitor"].map({"yes": ", monitor", "no": ""})
    caption = (
        "Stages of a frame at 1 kHz, from its acquisition until it is reconstructed: around the "
        "median, and around the slowest of 100 and of 1000 frames (each panel has its own scale; "
        f"of bars beyond it the sum is stated; dotted: {WANTED_MS:g} ms)"
    )
    n = len(QUANTILES)
    with Chart(out, "latency", caption, n, n, size_in=(9.0, 6.5), sharey=True) as chart:
        for axes, name in zip(chart.panels, QUANTILES, strict=True):
            left = np.zeros(len(rows))
            totals = rows[f"{name}_ms"].to_numpy(float)
            end = _end_of(totals)
            for k, stage in enumerate(STAGES):
                ms = rows[f"{name} {stage}_ms"].to_numpy(float)
                style: dict[str, Any] = {"color": PALETTE[k], "edgecolor": "white"}
                style |= {"linewidth": 0.3, "hatch": "////" if "queue" in stage else None}
                axes.barh(labels, ms, left=left, label=stage, **style)
                left += ms
            for bar in np.flatnonzero(totals > end).tolist():
                text: dict[str, Any] = {"ha": "right", "va": "center", "fontsize": 7}
                text["bbox"] = {"facecolor": "white", "edgecolor": "none", "pad": 1}
                axes.annotate(f"{totals[bar]:.0f} ms \N{RIGHTWARDS ARROW}", (end, bar), **text)
            axes.set(title=name, xlabel="ms", xlim=(0, end))
            if name == "p50":
                axes.axvline(WANTED_MS, color="black", linewidth=0.8, linestyle=":")
            axes.grid(axis="y", visible=False)
        chart.panels[0].invert_yaxis()
    return chart.markdown
