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
        quick=quick,
        lambdas_n=LAMBDAS_N,
        min_iterations=MIN_ITERATIONS,
        min_block=MIN_BLOCK,
        min_bits=MIN_BITS,
        **made,
    )
