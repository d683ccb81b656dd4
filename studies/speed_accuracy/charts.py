"""Study `speed-accuracy`: solve time and bytes sent against PSNR, and other libraries."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.studies.baselines.libraries import OURS, PEERS
from sparseskin.studies.harness import TIMED_ON, unrefused
from sparseskin.studies.points import compute_rows
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
    PAPER_LABEL,
    PRESET_SKIN,
    QUICK_SCENES,
    ROTATED,
    gathered,
    n_bytes,
    parts,
    pool_of,
    pooled,
    race,
    readings,
    solvers,
    variants,
)

#: A process that has its core to itself has it for more of its time than this.
QUIET_SHARE = 0.95
MEASURES = {"mean_db": "mean PSNR in dB", "min_db": "worst PSNR in dB"}
FOCUS = {ROTATED: 2, PRESET_SKIN: 1, "tv": 4, PAPER_LABEL: 0}
"""Series in colour in the chart of bytes, and the place of each in the palette."""
CAPTIONS = {
    "median_ms": "Solve time against PSNR, frames 1 ms apart, M = N/3: along each line the "
    "iterations grow; open marks: other M, of the solvers with a preset; grey: the Pareto front at "
    "M = N/3",
    "n_bytes": "Bytes of a frame's message against PSNR, frames 1 ms apart: along each line M "
    "grows, from N/16 (quick: N/8) to N/2 (N/3), each solver with its iterations; the default is "
    "*skin, rotating rows*, the paper's method *fista, preset paper*, and *tv* the best of the "
    "others by the mean of 40 x 40 taxels; thin and grey: all others",
}
_BLACK = PALETTE[-1]
#: Column, heading and format of the tables of rows.
_SHOWN = (
    *(("panel", "scenes", ""), ("label", "solver", ""), ("phi", "Phi", ""), ("ratio", "N/M", "g")),
    *(("iterations", "iterations", ".3g"), ("mean_db", "mean dB", ".1f")),
    *(("min_db", "worst dB", ".1f"), ("touched_mn", "touched mN", ".1f")),
    *(("median_ms", "median ms", ".3f"), ("p99_ms", "p99 ms", ".3f"), ("n_bytes", "bytes", "")),
)


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`.

    `executor` is for what is not timed; solve times are measured on this host, one at a time.
    """
    scenes = QUICK_SCENES if quick else tuple(SCENES)
    absent = [name for name, peer in PEERS.items() if find_spec(peer.module) is None]
    for peer in absent:
        text = f"{peer} is left out: it is not installed (pip install 'sparseskin[peers]')"
        print(text, file=sys.stderr)
    read = zones(readings(quick, seed).run(out, executor))
    every = gathered(solvers(quick, seed), out, executor)
    of_parts = gathered(parts(quick, seed), out, executor)
    common = {"seed": seed, "short": quick, "lambda_n": PRESETS["paper"]["lambda_n"]}
    common |= {"n_frames": 4 if quick else 10}
    known = [peer for peer in PEERS if peer not in absent]
    points = [{"peer": peer, "scene": scene, **common} for scene, peer in product(scenes, known)]
    raced = pd.DataFrame(compute_rows(race, points, out, TIMED_ON, "libraries"))
    return write(out, every, of_parts, read, raced, quick)


def zones(rows: pd.DataFrame) -> pd.DataFrame:
    """Full readings by panel and dead zone: mean_db, min_db, touched_mn, n_bytes."""
    found = pooled(unrefused(rows), ["method"]).assign(
        dead_zone_n=lambda f: f["method"].astype(float)
    )
    sizes = [n_bytes(int(panel.removeprefix("N = ")), 1.0, "", "") for panel in found["panel"]]
    return found.assign(n_bytes=sizes)


def raw_and_zoned(read: pd.DataFrame, panel: str) -> tuple[pd.Series, pd.Series]:
    """The reading of a panel as it is, and with its best dead zone."""
    of = read[read["panel"] == panel].set_index("dead_zone_n", drop=False)
    return of.loc[0.0], of.loc[of["mean_db"].idxmax()]


def front(rows: pd.DataFrame, x: str, y: str) -> pd.DataFrame:
    """Pareto front: the least x first, and each after it with a higher y."""
    rows = rows.sort_values([x, y], ascending=[True, False], kind="stable")
    return rows[~(rows[y] <= rows[y].cummax().shift())]


