"""The page of study `speed-accuracy`: its tables and charts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sparseskin.studies.report import (
    MARKERS,
    PALETTE,
    Chart,
    draw_lines,
    fill_page,
    markdown,
    series_style,
    write_csv,
)

from .peers import OURS, PEERS
from .rows import (
    CENTRE_RATIO,
    Results,
    front,
    pool_of,
    raw_and_zoned,
    swept_iterations,
    swept_m,
    variants,
)

#: A process that has its core to itself has it for more of its time than this.
QUIET_SHARE = 0.95
MEASURES = {"mean_db": "mean PSNR in dB", "worst_db": "worst PSNR in dB"}
#: Charts by their x: name, label of the x axis, rows that a line joins, caption.
SWEPT = {
    "median_ms": (
        "speed",
        "solve time a frame in ms (median, one core)",
        swept_iterations,
        "Solve time against PSNR, frames 1 ms apart, M = N/3: along each line the iterations grow; "
        "open marks: other M, of the solvers with a preset; grey: the Pareto front at M = N/3",
    ),
    "n_bytes": (
        "bytes",
        "bytes sent a frame",
        swept_m,
        "Bytes of a frame's message against PSNR, frames 1 ms apart: along each line M grows, from "
        "N/16 (quick: N/8) to N/2 (N/3), each solver with its iterations; the default is *skin, "
        "rotating rows*, the paper's method *fista, preset paper*, and *tv* the best of the others "
        "by the mean of 40 x 40 taxels; thin and grey: all others",
    ),
}
FOCUS = {
    "skin, rotating rows": 2,
    "skin, preset skin": 1,
    "tv": 4,
    "fista, preset paper": 0,
}
"""Series in colour in the chart of bytes, and the place of each in the palette."""
OTHERS = "other solvers"
_BLACK = PALETTE[-1]
#: Column, heading and format of the tables of rows.
_SHOWN = (
    *(("panel", "scenes", ""), ("label", "solver", ""), ("phi", "Phi", ""), ("basis", "basis", "")),
    *(("ratio", "N/M", ""), ("iterations", "iterations", ".3g"), ("mean_db", "mean dB", ".1f")),
    *(("worst_db", "worst dB", ".1f"), ("touched_mn", "touched mN", ".1f")),
    *(("median_ms", "median ms", ".3f"), ("p99_ms", "p99 ms", ".3f"), ("n_bytes", "bytes", "")),
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
    of_scenes = results.solvers[results.solvers["panel"].isin(results.scenes)]
    fill_page(
        out,
        "speed-accuracy",
        conclusion=_conclusion(results),
        quick=quick,
        centre_ratio=CENTRE_RATIO,
        variants=variants(),
        n_busy=(of_scenes["cpu_share"] < QUIET_SHARE).sum(),
        n_rows=len(of_scenes),
        quiet_share=QUIET_SHARE,
        speed_pooled=_draw(out, results, "median_ms", pooled=True),
        speed=_table(_swept(results, panel, "median_ms") for panel in results.pools),
        fronts={
            panel: front(_swept(results, panel, "median_ms"), "median_ms", "mean_db")
            for panel in results.pools
        },
        speed_by_scene=_draw(out, results, "median_ms", pooled=False),
        bytes_pooled=_draw(out, results, "n_bytes", pooled=True),
        bytes=_table(_m_rows(results, panel) for panel in results.pools),
        readings={panel: raw_and_zoned(results.readings, panel) for panel in results.pools},
        swept={panel: _swept(results, panel, "n_bytes") for panel in results.pools},
        bytes_by_scene=_draw(out, results, "n_bytes", pooled=False),
        absent=absent,
        race=_race(results.raced),
        libraries=_draw_race(out, results.raced),
        parts=_table([results.parts]),
        parts_chart=_draw_parts(out, results),
        refused=results.refused,
        files=[
            write_csv(out, "solvers", results.solvers),
            write_csv(out, "bases_and_phis", results.parts),
            write_csv(out, "libraries", results.raced),
        ],
    )


def _conclusion(results: Results) -> list[str]:
    """The default beside the paper's method and the reading of all taxels, at M = N/3."""
    lines = []
    for panel in results.pools:
        rows = _swept(results, panel, "n_bytes")
        rows = rows[rows["ratio"] == CENTRE_RATIO].set_index("label")
        raw, _ = raw_and_zoned(results.readings, panel)
        known = [label for label in FOCUS if label in rows.index]
        figures = ", ".join(f"*{label}* {rows.loc[label, 'mean_db']:.1f}" for label in known)
        lines.append(
            f"{panel}, M = N/{CENTRE_RATIO}, mean PSNR of contact frames in dB: {figures}; all "
            f"taxels sent {raw['mean_db']:.1f}."
        )
    best = _swept(results, results.pools[0], "n_bytes")
    best = best[best["ratio"] == CENTRE_RATIO].sort_values("mean_db").iloc[-1]
    return [*lines[:2], f"The best of {results.pools[0]} at these bytes: *{best['label']}*."]


