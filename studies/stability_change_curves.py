"""Sudden change, drawn and explained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.studies.points import compute
from sparseskin.studies.report import (
    chart_style,
    legend_outside,
    markdown_table,
    save_figure,
    write_csv,
)
from sparseskin.studies.solvers import SUM_SOLVERS
from sparseskin.studies.stability_change import (
    EVENTS,
    N_BEFORE,
    N_EACH,
    N_SETTLED,
    frames_until_settled,
    measure,
    points,
)
from sparseskin.studies.stability_charts import draw_solvers, label_outer, panels
from sparseskin.studies.stability_frames import psnr_of

N_SHOWN_BEFORE, N_SHOWN = 2, 16
Row = Mapping[str, Any]

_TEXT = f"""## Solvers: sudden change

Pads appear on an untouched skin within one frame, move by 5 taxels within one frame, and are gone
within one frame, {N_EACH} frames each; K/M = 0.12. PSNR of the mean squared error over trials, all
frames. It fails for as long as what is carried from frame to frame is wrong: a warm start is then
no better than none, and a fixed number of iterations is spread over several frames."""


def section(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute, draw and explain."""
    asked = points(quick, seed)
    figures = compute(measure, asked, out, executor, "sudden change")
    whole = [{**point, **figure} for point, figure in zip(asked, figures, strict=True)]
    rows = [row for one in whole for row in _rows(one)]
    return [
        _TEXT,
        _chart(out, whole),
        "Frames until the error stays within 1 dB of where it settles, or above 60 dB (1: at once) "
        f"/ frames of the {N_EACH} that are worse than the readings; in brackets, PSNR in the "
        "event's own frame and settled, dB:",
        _table(rows),
        f"All figures: {write_csv(out, 'change', rows)}.",
    ]


def _rows(one: Row) -> list[dict[str, Any]]:
    """What is found of each event, of one point with its figures."""
    settled = frames_until_settled(one["errors"])
    rows = []
    for k, event in enumerate(EVENTS):
        start = N_BEFORE + k * N_EACH
        errors, noisy = (one[key][start : start + N_EACH] for key in ("errors", "noisy"))
        rows.append(
            {
                **{key: one[key] for key in ("solver", "side", "ratio", "n_trials", "seed")},
                "event": event,
                "frames_until_settled": settled[event],
                "below_readings": sum(e > n for e, n in zip(errors, noisy, strict=True)),
                "first_db": psnr_of(errors[0]),
                "settled_db": float(np.mean([psnr_of(e) for e in errors[-N_SETTLED:]])),
            }
        )
    return rows


def _chart(out: Path, whole: Sequence[Row]) -> str:
    """PSNR around each event at each N/M, on the smaller skin."""
    ratios = list(dict.fromkeys(one["ratio"] for one in whole))
    side = whole[0]["side"]
    frames = list(range(-N_SHOWN_BEFORE, N_SHOWN))
    with chart_style():
        figure, axes = panels(len(EVENTS) * len(ratios), len(EVENTS), 3.1, 2.4)
        for i, ratio in enumerate(ratios):
            mine = [one for one in whole if (one["ratio"], one["side"]) == (ratio, side)]
            for k, event in enumerate(EVENTS):
                start = N_BEFORE + k * N_EACH - N_SHOWN_BEFORE
                shown = slice(start, start + len(frames))
                panel = axes[i * len(EVENTS) + k]
                curves = {
                    one["solver"]: (frames, [psnr_of(e) for e in one["errors"][shown]])
                    for one in mine
                }
                noisy = [psnr_of(e) for e in mine[0]["noisy"][shown]]
                draw_solvers(panel, curves, (frames, noisy))
                panel.set(title=f"{event}, N/{ratio}")
        label_outer(axes, len(EVENTS), "frames after the event", "PSNR, dB")
        legend_outside(figure, n_columns=5)
        return save_figure(figure, out, "change", f"Sudden change on {side} x {side} taxels.")


def _table(rows: Sequence[Row]) -> str:
    lines = []
    for side, ratio in dict.fromkeys((row["side"], row["ratio"]) for row in rows):
        for solver in SUM_SOLVERS:
            mine = {
                row["event"]: row
                for row in rows
                if (row["side"], row["ratio"], row["solver"]) == (side, ratio, solver)
            }
            cells = [
                f"{mine[e]['frames_until_settled']} / {mine[e]['below_readings']} "
                f"({mine[e]['first_db']:.1f}, {mine[e]['settled_db']:.1f})"
                for e in EVENTS
            ]
            lines.append([f"{side} x {side}", f"N/{ratio}", solver, *cells])
    return markdown_table(["taxels", "M", "solver", *EVENTS], lines)
