"""Draw the picture of the README from a real frame: python docs/pictures/picture.py [OUT.png]."""

from __future__ import annotations

import sys
from collections import deque
from pathlib import Path
from typing import Any

import matplotlib

import sparseskin

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

SCENE, FRAME = "drag_wrench_40", 2300
STATIONS = [
    ("sensor", "N forces, noisy"),
    ("compressor", "M = N/3 sums, at the edge"),
    ("reconstructor", "N forces, on the host"),
    ("monitor", "accuracy, latency, losses"),
]


def main(out: Path) -> None:
    (frame,) = deque(sparseskin.run_launch(SCENE, FRAME), maxlen=1)
    truth = frame.truth
    maps = [
        ("true forces", truth, ""),
        ("readings of the taxels", frame.taxels, _psnr(frame.taxels, truth)),
        (
            f"reconstructed from {frame.measurements.size} of {truth.size} numbers",
            frame.forces,
            _psnr(frame.forces, truth),
        ),
    ]
    figure = plt.figure(figsize=(11, 5.6), dpi=110, facecolor="white")
    _draw_stations(figure.add_axes((0.02, 0.77, 0.96, 0.21)))
    top = float(truth.max())
    for k, (title, forces, note) in enumerate(maps):
        axes = figure.add_axes((0.03 + 0.3 * k, 0.03, 0.28, 0.6))
        image = axes.imshow(forces, vmin=0, vmax=top, cmap="viridis", interpolation="nearest")
        axes.set_title(f"{title}\n{note}", fontsize=11)
        axes.set_xticks([])
        axes.set_yticks([])
    bar = figure.colorbar(image, cax=figure.add_axes((0.93, 0.06, 0.015, 0.54)))
    bar.set_label("force in N")
    figure.savefig(out)


def _psnr(forces: Any, truth: Any) -> str:
    return f"PSNR {sparseskin.psnr_db(forces, truth):.1f} dB"


def _draw_stations(axes: Any) -> None:
    axes.set_xlim(0, 4)
    axes.set_ylim(0, 1)
    axes.axis("off")
    for k, (name, what) in enumerate(STATIONS):
        box = FancyBboxPatch(
            (k + 0.08, 0.42), 0.66, 0.42, boxstyle="round,pad=0.03", fc="#e8eef7", ec="#30507a"
        )
        axes.add_patch(box)
        axes.text(k + 0.41, 0.63, name, ha="center", va="center", fontsize=13, weight="bold")
        axes.text(k + 0.41, 0.18, what, ha="center", va="center", fontsize=10)
        if k < 3:
            arrow = FancyArrowPatch(
                (k + 0.79, 0.63), (k + 1.04, 0.63), arrowstyle="-|>", mutation_scale=18, lw=2
            )
            axes.add_patch(arrow)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("picture.png"))