def swept(rows: pd.DataFrame, x: str) -> pd.DataFrame:
    """Rows that the lines of a chart join: iterations at M = N/3, or M at own iterations."""
    sums = rows[rows["phi"] == "sbhe"]
    if x == "n_bytes":
        return sums[sums["stated"].isna()].sort_values("n_bytes", kind="stable")
    # With its own iterations set, a solver does the same again: that is shown once.
    once = sums[sums["ratio"] == CENTRE_RATIO].sort_values("stated", na_position="last")
    once = once.drop_duplicates(["label", "iterations"], keep="last")
    return once.sort_values("iterations", kind="stable")


def write(
    out: Path,
    every: pd.DataFrame,
    of_parts: pd.DataFrame,
    read: pd.DataFrame,
    raced: pd.DataFrame,
    quick: bool,
) -> list[str]:
    """Write the figures as CSV, the charts and the page; `every`, `of_parts`: as of `gathered`;
    `read`: as of `zones`; `raced`: points of `race` with their figures.
    """
    keys = ["label", "phi", "ratio", "stated", "n_bytes"]
    filled = every.assign(stated=every["stated"].fillna(0))
    rows = pooled(filled, keys)
    rows["stated"] = rows["stated"].where(rows["stated"] > 0)
    by_panel: dict[Any, pd.DataFrame] = dict(iter(rows.groupby("panel", sort=False)))
    pages = Page(out, "speed-accuracy", Path(__file__).with_name("notes.md"), quick)
    settings = "\n".join(
        f"- {label}: {', '.join(f'{k} {v}' for k, v in of.settings.items() if k != 'solver')}"
        for label, of in variants().items()
    )
    n_busy = int((every["cpu_share"].astype(float) < QUIET_SHARE).sum())
    busy = (
        f"**The host was busy: {n_busy} of {len(every)} points had a core for less than "
        f"{QUIET_SHARE:.0%} of the time that their solves took. Their p99 is too long, and their "
        "median by what shared caches cost.**"
    )
    pages.section("", settings, busy if n_busy else "")
    of_front = "{label}, {iterations:.3g} iterations ({median_ms:.2f} ms, {mean_db:.1f} dB)"
    fronts = []
    for panel, of in by_panel.items():
        best = front(swept(of, "median_ms"), "median_ms", "mean_db")
        fronts.append(f"- {panel}: {'; '.join(cells(best, of_front))}")
    pages.section(
        "Solve time",
        _draw(out, by_panel, read, "median_ms"),
        _table(pd.concat(swept(of, "median_ms") for of in by_panel.values())),
        "The Pareto front of solve time and mean PSNR at M = N/3:",
        "\n".join(fronts),
    )
    full = [of[of["phi"] == "full"] for of in by_panel.values()]
    pages.section(
        "Bytes sent",
        _draw(out, by_panel, read, "n_bytes"),
        _table(pd.concat([*(swept(of, "n_bytes") for of in by_panel.values()), *full])),
        "Readings of all taxels without a solver, as they are and with their best dead zone:",
        _readings(read),
    )
    pages.section("Other libraries", _race(raced))
    of_bases = pooled(of_parts, ["label", "phi", "ratio", "n_bytes"])
    pages.section("Every basis and every Phi", _table(of_bases))
    both = pd.concat([every, of_parts])
    refused = cells(both[both["refused"] != ""], "- {method}, {phi}: {refused}")
    if refused:
        pages.section("Combinations that are refused", "\n".join(dict.fromkeys(refused)))
    for name, frame in (("solvers", every), ("bases_and_phis", of_parts), ("libraries", raced)):
        pages.csv(name, frame)
    lines = conclusion(by_panel, read)
    pages.write(lines)
    return lines


def conclusion(by_panel: dict[Any, pd.DataFrame], read: pd.DataFrame) -> list[str]:
    """The default beside the paper's method and the reading of all taxels, at M = N/3."""
    lines, best = [], []
    for panel, of in by_panel.items():
        rows = swept(of, "n_bytes")
        rows = rows[rows["ratio"] == CENTRE_RATIO].set_index("label")
        raw, _ = raw_and_zoned(read, panel)
        figures = ", ".join(
            f"*{label}* {rows.loc[label, 'mean_db']:.1f}" for label in FOCUS if label in rows.index
        )
        lines.append(
            f"{panel}, M = N/{CENTRE_RATIO}, mean PSNR of contact frames in dB: {figures}; all "
            f"taxels sent {raw['mean_db']:.1f}."
        )
        best.append(f"*{rows['mean_db'].idxmax()}* ({panel})")
    return [*lines, f"The best at these bytes: {', '.join(best)}."]


def _table(rows: pd.DataFrame) -> str:
    columns, headings, specs = zip(*_SHOWN, strict=True)
    shown = rows[list(columns)].set_axis(list(headings), axis="columns")
    return markdown(shown, dict(zip(headings, specs, strict=True)))


