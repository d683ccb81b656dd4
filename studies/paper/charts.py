"""Charts of study `paper-tables`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.studies.frames import scene_of
from sparseskin.studies.report import LINES, MARKERS, PALETTE, Chart

from .numbers import ITERATIONS, PAPER, RATIOS, Results

Style = dict[str, Any]
SHOWN_FRAMES = 300


def draw_maps(out: Path, scene: str, maps: Mapping[str, Any]) -> str:
    """True forces, taxels and reconstructed forces, a row a frame.

    `maps`: by title the number of the frame, its maps, and the PSNR of taxels and of reconstructed
    forces in dB.
    """
    source = "reconstructed from 1365 numbers, 20 iterations."
    caption = f"Forces of DRAG WRENCH 64 x 64, {source}"
    n_rows = len(maps)
    layout: dict[str, Any] = {"size_in": (9.0, 2.9 * n_rows + 0.4), "legend_columns": 0}
    with Chart(out, "maps", caption, 3 * n_rows, 3, **layout) as chart:
        for k, (title, (frame, images, (noisy_db, ours_db))) in enumerate(maps.items()):
            row = chart.panels[3 * k : 3 * k + 3]
            # One scale a row: its three maps are compared.
            scale: Style = {"vmin": 0, "vmax": float(np.max(images[0]))}
            noisy = f"noisy, {noisy_db:.1f} dB"
            notes = ("true", noisy, f"reconstructed, {ours_db:.1f} dB")
            for axes, image, note in zip(row, images, notes, strict=True):
                drawn = axes.imshow(
                    image,
                    cmap="viridis",
                    origin="lower",
                    **scale,
                )
                axes.set(title=note, xlabel="column")
                axes.grid(False)
            time_ms = frame * scene_of(scene).dt_ns * 1e-6
            row[0].set_ylabel(f"{title}, {time_ms:.1f} ms\nrow")
            chart.figure.colorbar(
                drawn,
                ax=row,
                label="force in N",
                shrink=0.9,
            )
    return chart.markdown


def draw_sequences(out: Path, results: Results, by: str) -> str:
    """PSNR over time, by "M" in DRAG WRENCH or by "iterations" in LIFT BOX, 64 x 64."""
    scene = "drag_wrench_64" if by == "M" else "lift_box_64"
    series = {f"M = N/{ratio}": results.ours(scene, ratio) for ratio in RATIOS}
    if by != "M":
        series = {f"{k} iterations": results.ours(scene, 3, str(k)) for k in ITERATIONS}
    series["noisy"] = results.ours(scene, 1)
    contact = results.contact(scene)
    begin_of_scene = results.scenes[scene]["first"]
    landing = max(0, int(np.argmax(contact)) - 50)
    begins = {
        "representative": _longest_contact(contact),
        "first contact": landing,
    }
    caption = f"PSNR over time, {PAPER[scene].title} 64 x 64, preset paper"
    name = f"psnr_by_{by.lower()}"
    with Chart(out, name, caption, 2, 2, size_in=(9.0, 4.2)) as chart:
        for axes, (title, begin) in zip(chart.panels, begins.items(), strict=True):
            part = slice(begin, min(begin + SHOWN_FRAMES, len(contact)))
            frames = np.arange(part.start, part.stop) + begin_of_scene
            times_ms = frames * scene_of(scene).dt_ns * 1e-6
            for k, (label, values) in enumerate(series.items()):
                if label == "noisy":
                    k = -1
                # Few marks, not at the same times: those of one line do not hide another's.
                style: Style = {
                    "color": PALETTE[k],
                    "linestyle": LINES[k],
                    "marker": MARKERS[k],
                    "markevery": (k * 5 % 30, max(1, len(times_ms) // 8)),
                }
                axes.plot(
                    times_ms,
                    values[part],
                    label=label,
                    markersize=4,
                    **style,
                )
            axes.set(
                title=title,
                xlabel="time in the scene in ms",
                ylabel="PSNR in dB",
            )
    return chart.markdown


def _longest_contact(contact: npt.NDArray[np.bool_]) -> int:
    """First of the middle frames of the longest contact: forces change slowly there."""
    # A contact begins and ends where the mark changes.
    padded = np.pad(contact, 1)
    edges = np.flatnonzero(np.diff(padded))
    begins = edges[::2]
    ends = edges[1::2]
    longest = int(np.argmax(ends - begins))
    middle = int(begins[longest] + ends[longest]) // 2
    return max(0, middle - SHOWN_FRAMES // 2)
