"""The page of the stability study, made from few points."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sparseskin.studies.stability import change, contact, faults, phase, settings, study

pytest.importorskip("matplotlib")
Point = dict[str, Any]


@pytest.mark.slow
def test_the_page_shows_all_its_charts_and_why_each_method_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def keep(
        module: ModuleType, name: str, wanted: Callable[[Point], bool], **changed: Any
    ) -> None:
        points = getattr(module, name)

        def few(quick: bool, seed: int) -> list[Point]:
            return [point | changed for point in points(quick, seed) if wanted(point)]

        monkeypatch.setattr(module, name, few)

    monkeypatch.setattr(contact, "N_SIDE_QUICK", 2)
    keep(contact, "points", lambda p: p.get("scene") in (None, "lift_box_40"))
    keep(phase, "l1_points", lambda p: p["phi"] == "sbhe", n_trials=1)
    keep(phase, "skin_points", lambda p: p["delta"] == 0.25)
    for module in (settings, faults):
        keep(module, "points", lambda p: p["solver"] == "fista" and p["value"] in KEPT)
    keep(change, "points", lambda p: p["solver"] in ("fista", "ista"), n_trials=1)

    study.run(tmp_path, quick=True, seed=0, executor="serial")

    page = (tmp_path / "stability.md").read_text()
    shown = re.findall(r"\]\(([a-z0-9_]+)\.(?:png|svg|csv)\)", page)
    assert len(shown) >= 8
    for link in re.findall(r"\]\(([^)]+)\)", page):
        assert (tmp_path / link).stat().st_size > 100
    for key in (*settings.SWEEPS, *faults.SWEEPS):
        # A line with a reason and what the program does, and one with the figures.
        (reason,) = re.findall(rf"^\| {key} \|([^|]+)\|([^|]+)\|$", page, re.MULTILINE)
        assert min(map(len, reason)) > 10
        assert len(re.findall(rf"^\| {key} \| fista \|", page, re.MULTILINE)) == 1
    for method in contact.INTEGRATORS:
        assert f"\n- {method}: " in page


#: Of each quantity that is swept, one or two values.
KEPT = (0, 0.5, 1, 1.5, 0.01, 5, 32, 8)
