"""Behaviour of a graph when something breaks: `sparseskin study faults`.

Each fault is really made: processes are killed, stopped and crashed, a disk is filled, clocks are
stepped. Counted are lost frames, the time until the graph runs as before, other nodes that stopped,
and what is left behind.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.studies.points import StudyError, compute
from sparseskin.studies.report import fill_page, write_csv

from . import cases, signals
from .observed import RATE_HZ, row_of

REPEATS, MAX_LOTS = 3, 7
"""Each signal 21 times to each node, in lots that each have a graph of their own: the scene lasts
122 s, and to stop each node once takes 31 s.
"""
BUDGET_S = 1500.0
"""No lot of signals is begun that would, as long as the last, end later than this: with all other
faults the study then takes 30 minutes at most.
"""
STOP_S = 5.0
TRANSPORTS = ("ipc", "tcp")
UNKNOWN = "?"
SIGNALS = {
    "SIGKILL": "kill -9 of the {node}",
    "SIGSEGV": "crash (SIGSEGV) of the {node}",
    "SIGSTOP": "SIGSTOP of the {node} for 5 s",
}


def signal_point(name: str, lot: int) -> dict[str, Any]:
    """A signal, sent some times to each node; lots differ by their number, and in turns by the
    transport between the nodes.
    """
    transport = TRANSPORTS[lot % len(TRANSPORTS)]
    sent = {"signal": name, "repeats": REPEATS, "lot": lot, "transport": transport}
    return {"fault": name, **sent, "stop_s": STOP_S, "rate_hz": RATE_HZ}


def case_points(quick: bool) -> list[dict[str, Any]]:
    """Every other fault, once."""
    seconds = 3.0 if quick else 10.0
    delays_s = (0, 0.2) if quick else (0.25, 2)
    points = [{"fault": name, "seconds": seconds, "delays_s": delays_s} for name in cases.CASES]
    return [{**point, "seconds": 3.0} if point["fault"] == "rate" else point for point in points]


def strike(out: Path, quick: bool) -> list[dict[str, Any]]:
    """Send signals in lots until all are sent or the budget is spent; their rows.

    The figures alone decide, so that a resumed run decides as the interrupted one.
    """
    lots: dict[str, list[dict[str, Any]]] = {name: [] for name in SIGNALS}
    used_s = 0.0
    for lot in range(1 if quick else MAX_LOTS):
        next_s = sum(found[-1]["took_s"] for found in lots.values() if found)
        if used_s + next_s > BUDGET_S:
            break
        made = [signal_point(name, lot) for name in SIGNALS]
        found = compute(measure, made, out, "serial", f"signals, lot {lot + 1}")
        for name, figures in zip(SIGNALS, found, strict=True):
            lots[name].append(figures)
            used_s += figures["took_s"]
    return [row for name in SIGNALS for row in signals.rows_of(name, lots[name])]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Make one fault in a graph of its own; figures of a signal, or rows of a case."""
    with tempfile.TemporaryDirectory(prefix="sparseskin-faults-") as name:
        folder = Path(name) / "graph"
        if "signal" in point:
            return signals.measure(point, folder)
        try:
            row = cases.CASES[point["fault"]].make(point, folder)
        except cases.NotPermittedError as error:
            return {"rows": [], "not_made": str(error)}
        except StudyError as error:
            row = {**row_of(str(error), []), "lost": UNKNOWN}
        return {"rows": [{"fault": point["fault"], **row}]}


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Make all faults, one after the other, and write the page; see `command.Study`.

    `seed` and `executor` are not used: nothing is drawn, and faults would disturb each other.
    """
    rows = strike(out, quick)
    made = case_points(quick)
    found = compute(measure, made, out, "serial", "other faults")
    rows += [row for figures in found for row in figures["rows"]]
    counts = sorted({len(row["recover_s"]) for row in rows if row["fault"] in SIGNALS})
    fill_page(
        out,
        "faults",
        conclusion=conclusion(rows),
        rate_hz=RATE_HZ,
        stop_s=STOP_S,
        quick=quick,
        repeats=" to ".join(str(n) for n in sorted({counts[0], counts[-1]})),
        table=pd.DataFrame(map(cells, rows)),
        not_made=[
            f"{cases.CASES[point['fault']].title} ({figures['not_made']})"
            for point, figures in zip(made, found, strict=True)
            if "not_made" in figures
        ],
        csv=write_csv(out, "faults", list(map(csv_row, rows))),
    )


def conclusion(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The faults that cost most frames and most time, and those that stopped or left more."""
    counted = [row for row in rows if row["lost"] != UNKNOWN]
    timed = [row for row in rows if row["recover_s"]]
    stopped = [name_of(row) for row in rows if row["stopped"]]
    left = [name_of(row) for row in rows if row["left"]]
    lines = []
    if counted:
        worst = max(counted, key=lambda row: float(row["lost"]))
        n = sum(not row["lost"] for row in counted)
        lines.append(
            f"{n} of {len(counted)} faults lose no frame; most are lost by: {name_of(worst)} "
            f"({worst['lost']:g})."
        )
    if timed:
        slowest = max(timed, key=lambda row: statistics.median(row["recover_s"]))
        lines.append(
            f"The graph runs as before after at most {statistics.median(slowest['recover_s']):.2f} "
            f"s in the median: {name_of(slowest)}."
        )
    lines.append(
        f"Other nodes stop after: {'; '.join(stopped) or 'none'}. Something is left behind by: "
        f"{'; '.join(left) or 'none'}."
    )
    return lines


def cells(row: dict[str, Any]) -> dict[str, str]:
    """A row of figures as a line of the page's table."""
    times_s = row["recover_s"]
    recovered = f"{statistics.median(times_s):.2f} s" if times_s else "-"
    if len(times_s) > 1:
        recovered += f" ({min(times_s):.2f}..{max(times_s):.2f})"
    lost = row["lost"] if row["lost"] == UNKNOWN else f"{row['lost']:g}"
    return {
        "fault": name_of(row),
        "lost frames": lost + (f" of {row['of']}" if row.get("of") else ""),
        "recovered after": recovered,
        "stopped too": ", ".join(row["stopped"]) or "nothing",
        "left behind": ", ".join(row["left"]) or "nothing",
        "what more": more_of(row),
    }


def csv_row(row: dict[str, Any]) -> dict[str, Any]:
    """A row with the same keys as all others."""
    times_s = row["recover_s"]
    return {
        "fault": name_of(row),
        "lost": row["lost"],
        "sensed": row.get("of") or "",
        "recover_median_s": statistics.median(times_s) if times_s else "",
        "recover_max_s": max(times_s) if times_s else "",
        "n": len(times_s),
        "stopped": " ".join(row["stopped"]),
        "left": " ".join(row["left"]),
        "more": more_of(row),
    }


def name_of(row: dict[str, Any]) -> str:
    """The fault in words."""
    if row["fault"] in SIGNALS:
        return SIGNALS[row["fault"]].format(node=row["node"])
    return cases.CASES[row["fault"]].title


def more_of(row: dict[str, Any]) -> str:
    """Further findings of a row."""
    if row["fault"] not in SIGNALS:
        return str(row["told"])
    more = []
    if row["not_sensed"]:
        more.append(f"{row['not_sensed']:g} frames were not acquired")
    if row["not_recorded"]:
        more.append(f"{row['not_recorded']:g} frames are in no recording")
    return "; ".join(more)
