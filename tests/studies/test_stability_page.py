"""The page of the stability study, made from few points."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sparseskin.studies import (
    stability,
    stability_change_curves,
    stability_contact,
    stability_contact_maps,
    stability_faults_curves,
    stability_phase_maps,
    stability_settings_curves,
)

pytest.importorskip("matplotlib")
Point = dict[str, Any]


def test_the_page_shows_all_its_charts_and_says_why_each_thing_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def keep(
        module: ModuleType, name: str, wanted: Callable[[Point], bool], **changed: Any
    ) -> None:
        points = getattr(module, name)

        def few(quick: bool, seed: int) -> list[Point]:
            return [point | changed for point in points(quick, seed) if wanted(point)]

        monkeypatch.setattr(module, name, few)

    monkeypatch.setattr(stability_contact, "N_SIDE_QUICK", 2)
    keep(stability_contact_maps, "points", lambda p: p.get("scene") in (None, "lift_box_40"))
    keep(stability_phase_maps, "l1_points", lambda p: p["phi"] == "sbhe", n_trials=1)
    keep(stability_phase_maps, "skin_points", lambda p: p["delta"] == 0.25)
    for module in (stability_settings_curves, stability_faults_curves):
        keep(module, "points", lambda p: p["solver"] == "fista" and p["value"] in KEPT)
    keep(stability_change_curves, "points", lambda p: True, n_trials=1)

    stability.run(tmp_path, quick=True, seed=0, executor="serial")

    page = (tmp_path / "stability.md").read_text()
    shown = re.findall(r"\]\(([a-z0-9_]+)\.(?:png|svg|csv)\)", page)
    assert len(shown) >= 8
    for link in re.findall(r"\]\(([^)]+)\)", page):
        assert (tmp_path / link).stat().st_size > 100
    for sweeps in (stability_settings_curves.SWEEPS, stability_faults_curves.SWEEPS):
        for sweep in sweeps.values():
            assert sweep.why in page
            assert sweep.done in page


#: Of each quantity that is swept, one or two values.
KEPT = (0, 0.5, 1, 1.5, 0.01, 5, 32, 8)
