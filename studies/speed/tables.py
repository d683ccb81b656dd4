"""Study `speed`: time of solvers, of bodies, of a frame by stage, beside lean nodes, and where
nodes share a process.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.compressor.phi.rotation import FIXED, RATIO
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.frames import PressFrames
from sparseskin.studies.harness import (
    PAPER_ROWS,
    TIMED_ON,
    Candidate,
    Experiment,
    Measurement,
    unrefused,
)
from sparseskin.studies.points import Function, compute_rows
from sparseskin.studies.report import Page, cells, markdown

from . import beside, latency, matrices, offline, processes, start
from .bodies import time_body
from .quiet import QUIET_S, WAYS, time_quiet

SIDES = (20, 40, 64, 128)
QUICK_SIDES = (20, 40)
SIZES = {scene: size for size, scene in latency.SCENES.items()}
PATCH_SIDE = 64
PATCHES = (1, 4, 16, 64, 244)
QUICK_PATCHES = (1, 4)
LOADS = {
    0.0: "all pressed",
    0.75: "a quarter pressed",
    1.0: "at rest",
}
"""Part of the patches that nothing presses, and what a body is then."""
GOAL = 244
"""Patches of a million taxels."""
GOAL_HZ = 1000
LINK_BYTES_HZ = 1e9 / 8
"""Bytes a second of a gigabit link."""
QUIET = 0.1
"""Cores that other work may use before the host counts as busy."""


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Time what is not known yet, write the page and return its conclusion; see `command.Study`.

    `executor` is not used: all is timed on this host, one point at a time.
    """
    page = Page(out, "speed", Path(__file__).with_name("notes.md"), quick)
    page.section("", cores=len(os.sched_getaffinity(0)))
    lines = [*solvers(page, quick, seed), bodies(page, quick, seed)]
    lines += [quiet_body(page, quick, seed), *stages(page, quick, seed)]
    lines += beside_lean(page, quick, seed)
    lines += shared_processes(page, quick, seed)
    lines += [*matrices_of(page, quick, seed), *offline_of(page, quick, seed)]
    lines += starts(page, quick, seed)
    page.write(lines)
    return lines


def solvers(page: Page, quick: bool, seed: int) -> list[str]:
    """Whole frames of both presets, in numpy and in compiled loops."""
    sides = QUICK_SIDES if quick else SIDES
    n_frames = 100 if quick else 400
    frames = [
        PressFrames("plate", (side, side), n_frames, speed=0.02) for side in sides
    ]
    # A slow body on both: times are of the steps, not of sudden contacts.
    forms = {"numpy": "off"}
    if find_spec("numba"):
        forms["compiled"] = "on"
    candidates = {}
    for preset, rows_of_phi in (("paper", PAPER_ROWS), ("skin", FIXED)):
        for form, fast in forms.items():
            settings = PRESETS[preset] | {"fast": fast}
            candidate = Candidate(settings, changes={"rows": rows_of_phi})
            candidates[f"{preset}, {form}"] = candidate
    scores = ("median_ms", "p99_ms", "iterations", "mean_db")
    timed = Experiment(
        "solvers", frames, [Measurement()], candidates, scores, (seed,), timed=True
    )
    rows = unrefused(timed.run(page.out, TIMED_ON))
    rows.insert(0, "n", [side * side for side, _ in rows["shape"]])
    page.csv("solvers", rows)
    table = rows[["n", "method", *scores]].assign(hz=1000 / rows["median_ms"])
    headings = {
        "n": "N",
        "median_ms": "median ms",
        "p99_ms": "p99 ms",
        "hz": "frames a second",
        "mean_db": "mean dB",
    }
    formats = {
        "median ms": ".3f",
        "p99 ms": ".3f",
        "iterations": ".1f",
        "mean dB": ".1f",
        "frames a second": ".0f",
    }
    page.section("Solvers", markdown(table.rename(columns=headings), formats))
    # The default on the largest skin.
    is_largest = rows["n"] == rows["n"].max()
    of_default = rows[is_largest & rows["method"].str.startswith("skin")]
    return cells(of_default, "Solver {method}, N = {n}: {median_ms:.2f} ms a frame.")


