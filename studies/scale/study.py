"""Study `scale`: from 4,096 taxels to a million, on one core, two cores and live."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.messages.skin import Skin
from sparseskin.nodes.compressor.phi.rotation import RATIO
from sparseskin.nodes.sensor.scenes.tiled import TiledScene
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import cells, fill_page, markdown, write_csv

from .live import DEPTH, rate_held
from .missed import FRAMES, false_alarms, missed, missed_lines
from .nodes import time_batch
from .offline import throughput, throughput_table

SIDE = 64
PATCHES, QUICK_PATCHES = (1, 4, 16, 64, 244), (1, 4)
#: Patches, a million taxels but for 576, and their frames a second.
GOAL, GOAL_HZ = 244, 1000
IDLE = 0.9
N_FRAMES, FEW_FRAMES, QUICK_N_FRAMES = 60, 12, 12
#: Patches from which on fewer frames are timed, and most that are timed on two cores.
LARGE, MOST_ON_TWO = 64, 64
CONTACTS, QUICK_CONTACTS = ((4, 8, 16), (8,))
SIGMAS = (1.0, 2.0, 3.0)
TRIED_S, LAST_S = 10.0, 60.0
#: Patches, part pressed, rate tried first, and seconds of the last run.
LIVE = ((16, 0.25, 100.0, 0.0), (16, 0.1, 150.0, 0.0), (GOAL, 0.25, 8.0, LAST_S))
#: Frames of all patches in a task of recorded frames, and least frames of a task.
OFFLINE_PATCH_FRAMES, LEAST_OFFLINE = 400, 3
WIRE_BYTES_HZ = 1e9 / 8
"""Bytes a second of a gigabit link."""

Point = dict[str, Any]


def points_of(quick: bool, seed: int) -> list[Point]:
    """Points to time: all patches solved on one core and on two, then most of them idle."""
    common = {"side": SIDE, "seed": seed}
    frames = {n: FEW_FRAMES if n >= LARGE else N_FRAMES for n in PATCHES}
    if quick:
        frames = dict.fromkeys(frames, QUICK_N_FRAMES)
    return [
        {**common, "patches": n, "n_frames": frames[n], "idle": idle, "skip_idle": idle > 0}
        for idle in (0.0, IDLE)
        for n in (QUICK_PATCHES if quick else PATCHES)
    ]


def offline_of(quick: bool) -> tuple[list[int], list[int]]:
    """Patches of the bodies whose recorded frames are timed, and frames of a task."""
    patches = list(QUICK_PATCHES if quick else PATCHES)
    return patches, [max(OFFLINE_PATCH_FRAMES // n, LEAST_OFFLINE) for n in patches]


def exponent(taxels: list[float], seconds: list[float]) -> float:
    """Slope of log seconds over log taxels, least squares."""
    return float(np.polyfit(np.log(taxels), np.log(seconds), 1)[0])


def needed(row: Point) -> dict[str, Any]:
    """Cores, network and wires for a million taxels at 1 kHz, from the figures of one point."""
    patch_hz = GOAL * GOAL_HZ
    bytes_s = row["bytes"] / row["patches"] * patch_hz
    return {
        "edge_cores": row["edge_us"] * 1e-6 * patch_hz,
        "host_cores": row["host_us"] * 1e-6 * patch_hz,
        "gigabyte_s": bytes_s / 1e9,
        "links": bytes_s / WIRE_BYTES_HZ,
        "full_links": RATIO * bytes_s / WIRE_BYTES_HZ,
    }


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page; see `command.Study`.

    One core: in this process. Two cores: `executor` is not used, but two processes at once.
    """
    points = points_of(quick, seed)
    one = pd.DataFrame(compute_rows(time_batch, points, out, "serial", "one core"))
    # The same points twice, with other noise, side by side: as many patches on each core.
    some = [p for p in points if not p["idle"] and p["patches"] <= MOST_ON_TWO]
    twins = [{**p, "seed": seed + k} for p in some for k in (1, 2)]
    two = pd.DataFrame(compute_rows(time_batch, twins, out, "process:2", "two cores"))
    two = two.groupby("patches", as_index=False)[["edge_us", "host_us"]].max()
    solved = one[one["idle"] == 0]
    seconds = 1e-6 * (solved["edge_us"] + solved["host_us"]) * solved["patches"]
    slope = exponent(list(solved["patches"] * SIDE**2), list(seconds))
    goal = needed(dict(solved.iloc[-1]))
    contacts = QUICK_CONTACTS if quick else CONTACTS
    n = 40 if quick else 200
    found = [missed(SIDE, side, sigmas, n, seed) for side in contacts for sigmas in SIGMAS]
    press = TiledScene("hug", Skin(SIDE, SIDE, 2.5, pitch_m=0.005), 1).forces(2.2)[0]
    n_frames = 64 if quick else 640
    alarms = {
        "untouched": false_alarms(np.zeros_like(press), 16, n_frames),
        "pressed": false_alarms(press, 16, n_frames),
    }
    table = missed_lines(found, alarms)
    trials = [] if quick else [t for a in LIVE for t in rate_held(*_live(*a))]
    load = os.getloadavg()[0]
    offline = throughput_table(throughput(*offline_of(quick), SIDE, seed))
    text = table_of(one, two)
    live = "not run (--quick)" if quick else live_table(pd.DataFrame(trials))
    fill_page(
        out,
        "scale",
        conclusion=[
            f"Time grows with the number of taxels to the power {slope:.2f}.",
            f"A million taxels at 1 kHz take {goal['edge_cores']:.0f} cores of edges and "
            f"{goal['host_cores']:.0f} of hosts, as fast as this one.",
            f"Their measurements are {goal['gigabyte_s']:.2f} GB/s: {goal['links']:.0f} gigabit "
            f"links in place of {goal['full_links']:.0f}.",
        ],
        side=SIDE,
        table=text,
        exponent=slope,
        cores=goal["edge_cores"] + goal["host_cores"],
        **goal,
        frames=FRAMES,
        missed="\n".join(table),
        live=live,
        depth=DEPTH,
        offline=offline,
        load=load,
        n_cores=len(os.sched_getaffinity(0)),
        csv=write_csv(out, "times", one),
    )
    print(text)
    print(f"\nexponent of time over taxels: {slope:.3f}")
    print(
        f"1 M taxels at 1 kHz: {goal['edge_cores']:.0f} cores of edges, "
        f"{goal['host_cores']:.0f} of hosts; {goal['gigabyte_s']:.2f} GB/s of measurements, "
        f"{goal['links']:.0f} gigabit links in place of {goal['full_links']:.0f}"
    )
    print("\n".join(["", *table, "", live, "", "recorded frames, wall-clock time:", offline]))
    print(f"load of the machine at the end: {load:.1f} on {os.cpu_count()} cores", file=sys.stderr)


