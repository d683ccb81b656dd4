"""Study `moving`: what its points compute, first frames of contacts, and its page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparseskin.studies.evaluate import Scores, Solved
from sparseskin.studies.moving import study
from sparseskin.studies.moving.sizes import sized
from sparseskin.studies.moving.study import METHODS, MOVED, RAW, first_db, pressed


def test_the_first_frames_of_contacts_are_those_after_untouched_ones() -> None:
    scores = Scores(f_max_n=1.0)
    nothing, press = np.zeros((2, 2), dtype=np.float32), np.ones((2, 2), dtype=np.float32)
    # Errors of 0.1 in first frames, 0.01 in others: 20 and 40 dB.
    for truth, error in ((press, 0.1), (press, 0.01), (nothing, 0.01), (press, 0.1)):
        scores.add(Solved(truth + np.float32(error)), truth)
    assert first_db(scores) == pytest.approx(20, abs=1e-3)
    assert scores.mean_db == pytest.approx(80 / 3, abs=1e-3)


def test_all_methods_have_the_same_readings_and_a_sudden_contact_is_hardest_at_first() -> None:
    point = {"side": 40, "course": "sudden", "body": "peg", "ratio": 4, "seed": 0}
    methods = pressed(point)["methods"]
    assert set(methods) == {RAW, *MOVED}
    assert pressed({**point, "ratio": 8})["methods"][RAW] == methods[RAW]
    assert methods["skin"]["mean_db"] > methods["paper"]["mean_db"] + 5
    for name in MOVED:
        assert methods[name]["first_db"] < methods[name]["mean_db"]
        assert methods[name]["min_db"] <= methods[name]["first_db"]


def test_a_skin_of_any_size_is_reconstructed_by_every_method_on_the_same_readings() -> None:
    point = {"skin": "5 x 5", "active": 0.3, "ratio": 3, "seed": 0}
    methods = sized(point)["methods"]
    assert set(methods) == {RAW, *METHODS, "lattice", "hold"}
    assert methods[RAW]["median"] < 20
    assert methods[RAW]["vanished"] == 0
    assert sized({**point, "ratio": 4})["methods"][RAW] == methods[RAW]
    masked = sized({**point, "skin": "20 x 20, 42 taxels"})["methods"]
    assert 0 < masked["lattice"]["median"] < 100


def test_the_page_states_means_by_course_and_body(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(function: Any, points: list[Any], *_: Any) -> list[Any]:
        if function is sized:
            figures = {name: {"median": 12.0, "vanished": 3.0} for name in (RAW, *METHODS)}
            return [{"methods": figures} for _ in points]
        names = list(enumerate((RAW, *MOVED)))
        return [
            {
                "methods": {
                    name: {"mean_db": 40 + k - bool(k) * p["ratio"], "min_db": 1, "first_db": 9}
                    for k, name in names
                }
            }
            for p in points
        ]

    monkeypatch.setattr(study, "compute", found)
    study.run(tmp_path, quick=True, seed=0, executor="serial")
    page = (tmp_path / "moving.md").read_text()
    cells = "| 40.0 | 38.0 / 37.0 / 33.0 | 39.0 / 38.0 / 34.0 | 40.0 / 39.0 / 35.0 "
    cells += "| 41.0 / 40.0 / 36.0 |"
    assert f"| 40 x 40 {cells}" in page
    assert f"| 64 x 64 | sudden {cells}" in page
    assert f"| 64 x 64 | moving | peg {cells}" in page
    assert "| 40 x 40 | ramped | 9.0 | 9.0 / 9.0 / 9.0 |" in page
    assert "| 10 x 10 | N/8 | 12 / 3 | 12 / 3 |" in page
    for name in ("sizes.csv", "above.png", "above.svg", "methods.csv"):
        assert (tmp_path / name).stat().st_size > 100
        assert name in page
