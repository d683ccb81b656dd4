"""A graph under load by others: `sparseskin study attacks`.

Connections that never finish a handshake, more pages than are served, and commands in a loop while
graphs start, end and are killed. Counted are lost frames, nodes that end, and what is left behind.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.studies.points import compute
from sparseskin.studies.report import fill_page, write_csv

from . import commands, half_open, open_pages

N_CONNECTIONS, N_PAGES = 10_000, 1000
MINUTES, QUICK_MINUTES = 60.0, 0.5
FEW_FILES = 64
RATE_HZ = 50.0


def half_open_points(quick: bool) -> list[dict[str, Any]]:
    """Half-open connections, with as many file descriptors as this process has, and with few."""
    n = 600 if quick else N_CONNECTIONS
    made = {"n": n, "n_wave": N_CONNECTIONS, "rate_hz": RATE_HZ}
    return [{**made, "files": files} for files in (None, FEW_FILES)]


def pages_point(quick: bool) -> dict[str, Any]:
    """Open pages, of which some never read."""
    n, times = (200, 1) if quick else (N_PAGES, 3)
    return {"n": n, "reading": 60, "seconds": 3.0, "times": times, "rate_hz": RATE_HZ}


def measure_half_open(point: dict[str, Any]) -> dict[str, Any]:
    """`half_open.measure` in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="sparseskin-attacks-") as name:
        return half_open.measure(point, Path(name) / "graph")


def measure_pages(point: dict[str, Any]) -> dict[str, Any]:
    """`open_pages.measure` in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="sparseskin-attacks-") as name:
        return open_pages.measure(point, Path(name) / "graph")


def run(out: Path, quick: bool, seed: int, executor: str, minutes: float | None = None) -> None:
    """Make all attacks, one after the other, the last for `minutes` (default: 60, quick half a
    minute), and write the page; see `command.Study`.

    `executor` is not used: attacks would disturb each other. `seed` draws how graphs end.
    """
    if minutes is None:
        minutes = QUICK_MINUTES if quick else MINUTES
    points = half_open_points(quick)
    silent = compute(measure_half_open, points, out, "serial", "half-open connections")
    (pages,) = compute(measure_pages, [pages_point(quick)], out, "serial", "open pages")
    looked = {"seconds": 60 * minutes, "seed": seed}
    (listed,) = compute(commands.measure, [looked], out, "serial", "commands")
    rows = [half_open_row(point, found) for point, found in zip(points, silent, strict=True)] + [
        pages_row(pages)
    ]
    fill_page(
        out,
        "attacks",
        conclusion=conclusion([*silent, pages], listed),
        quick=quick,
        minutes=minutes,
        rate_hz=RATE_HZ,
        table=pd.DataFrame(rows, dtype=object),
        statuses=[
            ", ".join(f"{n} x {status}" for status, n in s.items()) for s in pages["statuses"]
        ],
        pages=pages,
        listed=listed,
        n_graphs=sum(listed["graphs"].values()),
        csv=write_csv(out, "attacks", rows),
    )


def conclusion(found: Sequence[dict[str, Any]], listed: dict[str, Any]) -> list[str]:
    """Lost frames, nodes that ended and what was left, over all attacks; faults of commands."""
    lost, frames = (sum(one[key] for one in found) for key in ("lost", "frames"))
    ended = sorted({name for one in found for name in one["stopped"]})
    left = [name for one in found for name in one["left"]] + list(listed["left"])
    return [
        f"Half-open connections and open pages: {lost} of {frames} frames lost; nodes that ended: "
        f"{', '.join(ended) or 'none'}.",
        f"Commands beside {sum(listed['graphs'].values())} graphs that started and ended: "
        f"{len(listed['faults'])} faults, {listed['frames']['lost']} frames lost.",
        f"Left behind: {', '.join(left) or 'nothing'}.",
    ]


def half_open_row(point: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """A line of the table about half-open connections."""
    files = f", `ulimit -n {point['files']}`" if point["files"] else ""
    waves = f" in {found['waves']} waves" if found["waves"] > 1 else ""
    return {
        "attack": f"{found['n']} half-open connections{waves}{files}",
        "lost frames": f"{found['lost']} of {found['frames']}",
        "nodes that ended": ", ".join(found["stopped"]) or "none",
        "open files before, at most, after": "; ".join(
            f"{name} {' '.join(map(str, numbers))}" for name, numbers in found["files"].items()
        ),
        "memory grew by, MB (at most, after)": "; ".join(
            f"{name} {' '.join(map(str, numbers))}" for name, numbers in found["grew_mb"].items()
        ),
        "left behind": ", ".join(found["left"]) or "nothing",
        "remarks": (
            f"{found['closed']} closed by the nodes; {found['lines']} lines in the log; a reader "
            f"with a key had a message after {max(found['joined_s']):.2f} s"
        ),
    }


def pages_row(found: dict[str, Any]) -> dict[str, Any]:
    """A line of the table about open pages."""
    return {
        "attack": f"{found['n']} open pages, {len(found['statuses'])} times over",
        "lost frames": f"{found['lost']} of {found['frames']}",
        "nodes that ended": ", ".join(found["stopped"]) or "none",
        "open files before, at most, after": f"monitor {' '.join(map(str, found['files']))}",
        "memory grew by, MB (at most, after)": f"monitor {' '.join(map(str, found['grew_mb']))}",
        "left behind": ", ".join(found["left"]) or "nothing",
        "remarks": f"threads of the monitor: {', '.join(map(str, found['threads']))}",
    }
