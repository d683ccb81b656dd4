"""The charts of study `targets`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from .report import MARKERS, PALETTE, chart_style, legend_outside, new_figure, save_figure


def draw_gain(out: Path, method: str, gains_db: Mapping[str, Mapping[int, float]]) -> str:
    """Draw a method's gain over preset paper by scene and N / M; the Markdown that shows it."""
    figure = new_figure(8.0, 0.3 * len(gains_db) + 2.0)
    with chart_style():
        axes = figure.subplots()
        scenes = list(gains_db)[::-1]
        for k, ratio in enumerate(next(iter(gains_db.values()))):
            gains = [gains_db[scene][ratio] for scene in scenes]
            axes.plot(gains, scenes, MARKERS[k], color=PALETTE[k], label=f"M = N/{ratio}")
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_xlabel("mean PSNR over preset paper, same frames, dB")
        legend_outside(figure)
    name = "gain_" + method.replace(", ", "_")
    return save_figure(figure, out, name, f"Gain of {method} over preset paper, by scene")


def draw_ablation(
    out: Path, names: Sequence[str], changes_db: Mapping[str, Sequence[float]]
) -> str:
    """Draw what leaving out each ingredient changes, by ratio and rows; the Markdown."""
    figure = new_figure(8.0, 0.35 * len(names) + 1.8)
    with chart_style():
        axes = figure.subplots()
        height = 0.8 / len(changes_db)
        for k, (kind, changes) in enumerate(changes_db.items()):
            places = [-row - k * height for row in range(len(names))]
            hatch = ("", "///", "...")[k % 3]
            axes.barh(places, changes, height, color=PALETTE[k], label=kind, hatch=hatch)
        axes.set_yticks([-row - height / 2 for row in range(len(names))], list(names))
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_xlabel("change of mean PSNR without it, dB")
        legend_outside(figure)
    return save_figure(figure, out, "ablation", "One ingredient left out at a time")
