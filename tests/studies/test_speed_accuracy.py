"""Speed against accuracy: its experiments, the problem given to libraries, and its fronts."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.reconstructor.bases.base import BASES
from sparseskin.studies.baselines.libraries import PEERS, Bpdn
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.speed_accuracy.charts import front, raw_and_zoned, swept, zones
from sparseskin.studies.speed_accuracy.experiments import (
    DEAD_ZONES_N,
    QUICK_ITERATIONS,
    SCENES,
    WITHIN,
    n_bytes,
    parts,
    pooled,
    race,
    readings,
    solvers,
    variants,
)


@pytest.mark.parametrize("quick", [True, False])
def test_every_solver_basis_and_phi_is_tried_and_no_point_twice(quick: bool) -> None:
    points = [p for of in (solvers, parts) for one in of(quick, 0) for p in one.points()]
    tried = [chosen for point in points for chosen in point["candidates"].values()]
    assert {chosen["settings"]["solver"] for chosen in tried} == set(SUM_SOLVERS)
    assert {chosen["settings"].get("basis") for chosen in tried} >= set(BASES)
    kinds = {point["measurement"]["phi"] for point in points}
    assert kinds == set(KINDS) - {"acts", "adaptive", "row_local"}
    assert {point["frames"]["scene"] for point in points} <= set(SCENES)
    assert all(len(point["candidates"]) == 1 for point in points)


def test_the_iterations_of_each_variant_that_takes_them_are_swept() -> None:
    swept_ones, *_ = solvers(True, 0)
    for label in ("ista", "skin, rotating rows"):
        assert {f"{label}: {k}" for k in QUICK_ITERATIONS} <= set(swept_ones.candidates)
    assert {chosen.settings["solver"] for chosen in variants().values()} == set(SUM_SOLVERS)


def test_bytes_are_those_of_the_message() -> None:
    assert 4 * 533 < n_bytes(1600, 3, "fixed", "sbhe") < 4 * 533 + 300
    assert 4 * 1600 < n_bytes(1600, 1, "", "") < 4 * 1600 + 300


def test_the_problem_has_an_adjoint_and_its_minimum_is_lowest() -> None:
    problem = Bpdn((12, 20), 3, 0, 0.01)
    rng = np.random.default_rng(0)
    theta = rng.standard_normal(problem.n).astype(np.float32)
    y = rng.standard_normal(problem.m).astype(np.float32)
    inner = float(problem.forward(theta) @ y)
    assert inner == pytest.approx(float(theta @ problem.adjoint(y)), abs=1e-3)
    best = problem.solution(y)
    # At the minimum no coefficient's gradient is steeper than lambda.
    gradient = problem.adjoint(problem.forward(best) - y)
    assert np.abs(gradient).max() <= problem.lambda_n * 1.01
    for step in (1e-3, -1e-3):
        assert problem.objective(best + step * theta, y) > problem.objective(best, y)


@pytest.mark.parametrize("peer", PEERS)
def test_a_library_comes_within_one_percent_of_the_same_minimum(peer: str) -> None:
    pytest.importorskip(PEERS[peer].module)
    point = {"scene": "lift_box_40", "seed": 0, "short": True}
    point |= {"peer": peer, "lambda_n": 0.1 / 32, "n_frames": 1}
    figures = race(point)
    assert figures["n_frames"] == 1
    assert figures["objective"] <= WITHIN
    assert figures["mean_db"] > 40


def test_the_front_is_of_rows_that_none_beats() -> None:
    rows = pd.DataFrame(
        [(3, 47), (1, 40), (2, 39), (1, 38), (2, 45), (4, 47)], columns=["median_ms", "mean_db"]
    )
    best = front(rows, "median_ms", "mean_db")
    assert [*best.itertuples(index=False, name=None)] == [(1, 40), (2, 45), (3, 47)]


def test_figures_of_scenes_of_one_size_are_pooled_and_refused_ones_left_out() -> None:
    rows = [("lift_box_40", 40, 30, ""), ("path_40", 44, 36, ""), ("lift_box_64", 50, 1, "no")]
    frame = pd.DataFrame(rows, columns=["scene", "mean_db", "min_db", "refused"]).assign(label="a")
    (found,) = pooled(frame, ["label"]).to_dict("records")
    assert found == {"panel": "N = 1600", "label": "a", "mean_db": 42, "min_db": 30}


def test_a_dead_zone_is_the_best_by_mean_psnr() -> None:
    heights = {zone: 46.0 + (zone == 0.03) for zone in DEAD_ZONES_N}
    rows = pd.DataFrame(
        {"scene": "path_40", "method": f"{zone:g}", "mean_db": db, "refused": ""}
        for zone, db in heights.items()
    )
    raw, best = raw_and_zoned(zones(rows), "N = 1600")
    assert (raw["dead_zone_n"], best["dead_zone_n"]) == (0.0, 0.03)
    assert set(readings(True, 0).candidates) == {f"{zone:g}" for zone in DEAD_ZONES_N}


def test_a_line_shows_a_number_of_iterations_once() -> None:
    rows = [("sbhe", 3, np.nan, 30, 1), ("sbhe", 3, 30, 30, 2), ("sbhe", 3, 5, 5, 3)]
    rows += [("full", 1, np.nan, 30, 4), ("sbhe", 8, np.nan, 30, 5)]
    columns = ["phi", "ratio", "stated", "iterations", "n_bytes"]
    frame = pd.DataFrame(rows, columns=columns).assign(label="a")
    assert swept(frame, "median_ms")["n_bytes"].tolist() == [3, 1]
    assert swept(frame, "n_bytes")["n_bytes"].tolist() == [1, 5]
