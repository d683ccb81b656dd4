"""The page of study `speed-accuracy`: its tables and charts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sparseskin.studies.report import (
    MARKERS,
    PALETTE,
    Chart,
    draw_lines,
    fill_page,
    series_style,
    write_csv,
)

from .peers import OURS, PEERS
from .rows import (
    CENTRE_RATIO,
    Results,
    Row,
    front,
    labels_of,
    pool_of,
    swept_iterations,
    swept_m,
    variants,
)

#: A process that has its core to itself has it for more of its time than this.
QUIET_SHARE = 0.95
MEASURES = {"mean_db": "mean PSNR in dB", "worst_db": "worst PSNR in dB"}
_BLACK = PALETTE[-1]


_HEADER = (
    *("scenes", "solver", "Phi", "basis", "N/M", "iterations"),
    *("mean dB", "worst dB", "touched mN", "median ms", "p99 ms", "bytes"),
)
_RACE_HEADER = (
    *("scenes", "library", "median ms", "times ours", "iterations"),
    *("objective / minimum, worst", "mean dB", "worst dB"),
)


def write(out: Path, results: Results, absent: Sequence[str], quick: bool) -> None:
    """Write the figures as CSV, the charts and the page.

    Parameters
    ----------
    out : Path
    results : Results
    absent : sequence of str
        Libraries that are not installed.
    quick : bool
    """
    every = [asdict(row) for rows in results.solvers.values() for row in rows]
    parts = [asdict(row) for rows in results.parts.values() for row in rows]
    n_busy, n_rows = _busy(results)
    fill_page(
        out,
        "speed-accuracy",
        Path(__file__).with_name("page.md"),
        quick=quick,
        centre_ratio=CENTRE_RATIO,
        variants=variants(),
        n_busy=n_busy,
        n_rows=n_rows,
        quiet_share=QUIET_SHARE,
        speed_pooled=_draw_speed(out, results, pooled=True),
        speed=_table(_speed_rows(results)),
        fronts=_pareto_fronts(results),
        speed_by_scene=_draw_speed(out, results, pooled=False),
        bytes_pooled=_draw_bytes(out, results, pooled=True),
        bytes=_table(_m_rows(results)),
        better=_against_reading(results),
        bytes_by_scene=_draw_bytes(out, results, pooled=False),
        absent=absent,
        race=pd.DataFrame(_race_rows(results), columns=_RACE_HEADER, dtype=object),
        libraries=_draw_race(out, results),
        parts=_table(_cells(row) for rows in results.parts.values() for row in rows),
        parts_chart=_draw_parts(out, results),
        refused=results.refused,
        files=[
            write_csv(out, "solvers", every),
            write_csv(out, "bases_and_phis", parts),
            write_csv(out, "libraries", results.raced),
        ],
    )


def _table(rows: Iterable[list[object]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=_HEADER, dtype=object)


def _busy(results: Results) -> tuple[int, int]:
    """Number of points that were timed on a busy host, and of all."""
    rows = [row for panel in results.scenes for row in results.solvers[panel]]
    return sum(row.cpu_share < QUIET_SHARE for row in rows), len(rows)


def _cells(row: Row) -> list[object]:
    return [
        *(row.panel, row.label, row.phi, row.basis, row.ratio, f"{row.iterations:.3g}"),
        *(f"{row.mean_db:.1f}", f"{row.worst_db:.1f}", f"{row.touched_mn:.1f}"),
        *(f"{row.median_ms:.3f}", f"{row.p99_ms:.3f}", row.n_bytes),
    ]


def _speed_rows(results: Results) -> Iterator[list[object]]:
    for panel in results.pools:
        for label in labels_of(results.solvers[panel]):
            yield from map(_cells, swept_iterations(results.solvers[panel], label))


def _m_rows(results: Results) -> Iterator[list[object]]:
    for panel in results.pools:
        rows = results.solvers[panel]
        for label in labels_of(rows):
            yield from map(_cells, swept_m(rows, label))
        yield from (_cells(row) for row in rows if row.phi == "full")
        for what, reading in (("none", results.raw), ("best dead zone", results.zoned)):
            r = reading[panel]
            name = what if what == "none" else f"{what} ({r.dead_zone_n:g} N)"
            psnr = (f"{r.mean_db:.1f}", f"{r.worst_db:.1f}")
            yield [panel, name, "full", "", 1, "", *psnr, "", "", "", r.n_bytes]


def _pareto_fronts(results: Results) -> str:
    """Solvers on the Pareto front of each size, as a Markdown list."""
    lines = []
    for panel in results.pools:
        rows = results.solvers[panel]
        swept = [r for label in labels_of(rows) for r in swept_iterations(rows, label)]
        steps = [
            f"{r.label}, {r.iterations:.3g} iterations ({r.median_ms:.2f} ms, {r.mean_db:.1f} dB)"
            for r in front(swept, "median_ms", "mean_db")
        ]
        lines.append(f"- {panel}: " + "; ".join(steps))
    return "\n".join(lines)


def _against_reading(results: Results) -> str:
    """Ratios at which each solver is better than reading all taxels, as a Markdown list."""
    lines = []
    for panel in results.pools:
        rows, raw, zoned = results.solvers[panel], results.raw[panel], results.zoned[panel]
        for label in labels_of(rows):
            along = swept_m(rows, label)
            parts = []
            for reading, name in ((raw, "the raw reading"), (zoned, "its best dead zone")):
                better = [row.ratio for row in along if row.mean_db > reading.mean_db]
                where = ", ".join(f"N/{ratio}" for ratio in better) or "nowhere"
                parts.append(f"{name} ({reading.mean_db:.1f} dB): {where}")
            lines.append(f"- {panel}, {label}: " + "; ".join(parts))
    return "\n".join(lines)


def _race_rows(results: Results) -> Iterator[list[object]]:
    by_pool: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in results.raced:
        by_pool.setdefault((pool_of(row["scene"]), row["peer"]), []).append(row)
    for (pool, peer), rows in by_pool.items():
        ours_ms = np.mean([row["median_ms"] for row in by_pool[pool, OURS]])
        time_ms = np.mean([row["median_ms"] for row in rows])
        worst = max(row["objective"] for row in rows)
        yield [
            *(pool, peer, f"{time_ms:.2f}", f"{time_ms / ours_ms:.1f}"),
            "" if worst > 1.0101 else f"{np.mean([row['iterations'] for row in rows]):.0f}",
            f"{worst:.3f}",
            f"{np.mean([row['mean_db'] for row in rows]):.1f}",
            f"{min(row['worst_db'] for row in rows):.1f}",
        ]


def _draw_speed(out: Path, results: Results, pooled: bool) -> str:
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


def _draw_bytes(out: Path, results: Results, pooled: bool) -> str:
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
    shown = results.pools if pooled else results.scenes
    saved = []
    for names in [list(MEASURES)] if pooled else [[measure] for measure in MEASURES]:
        n_columns = min(3, len(shown))
        cells = [(panel, y) for y in names for panel in shown]
        n_rows = -(-len(cells) // n_columns)
        with Chart(
            out,
            name if pooled else f"{name}_{names[0].removesuffix('_db')}",
            caption,
            len(cells),
            n_columns,
            size_in=(3.6 * n_columns + 1.5, 3.1 * n_rows + 1.2),
            legend_columns=3,
            sharex=not pooled,
        ) as chart:
            for k, (axes, (panel, y)) in enumerate(zip(chart.panels, cells, strict=True)):
                _panel(axes, results, panel, x, y, curve)
                axes.set_title(panel)
                if k % n_columns == 0:
                    axes.set_ylabel(f"{MEASURES[y]}, contact")
                if k + n_columns >= len(cells):
                    axes.set_xlabel(x_label)
        saved.append(chart.markdown)
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
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _draw_race(out: Path, results: Results) -> str:
    """Time of the libraries to the same objective, against their PSNR."""
    pools = list(dict.fromkeys(pool_of(row["scene"]) for row in results.raced))
    caption = (
        "Time to within 1 % of the same objective from 0, on the same measurements "
        "(M = N/3, paper's lambda), a mark a scene; OMP: to the same residual"
    )
    n, size_in = len(pools), (4.4 * len(pools) + 0.6, 4.4)
    with Chart(out, "libraries", caption, n, n, size_in=size_in, legend_columns=3) as chart:
        raced = pd.DataFrame(results.raced)
        for axes, pool in zip(chart.panels, pools, strict=True):
            of_pool = raced[raced["scene"].map(pool_of) == pool]
            marks = {"linestyle": "", "markersize": 8, "alpha": 0.8}
            draw_lines(axes, of_pool, "median_ms", "mean_db", "peer", list(PEERS), **marks)
            axes.set(title=pool, xscale="log", ylabel="mean PSNR in dB")
            axes.set_xlabel("time a frame in ms (median, one core)")
            _plain_ticks(axes)
    return chart.markdown


def _draw_parts(out: Path, results: Results) -> str:
    """Every basis, and every Phi, with the paper's solver: PSNR against bytes sent."""
    pools = list(results.parts)
    drawn = (("basis", "every basis, Phi sbhe"), ("phi", "every Phi, basis haar"))
    caption = "Every basis and every Phi with the paper's FISTA (30 iterations)"
    size_in = (4.4 * len(pools) + 0.6, 8.2)
    with Chart(
        out, "bases_and_phis", caption, 2 * len(pools), len(pools), size_in=size_in
    ) as chart:
        for axes, ((part, title), pool) in zip(chart.panels, product(drawn, pools), strict=True):
            fixed = ("phi", "sbhe") if part == "basis" else ("basis", "haar")
            rows = [row for row in results.parts[pool] if getattr(row, fixed[0]) == fixed[1]]
            for k, name in enumerate(dict.fromkeys(getattr(row, part) for row in rows)):
                along = sorted(
                    (row for row in rows if getattr(row, part) == name), key=lambda row: row.n_bytes
                )
                # The legend of one row must not be taken for that of the other.
                style = series_style(k if part == "basis" else k + 14)
                places = [(row.n_bytes, row.mean_db) for row in along]
                axes.plot(*zip(*places, strict=True), label=f"{part} {name}", **style)
            raw = results.parts_raw[pool].mean_db
            axes.axhline(raw, color=_BLACK, linestyle="--", label="all taxels sent, noisy")
            axes.set(title=f"{pool}, {title}", xscale="log", ylabel="mean PSNR in dB, contact")
            _plain_ticks(axes)
        for axes in chart.panels[-len(pools) :]:
            axes.set_xlabel("bytes sent a frame")
    return chart.markdown
