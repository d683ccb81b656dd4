"""Study `speed-accuracy`: time of a frame and bytes sent against PSNR, other libraries included."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sparseskin.nodes.errors import not_installed
from sparseskin.studies.baselines.libraries import PEERS
from sparseskin.studies.harness import LARGER, TIMED_ON, unrefused
from sparseskin.studies.report import (
    MARKERS,
    PALETTE,
    Chart,
    Page,
    cells,
    markdown,
    series_style,
)

from .experiments import (
    CENTRE_RATIO,
    FORMULA,
    PAPER_LABEL,
    PRESET_SKIN,
    ROTATED,
    gathered,
    n_bytes,
    parts,
    pooled,
    readings,
    solvers,
    times,
    variants,
)
from .time_chart import draw_times

#: A process that has its core to itself has it for more of its time than this.
QUIET_SHARE = 0.95
MEASURES = {"mean_db": "mean PSNR in dB", "min_db": "worst PSNR in dB"}
FOCUS = {
    ROTATED: 2,
    PRESET_SKIN: 1,
    FORMULA: 3,
    "tv": 4,
    PAPER_LABEL: 0,
}
FOCUS |= dict.fromkeys(LARGER, 5)
"""Series in colour in the chart of bytes, and the place of each in the palette."""
CAPTION = (
    "Bytes of a frame's message against PSNR, frames 1 ms apart: along each line M grows, from "
    "N/16 (quick: N/8) to N/2 (N/3), each solver with its iterations; the default is *skin, "
    "rotating rows*, the same without learned gates *skin, formula* (fixed rows), the paper's "
    "method *fista, preset paper*; thin and grey: all others"
)
_BLACK = PALETTE[-1]
#: Column, heading and format of the tables of rows.
_SHOWN = (
    ("panel", "scenes", ""),
    ("label", "solver", ""),
    ("phi", "Phi", ""),
    ("ratio", "N/M", "g"),
    ("iterations", "iterations", ".3g"),
    ("mean_db", "mean dB", ".1f"),
    ("min_db", "worst dB", ".1f"),
    ("touched_mn", "touched mN", ".1f"),
    ("median_ms", "median ms", ".3f"),
    ("p99_ms", "p99 ms", ".3f"),
    ("n_bytes", "bytes", ""),
)


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`.

    `executor` is for what is not timed; solve times are measured on this host, one at a time.
    """
    for name, peer in PEERS.items():
        if find_spec(peer.module) is None:
            text = not_installed(f"{name} is left out: {peer.module}", "peers")
            print(text, file=sys.stderr)
    read = zones(readings(quick, seed).run(out, executor))
    timed = gathered([times(quick, seed)], out, TIMED_ON)
    every = gathered(solvers(quick, seed), out, executor)
    of_parts = gathered(parts(quick, seed), out, executor)
    return write(out, timed, every, of_parts, read, quick)


def zones(rows: pd.DataFrame) -> pd.DataFrame:
    """Full readings by panel and dead zone: mean_db, min_db, touched_mn, n_bytes."""
    # A method is named by its dead zone.
    full_readings = pooled(unrefused(rows), ["method"])
    dead_zones = full_readings["method"].astype(float)
    sizes = []
    for panel in full_readings["panel"]:
        n = int(panel.removeprefix("N = "))
        sizes.append(n_bytes(n, 1.0, "", ""))
    return full_readings.assign(dead_zone_n=dead_zones, n_bytes=sizes)


def raw_and_zoned(read: pd.DataFrame, panel: str) -> tuple[pd.Series, pd.Series]:
    """The reading of a panel as it is, and with its best dead zone."""
    of_panel = read[read["panel"] == panel].set_index("dead_zone_n", drop=False)
    best = of_panel["mean_db"].idxmax()
    return of_panel.loc[0.0], of_panel.loc[best]


