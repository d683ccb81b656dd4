"""The study `stability`: where each method fails, why, and what the program does about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sparseskin.nodes.compressor.limits import MIN_BITS, MIN_BLOCK
from sparseskin.nodes.reconstructor.limits import LAMBDAS_N, MIN_ITERATIONS
from sparseskin.studies.report import fill_page

from . import change, contact, faults, phase, settings

SECTIONS = {
    "contact": contact.section,
    "phase": phase.section,
    "settings": settings.section,
    "change": change.section,
    "faults": faults.section,
}


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute what is not known yet, and write charts, tables and the page `stability.md`."""
    made: dict[str, Any] = {
        name: section(out, quick, seed, executor) for name, section in SECTIONS.items()
    }
    fill_page(
        out,
        "stability",
        conclusion=conclusion(made),
        quick=quick,
        lambdas_n=LAMBDAS_N,
        min_iterations=MIN_ITERATIONS,
        min_block=MIN_BLOCK,
        min_bits=MIN_BITS,
        **made,
    )


def conclusion(made: dict[str, Any]) -> list[str]:
    """Integrators that are unstable, and the slowest recovery from a sudden change."""
    table = made["contact"]["table"]
    parts = map(" ".join, zip(table["integrator"], table["unstable"], strict=True))
    rows = made["change"]["rows"]
    slowest = rows.loc[rows["frames_until_settled"].idxmax()]
    behind = rows[rows["settled_db"] == rows["settled_db"].min()].iloc[0]
    return [
        f"Contact: share of the places where an integrator is unstable: {', '.join(parts)}.",
        f"Sudden change: settled after {slowest['frames_until_settled']} frames at most, solver "
        f"{slowest['solver']}, N/{slowest['ratio']}, {slowest['event']}.",
        f"It settles lowest, at {behind['settled_db']:.1f} dB, with solver {behind['solver']}, "
        f"N/{behind['ratio']}, {behind['event']}.",
    ]