def bodies(page: Page, quick: bool, seed: int) -> str:
    """Bodies of many patches: time by the number of taxels, and what a million would take."""
    common: dict[str, float] = {"side": PATCH_SIDE, "seed": seed}
    numbers = QUICK_PATCHES if quick else PATCHES
    points = []
    for idle, n in product(LOADS, numbers):
        # A frame of many patches takes long enough to be measured by itself.
        n_frames = 12 if quick or n >= 64 else 60
        points.append(
            {
                **common,
                "patches": n,
                "idle": idle,
                "n_frames": n_frames,
            }
        )
    rows = _measured(time_body, points, page.out, "bodies", TIMED_ON)
    page.csv("bodies", rows)
    us = rows["edge_us"] + rows["host_us"]
    table = pd.DataFrame(
        {
            "taxels": [f"{n * PATCH_SIDE**2:,}" for n in rows["patches"]],
            "patches": rows["patches"],
            "load": rows["idle"].map(LOADS),
            "iterations": rows["iterations"],
            "edge, us a patch": cells(rows, "{edge_us:.0f}"),
            "host, us a patch": cells(rows, "{host_us:.0f}"),
            "solver, us a patch": cells(rows, "{solve_us:.0f}"),
            "frames/s": [f"{hz:.1f}" for hz in 1e6 / us / rows["patches"]],
            "MB a patch": cells(rows, "{memory_mb:.2f}"),
            "unchanged": cells(rows, "{unchanged:.0%}"),
        }
    )
    line = _cost_of_a_million(rows)
    page.section("Bodies of many patches", table, line, side=PATCH_SIDE)
    return line


def _cost_of_a_million(rows: pd.DataFrame) -> str:
    """How time grows with the taxels, and what a million of them take at 1 kHz."""
    # Time of all patches over their number: a line in logarithms, whose slope is the power.
    solved = rows[rows["idle"] == 0]
    us_of_body = (solved["edge_us"] + solved["host_us"]) * solved["patches"]
    line_of_fit = np.polyfit(np.log(solved["patches"]), np.log(us_of_body), 1)
    slope = float(line_of_fit[0])
    patch_hz = GOAL * GOAL_HZ
    largest = rows[rows["patches"] == rows["patches"].max()]
    cores = largest.assign(
        load=largest["idle"].map(LOADS),
        edges=1e-6 * patch_hz * largest["edge_us"],
        hosts=1e-6 * patch_hz * largest["host_us"],
    )
    most_patches = solved.iloc[-1]
    patch_bytes = most_patches["bytes"] / most_patches["patches"]
    links = patch_bytes * patch_hz / LINK_BYTES_HZ
    of_loads = ", ".join(cells(cores, "{load} {edges:.0f} + {hosts:.0f}"))
    return (
        f"Time grows with taxels to the power {slope:.2f}. A million taxels at 1 kHz take, in "
        f"cores of edges + hosts as fast as this one: "
        f"{of_loads}; and {links:.0f} gigabit "
        f"links in place of {RATIO * links:.0f}."
    )


def quiet_body(page: Page, quick: bool, seed: int) -> str:
    """A body of which one patch is touched, by three ways to send it."""
    size = {
        "patches": 64,
        "side": 16,
        "n_frames": 2000,
    }
    if quick:
        size |= {"patches": 16, "n_frames": 100}
    points = [
        {
            "way": way,
            **size,
            "seed": seed,
        }
        for way in WAYS
    ]
    rows = _measured(time_quiet, points, page.out, "quiet", TIMED_ON)
    page.csv("quiet", rows)
    names = ("all frames", "quiet", "single taxels that change")
    table = pd.DataFrame(
        {
            "sent": names,
            "bytes a frame": cells(rows, "{bytes:,.0f}"),
            "edge, us a frame": cells(rows, "{edge_us:.0f}"),
            "host, us a frame": cells(rows, "{host_us:.0f}"),
            "error of touched taxels, N": cells(rows, "{error:.3f}"),
        }
    )
    ratio = rows["bytes"][0] / rows["bytes"][1]
    line = (
        f"Of {size['patches']} patches one is touched: quiet ones are sent in {ratio:.0f} times "
        "fewer bytes than all."
    )
    page.section("Quiet bodies", table, line, patches=size["patches"], quiet_s=QUIET_S)
    return line


