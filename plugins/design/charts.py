"""The chart of a design: accuracy, and the rate at which it is reached.

An open mark is a rate below the one asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sparseskin.studies.report import PALETTE, Chart

from .budget import STAGES, Row
from .spec import Design
from .text import hertz

_COLOURS = dict(zip(STAGES, PALETTE, strict=False))
_MARKS = dict(zip(STAGES, "osD^", strict=True))


def draw_accuracy(out: Path, rows: Sequence[Row], design: Design) -> Chart:
    """PSNR with its band, a line a strategy, the first at the top, and the rate at which it is
    reached.
    """
    caption = (
        "PSNR of contact frames and its band (90 % of scenes and seeds) at the rate that is "
        f"reached, which stands at the right; open: below the {hertz(design.rate_hz)} Hz asked "
        "for; mark and colour: the slowest stage"
    )
    size_in = (8.5, 0.34 * len(rows) + 1.8)
    with Chart(out, "accuracy", caption, size_in=size_in, legend_columns=4) as chart:
        (axes,) = chart.panels
        axes.set_yticks(range(len(rows)), [row.strategy.name for row in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        for k, row in enumerate(rows):
            a = row.accuracy
            if math.isnan(a.psnr_db):
                axes.text(0.02, k, "not known", transform=axes.get_yaxis_transform(), va="center")
                continue
            ends = [[max(0.0, a.psnr_db - a.low_db)], [max(0.0, a.high_db - a.psnr_db)]]
            style: dict[str, Any] = {
                "color": _COLOURS[row.limit],
                "marker": _MARKS[row.limit],
                "ms": 7,
            }
            inside = style["color"] if row.is_met else "white"
            axes.errorbar(
                a.psnr_db, k, xerr=ends, lw=1.2, capsize=3, markerfacecolor=inside, **style
            )
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
        label = "open: below the rate asked for"
        axes.plot([], [], "o", ms=7, color="0.4", markerfacecolor="white", label=label)
        axes.set_xlabel("PSNR, dB")
    return chart
