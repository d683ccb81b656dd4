"""A graph as a picture: SVG by itself, PNG by matplotlib, both from one layout."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from sparseskin.nodes.errors import SettingsError

from .graph_layout import LINE, MARGIN, Box, Curve, Layout, layout_of
from .launchspec import LaunchFile

FILLS = ("#dbe9f6", "#fde5d2", "#dcefe3", "#f3e0ec", "#fbefcf")
"""One a host, again from the first where there are more."""
INK, LINK = "#1b1b1b", "#4a6f95"
FONT_PX = 11
PNG_SCALE = 2.0
_PX_IN = 1 / 96


def svg_of(launch: LaunchFile) -> str:
    """The picture of a graph as the text of an SVG file."""
    layout = layout_of(launch)
    size = f"{layout.width:.0f} {layout.height:.0f}"
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" '
        f'width="{layout.width:.0f}" height="{layout.height:.0f}" '
        f'font-family="DejaVu Sans, Verdana, sans-serif" font-size="{FONT_PX}" fill="{INK}">',
        '<defs><marker id="arrow" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
        f'markerHeight="8" orient="auto"><path d="M0 0L8 4L0 8z" fill="{LINK}"/></marker></defs>',
        '<rect width="100%" height="100%" fill="white"/>',
        f'<text x="{MARGIN}" y="{MARGIN}" font-weight="bold">{escape(layout.title)}</text>',
        *map(_svg_curve, layout.curves),
        *map(_svg_label, layout.curves),
        *map(_svg_box, layout.boxes),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def write_svg(launch: LaunchFile, path: Path) -> None:
    """Write the picture as SVG.

    Raises
    ------
    SettingsError
        If the file cannot be written.
    """
    try:
        path.write_text(svg_of(launch), encoding="utf-8")
    except OSError as error:
        raise SettingsError(f"--svg {path}: {error.strerror}") from error


def write_png(launch: LaunchFile, path: Path) -> None:
    """Write the picture as PNG, twice the size of the SVG.

    Raises
    ------
    SettingsError
        If matplotlib is not installed, or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise SettingsError(
            "--png: drawn with matplotlib: pip install 'sparseskin[charts]' (--svg needs nothing)"
        ) from error
    layout = layout_of(launch)
    figure = Figure(figsize=(layout.width * _PX_IN, layout.height * _PX_IN))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, layout.width), ylim=(layout.height, 0))
    axes.set_axis_off()
    _draw(axes, layout)
    try:
        figure.savefig(path, format="png", dpi=96 * PNG_SCALE, facecolor="white")
    except OSError as error:
        raise SettingsError(f"--png {path}: {error.strerror}") from error


def bends(curve: Curve) -> list[tuple[tuple[float, float], ...]]:
    """The cubic pieces of a link, (end, end, end, end) control points each: they leave and arrive
    level, half of the way being spent on either.
    """
    pieces: list[tuple[tuple[float, float], ...]] = []
    for (xa, ya), (xb, yb) in zip(curve.points, curve.points[1:], strict=False):
        half = max(12.0, (xb - xa) / 2)
        pieces.append(((xa, ya), (xa + half, ya), (xb - half, yb), (xb, yb)))
    return pieces


def _svg_curve(curve: Curve) -> str:
    x, y = curve.points[0]
    path = f"M{x:.1f} {y:.1f}" + "".join(
        "C" + " ".join(f"{px:.1f} {py:.1f}" for px, py in piece[1:]) for piece in bends(curve)
    )
    return f'<path d="{path}" fill="none" stroke="{LINK}" marker-end="url(#arrow)"/>'


def _svg_label(curve: Curve) -> str:
    x, y = curve.label_start
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{LINK}">{escape(curve.label)}</text>'


def _svg_box(box: Box) -> str:
    fill = FILLS[box.host % len(FILLS)]
    middle = box.x + box.width / 2
    rows = "".join(
        f'<text x="{middle:.1f}" y="{y + 4:.1f}" text-anchor="middle"'
        f"{' font-weight=' + chr(34) + 'bold' + chr(34) if k == 0 else ''}>{escape(line)}</text>"
        for k, (line, y) in enumerate(_rows(box))
    )
    return (
        f'<rect x="{box.x:.1f}" y="{box.y:.1f}" width="{box.width:.1f}" height="{box.height:.1f}" '
        f'rx="6" fill="{fill}" stroke="{INK}"/>{rows}'
    )


def _rows(box: Box) -> list[tuple[str, float]]:
    """Each line of a box, and the height of its middle."""
    first = box.y + box.height / 2 - LINE * (len(box.lines) - 1) / 2
    return [(line, first + k * LINE) for k, line in enumerate(box.lines)]


def _draw(axes: object, layout: Layout) -> None:
    """Draw a layout into axes whose unit is the pixel of the SVG."""
    from matplotlib.axes import Axes
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
    from matplotlib.path import Path as Outline

    assert isinstance(axes, Axes)
    points = FONT_PX * 72 / 96
    place: dict[str, Any] = {"fontsize": points, "va": "center", "family": "DejaVu Sans"}
    axes.text(MARGIN, MARGIN - 4, layout.title, weight="bold", color=INK, **place)
    for curve in layout.curves:
        at = [curve.points[0], *(point for piece in bends(curve) for point in piece[1:])]
        codes = [Outline.MOVETO, *[Outline.CURVE4] * (len(at) - 1)]
        axes.add_patch(
            FancyArrowPatch(path=Outline(at, codes), arrowstyle="-|>", mutation_scale=8, color=LINK)
        )
    for curve in layout.curves:
        x, y = curve.label_start
        axes.text(x, y, curve.label, color=LINK, **{**place, "va": "baseline"})
    for box in layout.boxes:
        style = "round,pad=0,rounding_size=6"
        fill = FILLS[box.host % len(FILLS)]
        corner = (box.x, box.y)
        axes.add_patch(
            FancyBboxPatch(
                corner,
                box.width,
                box.height,
                boxstyle=style,
                facecolor=fill,
                edgecolor=INK,
                zorder=4,
            )
        )
        for k, (line, y) in enumerate(_rows(box)):
            weight = "bold" if k == 0 else "normal"
            x = box.x + box.width / 2
            axes.text(x, y, line, ha="center", color=INK, weight=weight, zorder=5, **place)