def stages(page: Page, quick: bool, seed: int) -> list[str]:
    """Age of a frame when it is reconstructed, by stage, in real graphs."""
    points = latency.points(quick, seed)
    rows = _measured(latency.measure, points, page.out, "latency")
    rows["skin"] = rows["scene"].map(SIZES)
    rows["reconstructed"] = np.where(rows["depth"] > 0, "newest", "all")
    for name in ("monitor", "contacts"):
        rows[name] = np.where(rows[name], "yes", "no")
    page.csv("latency", rows)
    names = ["skin", "preset", "reconstructed", "contacts", "monitor"]
    names += ["frames", "skipped", "lost"]
    headings = {f"{name}_ms": f"{name} ms" for name in latency.QUANTILES}
    headings |= {f"p50 {stage}": stage for stage in latency.STAGES}
    formats = {f"{name} ms": ".2f" for name in latency.QUANTILES}
    formats |= dict.fromkeys(latency.STAGES, ".3f")
    # A reader has to know: the figures are of this host alone.
    busiest = rows["others"].max()
    busy = (
        f"**The host was busy: other work used up to {busiest:.1f} cores meanwhile. Times are too "
        "long, the tails most of all.**"
    )
    page.section(
        "From acquisition to reconstruction",
        busy if busiest > QUIET else "",
        markdown(rows[[*names, *headings]].rename(columns=headings), formats),
        warm_up=latency.WARM_UP,
    )
    is_default = (rows["preset"] == "skin") & (rows["depth"] == 0)
    alone = rows[is_default & (rows["monitor"] == "no")]
    with_contacts = np.where(alone["contacts"] == "yes", ", with contacts", "")
    return cells(
        alone.assign(with_=with_contacts),
        "All frames of {skin} taxels at 1 kHz{with_}: half of them are reconstructed "
        "{p50_ms:.2f} ms after acquisition, 99 % within {p99_ms:.2f} ms.",
    )


def _measured(
    function: Function,
    points: list[dict[str, Any]],
    out: Path,
    label: str,
    executor: str = "serial",
) -> pd.DataFrame:
    """Points with their figures; graphs run one at a time."""
    return pd.DataFrame(compute_rows(function, points, out, executor, label))


def beside_lean(page: Page, quick: bool, seed: int) -> list[str]:
    """Processor time and age of a frame in the shipped nodes and in lean ones, in turn."""
    points = beside.points(quick, seed)
    rows = _measured(beside.measure, points, page.out, "beside")
    rows["skin"] = rows["scene"].map(SIZES)
    rows["monitor"] = np.where(rows["monitor"], "yes", "no")
    page.csv("beside", rows)

    nodes = [*beside.NODES, "monitor"]
    table = rows[["skin", "rate_hz", "monitor"]].rename(columns={"rate_hz": "Hz"})
    for kind in ("ours", "lean"):
        for node in nodes:
            if f"{kind} {node}_us" in rows:
                table[f"{kind}: {node}, us"] = rows[f"{kind} {node}_us"]
        table[f"{kind}: p50, p99, ms"] = _quantiles(rows, kind)
        table[f"{kind}: lost"] = rows[f"{kind} lost"]
    table["processor time, ours / lean"] = rows["cpu ratio"]
    table["p50, ours / lean"] = rows["p50 ratio"]
    formats = {name: ".0f" for name in table if name.endswith((", us", ": lost"))}
    formats |= {name: ".2f" for name in table if name.endswith("ours / lean")}
    page.section(
        "Beside lean nodes",
        markdown(table, formats),
        seconds=beside.SECONDS,
        slices=beside.SLICES,
        steps=beside.STEPS,
        warm_up=f"{beside.WARM_UP:.0%}",
    )
    alone = rows[rows["monitor"] == "no"]
    return cells(
        alone,
        "{skin} taxels at {rate_hz} Hz: {cpu ratio:.2f} times the processor time of lean nodes, "
        "{p50 ratio:.2f} times their median age.",
    )


