"""Study `stability`: where solvers fail, and drawn worlds, without and with a fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.studies.evaluate import CLOSE
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import PALETTE, Chart, Page, cells

from . import faults, loads, phase, sweeps
from .verdicts import GOOD, WAYS, judge
from .worlds import draw_world

NO_FAULT = "no fault"
OF_TAXELS = "of taxels"
OF_MEASUREMENTS = "of measurements"
GROUPS = {"": NO_FAULT}
GROUPS |= dict.fromkeys(faults.OF_TAXELS, OF_TAXELS)
GROUPS |= dict.fromkeys(faults.OF_MEASUREMENTS, OF_MEASUREMENTS)
"""Groups of faults by kind."""
N_WORLDS = 20
"""Drawn worlds of each kind of load, and of each kind of fault; in a quick run one."""
KINDS = {"load": tuple(loads.KINDS), "fault": tuple(faults.KINDS)}
"""Kinds of loads, without a fault, and of faults, with any load."""
QUICK_KINDS = {
    "load": ("even", "disc"),
    "fault": ("stuck blob", "garbage at times", "zeros"),
}
ALL_WAYS = {
    NO_FAULT: 4,
    OF_TAXELS: 10,
    OF_MEASUREMENTS: 10,
}
"""One world of so many goes through all ways, by the group of its fault. Chosen."""
SILENT_GOAL = 0.02
"""Share of wrong and trusted frames up to which a fault is noticed. Chosen."""
RESIDUE = 0.05
"""Part of a load beyond which force stays after release. Chosen."""
FAR_FROM_READING = 2.0
"""Error, in that of reading all taxels, beyond which a still load is not resolved. Chosen."""
N_LISTED = 12
"""Worlds in the list of the worst. Chosen."""
GREY = "#999999"


def run(
    out: Path, quick: bool, seed: int, executor: str, worlds: int | None = None
) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`. `worlds`:
    number of worlds of each kind; with it these sections alone.
    """
    command = ""
    if worlds:
        command = f"study stability --worlds {worlds}"
    page = Page(out, "stability", Path(__file__).with_name("notes.md"), quick, command)
    if not worlds:
        phase.section(page, quick, seed, executor)
        sweeps.section(page, quick, seed, executor)

    kinds = KINDS
    n_worlds = N_WORLDS
    if quick:
        kinds = QUICK_KINDS
        n_worlds = 1
    rows = judged(points(kinds, worlds or n_worlds, seed), out, executor)
    page.csv("worlds", rows.drop(columns="reasons"))
    lines = [without_fault(page, rows), with_fault(page, rows)]
    all_ways(page, rows)
    worst = worst_worlds(page, rows)
    page.write(lines)
    if worlds:
        lines += worst
    return lines


