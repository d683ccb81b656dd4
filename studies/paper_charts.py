"""The charts of the paper, drawn from our frames, and two that show why figures differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .paper_numbers import PAPER
from .paper_results import Highest
from .report import LINES, MARKERS, PALETTE, chart_style, legend_outside, new_figure, save_figure

Series = Mapping[str, Sequence[float]]


def draw_maps(out: Path, rows: Sequence[tuple[str, Any, Any]], shown: str) -> str:
    """Truth, taxels and restored forces, a row a frame.

    Parameters
    ----------
    out : Path
    rows : sequence of (title, maps, psnr_db)
        As `frame_maps` gives them.
    shown : str
        What was restored and how, for the caption.
    """
    with chart_style():
        figure = new_figure(9.0, 2.9 * len(rows) + 0.4)
        grid = figure.subplots(len(rows), 3, squeeze=False)
        for axes, (title, maps, (noisy_db, restored_db)) in zip(grid, rows, strict=True):
            top = float(np.max(maps[0]))
            notes = ("true", f"noisy, {noisy_db:.1f} dB", f"restored, {restored_db:.1f} dB")
            for axis, image, note in zip(axes, maps, notes, strict=True):
                drawn = axis.imshow(image, vmin=0, vmax=top, cmap="viridis", origin="lower")
                axis.set_title(note)
                axis.grid(False)
                axis.set_xlabel("column")
            axes[0].set_ylabel(f"{title}\nrow")
            figure.colorbar(drawn, ax=list(axes), label="force in N", shrink=0.9)
        return save_figure(figure, out, "maps", f"Forces of {shown}.")


def draw_sequences(
    out: Path,
    name: str,
    panels: Sequence[tuple[str, Sequence[float], Series]],
    caption: str,
) -> str:
    """PSNR over time, a panel a part of a scene.

    Parameters
    ----------
    out : Path
    name : str
        Of the files.
    panels : sequence of (title, times in ms, PSNR in dB by label)
        The noisy signal last.
    caption : str
    """
    with chart_style():
        figure = new_figure(9.0, 4.2)
        for axis, (title, times_ms, series) in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            for k, (label, values) in enumerate(series.items()):
                k = -1 if label == "noisy" else k
                axis.plot(
                    *(times_ms, values),
                    label=label,
                    color=PALETTE[k],
                    linestyle=LINES[k],
                    marker=MARKERS[k],
                    markevery=(k * 5 % 30, max(1, len(times_ms) // 8)),
                    markersize=4,
                )
            axis.set_title(title)
            axis.set_xlabel("time in the scene in ms")
            axis.set_ylabel("PSNR in dB")
        legend_outside(figure)
        return save_figure(figure, out, name, caption)


def draw_untouched(
    out: Path,
    lambdas_n: Sequence[float],
    highest_db: Highest,
) -> str:
    """The best PSNR of an untouched skin over lambda, with the range ends of table III.

    Parameters
    ----------
    out : Path
    lambdas_n : sequence of float
    highest_db : dict
        By (side, few_levels, ratio), in the order of lambdas_n.
    """
    kinds = sorted({(side, few) for side, few, _ in highest_db})
    titles = {
        (40, False): "40 x 40, all levels",
        (40, True): "40 x 40, three levels",
        (64, True): "64 x 64, six levels",
    }
    with chart_style():
        figure = new_figure(10.0, 4.4)
        for axis, kind in zip(figure.subplots(1, len(kinds), sharey=True), kinds, strict=True):
            ratios = [ratio for side, few, ratio in highest_db if (side, few) == kind]
            for k, ratio in enumerate(ratios):
                axis.plot(
                    *(lambdas_n, np.clip(highest_db[(*kind, ratio)], 0, 72)),
                    label=f"ours, M = N/{ratio}",
                    color=PALETTE[k],
                    linestyle=LINES[k],
                    marker=MARKERS[k],
                )
                ends = [p.by_ratio[ratio].high for p in PAPER.values() if p.n == kind[0] ** 2]
                axis.axhspan(
                    *(min(ends), max(ends)),
                    color=PALETTE[k],
                    alpha=0.25,
                    label=f"paper, M = N/{ratio}",
                )
            axis.set_xscale("log")
            axis.set_title(titles[kind])
            axis.set_xlabel("lambda in mN")
            axis.set_xticks(lambdas_n[::2], [f"{x * 1e3:.1f}" for x in lambdas_n[::2]])
            axis.minorticks_off()
            axis.set_ylim(50, 72)
        figure.axes[0].set_ylabel("highest PSNR in dB")
        legend_outside(figure, 3)
        return save_figure(
            *(figure, out, "untouched"),
            "Highest PSNR of an untouched skin over lambda (30 iterations; above 72 dB cut off); "
            "shaded: the upper ends of the ranges in the paper's table III",
        )


def draw_coefficients(
    out: Path,
    by_n: Mapping[int, tuple[Sequence[float], Sequence[float]]],
    means: Mapping[str, tuple[float, float]],
) -> str:
    """PSNR over the number of coefficients, and the means of the paper and of ours.

    Parameters
    ----------
    out : Path
    by_n : dict
        By N: number of D2 coefficients of frames in contact, and their PSNR restored from N/3.
    means : dict
        By scene: means of both over all its frames.
    """
    with chart_style():
        figure = new_figure(9.0, 4.6)
        for axis, (n, (counts, psnr)) in zip(
            figure.subplots(1, len(by_n)), by_n.items(), strict=True
        ):
            axis.scatter(counts, psnr, s=4, alpha=0.15, color="0.5", label="our frames")
            for k, title in enumerate(("LIFT BOX", "LIFT WRENCH", "DRAG WRENCH", "PATH")):
                for scene, scenario in PAPER.items():
                    if (scenario.n, scenario.title) != (n, title):
                        continue
                    paper = (scenario.d2.mean, scenario.by_ratio[3].mean)
                    style = {"color": PALETTE[k], "marker": MARKERS[k], "linestyle": ""}
                    axis.plot(*paper, label=f"paper, {title}", markersize=8, **style)
                    axis.plot(
                        *means[scene],
                        label=f"ours, {title}",
                        **{"markersize": 8, "markerfacecolor": "white"},
                        **style,
                    )
            axis.set_title(f"N = {n}, M = N/3, 30 iterations")
            axis.set_xlabel("D2 coefficients of the true forces")
            axis.set_ylabel("PSNR in dB")
        legend_outside(figure, 3)
        return save_figure(
            *(figure, out, "coefficients"),
            "PSNR of our frames in contact over the number of coefficients there are to find; "
            "marks: means over all frames of a scenario, filled as the paper reports, open ours",
        )