def _table(parts: Any) -> str:
    rows = pd.concat(parts)
    headings = {column: heading for column, heading, _ in _SHOWN}
    formats = {heading: spec for _, heading, spec in _SHOWN}
    return markdown(rows[list(headings)].rename(columns=headings), formats)


def _swept(results: Results, panel: str, x: str) -> pd.DataFrame:
    """Rows of one panel that the lines of a chart join, solver after solver."""
    rows, curve = results.of(panel), SWEPT[x][2]
    return pd.concat([curve(rows, label) for label in rows["label"].unique()])


def _m_rows(results: Results, panel: str) -> pd.DataFrame:
    """Each solver at each M, each with all taxels, and the reading without a solver."""
    rows = results.of(panel)
    raw, zoned = raw_and_zoned(results.readings, panel)
    names = ("none", f"best dead zone ({zoned['dead_zone_n']:g} N)")
    readings = pd.DataFrame([raw, zoned]).assign(label=names, phi="full", ratio=1)
    readings["n_bytes"] = readings["n_bytes"].astype(int)
    return pd.concat([_swept(results, panel, "n_bytes"), rows[rows["phi"] == "full"], readings])


def _race(raced: pd.DataFrame) -> pd.DataFrame:
    """Figures of each library over the scenes of one size."""
    groups = raced.assign(pool=raced["scene"].map(pool_of)).groupby(["pool", "peer"], sort=False)
    figures = {"median_ms": "mean", "iterations": "mean", "objective": "max"}
    rows = groups.agg(figures | {"mean_db": "mean", "worst_db": "min"}).reset_index()
    ours_ms = rows[rows["peer"] == OURS].set_index("pool")["median_ms"]
    return rows.assign(times=rows["median_ms"] / rows["pool"].map(ours_ms))


