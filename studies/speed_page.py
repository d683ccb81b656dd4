"""The page of the study `speed-accuracy`: its tables, and what they say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from .report import markdown_table, write_csv, write_page
from .speed_design import CENTRE_RATIO, variants
from .speed_peers import OURS
from .speed_rows import Results, Row, front, labels_of, pool_of, swept_iterations, swept_m

#: A process that has its core to itself has it for more of its time than this.
QUIET_SHARE = 0.95
ALL_LIBRARIES = "pip install 'sparseskin[peers]'"


def write_speed_page(
    out: Path, results: Results, charts: Sequence[str], absent: Sequence[str], quick: bool
) -> None:
    """Write the figures as CSV, and the page."""
    every = [asdict(row) for rows in results.solvers.values() for row in rows]
    parts = [asdict(row) for rows in results.parts.values() for row in rows]
    files = [
        write_csv(out, "solvers", every),
        write_csv(out, "bases_and_phis", parts),
        write_csv(out, "libraries", results.raced),
    ]
    speed, speed_scenes, sent, sent_scenes, race, kinds = charts
    write_page(
        out,
        "speed-accuracy",
        [
            "# Speed against accuracy",
            *([_QUICK] if quick else []),
            _how(),
            *_disturbed(results),
            "## Solve time",
            speed,
            markdown_table(_HEADER, _speed_rows(results)),
            _what_time_buys(results),
            speed_scenes,
            "## Bytes sent",
            sent,
            markdown_table(_HEADER, _m_rows(results)),
            _against_reading(results),
            sent_scenes,
            "## Other libraries",
            _about_race(absent),
            markdown_table(_RACE_HEADER, _race_rows(results)),
            race,
            "## Every basis and every Phi",
            _PARTS,
            kinds,
            markdown_table(_HEADER, (_cells(r) for rows in results.parts.values() for r in rows)),
            *_refused(results),
            "Data: " + ", ".join(files),
        ],
    )


_QUICK = (
    "**A quick run: two scenes, few frames and settings. It shows that the study runs; its "
    "figures are of no use.**"
)
_HEADER = (
    *("scenes", "solver", "Phi", "basis", "N/M", "iterations"),
    *("mean dB", "worst dB", "touched mN", "median ms", "p99 ms", "bytes"),
)
_RACE_HEADER = (
    *("scenes", "library", "median ms", "times ours", "iterations"),
    *("objective / minimum, worst", "mean dB", "worst dB"),
)
_PARTS = (
    "The paper's FISTA, its lambda and 30 iterations, on 100 frames a scene: 60 around the first "
    "contact and 40 later ones, no more, as a dense Phi is slow. Phi `full` sends every taxel. "
    "Phi `subsample` reads single taxels, so what lies between them has to be guessed; the rows of "
    "`sbhe` and `gaussian` each hold something of many taxels. `gaussian`, which theory favours, "
    "is hardly better or worse than `sbhe`, takes far longer to solve, and no wiring could make it."
)


def _how() -> str:
    ways = "\n".join(
        f"- {label}: "
        + ", ".join(f"{key} {value}" for key, value in chosen.items() if key != "solver")
        for label, chosen in variants().items()
    )
    return f"""Which settings are tried is a choice, not all combinations:

- every solver at M = N/{CENTRE_RATIO} with its iterations swept, and at its own iterations with M
  swept, in its own basis and with Phi `sbhe`; and with Phi `full`, as a denoiser of all taxels
- every basis and every Phi with the paper's FISTA, M swept

The solvers, each with its own settings:

{ways}

Frames are 1 ms apart in every scene: 200 around the first contact, and 200 from half way on; the
solver is reset in between. PSNR is over the frames in contact, `worst` is the worst of them, and
`touched` the root mean square error of the taxels that bear more than 0.01 N. Pooled: the mean
over the scenes of one size, the worst of all, and the mean of the scenes' median times. A solve is
timed by itself, in one process of one thread, with no other point of the study under way: `median`
is of the processor time of `Solver.solve`, `p99` of its time by the clock, in which other work on
the host shows most.
Bytes are those of the whole message, 4 a measurement and about a hundred around them."""


def _disturbed(results: Results) -> list[str]:
    """How many points were timed on a host that was busy with something else."""
    rows = [row for panel in results.scenes for row in results.solvers[panel]]
    n_busy = sum(row.cpu_share < QUIET_SHARE for row in rows)
    if not n_busy:
        return []
    return [
        f"**The host was busy: {n_busy} of {len(rows)} points had a core for less than "
        f"{QUIET_SHARE:.0%} of the time that their solves took. Their p99 is too long, and their "
        "median by what shared caches cost.**"
    ]


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


def _what_time_buys(results: Results) -> str:
    """What the Pareto front is made of."""
    lines = ["The Pareto front of solve time and mean PSNR at M = N/3:"]
    for panel in results.pools:
        rows = results.solvers[panel]
        swept = [r for label in labels_of(rows) for r in swept_iterations(rows, label)]
        steps = [
            f"{r.label}, {r.iterations:.3g} iterations ({r.median_ms:.2f} ms, {r.mean_db:.1f} dB)"
            for r in front(swept, "median_ms", "mean_db")
        ]
        lines.append(f"- {panel}: " + "; ".join(steps))
    return "\n".join([lines[0], "", *lines[1:]])


def _against_reading(results: Results) -> str:
    """For each solver, the fewest bytes at which it is better than reading all taxels."""
    lines = ["Where a solver is better, in the mean, than the noisy reading of all taxels:", ""]
    for panel in results.pools:
        rows, raw, zoned = results.solvers[panel], results.raw[panel], results.zoned[panel]
        for label in labels_of(rows):
            along = swept_m(rows, label)
            said = []
            for reading, name in ((raw, "the raw reading"), (zoned, "its best dead zone")):
                better = [row.ratio for row in along if row.mean_db > reading.mean_db]
                where = ", ".join(f"N/{ratio}" for ratio in better) or "nowhere"
                said.append(f"{name} ({reading.mean_db:.1f} dB): {where}")
            lines.append(f"- {panel}, {label}: " + "; ".join(said))
    return "\n".join(lines)


def _about_race(absent: Sequence[str]) -> str:
    text = (
        "The paper's problem (M = N/3, lambda = 0.003125 N) on the same measurements, each frame "
        "from 0. Each library gets this project's operators as its own kind of linear operator, "
        "and the step size, so that none has to look for it. For each frame, the fewest "
        "iterations are found that come within 1 % of the minimum (1000 iterations of the "
        "project's FISTA), and a call with so many is timed, the shortest of three. SPGL1 solves "
        "the equal problem with a bound on the l1 norm, and is told the right bound. Orthogonal "
        "matching pursuit minimises something else and takes a dense matrix: it runs to the "
        "residual of the minimum, and its objective is what it comes to."
    )
    if absent:
        text += f"\n\n**Left out, not installed: {', '.join(absent)}** ({ALL_LIBRARIES})."
    return text


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


def _refused(results: Results) -> list[str]:
    if not results.refused:
        return []
    lines = "\n".join(f"- {what}: {why}" for what, why in results.refused)
    return [f"## What does not go together\n\n{lines}"]
