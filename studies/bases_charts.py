"""The charts of study `bases`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy.typing as npt

from .bases_points import KEPT_PARTS, SAMPLINGS
from .report import MARKERS, PALETTE, chart_style, legend_outside, new_figure, save_figure
from .report import series_style as style

#: What float32 leaves of an energy that is all captured.
LEAST_MISSING = 1e-12


def draw_missing(out: Path, counted: Mapping[tuple[str, str], Mapping[str, Any]]) -> str:
    """Draw the energy outside the largest coefficients, by basis; the Markdown that shows it."""
    scenes = list(dict.fromkeys(scene for scene, _ in counted))
    bases = list(dict.fromkeys(basis for _, basis in counted))
    n_rows = -(-len(scenes) // 2)
    figure = new_figure(8.0, 2.4 * n_rows + 1.0)
    with chart_style():
        grid = figure.subplots(n_rows, 2, squeeze=False, sharex=True, sharey=True).reshape(-1)
        for axes, scene in zip(grid, scenes, strict=False):
            for k, basis in enumerate(bases):
                missing = [max(part, LEAST_MISSING) for part in counted[scene, basis]["missing"]]
                axes.plot([100 * part for part in KEPT_PARTS], missing, label=basis, **style(k))
            axes.set_title(scene)
            axes.set_xscale("log")
            axes.set_yscale("log")
        for axes in grid[len(scenes) :]:
            axes.set_visible(False)
        _label_lowest(grid[: len(scenes)], "largest coefficients kept, % of N")
        figure.supylabel("part of the energy that is missing")
        legend_outside(figure)
    return save_figure(figure, out, "energy", "Energy of the true forces outside the K largest")


def draw_restored(out: Path, tuned_db: Mapping[tuple[str, str, int], float]) -> str:
    """Draw the PSNR with the best lambda, by basis and scene; the Markdown that shows it."""
    scenes = list(dict.fromkeys(scene for scene, _, _ in tuned_db))
    bases = list(dict.fromkeys(basis for _, basis, _ in tuned_db))
    ratios = sorted({ratio for _, _, ratio in tuned_db})
    figure = new_figure(8.0, 0.3 * len(bases) + 1.8)
    with chart_style():
        for axes, ratio in zip(figure.subplots(1, len(ratios), sharey=True), ratios, strict=True):
            for k, scene in enumerate(scenes):
                found = [tuned_db[scene, basis, ratio] for basis in bases[::-1]]
                axes.plot(found, bases[::-1], MARKERS[k], color=PALETTE[k], label=scene)
            axes.set_title(f"M = N/{ratio}")
            axes.set_xlabel("mean PSNR, dB")
        legend_outside(figure, 3)
    return save_figure(figure, out, "restored", "FISTA with the best lambda, by basis and scene")


def draw_sampled(out: Path, sampled: Mapping[tuple[str, int], Mapping[str, Any]]) -> str:
    """Draw PSNR over M by kind of sampling, a chart a scene; the Markdown that shows it."""
    scenes = list(dict.fromkeys(scene for scene, _ in sampled))
    ratios = sorted({ratio for _, ratio in sampled})
    n_rows = -(-len(scenes) // 2)
    figure = new_figure(8.0, 2.4 * n_rows + 1.0)
    with chart_style():
        grid = figure.subplots(n_rows, 2, squeeze=False, sharex=True).reshape(-1)
        for axes, scene in zip(grid, scenes, strict=False):
            reading = sampled[scene, ratios[0]]["reading"]["mean_db"]
            axes.axhline(reading, color="grey", linewidth=1.0, label="all taxels read")
            for k, name in enumerate(SAMPLINGS):
                found = [sampled[scene, ratio][name]["mean_db"] for ratio in ratios]
                axes.plot([100 / ratio for ratio in ratios], found, label=name, **style(k))
            axes.set_title(scene)
        for axes in grid[len(scenes) :]:
            axes.set_visible(False)
        _label_lowest(grid[: len(scenes)], "measurements, % of N")
        figure.supylabel("mean PSNR, dB")
        legend_outside(figure, 5)
    return save_figure(figure, out, "sampling", "PSNR in contact over M: what is measured, and how")


def _label_lowest(grid: npt.NDArray[Any], label: str) -> None:
    """Label the axes of a grid of two columns that have none below them."""
    for axes in grid[-2:]:
        axes.set_xlabel(label)
        axes.tick_params(labelbottom=True)
