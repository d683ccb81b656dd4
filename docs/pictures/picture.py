"""Draw the first picture of the README from a frame: python docs/pictures/picture.py [OUT.png]."""

from __future__ import annotations

import sys
from collections import deque
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

import sparseskin

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch

SCENE, FRAME = "drag_wrench_40", 329
"""The wrench has just landed: nearly 300 N, on a third of the taxels."""
WIDTH_IN, HEIGHT_IN = 12.0, 3.7
SIDE, BOTTOM, STRIP = 0.235, 0.06, 0.055
"""Width of a map, lower end of all, and width of the strip of measurements, in the figure's width
and height.
"""
LEFTS = (0.012, 0.29, 0.41, 0.70)
"""Left ends of readings, strip, reconstruction and truth."""


def main(out: Path) -> None:
    (frame,) = deque(sparseskin.run_launch(SCENE, FRAME), maxlen=1)
    truth = frame.truth
    m = frame.measurements.size
    figure = plt.figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=110, facecolor="white")
    height = SIDE * WIDTH_IN / HEIGHT_IN
    readings, strip, forces, true = (
        figure.add_axes((left, BOTTOM, STRIP if k == 1 else SIDE, height))
        for k, left in enumerate(LEFTS)
    )

    scale = {"vmin": 0.0, "vmax": float(truth.max()), "cmap": "viridis"}
    readings.imshow(frame.taxels, **scale)
    readings.set_title(f"{truth.size} taxels, noisy\n{_error(frame.taxels, truth)}")
    forces.imshow(frame.forces, **scale)
    forces.set_title(
        f"{truth.size} forces, reconstructed\n{_error(frame.forces, truth)}"
    )
    image = true.imshow(truth, **scale)
    true.set_title("true forces\n(simulated)")
    _draw_strip(strip, frame.measurements)
    strip.set_title(f"{m} sums\nare sent")
    for axes in (readings, strip, forces, true):
        axes.set(xticks=[], yticks=[])

    bar = figure.colorbar(image, cax=figure.add_axes((0.945, BOTTOM, 0.012, height)))
    bar.set_label("force of a taxel in N")
    middle = BOTTOM + height / 2
    for begin, end in ((LEFTS[0] + SIDE, LEFTS[1]), (LEFTS[1] + STRIP, LEFTS[2])):
        style = {"arrowstyle": "-|>", "mutation_scale": 18, "lw": 2, "color": "black"}
        ends = (begin + 0.005, middle), (end - 0.005, middle)
        figure.add_artist(FancyArrowPatch(*ends, transform=figure.transFigure, **style))
    figure.savefig(out)


def _error(forces: Any, truth: Any) -> str:
    return f"error {1e3 * float(np.sqrt(np.mean((forces - truth) ** 2))):.0f} mN (RMS)"


def _draw_strip(axes: Any, y: Any) -> None:
    """Measurements in their order, row by row, coloured by sign and size."""
    n_columns = 10
    cells = np.full(-(-y.size // n_columns) * n_columns, np.nan, dtype=np.float32)
    # The square root of the size shows small ones beside those of large sums.
    cells[: y.size] = np.sign(y) * np.sqrt(np.abs(y))
    limit = float(np.nanmax(np.abs(cells)))
    rows = cells.reshape(-1, n_columns)
    axes.imshow(
        rows,
        vmin=-limit,
        vmax=limit,
        cmap="RdBu",
        aspect="auto",
        interpolation="nearest",
    )


if __name__ == "__main__":
    main(
        Path(sys.argv[1])
        if len(sys.argv) > 1
        else Path(__file__).with_name("picture.png")
    )
