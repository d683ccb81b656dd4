"""Speed against accuracy: the design, the problem given to libraries, and what is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.reconstructor.bases.base import BASES
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.speed_accuracy import study as speed_study
from sparseskin.studies.speed_accuracy.page import write
from sparseskin.studies.speed_accuracy.peers import OURS, PEERS, Bpdn
from sparseskin.studies.speed_accuracy.rows import (
    DEAD_ZONES_N,
    PAPER_LABEL,
    front,
    gather,
    variants,
)
from sparseskin.studies.speed_accuracy.study import (
    SCENES,
    TIMED_ON,
    WITHIN,
    design,
    full_reading,
    race,
    timed,
)

SHORT = {"scene": "lift_box_40", "seed": 0, "short": True}
PAPER_POINT = {**SHORT, "label": PAPER_LABEL, "phi": "sbhe", "ratio": 3, **PRESETS["paper"]}


@pytest.mark.parametrize("quick", [True, False])
def test_the_design_covers_every_solver_basis_and_phi_and_repeats_no_point(quick: bool) -> None:
    points = design(quick, 0)
    assert {point["solver"] for point in points} == set(SUM_SOLVERS)
    assert {point["basis"] for point in points} >= set(BASES)
    assert {point["phi"] for point in points} == set(KINDS) - {"acts", "adaptive", "row_local"}
    assert len({str(sorted(point.items())) for point in points}) == len(points)
    if not quick:
        assert {point["scene"] for point in points} == set(SCENES)


def test_the_variants_cover_every_solver_of_sums() -> None:
    assert {chosen["solver"] for chosen in variants().values()} == set(SUM_SOLVERS)


def test_the_iterations_of_each_variant_that_takes_them_are_swept() -> None:
    for label in ("ista", "skin, rotating rows"):
        swept = [p for p in design(True, 0) if p["label"] == label and "iterations" in p]
        assert {p["iterations"] for p in swept} == set(speed_study.QUICK_ITERATIONS)


def test_the_problem_has_an_adjoint_and_its_minimum_is_lowest() -> None:
    problem = Bpdn((12, 20), 3, 0, 0.01)
    rng = np.random.default_rng(0)
    theta = rng.standard_normal(problem.n).astype(np.float32)
    y = rng.standard_normal(problem.m).astype(np.float32)
    inner = float(problem.forward(theta) @ y)
    assert inner == pytest.approx(float(theta @ problem.adjoint(y)), abs=1e-3)
    np.testing.assert_allclose(problem.dense() @ theta, problem.forward(theta), atol=1e-4)
    best = problem.solution(y)
    # At the minimum no coefficient's gradient is steeper than lambda.
    gradient = problem.adjoint(problem.forward(best) - y)
    assert np.abs(gradient).max() <= problem.lambda_n * 1.01
    for step in (1e-3, -1e-3):
        assert problem.objective(best + step * theta, y) > problem.objective(best, y)


@pytest.mark.parametrize("peer", PEERS)
def test_a_library_comes_within_one_percent_of_the_same_minimum(peer: str) -> None:
    pytest.importorskip(PEERS[peer].module)
    point = {**SHORT, "peer": peer, "ratio": 3, "lambda_n": 0.1 / 32, "n_frames": 1}
    figures = race(point)
    assert figures["n_frames"] == 1
    if PEERS[peer].stops_by_itself:
        assert figures["objective"] < 2
    else:
        assert figures["objective"] <= WITHIN
    assert figures["mean_db"] > 40


def test_a_solver_is_timed_and_judged_on_frames_in_contact() -> None:
    figures = timed(PAPER_POINT)
    assert figures["done"] == 30
    assert 0 < figures["median_ms"] <= figures["p99_ms"]
    assert 30 < figures["worst_db"] <= figures["mean_db"] < 60
    assert 4 * 533 < figures["bytes"] < 4 * 533 + 300


def test_all_taxels_denoised_are_better_than_as_they_are_read() -> None:
    reading = full_reading(SHORT)
    raw = reading["by_dead_zone"][DEAD_ZONES_N.index(0.0)]
    denoised = timed(PAPER_POINT | {"phi": "full", "ratio": 1})
    assert denoised["mean_db"] > raw["mean_db"]
    assert reading["bytes"] > 3 * 4 * 533


def test_what_does_not_go_together_is_listed_and_not_left_out() -> None:
    refused = timed(PAPER_POINT | {"iterations": 0})
    assert "iterations = 0" in refused["refused"]
    results = gather([PAPER_POINT], [refused], True, {}, {}, [])
    assert results.refused == [(f"{PAPER_LABEL}, sbhe, haar, N/3", refused["refused"])]


def test_the_front_is_of_rows_that_none_beats() -> None:
    rows = pd.DataFrame(
        [(3, 47), (1, 40), (2, 39), (1, 38), (2, 45), (4, 47)], columns=["median_ms", "mean_db"]
    )
    best = front(rows, "median_ms", "mean_db")
    assert [*best.itertuples(index=False, name=None)] == [(1, 40), (2, 45), (3, 47)]


def made_up(quick: bool) -> Any:
    """Results of the whole design, with made-up figures."""
    points = design(quick, 0)
    rng = np.random.default_rng(0)
    figures = [
        {
            **{"mean_db": rng.uniform(40, 50), "worst_db": 35.0, "touched_mn": 9.0},
            **{"median_ms": rng.uniform(0.5, 2), "p99_ms": 3.0, "cpu_share": 0.5},
            **{"bytes": 6000 // point["ratio"], "done": point.get("iterations", 30)},
        }
        for point in points
    ]
    judged = {"mean_db": 46.0, "worst_db": 40.0, "touched_mn": 15.0}
    full = {
        point["scene"]: {"bytes": 6500, "by_dead_zone": [judged] * len(DEAD_ZONES_N)}
        for point in points
    }
    raced = [
        {
            **{"scene": scene, "peer": peer, "median_ms": 2.0, "iterations": 20.0},
            **{"mean_db": 45.0, "worst_db": 44.0, "objective": 1.005, "n_frames": 2},
        }
        for scene in full
        for peer in (OURS, "SPGL1")
    ]
    return gather(points, figures, quick, full, full, raced)


@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_page_shows_every_solver_and_reports_what_is_absent(
    quick: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # One scene of each size: the others add panels of the same kind.
    monkeypatch.setattr(speed_study, "SCENES", speed_study.QUICK_SCENES)
    write(tmp_path, made_up(quick), ["SigPy FISTA"], quick)
    page = (tmp_path / "speed-accuracy.md").read_text()
    for label in variants():
        assert f"| {label} |" in page
    assert "Left out, not installed: SigPy FISTA" in page
    assert "The host was busy" in page
    for chart in tmp_path.glob("*.png"):
        assert f"({chart.name})" in page
    assert {path.stem for path in tmp_path.glob("*.png")} == {
        path.stem for path in tmp_path.glob("*.svg")
    }


def test_what_is_timed_runs_in_one_process() -> None:
    assert TIMED_ON == "process:1"