def _live(patches: int, active: float, first_hz: float, last_s: float) -> tuple[Any, ...]:
    return first_hz, patches, active, TRIED_S, last_s


def table_of(one: pd.DataFrame, two: pd.DataFrame) -> str:
    """Time, rate, bytes and memory by the number of taxels."""
    both = two.set_index("patches")
    rows = []
    for row in one.to_dict("records"):
        us = row["edge_us"] + row["host_us"]
        hz = 1e6 / us / row["patches"]
        pair = None
        if not row["idle"] and row["patches"] in both.index:
            pair = both.loc[row["patches"]]
        two_hz = None if pair is None else 1e6 / (pair["edge_us"] + pair["host_us"])
        rows.append(
            {
                "taxels": f"{row['patches'] * SIDE**2:,}",
                "patches": row["patches"],
                "idle": f"{row['idle']:.0%}",
                "edge, us a patch": f"{row['edge_us']:.0f}",
                "host, us a patch": f"{row['host_us']:.0f}",
                "frames/s, one core": f"{hz:.1f}",
                "two cores": "" if two_hz is None else f"{2 * two_hz / row['patches']:.1f}",
                "MB/s of measurements": f"{hz * row['bytes'] / 1e6:.1f}",
                "MB a patch": f"{row['memory_mb']:.2f}",
                "unchanged": f"{row['unchanged']:.0%}",
            }
        )
    return markdown(pd.DataFrame(rows))


def live_table(trials: pd.DataFrame) -> str:
    """Trials of live graphs."""
    columns = {
        "patches": "{patches}",
        "pressed": "{active:.0%}",
        "asked, Hz": "{rate_hz:.1f}",
        "held, Hz": "{held_hz:.1f}",
        "skipped": "{skipped}",
        "lost": "{lost}",
        "unchanged": "{unchanged:.0%}",
        "p50, ms": "{p50_ms:.1f}",
        "p99, ms": "{p99_ms:.1f}",
    }
    return markdown(pd.DataFrame({title: cells(trials, form) for title, form in columns.items()}))