def swept(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of sums, by bytes."""
    return rows[rows["phi"] == "sbhe"].sort_values("n_bytes", kind="stable")


def write(
    out: Path,
    timed: pd.DataFrame,
    every: pd.DataFrame,
    of_parts: pd.DataFrame,
    read: pd.DataFrame,
    quick: bool,
) -> list[str]:
    """Write the figures as CSV, the charts and the page; `timed`, `every`, `of_parts`: as of
    `gathered`; `read`: as of `zones`.
    """
    rows = pooled(every, ["label", "phi", "ratio", "n_bytes"])
    by_panel: dict[Any, pd.DataFrame] = dict(iter(rows.groupby("panel", sort=False)))
    pages = Page(out, "speed-accuracy", Path(__file__).with_name("notes.md"), quick)
    # Larger taxels have none.
    items = []
    for label, variant in variants().items():
        if label in LARGER:
            continue
        texts = [f"{k} {v}" for k, v in variant.settings.items() if k != "solver"]
        items.append(f"- {label}: {', '.join(texts)}")
    settings = "\n".join(items)
    n_busy = int((timed["cpu_share"].astype(float) < QUIET_SHARE).sum())
    busy = (
        f"**The host was busy: {n_busy} of {len(timed)} points had a core for less than "
        f"{QUIET_SHARE:.0%} of the time that their solves took. Their p99 is too long, and their "
        "median by the cost of shared caches.**"
    )
    pages.section("", settings, busy if n_busy else "")
    # A point without a pace has NaN there, which is a group of its own.
    of_times = pooled(timed.fillna({"pace": 0}), ["label", "pace"])
    noisy = {panel: raw_and_zoned(read, panel)[0]["mean_db"] for panel in by_panel}
    pages.section("Time of a frame", draw_times(out, of_times, noisy), _times(of_times))
    # Sums by their bytes, then the readings of all taxels.
    sums = [swept(of_panel) for of_panel in by_panel.values()]
    full = [of_panel[of_panel["phi"] == "full"] for of_panel in by_panel.values()]
    pages.section(
        "Bytes sent",
        _draw(out, by_panel, read),
        _table(pd.concat([*sums, *full])),
        "Readings of all taxels without a solver, as they are and with their best dead zone:",
        _readings(read),
    )
    of_bases = pooled(of_parts, ["label", "phi", "ratio", "n_bytes"])
    pages.section("Every basis and every Phi", _table(of_bases))
    all_rows = pd.concat([timed, every, of_parts])
    refused = cells(all_rows[all_rows["refused"] != ""], "- {method}, {phi}: {refused}")
    if refused:
        text = "\n".join(dict.fromkeys(refused))
        pages.section("Combinations that are refused", text)
    pages.csv("times", timed)
    pages.csv("solvers", every)
    pages.csv("bases_and_phis", of_parts)
    lines = conclusion(by_panel, read)
    pages.write(lines)
    return lines


def conclusion(by_panel: dict[Any, pd.DataFrame], read: pd.DataFrame) -> list[str]:
    """The default beside the paper's method and the reading of all taxels, at M = N/3."""
    lines = []
    best = []
    for panel, of_panel in by_panel.items():
        rows = swept(of_panel)
        rows = rows[rows["ratio"] == CENTRE_RATIO].set_index("label")
        raw, _ = raw_and_zoned(read, panel)
        # A library that is not installed has no row.
        figures = []
        for label in FOCUS:
            if label in rows.index:
                figures.append(f"*{label}* {rows.loc[label, 'mean_db']:.1f}")
        lines.append(
            f"{panel}, M = N/{CENTRE_RATIO}, mean PSNR of contact frames in dB: "
            f"{', '.join(figures)}; all "
            f"taxels sent {raw['mean_db']:.1f}."
        )
        best.append(f"*{rows['mean_db'].idxmax()}* ({panel})")
    return [*lines, f"The best at these bytes: {', '.join(best)}."]


def _table(rows: pd.DataFrame) -> str:
    columns, headings, specs = zip(*_SHOWN, strict=True)
    columns_shown = rows[list(columns)].set_axis(list(headings), axis="columns")
    return markdown(columns_shown, dict(zip(headings, specs, strict=True)))


def _times(rows: pd.DataFrame) -> str:
    """Table of the points of the chart, the slowest last."""
    names = {
        "panel": "scenes",
        "label": "solver or library",
        "iterations": "iterations",
        "mean_db": "mean dB",
        "min_db": "worst dB",
        "median_ms": "median ms",
    }
    ordered = rows.sort_values(["panel", "median_ms"], kind="stable")
    formats = {
        "iterations": ".3g",
        "mean dB": ".1f",
        "worst dB": ".1f",
        "median ms": ".3f",
    }
    return markdown(ordered[list(names)].rename(columns=names), formats)


def _readings(read: pd.DataFrame) -> str:
    of_panels = pd.DataFrame(
        row for panel in read["panel"].unique() for row in raw_and_zoned(read, panel)
    )
    columns = ["panel", "dead_zone_n", "mean_db", "min_db", "touched_mn", "n_bytes"]
    return markdown(of_panels[columns], dict.fromkeys(columns[2:5], ".1f"))


def _draw(out: Path, by_panel: dict[Any, pd.DataFrame], read: pd.DataFrame) -> str:
    """Chart of bytes: a row of panels per measure, a column per size."""
    n = len(by_panel)
    size_in = (3.6 * n + 1.5, 3.1 * len(MEASURES) + 1.2)
    with Chart(
        out,
        "bytes_pooled",
        CAPTION,
        len(MEASURES) * n,
        n,
        size_in=size_in,
        legend_columns=3,
    ) as chart:
        for k, (y, panel) in enumerate(product(MEASURES, by_panel)):
            axes = chart.panels[k]
            _draw_panel(axes, by_panel[panel], raw_and_zoned(read, panel), y)
            axes.set_title(panel)
            axes.set_ylabel("" if k % n else f"{MEASURES[y]}, contact")
            axes.set_xlabel(
                "bytes sent per frame" if k >= (len(MEASURES) - 1) * n else ""
            )
    return chart.markdown


def _draw_panel(axes: Axes, rows: pd.DataFrame, reading: Any, y: str) -> None:
    lines = swept(rows)
    # Those in colour come last, on top of the others.
    for label in sorted(rows["label"].unique(), key=lambda label: label in FOCUS):
        along = lines[lines["label"] == label]
        axes.plot(along["n_bytes"], along[y], **_focused(label))
    styles = {"noisy": "--", "best dead zone": ":"}
    for sent, (text, style) in zip(reading, styles.items(), strict=True):
        line: dict[str, Any] = {"linestyle": style, "linewidth": 1.2}
        label = f"all taxels sent, {text}"
        axes.axhline(
            sent[y],
            color=_BLACK,
            label=label,
            **line,
        )
        axes.plot(sent["n_bytes"], sent[y], color=_BLACK, marker=MARKERS[-1])
    axes.set_xscale("log")
    # 1, 2, 5 and their tenfolds in plain numbers: half a decade has to show two.
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _focused(label: str) -> dict[str, Any]:
    """Style of a series in the chart of bytes, its label included."""
    if label not in FOCUS:
        return {
            "color": "0.75",
            "linewidth": 0.9,
            "zorder": 1,
            "label": "other solvers",
        }
    style = series_style(FOCUS[label])
    return style | {
        "linewidth": 2.0,
        "markersize": 6,
        "zorder": 3,
        "label": label,
    }
