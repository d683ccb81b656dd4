"""The study `stability`: where each method fails, why, and what the program does about it."""

from __future__ import annotations

from pathlib import Path

from sparseskin.studies import (
    stability_change_curves,
    stability_contact_maps,
    stability_faults_curves,
    stability_phase_maps,
    stability_settings_curves,
)
from sparseskin.studies.report import write_page

SECTIONS = (
    stability_contact_maps.section,
    stability_phase_maps.section,
    stability_settings_curves.section,
    stability_change_curves.section,
    stability_faults_curves.section,
)


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute what is not known yet, and write charts, tables and the page `stability.md`."""
    parts = ["# Stability: where each method fails"]
    if quick:
        parts.append("Quick: few points and trials. It shows that the study runs, and little else.")
    for section in SECTIONS:
        parts += section(out, quick, seed, executor)
    write_page(out, "stability", parts)