def points(
    kinds: Mapping[str, Sequence[str]], n_worlds: int, seed: int
) -> list[dict[str, Any]]:
    """So many worlds of each kind of load without a fault, and of each kind of fault."""
    asked = [{"load": kind, "fault": ""} for kind in kinds["load"]]
    asked += [{"load": "", "fault": kind} for kind in kinds["fault"]]
    worlds: list[dict[str, Any]] = []
    for number, kind in enumerate(asked):
        # All ways are slow: they are run for a part of the worlds.
        n_apart = ALL_WAYS[GROUPS[kind["fault"]]]
        first_seed = (1000 * seed + number) * 1000
        for k in range(n_worlds):
            world = kind | {"seed": first_seed + k}
            worlds.append(world | {"through": "Stream"})
            if k % n_apart == 0:
                for way in WAYS:
                    if way != "Stream":
                        worlds.append(world | {"through": way})
    return worlds


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Verdict on the world of a point, and what the world is."""
    has_fault = bool(point["fault"])
    world = draw_world(
        point["seed"], has_fault, load=point["load"], fault=point["fault"]
    )
    verdict = judge(world, point["through"])
    return {
        **vars(verdict),
        "drawn_load": world.load.kind,
        "motion": world.load.motion,
        "rows": world.rows,
        "world": world.describe(),
    }


def judged(worlds: Sequence[dict[str, Any]], out: Path, executor: str) -> pd.DataFrame:
    """Points with their figures, and the group of their fault."""
    verdicts = compute_rows(measure, worlds, out, executor, "worlds")
    rows = pd.DataFrame(verdicts)
    rows = rows.assign(group=rows["fault"].map(GROUPS))
    return rows.astype({"error": float, "reading": float})


def shares(rows: pd.DataFrame, by: str) -> pd.DataFrame:
    """Of each kind: number of worlds; shares of wrong frames, silent ones and false alarms; worlds
    with a silent frame, and with force that stays after release; medians of the errors; share of
    the estimated errors that are close to the true one.
    """
    counted = rows.assign(
        worlds=1,
        of_silent=rows["silent"] > 0,
        of_residue=rows["residue"] > RESIDUE,
    )
    kinds = counted.groupby(by, sort=False)
    counts = ["frames", "wrong", "silent", "right", "alarms", "estimated", "close"]
    sums = kinds[["worlds", *counts, "of_silent", "of_residue"]].sum()
    sums["close"] = sums["close"] / sums["estimated"].where(sums["estimated"] > 0)
    sums["wrong"] = sums["wrong"] / sums["frames"]
    sums["silent"] = sums["silent"] / sums["frames"]
    # Where no frame is right, no alarm can be false.
    sums["alarms"] = sums["alarms"].where(sums["right"] > 0) / sums["frames"]
    return sums.join(kinds[["error", "reading"]].median()).reset_index()


def percent(share: float) -> str:
    """A share as the tables have it."""
    if pd.isna(share):
        return "-"
    return f"{100 * share:.1f}"


def without_fault(page: Page, rows: pd.DataFrame) -> str:
    """Add the section on worlds without a fault, by kind of load; the line of the conclusion."""
    sound = rows[(rows["group"] == NO_FAULT) & (rows["through"] == "Stream")]
    kinds = shares(sound, "load")
    headings = {
        "load": "load",
        "worlds": "worlds",
        "error": "error, %",
        "reading": "reading all, %",
        "wrong": "wrong, %",
        "silent": "silent, %",
        "alarms": "false alarms, %",
        "of_residue": "force stays",
        "close": "estimate close, %",
    }
    table = _with_percents(kinds, headings)
    page.section("Worlds without a fault", table, residue=f"{RESIDUE:.0%}")
    # After a cycle of rotating rows a still load has been measured in full: little error is due.
    still = sound[(sound["motion"] == "still") & (sound["rows"] == ROTATING)]
    still = still[still["reading"] < GOOD]
    is_far = still["error"] > FAR_FROM_READING * still["reading"]
    sums = sound.groupby("rows")[["close", "estimated"]].sum()
    shares_close = []
    for kind_of_rows, n_close, n_estimated in sums.itertuples():
        if n_estimated:
            share = percent(n_close / n_estimated)
            shares_close.append(f"{share} % ({kind_of_rows} rows)")
    each_close = ", ".join(shares_close)
    n_residues = (sound["residue"] > RESIDUE).sum()
    return (
        f"Without a fault, {_counts(sound)}; force stays after release in "
        f"{n_residues}; still loads with rotating rows have more than "
        f"twice the error of reading all taxels in {is_far.sum()} of {len(still)}; estimated "
        f"errors are within a factor of {CLOSE:g} in {each_close} of the pressed frames."
    )


def _with_percents(kinds: pd.DataFrame, headings: Mapping[str, str]) -> pd.DataFrame:
    """Columns under their headings, those that end in % as percentages."""
    table = kinds[list(headings)]
    table = table.set_axis(list(headings.values()), axis="columns")
    for heading in table:
        if heading.endswith("%"):
            table[heading] = table[heading].map(percent)
    return table


def _counts(rows: pd.DataFrame) -> str:
    """Silent frames and false alarms of worlds, in words."""
    n_frames = rows["frames"].sum()
    silent = rows["silent"].sum() / n_frames
    alarms = rows["alarms"].sum() / n_frames
    n_worlds = (rows["silent"] > 0).sum()
    return (
        f"{silent:.2%} of the frames are wrong and trusted, in {n_worlds} of {len(rows)} worlds, "
        f"and {alarms:.1%} are right and not trusted"
    )


def with_fault(page: Page, rows: pd.DataFrame) -> str:
    """Add the section on faults, by kind; the line of the conclusion."""
    faulty = rows[(rows["group"] != NO_FAULT) & (rows["through"] == "Stream")]
    kinds = shares(faulty, "fault")
    kinds = kinds.sort_values("silent", ascending=False, kind="stable")
    headings = {
        "fault": "fault",
        "worlds": "worlds",
        "wrong": "wrong, %",
        "silent": "silent, %",
        "alarms": "false alarms, %",
        "of_silent": "worlds with silent frames",
    }
    parts = (_draw(page.out, kinds), _with_percents(kinds, headings))
    goal = f"{SILENT_GOAL:.0%}"
    page.section("Faults of taxels and measurements", *parts, goal=goal)
    return f"With a fault, {_counts(faulty)}."


def _draw(out: Path, kinds: pd.DataFrame) -> str:
    """Chart: share of silent frames by kind of fault, largest on top, and of false alarms."""
    n_silent = int((kinds["silent"] > SILENT_GOAL).sum())
    caption = (
        f"{n_silent} of {len(kinds)} kinds of fault leave more than {SILENT_GOAL:.0%} of the "
        "frames wrong and trusted."
    )
    size_in = (8.0, 0.22 * len(kinds) + 0.9)
    columns = {
        "silent": "wrong and trusted, % of frames",
        "alarms": "right and not trusted, % of frames",
    }
    chart = Chart(
        out,
        "faults",
        caption,
        2,
        2,
        size_in=size_in,
        legend_columns=0,
        sharey=True,
    )
    limit = 115 * kinds[list(columns)].max(axis=None)
    with chart:
        for axes, (column, label) in zip(chart.panels, columns.items(), strict=True):
            values = 100 * kinds[column].astype(float).fillna(0)
            colours = [PALETTE[5]] * len(kinds)
            if column == "silent":
                # The faults that matter, in a colour of their own.
                is_bad = kinds["silent"] > SILENT_GOAL
                colours = [PALETTE[1] if bad else GREY for bad in is_bad]
            bars = axes.barh(kinds["fault"], values, color=colours, height=0.72)
            texts = [percent(share) for share in kinds[column]]
            axes.bar_label(bars, texts, padding=3, fontsize=8)
            axes.set(xlim=(0, limit), title=label)
            axes.set_axisbelow(True)
            axes.grid(visible=False, axis="y")
            axes.tick_params(axis="y", length=0)
        chart.panels[0].invert_yaxis()
        chart.panels[0].margins(y=0.01)
    return chart.markdown


def all_ways(page: Page, rows: pd.DataFrame) -> None:
    """Add the section on the worlds that go through all ways."""
    through_all = rows[rows["seed"].isin(rows.loc[rows["through"] != "Stream", "seed"])]
    lines = []
    for group in ALL_WAYS:
        ways = shares(through_all[through_all["group"] == group], "through")
        line = {"fault": group, "worlds": ways["worlds"].iloc[0]}
        for way in ways.to_dict("records"):
            parts = (percent(way["silent"]), percent(way["alarms"]), way["of_residue"])
            line[way["through"]] = "{} / {} / {}".format(*parts)
        lines.append(line)
    page.section("Three ways through", pd.DataFrame(lines))


def worst_worlds(page: Page, rows: pd.DataFrame) -> list[str]:
    """Add the section on the worlds with the largest number of silent frames; a line of each."""
    streams = rows[rows["through"] == "Stream"]
    worst = streams[streams["silent"] > 0].nlargest(N_LISTED, "silent")
    table = worst[["silent", "frames", "world"]]
    page.section("Worlds with the largest number of silent frames", table)
    return cells(table, "{silent} of {frames} frames silent: {world}")