def _readings(read: pd.DataFrame) -> str:
    both = pd.DataFrame(
        row for panel in read["panel"].unique() for row in raw_and_zoned(read, panel)
    )
    columns = ["panel", "dead_zone_n", "mean_db", "min_db", "touched_mn", "n_bytes"]
    return markdown(both[columns], dict.fromkeys(columns[2:5], ".1f"))


def _draw(out: Path, by_panel: dict[Any, pd.DataFrame], read: pd.DataFrame, x: str) -> str:
    """Chart of panels, a row a measure and a column a size."""
    names = {
        "n_bytes": ("bytes_pooled", "bytes sent a frame"),
        "median_ms": ("speed_pooled", "solve time a frame in ms (median, one core)"),
    }
    (name, x_label), n = names[x], len(by_panel)
    size_in = (3.6 * n + 1.5, 3.1 * len(MEASURES) + 1.2)
    with Chart(
        out, name, CAPTIONS[x], len(MEASURES) * n, n, size_in=size_in, legend_columns=3
    ) as chart:
        for k, (y, panel) in enumerate(product(MEASURES, by_panel)):
            axes = chart.panels[k]
            _draw_panel(axes, by_panel[panel], raw_and_zoned(read, panel), x, y)
            axes.set_title(panel)
            axes.set_ylabel("" if k % n else f"{MEASURES[y]}, contact")
            axes.set_xlabel(x_label if k >= (len(MEASURES) - 1) * n else "")
    return chart.markdown


def _draw_panel(axes: Axes, rows: pd.DataFrame, reading: Any, x: str, y: str) -> None:
    is_bytes, lines = x == "n_bytes", swept(rows, x)
    labels = list(rows["label"].unique())
    # In the chart of bytes, those in colour come last, on top of the others.
    for label in sorted(labels, key=lambda label: label in FOCUS) if is_bytes else labels:
        along, k = lines[lines["label"] == label], labels.index(label)
        if is_bytes:
            axes.plot(along[x], along[y], **_focused(label))
            continue
        style = series_style(k)
        axes.plot(along[x], along[y], label=label, markersize=5, **style)
        others = swept(rows, "n_bytes")
        others = others[(others["label"] == label) & (others["ratio"] != CENTRE_RATIO)]
        style |= {"markerfacecolor": "white", "linestyle": ""}
        for row in others.to_dict("records") if "preset" in label else ():
            axes.plot(row[x], row[y], markersize=5, zorder=1, **style)
            note: dict[str, Any] = {"fontsize": 6, "va": "center", "color": style["color"]}
            note |= {"xytext": (4, 0), "textcoords": "offset points"}
            axes.annotate(f"N/{row['ratio']:g}", (row[x], row[y]), **note)
    if not is_bytes:
        best = front(lines, x, y)
        grey: dict[str, Any] = {"color": "0.6", "linewidth": 5, "alpha": 0.5, "zorder": 0}
        axes.step(best[x], best[y], where="post", label="Pareto front", **grey)
    for one, text, line in zip(reading, ("noisy", "best dead zone"), ("--", ":"), strict=True):
        label = f"all taxels sent, {text}"
        axes.axhline(one[y], color=_BLACK, linestyle=line, linewidth=1.2, label=label)
        if is_bytes:
            axes.plot(one[x], one[y], color=_BLACK, marker=MARKERS[-1])
    axes.set_xscale("log")
    # 1, 2, 5 and their tenfolds in plain numbers: half a decade has to show two.
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _focused(label: str) -> dict[str, Any]:
    """Style of a series in the chart of bytes, its label included."""
    if label not in FOCUS:
        return {"color": "0.75", "linewidth": 0.9, "zorder": 1, "label": "other solvers"}
    style = series_style(FOCUS[label])
    return style | {"linewidth": 2.0, "markersize": 6, "zorder": 3, "label": label}


def _race(raced: pd.DataFrame) -> str:
    """Figures of each library over the scenes of one size."""
    groups = raced.assign(scenes=raced["scene"].map(pool_of)).groupby(
        ["scenes", "peer"], sort=False
    )
    figures = {"median_ms": "mean", "iterations": "mean", "objective": "max"}
    rows = groups.agg(figures | {"mean_db": "mean", "min_db": "min"}).reset_index()
    ours_ms = rows[rows["peer"] == OURS].set_index("scenes")["median_ms"]
    rows.insert(3, "times ours", rows["median_ms"] / rows["scenes"].map(ours_ms))
    formats = {"median_ms": ".2f", "times ours": ".1f", "iterations": ".0f", "objective": ".3f"}
    return markdown(rows, formats | {"mean_db": ".1f", "min_db": ".1f"})
