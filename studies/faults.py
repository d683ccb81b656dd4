"""What a graph does when something breaks: `sparseskin study faults`.

Each fault is really made: processes are killed, stopped and crashed, a disk is filled, clocks are
stepped. Counted are the frames that were lost, the time until all is as before, what else stopped,
and what is left behind.
"""

from __future__ import annotations

import shutil
import statistics
import tempfile
from pathlib import Path
from typing import Any

from . import faults_cases, faults_signals
from .points import StudyError, compute
from .report import markdown_table, write_csv, write_page

REPEATS, MAX_LOTS = 3, 7
"""Each signal 21 times to each node, in lots that each have a graph of their own: the scene lasts
122 s, and to stop each node once takes 31 s.
"""
BUDGET_S = 1500.0
"""No lot of signals is begun that would, as long as the last, end beyond this: with all other
faults the study then takes 30 minutes at most.
"""
STOP_S = 5.0
UNKNOWN = "?"
SIGNALS = {
    "SIGKILL": "kill -9 of the {node}",
    "SIGSEGV": "crash (SIGSEGV) of the {node}",
    "SIGSTOP": "SIGSTOP of the {node} for 5 s",
}
CASES = {
    "launcher": "kill -9 of the launcher",
    "in a row": "kill -9 of the reconstructor 20 times in a row, `max_restarts = 100`",
    "given up": "the same with the default policy",
    "full disk": "the recorder's disk (1 MB) is full",
    "rate": "the sensor publishes at 10 times its rate for 3 s, more than the solver takes",
    "clock": "the wall clock steps back by 1 h",
    "driver": "the stamps of a driver step back by 1 h",
    "subscribers": "100 subscribers of the sensor and 100 of the reconstructor never read",
    "keys": "readers with an unlisted key, a wrong key of the host and no key, on a secured graph",
}


def signal_point(name: str, lot: int) -> dict[str, Any]:
    """A signal, some times to each node; the lots differ by their number alone."""
    return {
        "fault": name,
        "signal": name,
        "repeats": REPEATS,
        "lot": lot,
        "stop_s": STOP_S,
        "rate_hz": faults_signals.RATE_HZ,
    }


def case_points(quick: bool) -> list[dict[str, Any]]:
    """Every other fault, once."""
    seconds = 3.0 if quick else 10.0
    delays_s = (0, 0.2) if quick else (0.25, 2)
    cases = [{"fault": name, "seconds": seconds, "delays_s": delays_s} for name in CASES]
    return [{**case, "seconds": 3.0} if case["fault"] == "rate" else case for case in cases]


def strike(out: Path, quick: bool) -> list[dict[str, Any]]:
    """Signals in lots, until all are made or the budget is spent; their rows.

    What decides is of the figures alone, so that a run that goes on decides as the one before.
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
    return [row for name in SIGNALS for row in faults_signals.rows_of(name, lots[name])]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Make one fault in a graph of its own; what came of it, of a case in rows."""
    folder = Path(tempfile.mkdtemp(prefix="sparseskin-faults-"))
    try:
        if "signal" in point:
            return faults_signals.measure(point, folder / "graph")
        try:
            row = faults_cases.CASES[point["fault"]](point, folder / "graph")
        except faults_cases.NotPermittedError as error:
            return {"rows": [], "not_made": str(error)}
        except StudyError as error:
            row = {"recover_s": [], "lost": UNKNOWN, "stopped": [], "left": [], "told": str(error)}
        return {"rows": [{"fault": point["fault"], **row}]}
    finally:
        shutil.rmtree(folder)


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Make all faults, one after the other, and write the table.

    Parameters
    ----------
    out : Path
        Folder to write to, which exists.
    quick : bool
        One lot of signals in place of 7, and shorter waits.
    seed, executor
        Not used: nothing here is drawn, and faults at the same time would disturb each other.
    """
    rows = strike(out, quick)
    made = case_points(quick)
    found = compute(measure, made, out, "serial", "other faults")
    rows += [row for figures in found for row in figures["rows"]]
    not_made = [
        f"- not made here: {CASES[point['fault']]} ({figures['not_made']})"
        for point, figures in zip(made, found, strict=True)
        if "not_made" in figures
    ]
    header = ("fault", "lost frames", "recovered after", "stopped too", "left behind", "what more")
    link = write_csv(out, "faults", [csv_row(row) for row in rows])
    write_page(
        out,
        "faults",
        [
            "# When something breaks",
            _INTRODUCTION.format(
                rate_hz=faults_signals.RATE_HZ,
                repeats=_repeats_text(rows),
                stop_s=STOP_S,
            ),
            markdown_table(header, [cells(row) for row in rows]),
            *not_made,
            f"All figures: {link}. Made by `sparseskin study faults{' --quick' * quick}`.",
        ],
    )


def _repeats_text(rows: list[dict[str, Any]]) -> str:
    """How often the signals were sent: one number, or from the least to the most."""
    counts = {len(row["recover_s"]) for row in rows if row["fault"] in SIGNALS}
    return " to ".join(str(n) for n in sorted({min(counts), max(counts)}))


def cells(row: dict[str, Any]) -> list[str]:
    """A row of figures as a line of the page's table."""
    times_s = row["recover_s"]
    recovered = f"{statistics.median(times_s):.2f} s" if times_s else "-"
    if len(times_s) > 1:
        recovered += f" ({min(times_s):.2f}..{max(times_s):.2f})"
    lost = row["lost"] if row["lost"] == UNKNOWN else f"{row['lost']:g}"
    lost += f" of {row['of']}" if row.get("of") else ""
    return [
        name_of(row),
        lost,
        recovered,
        ", ".join(row["stopped"]) or "nothing",
        ", ".join(row["left"]) or "nothing",
        more_of(row),
    ]


def name_of(row: dict[str, Any]) -> str:
    """The fault as a person calls it."""
    if row["fault"] in SIGNALS:
        return SIGNALS[row["fault"]].format(node=row["node"])
    return CASES[row["fault"]]


def more_of(row: dict[str, Any]) -> str:
    """What else is to be told of a row."""
    if row["fault"] not in SIGNALS:
        return str(row["told"])
    told = []
    if row["not_sensed"]:
        told.append(f"{row['not_sensed']:g} frames were not acquired")
    if row["not_recorded"]:
        told.append(f"{row['not_recorded']:g} frames are in no recording")
    return "; ".join(told)


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


_INTRODUCTION = """\
A graph of five nodes (sensor, compressor, reconstructor, monitor, recorder; 40 x 40 taxels at
{rate_hz:g} Hz, preset `skin`, `restart = "on-failure"`) and a reader beside it that notes which
frames were sensed and which came out restored. Nodes are killed, crashed and stopped {repeats}
times each, the medians and extremes are shown; a stop lasts {stop_s:g} s, and its recovery counts
from its end. Recovered is a stream once a frame comes out that was acquired after the fault and is
less than half a second old; a monitor or recorder, once it runs again. `Stopped too` are other
processes that ended, `left behind` are processes, notes, unfinished files and shared memory after
the end; a recorder that is killed leaves its NAME.mcap.part, which can be read, and the one after
it goes on in NAME.restart1.mcap.

The stepped clock is that of Python's `time.time`, replaced in every process as it starts (a
`sitecustomize` of the study's own); the host's clock is left alone. Stalled subscribers are stopped
processes (SIGSTOP), so that their kernel buffers fill too."""
