"""Study `endurance`: a short stream of it, and its page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.studies.endurance.study import (
    LOST,
    LOST_EVERY,
    PER_SCENE,
    STREAMS,
    endured,
    summary,
)


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
def test_over_jumps_and_losses_nothing_is_lost_for_good(rows: str) -> None:
    n_scenes = 12
    point = {"side": 20, "ratio": 3, "rows": rows, "n_frames": n_scenes * PER_SCENE, "seed": 1}
    figures = endured(point)
    n_losses = n_scenes // LOST_EVERY
    assert figures["n_frames"] == n_scenes * PER_SCENE - n_losses * LOST
    assert figures["not_finite"] == 0
    assert figures["largest_n"] < 5
    assert len(figures["jumps_db"]) == n_scenes - 1
    assert len(figures["losses_db"]) == n_losses
    behind = figures["jumps_db"] + figures["losses_db"]
    assert float(np.median(behind)) < 1
    assert len(figures["apart_db"]) == len(behind)
    assert np.any(figures["apart_db"])
    assert figures["rounds_db"][0] > 40


@pytest.mark.slow
def test_the_page_has_a_line_a_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("sparseskin.studies.endurance.study.QUICK_FRAMES", 2 * PER_SCENE)
    arguments = ["--quick", "--out", str(tmp_path), "--executor", "process:1"]
    assert main(["study", "endurance", *arguments]) == 0
    page = (tmp_path / "endurance.md").read_text()
    assert page.count("| 400 |") == len(STREAMS)
    assert "none" in page  # of so few frames none are lost
    assert (tmp_path / "endurance.csv").exists()


def test_a_line_reports_how_many_are_within_a_decibel() -> None:
    point = {"side": 20, "ratio": 3, "rows": "fixed"}
    figures = {
        **{"n_frames": 1000, "not_finite": 0, "largest_n": 2.0, "frame_ms": 0.25},
        **{
            "rounds_db": [50.0, 49.0, 49.5],
            "jumps_db": [0.5, 2.0],
            "losses_db": [],
            "apart_db": [0.1],
        },
    }
    line = summary(point, figures)
    assert "50.0 % of 2 (median +1.2 dB, worst +2.0 dB)" in line.values()
    assert line["least round, dB"] == "49.00"