def shared_processes(page: Page, quick: bool, seed: int) -> list[str]:
    """Processor time and age of a frame with the nodes in four processes, and in fewer, in turn."""
    points = processes.points(quick, seed)
    rows = _measured(processes.measure, points, page.out, "processes")
    page.csv("processes", rows)
    tables = [_processes_table(rows, kind) for kind in processes.PROCESSES]
    formats = {
        "reached, Hz": ".0f",
        "skipped": ".0%",
        "processor time, us": ".0f",
    }
    formats |= {f"{name} / four": ".2f" for name in processes.RATIOS}
    page.section(
        "Nodes that share a process",
        markdown(pd.concat(tables), formats),
        scene=processes.SCENE,
        seconds=processes.SECONDS,
        slices=processes.SLICES,
        steps=processes.STEPS,
        warm_up=f"{beside.WARM_UP:.0%}",
    )
    return cells(
        rows,
        "Edge and host in a process each at {rate_hz} Hz: {two cpu ratio:.2f} times the processor "
        "time of four processes, {two p50 ratio:.2f} times their median age.",
    )


def _processes_table(rows: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Figures of one kind of graph, a row a rate."""
    columns = {
        "Hz": rows["rate_hz"],
        "processes": kind,
        "reached, Hz": rows[f"{kind} hz"],
        "skipped": rows[f"{kind} skipped"],
        "processor time, us": rows[f"{kind} cpu_us"],
        "p50, p99, ms": _quantiles(rows, kind),
    }
    for name in processes.RATIOS:
        columns[f"{name} / four"] = rows[f"{kind} {name} ratio"]
    return pd.DataFrame(columns)


def _quantiles(rows: pd.DataFrame, kind: str) -> list[str]:
    return cells(rows, f"{{{kind} p50_ms:.2f}}, {{{kind} p99_ms:.2f}}")


def matrices_of(page: Page, quick: bool, seed: int) -> list[str]:
    """Set-up, memory and time of a frame of each kind of Phi."""
    points = matrices.points(quick, seed)
    rows = _measured(matrices.measure, points, page.out, "matrices", TIMED_ON)
    page.csv("matrices", rows)
    table = pd.DataFrame(
        {
            "taxels": cells(rows, "{side} x {side}"),
            "phi": rows["kind"],
            "M": [f"N/{ratio}" if ratio > 1 else "N" for ratio in rows["ratio"]],
            "set-up, s": cells(rows, "{set_up_s:.2f}"),
            "memory, MB": cells(rows, "{memory_mb:.0f}"),
            "edge, us": cells(rows, "{edge_us:.0f}"),
            "host, us": cells(rows, "{host_us:.0f}"),
            "frame, in that of the default": cells(rows, "{ratio to default:.2f}"),
            "error, N": cells(rows, "{error:.4f}"),
        }
    )
    page.section(
        "Measurement matrices",
        table,
        n_frames=matrices.N_FRAMES - matrices.WARM_UP,
    )
    return cells(
        rows[rows["kind"] == "full"],
        "Reading all {side} x {side} taxels takes {ratio to default:.2f} times the processor time "
        "of the default Phi.",
    )


def offline_of(page: Page, quick: bool, seed: int) -> list[str]:
    """Reprocessing of a recording beside its solver alone."""
    points = offline.points(quick, seed)
    rows = _measured(offline.measure, points, page.out, "offline", TIMED_ON)
    page.csv("offline", rows)
    table = pd.DataFrame(
        {
            "scene": rows["scene"],
            "iterations": rows["iterations"],
            "solver alone, us": cells(rows, "{alone_us:.0f}"),
            "reprocess, us": cells(rows, "{reprocess_us:.0f}"),
            "frames/s, in those of the solver": cells(rows, "{hz ratio:.2f}"),
            "the same of processor time": cells(rows, "{cpu ratio:.2f}"),
        }
    )
    page.section(
        "Reprocessing",
        table,
        n_frames=rows["n_frames"][0],
        slices=rows["slices"][0],
    )
    return cells(
        rows,
        "Reprocessing {scene} in {iterations} iterations reaches {hz ratio:.0%} of the frames per "
        "second of the solver alone.",
    )


def starts(page: Page, quick: bool, seed: int) -> list[str]:
    """Processor time of each node up to its first frame."""
    rows = _measured(start.measure, start.points(quick, seed), page.out, "start")
    page.csv("start", rows)
    table = pd.DataFrame({"bytecode": rows["bytecode"].map(start.STORED)})
    for node in processes.NODES:
        table[f"{node}, s"] = cells(rows, f"{{{node}_s:.2f}}")
    page.section("Start", table, scene=start.SCENE, starts=rows["starts"][0])
    return cells(
        rows[rows["bytecode"]],
        "The reconstructor takes {reconstructor_s:.2f} s of a processor up to its first frame.",
    )
