"""Study `rates`: its filter, frames taken at a rate, and its page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.rates import study
from sparseskin.studies.rates.study import DEAD_ZONE_N, METHODS, NEWEST, PAPER, Filtered, at_rate


def still(force_n: float, n: int = 40) -> list[np.ndarray[Any, Any]]:
    truth = np.full((8, 8), force_n, dtype=np.float32)
    rng = np.random.default_rng(0)
    return [NoiseModel().apply(truth, rng) for _ in range(n)]


def test_the_filter_halves_the_noise_of_a_still_force() -> None:
    frames = still(1.25)
    kept = Filtered(NoiseModel())
    last = [kept.reconstruct(frame).forces for frame in frames][-1]
    # Of a running mean of weight w, the variance is w / (2 - w).
    expected = np.std(frames[-1]) * np.sqrt(NEWEST / (2 - NEWEST))
    assert np.std(last) == pytest.approx(expected, rel=0.3)


def test_the_filter_follows_a_jump_at_once_and_leaves_its_input_as_it_is() -> None:
    kept = Filtered(NoiseModel())
    for frame in still(0.0):
        assert kept.reconstruct(frame).forces.max() < 0.1
    pressed = still(1.0, 1)[0]
    before = pressed.copy()
    np.testing.assert_allclose(kept.reconstruct(pressed).forces, pressed, rtol=1e-6)
    np.testing.assert_array_equal(pressed, before)


def test_the_filter_sets_what_is_in_its_dead_zone_to_0() -> None:
    kept = Filtered(NoiseModel())
    forces = kept.reconstruct(np.linspace(0, 0.06, 64, dtype=np.float32).reshape(8, 8)).forces
    assert set(forces[forces < DEAD_ZONE_N]) == {0}
    assert forces.max() == np.float32(0.06)


def test_a_lower_rate_has_fewer_frames_of_the_same_span() -> None:
    point = {"scene": "lift_box_40", "span_s": 0.2, "seed": 0}
    fast, slow = (at_rate({**point, "rate_hz": rate}) for rate in (1000, 100))
    assert (fast["spacing_ms"], slow["spacing_ms"]) == (1, 10)
    assert 5 * slow["n_contact"] < fast["n_contact"] < 15 * slow["n_contact"]
    assert set(fast["methods"]) == {PAPER, *METHODS}
    assert all(one["min_db"] <= one["mean_db"] for one in fast["methods"].values())


def test_the_page_states_gains_and_spacings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(function: Any, points: list[Any], *_: Any) -> list[Any]:
        methods = {name: 40.0 + k for k, name in enumerate((PAPER, *METHODS))}
        figures = {name: {"mean_db": db, "min_db": db - 9} for name, db in methods.items()}
        return [
            {"spacing_ms": 1000 / p["rate_hz"], "n_contact": 7, "methods": figures} for p in points
        ]

    monkeypatch.setattr(study, "compute", found)
    study.run(tmp_path, quick=True, seed=0, executor="serial")
    page = (tmp_path / "rates.md").read_text()
    assert "| path_40 | 30 | 33.3 ms | 7 | +1.0 | +2.0 | +3.0 | +4.0 | +5.0 | +6.0 |" in page
    assert "| path_40 | 1000 | 1 ms | 7 | 40.0 / 31.0 | 41.0 / 32.0 |" in page
    for name in ("gain.png", "gain.svg", "methods.csv"):
        assert (tmp_path / name).stat().st_size > 100
        assert name in page
