"""The study `stability`: where solvers fail, and what the program notices."""

from __future__ import annotations

from pathlib import Path

from sparseskin.studies.report import Page

from . import faults, phase, sweeps


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`."""
    page = Page(out, "stability", Path(__file__).with_name("notes.md"), quick)
    for part in (phase, sweeps):
        part.section(page, quick, seed, executor)
    lines = [faults.section(page, quick, seed, executor)]
    page.write(lines)
    return lines
