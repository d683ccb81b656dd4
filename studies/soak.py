"""A graph that runs for long: `sparseskin study soak --minutes 30`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from .points import compute
from .report import (
    chart_style,
    legend_outside,
    markdown_table,
    new_figure,
    save_figure,
    series_style,
    write_csv,
    write_page,
)
from .soak_points import LAUNCHER, measure, verdict

RATE_HZ = 500
SIDE = 64
MINUTES = 30.0
QUICK_MINUTES = 1.0
FLAT = 0.02
"""How much memory may change after the warm-up, as a part of it."""


def run(out: Path, quick: bool, seed: int, executor: str, minutes: float | None = None) -> None:
    """Let one graph run, and write table, chart, CSV and page.

    Parameters
    ----------
    out : Path
        Folder to write to, which exists.
    quick : bool
        One minute in place of 30, where `minutes` is not stated.
    seed, executor
        Not used: it is one graph, with the scene's own seed.
    minutes : float, optional
        How long it runs.
    """
    if minutes is None:
        minutes = QUICK_MINUTES if quick else MINUTES
    load = os.getloadavg()[0]
    point = {"seconds": 60.0 * minutes, "rate_hz": RATE_HZ, "side": SIDE}
    (found,) = compute(measure, [point], out, "serial", "soak")
    samples = found["samples"]
    names = [name for name in samples if name != "time_s"]
    verdicts = {name: verdict(samples, name) for name in names}
    header = ("process", "memory, MB", "change", "highest", "MB an hour", "files", "cores", "lost")
    rows = [
        [
            name,
            f"{v['before_mb']:.1f} to {v['after_mb']:.1f}",
            f"{100 * v['growth']:+.1f} %" + " (**not flat**)" * (abs(v["growth"]) > FLAT),
            f"{v['highest_mb']:.1f}",
            f"{v['mb_per_hour']:+.1f}",
            f"{v['files_before']} to {v['files_after']}",
            f"{v['cpu']:.2f}",
            found["lost"].get(name, ""),
        ]
        for name, v in verdicts.items()
    ]
    frames = found["frames"]
    write_page(
        out,
        "soak",
        [
            "# A graph that runs for long",
            _INTRODUCTION.format(
                rate_hz=RATE_HZ,
                side=SIDE,
                minutes=f"{minutes:g}",
                warm_up_s=round(verdicts[LAUNCHER]["warm_up_s"]),
                flat=f"{FLAT:.0%}",
            ),
            f"{frames['sensed']} frames sensed, {frames['reconstructed']} reconstructed, "
            f"{frames['lost']} lost; {found['restarts']} restarts. The host's load average was "
            f"{load:.1f} on {os.cpu_count()} cores as it began: where that is not near 0, others "
            "took the time that frames were lost for.",
            markdown_table(header, rows),
            draw(out, samples, names),
            f"All samples: {write_csv(out, 'soak', list(flat_rows(samples, names)))}.",
        ],
    )


def flat_rows(samples: dict[str, Any], names: list[str]) -> list[dict[str, Any]]:
    """A row a sample and process."""
    return [
        {"time_s": time_s, "process": name}
        | {what: values[k] for what, values in samples[name].items()}
        for name in names
        for k, time_s in enumerate(samples["time_s"])
    ]


def draw(out: Path, samples: dict[str, Any], names: list[str]) -> str:
    """Memory of each process over time."""
    with chart_style():
        figure = new_figure(7.5, 4.0)
        axes = figure.subplots()
        minutes = np.array(samples["time_s"]) / 60
        for k, name in enumerate(names):
            style = {**series_style(k), "marker": ""}
            axes.plot(minutes, samples[name]["memory_mb"], label=name, **style)
        axes.set_xlabel("minutes")
        axes.set_ylabel("resident memory, MB")
        axes.set_ylim(bottom=0)
        legend_outside(figure, 3)
    return save_figure(figure, out, "soak", "Resident memory of each process over time")


_INTRODUCTION = """\
All nodes at {rate_hz} Hz with {side} x {side} taxels, preset `skin`, for {minutes} minutes; the
recorder takes the measurements. Memory is what is resident, its change that of the median from the
first to the last fifth after {warm_up_s} s of warm-up; flat is within {flat}. What is above it at
the highest are messages that waited while other work of the host held a node up. `lost` are
messages that never came to a node, by the numbers they carry."""
