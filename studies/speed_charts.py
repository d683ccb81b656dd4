"""The charts of `speed-accuracy`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .report import (
    MARKERS,
    PALETTE,
    chart_style,
    legend_outside,
    new_figure,
    save_figure,
    series_style,
)
from .speed_design import CENTRE_RATIO
from .speed_peers import PEERS
from .speed_rows import Results, Row, front, labels_of, pool_of, swept_iterations, swept_m

MEASURES = {"mean_db": "mean PSNR in dB", "worst_db": "worst PSNR in dB"}
_BLACK = PALETTE[-1]


def draw_speed(out: Path, results: Results, pooled: bool) -> str:
    """Solve time against PSNR."""

    def curve(rows: Sequence[Row], label: str) -> list[Row]:
        return swept_iterations(rows, label)

    where = "pooled" if pooled else "by_scene"
    return _draw(
        *(out, f"speed_{where}", results, pooled, "median_ms"),
        *("solve time a frame in ms (median, one core)", curve),
        "Solve time against PSNR, M = N/3: along each line the iterations grow; open marks: other "
        "M, of the solvers with a preset; grey: the Pareto front at M = N/3",
    )


def draw_bytes(out: Path, results: Results, pooled: bool) -> str:
    """Bytes sent against PSNR."""
    where = "pooled" if pooled else "by_scene"
    return _draw(
        *(out, f"bytes_{where}", results, pooled, "n_bytes"),
        *("bytes sent a frame", swept_m),
        "Bytes of a frame's message against PSNR: along each line M grows, from N/16 (quick: "
        "N/8) to N/2 (N/3), each solver with its own iterations; grey: the Pareto front",
    )


def _draw(
    out: Path,
    name: str,
    results: Results,
    pooled: bool,
    x: str,
    x_label: str,
    curve: Callable[[Sequence[Row], str], list[Row]],
    caption: str,
) -> str:
    """One chart of panels, a row a measure when pooled, and a chart a measure when not."""
    panels = results.pools if pooled else results.scenes
    saved = []
    with chart_style():
        for names in [list(MEASURES)] if pooled else [[measure] for measure in MEASURES]:
            n_cols = min(3, len(panels))
            n_rows = len(names) if pooled else -(-len(panels) // n_cols)
            figure = new_figure(3.6 * n_cols + 1.5, 3.1 * n_rows + 1.2)
            axes = figure.subplots(n_rows, n_cols, squeeze=False, sharex=not pooled)
            cells = [(panel, y) for y in names for panel in panels]
            for axis, (panel, y) in zip(axes.flat, cells, strict=False):
                _panel(axis, results, panel, x, y, curve)
                axis.set_title(panel)
            for axis in axes.flat[len(cells) :]:
                axis.set_axis_off()
            for axis in axes[-1]:
                axis.set_xlabel(x_label)
            for row, y in zip(axes, names * n_rows, strict=False):
                row[0].set_ylabel(f"{MEASURES[y]}, contact")
            legend_outside(figure, 3)
            stem = name if pooled else f"{name}_{names[0].removesuffix('_db')}"
            saved.append(save_figure(figure, out, stem, caption))
    return "\n\n".join(saved)


def _panel(
    axis: Any,
    results: Results,
    panel: str,
    x: str,
    y: str,
    curve: Callable[[Sequence[Row], str], list[Row]],
) -> None:
    rows = results.solvers[panel]
    swept = []
    for k, label in enumerate(labels_of(rows)):
        along = curve(rows, label)
        swept += along
        points = [(getattr(row, x), getattr(row, y)) for row in along]
        style = series_style(k)
        axis.plot(*zip(*points, strict=True), label=label, markersize=5, **style)
        if x == "median_ms" and "preset" in label:
            style |= {"markerfacecolor": "white", "linestyle": ""}
            for row in swept_m(rows, label):
                if row.ratio == CENTRE_RATIO:
                    continue
                place = (row.median_ms, getattr(row, y))
                axis.plot(*place, markersize=5, zorder=1, **style)
                axis.annotate(
                    f"N/{row.ratio}",
                    place,
                    **{"xytext": (4, 0), "textcoords": "offset points"},
                    **{"fontsize": 6, "va": "center", "color": style["color"]},
                )
    best = front(swept, x, y)
    axis.step(
        *zip(*[(getattr(row, x), getattr(row, y)) for row in best], strict=True),
        **{"where": "post", "color": "0.6", "linewidth": 5, "alpha": 0.5, "zorder": 0},
        label="Pareto front",
    )
    raw, zoned = results.raw[panel], results.zoned[panel]
    for reading, text, line in (
        (raw, "all taxels sent, noisy", "--"),
        (zoned, "all taxels sent, best dead zone", ":"),
    ):
        axis.axhline(getattr(reading, y), color=_BLACK, linestyle=line, linewidth=1.2, label=text)
        if x == "n_bytes":
            axis.plot(reading.n_bytes, getattr(reading, y), color=_BLACK, marker=MARKERS[-1])
    axis.set_xscale("log")
    _plain_ticks(axis)


def _plain_ticks(axis: Any) -> None:
    """1, 2, 5 and their tenfolds in plain numbers: half a decade has to show two."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def draw_race(out: Path, results: Results) -> str:
    """Time of the libraries to the same objective, against their PSNR."""
    with chart_style():
        pools = list(dict.fromkeys(pool_of(row["scene"]) for row in results.raced))
        figure = new_figure(4.4 * len(pools) + 0.6, 4.4)
        for axis, pool in zip(figure.subplots(1, len(pools), squeeze=False)[0], pools, strict=True):
            for k, peer in enumerate(PEERS):
                points = [
                    (row["median_ms"], row["mean_db"])
                    for row in results.raced
                    if row["peer"] == peer and pool_of(row["scene"]) == pool
                ]
                if points:
                    style = series_style(k) | {"linestyle": "", "markersize": 8, "alpha": 0.8}
                    axis.plot(*zip(*points, strict=True), label=peer, **style)
            axis.set_title(pool)
            axis.set_xscale("log")
            _plain_ticks(axis)
            axis.set_xlabel("time a frame in ms (median, one core)")
            axis.set_ylabel("mean PSNR in dB")
        legend_outside(figure, 3)
        return save_figure(
            *(figure, out, "libraries"),
            "Time to within 1 % of the same objective from 0, on the same measurements "
            "(M = N/3, paper's lambda), a mark a scene; OMP: to the same residual",
        )


