"""The study `stability`: where each method fails, why, and what the program does about it."""

from __future__ import annotations

from pathlib import Path

from sparseskin.studies.report import Page

from . import contact, faults, phase, sweeps


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Compute the study, write its page and return its conclusion; see `command.Study`."""
    page = Page(out, "stability", Path(__file__).with_name("notes.md"), quick)
    integrators = contact.section(page, quick, seed, executor)
    phase.section(page, quick, seed, executor)
    sweeps.section(page, quick, seed, executor)
    noticed = faults.section(page, quick, seed, executor)
    parts = map(" ".join, zip(integrators["integrator"], integrators["unstable"], strict=True))
    lines = [f"Contact: share of the places where an integrator is unstable: {', '.join(parts)}."]
    lines.append(noticed)
    page.write(lines)
    return lines
