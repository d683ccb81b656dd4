"""Charts of a design: rates of each stage, accuracy against rate, latency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from sparseskin.studies.report import PALETTE, Chart

from .budget import STAGES, Row
from .models.costs import HOP_S
from .spec import Design
from .text import hertz

_COLOURS = dict(zip(STAGES, PALETTE, strict=False))
_MARKS = dict(zip(STAGES, "osD^", strict=True))
_HOP = "process to process"


def draw_rates(out: Path, rows: Sequence[Row], design: Design) -> Chart:
    """Frames a second that each stage allows, a line a strategy; the slowest is filled."""
    caption = "Frames a second that each stage allows (log); filled: the slowest, which is the rate"
    chart = Chart(out, "rates", caption, size_in=(8.5, 0.34 * len(rows) + 1.8), legend_columns=5)
    with chart:
        (axes,) = chart.panels
        for k, row in enumerate(rows):
            ends = row.stage_hz.values()
            axes.plot([min(ends), max(ends)], [k, k], color="0.8", lw=1.2, zorder=1)
            for stage in STAGES:
                slowest = stage == row.limit
                axes.plot(
                    row.stage_hz[stage],
                    k,
                    _MARKS[stage],
                    ms=9 if slowest else 6,
                    color=_COLOURS[stage],
                    markerfacecolor=_COLOURS[stage] if slowest else "white",
                    label=stage,
                    zorder=3 if slowest else 2,
                )
        axes.axvline(design.rate_hz, color="black", lw=1, ls="--", label="asked for")
        axes.set_xscale("log")
        axes.set_yticks(range(len(rows)), [row.strategy.name for row in rows])
        axes.invert_yaxis()
        axes.set_xlabel("frames a second")
        _merge_legend(chart)
    return chart


def draw_accuracy(out: Path, rows: Sequence[Row]) -> Chart:
    """PSNR with its band, a line a strategy, and the rate at which it is reached."""
    caption = (
        "PSNR of contact frames and its band (90 % of scenes and seeds) at the rate that is "
        "reached; open: a lower rate than asked for; mark and colour: the slowest stage"
    )
    chart = Chart(out, "accuracy", caption, size_in=(8.5, 0.34 * len(rows) + 1.8))
    with chart:
        (axes,) = chart.panels
        for k, row in enumerate(rows):
            a = row.accuracy
            if math.isnan(a.psnr_db):
                axes.text(0.02, k, "not known", transform=axes.get_yaxis_transform(), va="center")
                continue
            axes.errorbar(
                a.psnr_db,
                k,
                xerr=[[max(0.0, a.psnr_db - a.low_db)], [max(0.0, a.high_db - a.psnr_db)]],
                fmt=_MARKS[row.limit],
                color=_COLOURS[row.limit],
                markerfacecolor=_COLOURS[row.limit] if row.is_met else "white",
                ms=7,
                lw=1.2,
                capsize=3,
                label=f"slowest: {row.limit}",
            )
            axes.annotate(
                f"{hertz(row.reached_hz)} Hz",
                (1.01, k),
                xycoords=axes.get_yaxis_transform(),
                va="center",
                fontsize=9,
            )
        axes.set_yticks(range(len(rows)), [row.strategy.name for row in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlabel("PSNR, dB")
        _merge_legend(chart)
    return chart


def draw_latency(out: Path, rows: Sequence[Row]) -> Chart:
    """Latency of a frame by its stages."""
    caption = "Time from the first conversion to the reconstruction, without queues"
    chart = Chart(out, "latency", caption, size_in=(8.5, 0.34 * len(rows) + 1.8), legend_columns=5)
    with chart:
        (axes,) = chart.panels
        for k, row in enumerate(rows):
            left = 0.0
            for stage, width in (*row.stage_s.items(), (_HOP, HOP_S)):
                colour = _COLOURS.get(stage, "0.5")
                axes.barh(k, 1e3 * width, left=left, color=colour, height=0.7, label=stage)
                left += 1e3 * width
            axes.text(left, k, f" {left:.2g}" if left < 10 else f" {left:.0f}", va="center")
        axes.set_yticks(range(len(rows)), [row.strategy.name for row in rows])
        axes.invert_yaxis()
        axes.margins(x=0.08)
        axes.set_axisbelow(True)
        axes.set_xlabel("ms")
        _merge_legend(chart)
    return chart


def _merge_legend(chart: Chart) -> None:
    """Keep one entry of each label, with a filled mark."""
    seen: set[str] = set()
    for axes in chart.panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if label in seen:
                handle.set_label("_" + label)
            seen.add(label)
