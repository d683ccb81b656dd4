"""Chart of study `speed-accuracy`: time of a frame against accuracy, a point per solver, pace and
library.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.studies.baselines.libraries import PEERS
from sparseskin.studies.report import PALETTE, Chart

from .experiments import CENTRE_RATIO, ROTATED

CAPTION = (
    f"Time of a frame against accuracy, M = N/{CENTRE_RATIO}: up and to the left is better. "
    "Orange: the default by its number of iterations. Blue: other solvers. Green: other libraries, "
    "on the problem of preset paper"
)
ORANGE = PALETTE[1]
BLUE = PALETTE[0]
GREEN = PALETTE[2]
BLACK = PALETTE[-1]
_PLACES = ((6, 0), (-6, 0), (6, 9), (6, -9), (-6, 9), (-6, -9), (0, 11), (0, -11))
"""Places of a label about its point, in points; those of no room are tried further away, too."""
_REACHES = (1.0, 1.8, 2.6, 3.4)
_MARGIN = 10
"""Least distance of a label from the right end of its panel, in pixels."""
_GAP = 4
"""Least distance between two labels in a row, in pixels."""
_MARKER_POINTS = 8
_STAR_POINTS = 15
"""Widths of the marker of a point, and of the star of the default, in points."""
_NEAR = 12
"""Vertical distance of a label from its point beyond which a line leads to it, in points."""


def draw_times(out: Path, rows: pd.DataFrame, noisy: Mapping[str, float]) -> str:
    """Draw the chart, a panel per size, and return its Markdown.

    `rows`: panel, label, pace (0: none), mean_db, median_ms; `noisy`: mean PSNR of the readings of
    all taxels by panel, dB.
    """
    n = len(noisy)
    with Chart(
        out,
        "time_of_a_frame",
        CAPTION,
        n,
        n,
        size_in=(4.6 * n, 4.4),
        legend_columns=0,
        sharey=True,
    ) as chart:
        for axes, panel in zip(chart.panels, noisy, strict=True):
            points = rows[rows["panel"] == panel]
            axes.set_title(f"{panel} taxels".replace("N = ", ""))
            _prepare(axes, points)
        # All panels share the axis, with room for labels.
        levels = [*rows["mean_db"], *noisy.values()]
        axes.set_ylim(min(levels) - 2, max(levels) + 2.5)
        chart.label("time of a frame in ms, median, one core", "mean PSNR in dB")
        _show_error(chart.panels[-1])
        # Labels are placed where the layout leaves their points.
        layout = chart.figure.get_layout_engine()
        assert layout is not None
        layout.execute(chart.figure)
        for axes, (panel, noisy_db) in zip(chart.panels, noisy.items(), strict=True):
            _draw_points(axes, rows[rows["panel"] == panel], noisy_db)
    return chart.markdown


def _prepare(axes: Axes, points: pd.DataFrame) -> None:
    """Scale and limits of the times, with room for labels."""
    axes.set_xscale("log")
    axes.set_xlim(points["median_ms"].min() / 2.2, points["median_ms"].max() * 6)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _show_error(axes: Axes) -> None:
    """A second scale: the root mean square error that a PSNR is."""
    peak_mn = 1e3 * PAPER_F_MAX_N

    def error_mn(psnr_db: Any) -> Any:
        return peak_mn * 10 ** (-np.asarray(psnr_db) / 20)

    def level_db(error: Any) -> Any:
        return -20 * np.log10(np.maximum(error, 1e-9) / peak_mn)

    scale = axes.secondary_yaxis("right", functions=(error_mn, level_db))
    scale.set_ylabel("RMS error of a taxel in mN")
    scale.set_yticks([1, 2, 5, 10, 20, 50, 100])
    scale.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _draw_points(axes: Axes, points: pd.DataFrame, noisy_db: float) -> None:
    """The default as a line of its paces, all others as points, and a label for each."""
    axes.axhline(
        noisy_db,
        color=BLACK,
        linestyle="--",
        linewidth=1.0,
        zorder=1,
    )
    across = axes.get_yaxis_transform()
    text = "all taxels read, no solver"
    # At the slow end: what takes long and is less accurate than that is of no use.
    axes.text(
        0.99,
        noisy_db,
        text,
        fontsize=8,
        va="top",
        ha="right",
        transform=across,
    )

    paces = points[points["label"] == ROTATED].sort_values("pace")
    default = paces.iloc[-1]
    axes.plot(paces["median_ms"], paces["mean_db"], "o-", color=ORANGE, markersize=4)
    star = (default["median_ms"], default["mean_db"])
    axes.plot(*star, "*", color=ORANGE, markersize=_STAR_POINTS)
    peers = points[points["label"].isin(list(PEERS))]
    solvers = points[~points["label"].isin([ROTATED, *PEERS])]
    for methods, color, marker in ((solvers, BLUE, "s"), (peers, GREEN, "D")):
        places = (methods["median_ms"], methods["mean_db"])
        axes.plot(*places, marker, color=color, markersize=5)

    label = _Labels(axes, points, default)
    text = f"default: skin, {default['pace']:.0f} iterations"
    label.add(default, text, ORANGE, weight="bold")
    for _, point in paces.iloc[:-1].iterrows():
        label.add_below(point, f"{point['pace']:.0f}", ORANGE)
    for methods, color in ((solvers, BLUE), (peers, GREEN)):
        # The slowest first: it has the place to its right.
        for _, point in methods.sort_values("median_ms", ascending=False).iterrows():
            label.add(point, point["label"], color)


class _Labels:
    """Labels of points, each where it covers no other and no point; `default`: that of the star."""

    def __init__(self, axes: Axes, points: pd.DataFrame, default: pd.Series) -> None:
        self._axes = axes
        # Extents of texts are those of the renderer that `Chart` draws with.
        canvas: Any = FigureCanvasAgg(axes.figure.figure)
        self._renderer = canvas.get_renderer()
        places = axes.transData.transform(
            points[["median_ms", "mean_db"]].to_numpy(float)
        )
        radii = axes.figure.dpi / 72 * np.full(len(points), _MARKER_POINTS / 2)
        radii[points.index == default.name] *= _STAR_POINTS / _MARKER_POINTS
        self._taken = [
            Bbox.from_extents(*(place - radius), *(place + radius))
            for place, radius in zip(places, radii, strict=True)
        ]
        # The line of the readings and the text on it.
        self._taken += [
            artist.get_window_extent() for artist in (axes.lines[0], *axes.texts)
        ]

    def add(self, point: pd.Series, text: str, color: str, **font: Any) -> None:
        """Add a label at the first place with room; where there is none, at the first of all."""
        for reach in _REACHES:
            for right, up in _PLACES:
                if self._fits(point, text, (right, up * reach), color, font):
                    return
        self._put(point, text, _PLACES[0], color, font)

    def add_below(self, point: pd.Series, text: str, color: str) -> None:
        """Add a label right below its point, or none where there is no room."""
        self._fits(point, text, (0, -9), color, {})

    def _fits(
        self,
        point: pd.Series,
        text: str,
        offset: tuple[float, float],
        color: str,
        font: Any,
    ) -> bool:
        """Put a label, and take it away again if it covers something."""
        label = self._put(point, text, offset, color, font)
        label.update_positions(self._renderer)
        # Of the text alone: the line that leads to it may cross others.
        box = Text.get_window_extent(label)
        inside = self._axes.bbox
        is_inside = inside.x0 < box.x0 and box.x1 + _MARGIN < inside.x1
        is_free = not any(box.overlaps(taken) for taken in self._taken)
        if is_inside and is_free:
            self._taken.append(box.padded(_GAP, 0))
            return True
        label.remove()
        return False

    def _put(
        self,
        point: pd.Series,
        text: str,
        offset: tuple[float, float],
        color: str,
        font: Any,
    ) -> Annotation:
        sides = {
            -1: "right",
            0: "center",
            1: "left",
        }
        style: dict[str, Any] = {
            "color": color,
            "ha": sides[int(np.sign(offset[0]))],
            "va": "center",
            "fontsize": 8,
            "zorder": 5,
            **font,
        }
        # A thin line leads from a label that is not next to its point.
        if abs(offset[1]) > _NEAR:
            line = {
                "arrowstyle": "-",
                "color": color,
                "linewidth": 0.6,
            }
            style["arrowprops"] = line | {"shrinkA": 0, "shrinkB": 3}
        place = (point["median_ms"], point["mean_db"])
        return self._axes.annotate(
            text, place, offset, textcoords="offset points", **style
        )
