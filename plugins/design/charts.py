"""Charts of a design: rates of each stage, and accuracy against rate.

An open mark is a rate below the one asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes

from sparseskin.studies.report import PALETTE, Chart

from .budget import STAGES, Row
from .spec import Design
from .text import hertz

_COLOURS = dict(zip(STAGES, PALETTE, strict=False))
_MARKS = dict(zip(STAGES, "osD^", strict=True))
_OPEN = "open: below the rate asked for"
_PALE = 0.35
"""Opacity of what the host takes longer under a dense press."""


def draw_rates(out: Path, rows: Sequence[Row], design: Design) -> Chart:
    """Frames a second that each stage allows, a line a strategy; the slowest is large."""
    caption = (
        "Frames a second that each stage allows (log); the large mark is the slowest stage, which "
        "limits the rate; open: below the rate asked for. Host: from a dense press (mark) to a "
        "calm frame (end of the bar)"
    )
    with _StrategyChart(out, "rates", caption, rows) as chart:
        (axes,) = chart.panels
        for k, row in enumerate(rows):
            rates = row.stage_hz
            axes.plot([min(rates.values()), max(rates.values())], [k, k], color="0.8", lw=1.2)
            calm_hz = rates["host"] * row.stage_s["host"] / row.host_calm_s
            axes.plot([rates["host"], calm_hz], [k, k], color=_COLOURS["host"], lw=4, alpha=_PALE)
            for stage in STAGES:
                size = 10 if stage == row.limit else 6
                _mark(axes, rates[stage], k, stage, rates[stage] >= design.rate_hz, size)
        axes.axvline(design.rate_hz, color="black", lw=1, ls="--", label="asked for")
        for stage in STAGES:
            axes.plot([], [], _MARKS[stage], ms=7, color=_COLOURS[stage], label=stage)
        axes.plot([], [], color=_COLOURS["host"], lw=4, alpha=_PALE, label="host, to a calm frame")
        _open_entry(axes)
        axes.set_xscale("log")
        axes.set_xlabel("frames a second")
    return chart


def draw_accuracy(out: Path, rows: Sequence[Row], design: Design) -> Chart:
    """PSNR with its band, a line a strategy, and the rate at which it is reached."""
    caption = (
        "PSNR of contact frames and its band (90 % of scenes and seeds) at the rate that is "
        f"reached, which stands at the right; open: below the {hertz(design.rate_hz)} Hz asked "
        "for; mark and colour: the slowest stage"
    )
    with _StrategyChart(out, "accuracy", caption, rows) as chart:
        (axes,) = chart.panels
        for k, row in enumerate(rows):
            a = row.accuracy
            if math.isnan(a.psnr_db):
                axes.text(0.02, k, "not known", transform=axes.get_yaxis_transform(), va="center")
                continue
            ends = [[max(0.0, a.psnr_db - a.low_db)], [max(0.0, a.high_db - a.psnr_db)]]
            colour = _COLOURS[row.limit]
            axes.errorbar(a.psnr_db, k, xerr=ends, color=colour, lw=1.2, capsize=3)
            _mark(axes, a.psnr_db, k, row.limit, row.is_met, 7)
            axes.annotate(
                f"{hertz(row.reached_hz)} Hz",
                (1.01, k),
                xycoords=axes.get_yaxis_transform(),
                va="center",
                fontsize=9,
            )
        for stage in STAGES:
            if any(row.limit == stage for row in rows):
                label = f"slowest: {stage}"
                axes.plot([], [], _MARKS[stage], ms=7, color=_COLOURS[stage], label=label)
        _open_entry(axes)
        axes.set_xlabel("PSNR, dB")
    return chart


class _StrategyChart(Chart):
    """A chart with a line a strategy, the first at the top."""

    def __init__(self, out: Path, name: str, caption: str, rows: Sequence[Row]) -> None:
        size_in = (8.5, 0.34 * len(rows) + 1.8)
        super().__init__(out, name, caption, size_in=size_in, legend_columns=4)
        self.panels[0].set_yticks(range(len(rows)), [row.strategy.name for row in rows])
        self.panels[0].set_ylim(len(rows) - 0.5, -0.5)


def _mark(axes: Axes, x: float, y: float, stage: str, filled: bool, size: float) -> None:
    """Draw the mark of a stage."""
    colour = _COLOURS[stage]
    inside = colour if filled else "white"
    axes.plot(x, y, _MARKS[stage], ms=size, color=colour, markerfacecolor=inside, zorder=3)


def _open_entry(axes: Axes) -> None:
    """Add to the legend what an open mark is."""
    axes.plot([], [], "o", ms=7, color="0.4", markerfacecolor="white", label=_OPEN)