def draw_parts(out: Path, results: Results) -> str:
    """Every basis, and every Phi, with the paper's solver: PSNR against bytes sent."""
    pools = list(results.parts)
    with chart_style():
        figure = new_figure(4.4 * len(pools) + 0.6, 8.2)
        axes = figure.subplots(2, len(pools), squeeze=False)
        for row_of_axes, title, drawn in (
            (axes[0], "every basis, Phi sbhe", "basis"),
            (axes[1], "every Phi, basis haar", "phi"),
        ):
            for axis, pool in zip(row_of_axes, pools, strict=True):
                fixed = ("phi", "sbhe") if drawn == "basis" else ("basis", "haar")
                rows = [row for row in results.parts[pool] if getattr(row, fixed[0]) == fixed[1]]
                for k, name in enumerate(dict.fromkeys(getattr(row, drawn) for row in rows)):
                    along = sorted(
                        (row for row in rows if getattr(row, drawn) == name),
                        key=lambda row: row.n_bytes,
                    )
                    points = [(row.n_bytes, row.mean_db) for row in along]
                    # The legend of one row must not be taken for that of the other.
                    style = series_style(k if drawn == "basis" else k + 14)
                    axis.plot(*zip(*points, strict=True), label=f"{drawn} {name}", **style)
                raw = results.parts_raw[pool].mean_db
                axis.axhline(raw, color=_BLACK, linestyle="--", label="all taxels sent, noisy")
                axis.set_title(f"{pool}, {title}")
                axis.set_xscale("log")
                _plain_ticks(axis)
                axis.set_ylabel("mean PSNR in dB, contact")
        for axis in axes[-1]:
            axis.set_xlabel("bytes sent a frame")
        legend_outside(figure, 4)
        return save_figure(
            *(figure, out, "bases_and_phis"),
            "Every basis and every Phi with the paper's FISTA (30 iterations)",
        )