def _draw(out: Path, results: Results, x: str, pooled: bool) -> str:
    """One chart of panels, a row a measure when pooled, and a chart a measure when not."""
    name, x_label, _, caption = SWEPT[x]
    shown = results.pools if pooled else results.scenes
    n_columns = min(3, len(shown))
    saved = []
    for names in [list(MEASURES)] if pooled else [[measure] for measure in MEASURES]:
        cells = list(product(names, shown))
        n_rows = -(-len(cells) // n_columns)
        with Chart(
            out,
            f"{name}_pooled" if pooled else f"{name}_by_scene_{names[0].removesuffix('_db')}",
            caption,
            len(cells),
            n_columns,
            size_in=(3.6 * n_columns + 1.5, 3.1 * n_rows + 1.2),
            legend_columns=3,
            sharex=not pooled,
        ) as chart:
            for k, (axes, (y, panel)) in enumerate(zip(chart.panels, cells, strict=True)):
                _draw_panel(axes, results, panel, x, y)
                axes.set_title(panel)
                if k % n_columns == 0:
                    axes.set_ylabel(f"{MEASURES[y]}, contact")
                if k + n_columns >= len(cells):
                    axes.set_xlabel(x_label)
        saved.append(chart.markdown)
    return "\n\n".join(saved)


def _draw_panel(axes: Axes, results: Results, panel: str, x: str, y: str) -> None:
    rows, curve = results.of(panel), SWEPT[x][2]
    labels = list(rows["label"].unique())
    if x == "n_bytes":  # those in colour last, on top of the others
        labels = sorted(labels, key=lambda label: label in FOCUS)
    for k, label in enumerate(labels):
        along = curve(rows, label)
        if x == "n_bytes":
            axes.plot(along[x], along[y], **_focused(label))
            continue
        style = series_style(k)
        axes.plot(along[x], along[y], label=label, markersize=5, **style)
        if "preset" not in label:
            continue
        style |= {"markerfacecolor": "white", "linestyle": ""}
        for row in swept_m(rows, label).to_dict("records"):
            if row["ratio"] == CENTRE_RATIO:
                continue
            place = (row[x], row[y])
            axes.plot(*place, markersize=5, zorder=1, **style)
            note: dict[str, Any] = {"fontsize": 6, "va": "center", "color": style["color"]}
            note |= {"xytext": (4, 0), "textcoords": "offset points"}
            axes.annotate(f"N/{row['ratio']}", place, **note)
    if x != "n_bytes":
        best = front(_swept(results, panel, x), x, y)
        grey: dict[str, Any] = {"color": "0.6", "linewidth": 5, "alpha": 0.5, "zorder": 0}
        axes.step(best[x], best[y], where="post", label="Pareto front", **grey)
    for reading, text, line in zip(
        raw_and_zoned(results.readings, panel),
        ("all taxels sent, noisy", "all taxels sent, best dead zone"),
        ("--", ":"),
        strict=True,
    ):
        axes.axhline(reading[y], color=_BLACK, linestyle=line, linewidth=1.2, label=text)
        if x == "n_bytes":
            axes.plot(reading[x], reading[y], color=_BLACK, marker=MARKERS[-1])
    axes.set_xscale("log")
    _plain_ticks(axes)


def _focused(label: str) -> dict[str, Any]:
    """Style of a series in the chart of bytes, its label included."""
    if label not in FOCUS:
        return {"color": "0.75", "linewidth": 0.9, "zorder": 1, "label": OTHERS}
    k = FOCUS[label]
    return series_style(k) | {"linewidth": 2.0, "markersize": 6, "zorder": 3, "label": label}


def _plain_ticks(axes: Axes) -> None:
    """1, 2, 5 and their tenfolds in plain numbers: half a decade has to show two."""
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _draw_race(out: Path, raced: pd.DataFrame) -> str:
    """Time of the libraries to the same objective, against their PSNR."""
    pool = raced["scene"].map(pool_of)
    pools = list(pool.unique())
    caption = (
        "Time to within 1 % of the same objective from 0, on the same measurements "
        "(M = N/3, paper's lambda), a mark a scene; OMP: to the same residual"
    )
    n, size_in = len(pools), (4.4 * len(pools) + 0.6, 4.4)
    with Chart(out, "libraries", caption, n, n, size_in=size_in, legend_columns=3) as chart:
        for axes, title in zip(chart.panels, pools, strict=True):
            marks = {"linestyle": "", "markersize": 8, "alpha": 0.8}
            of = raced[pool == title]
            draw_lines(axes, of, "median_ms", "mean_db", "peer", list(PEERS), **marks)
            axes.set(title=title, xscale="log", ylabel="mean PSNR in dB")
            axes.set_xlabel("time a frame in ms (median, one core)")
            _plain_ticks(axes)
    return chart.markdown


def _draw_parts(out: Path, results: Results) -> str:
    """Every basis, and every Phi, with the paper's solver: PSNR against bytes sent."""
    parts = results.parts
    pools = list(parts["panel"].unique())
    drawn = (
        ("basis", parts["phi"] == "sbhe", "every basis, Phi sbhe"),
        ("phi", parts["basis"] == "haar", "every Phi, basis haar"),
    )
    caption = "Every basis and every Phi with the paper's FISTA (30 iterations)"
    n = len(pools)
    with Chart(out, "bases_and_phis", caption, 2 * n, n, size_in=(4.4 * n + 0.6, 8.2)) as chart:
        for axes, ((part, is_drawn, title), pool) in zip(
            chart.panels, product(drawn, pools), strict=True
        ):
            rows = parts[is_drawn & (parts["panel"] == pool)]
            for k, (name, along) in enumerate(rows.groupby(part, sort=False)):
                along = along.sort_values("n_bytes", kind="stable")
                # The legend of one row must not be taken for that of the other.
                style = series_style(k if part == "basis" else k + 14)
                axes.plot(along["n_bytes"], along["mean_db"], label=f"{part} {name}", **style)
            raw_db = raw_and_zoned(results.parts_readings, pool)[0]["mean_db"]
            axes.axhline(raw_db, color=_BLACK, linestyle="--", label="all taxels sent, noisy")
            axes.set(title=f"{pool}, {title}", xscale="log", ylabel="mean PSNR in dB, contact")
            _plain_ticks(axes)
        for axes in chart.panels[-n:]:
            axes.set_xlabel("bytes sent a frame")
    return chart.markdown
