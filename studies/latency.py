"""From acquisition to reconstruction at 1 kHz, and where the time goes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from .latency_points import QUANTILES, STAGES, WARM_UP, measure
from .points import compute
from .report import (
    PALETTE,
    chart_style,
    legend_outside,
    markdown_table,
    new_figure,
    save_figure,
    write_csv,
    write_page,
)

RATE_HZ = 1000
WANTED_MS = 2.0
SCENES = {"40 x 40": "path_40", "64 x 64": "drag_wrench_64"}
QUIET = 0.1
"""Cores that other work may have before the host counts as busy."""


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """Both sizes, the default solver and the paper's, with and without a monitor; of the default
    one also where it restores the newest frames alone.
    """
    n_frames = 3000 if quick else 12_000
    return [
        {
            "scene": scene,
            "preset": preset,
            "depth": depth,
            "rate_hz": RATE_HZ,
            "n_frames": n_frames,
            "monitor": monitor,
            "seed": seed,
        }
        for monitor in (False, True)
        for preset, depth in (("skin", 0), ("skin", 1), ("paper", 0))
        for scene in SCENES.values()
    ]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Measure each graph, one after the other, and write table, chart, CSV and page.

    Parameters
    ----------
    out : Path
        Folder to write to, which exists.
    quick : bool
        3000 frames each in place of 12,000.
    seed : int
        Kept with the points.
    executor
        Not used: graphs at the same time would measure each other.
    """
    made = points(quick, seed)
    found = compute(measure, made, out, "serial", "latency")
    rows = [row_of(point, figures) for point, figures in zip(made, found, strict=True)]
    header = (
        *("skin", "preset", "restored", "monitor", "frames", "skipped", "lost"),
        *(f"{name} ms" for name in QUANTILES),
        *(f"{stage}" for stage in STAGES),
    )
    lines = [
        [
            *(row["skin"], row["preset"], row["restored"], row["monitor"]),
            *(row["n_frames"], row["skipped"], row["lost"]),
            *(f"{row[f'{name}_ms']:.2f}" for name in QUANTILES),
            *(f"{row[f'p50 {stage}_ms']:.3f}" for stage in STAGES),
        ]
        for row in rows
    ]
    busiest = max(figures["others"] for figures in found)
    write_page(
        out,
        "latency",
        [
            "# From acquisition to reconstruction",
            _INTRODUCTION.format(warm_up=WARM_UP, cores=len(os.sched_getaffinity(0))),
            *_disturbed(busiest),
            markdown_table(header, lines),
            "The quantiles are those of a frame's age when it is restored; the stages right of "
            "them, in ms, add up to the median.",
            draw(out, rows),
            f"All figures: {write_csv(out, 'latency', rows)}.",
        ],
    )


def row_of(point: dict[str, Any], figures: dict[str, Any]) -> dict[str, Any]:
    """One graph as a flat row: its quantiles, and its stages around each."""
    skin = next(name for name, scene in SCENES.items() if scene == point["scene"])
    row: dict[str, Any] = {
        "skin": skin,
        "preset": point["preset"],
        "restored": "newest" if point["depth"] else "all",
        "monitor": "yes" if point["monitor"] else "no",
        "rate_hz": point["rate_hz"],
        "n_frames": figures["n_frames"],
        "skipped": figures["skipped"],
        "lost": figures["lost"],
        "others_cores": figures["others"],
    }
    for name in QUANTILES:
        row[f"{name}_ms"] = figures[name]["total_ms"]
        for stage, ms in zip(STAGES, figures[name]["stages_ms"], strict=True):
            row[f"{name} {stage}_ms"] = ms
    return row


def draw(out: Path, rows: list[dict[str, Any]]) -> str:
    """Where the time goes: a bar a graph, for the median and both tails."""
    with chart_style():
        figure = new_figure(9.0, 5.0)
        panels = figure.subplots(1, len(QUANTILES), sharey=True)
        labels = [_label(row) for row in rows]
        for axes, name in zip(panels, QUANTILES, strict=True):
            left = np.zeros(len(rows))
            for k, stage in enumerate(STAGES):
                ms = np.array([row[f"{name} {stage}_ms"] for row in rows])
                axes.barh(
                    *(labels, ms),
                    left=left,
                    color=PALETTE[k],
                    hatch="////" if "queue" in stage else None,
                    edgecolor="white",
                    linewidth=0.3,
                    label=stage,
                )
                left += ms
            axes.set_title(name)
            axes.set_xlabel("ms")
            if name == "p50":
                axes.axvline(WANTED_MS, color="black", linewidth=0.8, linestyle=":")
            axes.grid(axis="y", visible=False)
        panels[0].invert_yaxis()
        legend_outside(figure, 4)
    return save_figure(
        figure,
        out,
        "latency",
        "Where a frame's time goes at 1 kHz, from its acquisition until it is restored: around the "
        "median, and around the slowest of 100 and of 1000 frames (each panel has its own scale; "
        f"dotted: {WANTED_MS:g} ms)",
    )


def _label(row: dict[str, Any]) -> str:
    newest = ", newest" * (row["restored"] == "newest")
    return f"{row['skin']}, {row['preset']}{newest}{', monitor' * (row['monitor'] == 'yes')}"


def _disturbed(busiest: float) -> list[str]:
    if busiest <= QUIET:
        return []
    return [
        f"**The host was busy: other work had up to {busiest:.1f} cores meanwhile. Times are too "
        "long, the tails most of all.**"
    ]


_INTRODUCTION = """\
A sensor, an edge and a host, each in a process of its own, at 1 kHz on {cores} cores; in half of
the graphs a monitor watches, and some restore the newest frame that waits and skip the others
(`depth = 1`). The first {warm_up} frames are left out. The nodes are the shipped
ones, each with a stopwatch beside it (`studies/latency_nodes.py`): when a message came, when what
was made of it had been sent. `queue` is the time for which the reader was still busy with the frame
before, `wire` what else lies between: ZeroMQ, the wake-up of the reader, decoding; `host` is what
the reconstructor does before the solver."""
