"""Speed against accuracy: its experiments, the problem given to libraries, and its fronts."""

import numpy as np
import pandas as pd
import pytest

from sparseskin.nodes.compressor.phi.base import KINDS, make_phi
from sparseskin.nodes.reconstructor.bases.base import BASES
from sparseskin.studies.baselines.libraries import PEERS, Bpdn, TotalVariation
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.speed_accuracy.charts import front
from sparseskin.studies.speed_accuracy.experiments import SCENES, WITHIN, parts, race, solvers


@pytest.mark.parametrize("quick", [True, False])
def test_every_solver_basis_and_phi_is_tried_and_no_point_twice(quick):
    points = [p for of in (solvers, parts) for one in of(quick, 0) for p in one.points()]
    tried = [chosen for point in points for chosen in point["candidates"].values()]
    assert {chosen["settings"]["solver"] for chosen in tried} == set(SUM_SOLVERS)
    assert {chosen["settings"].get("basis") for chosen in tried} >= set(BASES)
    kinds = {point["measurement"]["phi"] for point in points}
    assert kinds == set(KINDS) - {"acts", "adaptive", "row_local"}
    assert {point["frames"]["scene"] for point in points} <= set(SCENES)
    assert all(len(point["candidates"]) == 1 for point in points)


def test_the_problem_has_an_adjoint_and_its_minimum_is_lowest():
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
def test_a_library_comes_within_one_percent_of_the_same_minimum(peer):
    pytest.importorskip(PEERS[peer].module)
    point = {"scene": "lift_box_40", "seed": 0, "short": True}
    point |= {"peer": peer, "lambda_n": 0.1 / 32, "n_frames": 1}
    figures = race(point)
    assert figures["n_frames"] == 1
    assert figures["objective"] <= WITHIN
    assert figures["mean_db"] > 40


def test_the_front_is_of_rows_that_none_beats():
    rows = pd.DataFrame(
        [(3, 47), (1, 40), (2, 39), (1, 38), (2, 45), (4, 47)], columns=["median_ms", "mean_db"]
    )
    best = front(rows, "median_ms", "mean_db")
    assert [*best.itertuples(index=False, name=None)] == [(1, 40), (2, 45), (3, 47)]


def test_total_variation_of_sigpy_finds_an_even_box():
    pytest.importorskip("sigpy")
    mask = np.ones((16, 16), np.bool_)
    mask[0] = False
    box = np.zeros((16, 16), np.float32)
    box[5:11, 4:12] = 1
    phi = make_phi("sbhe", n=240, m=120, seed=0)
    found = TotalVariation(phi, mask, 0.01, 1000).reconstruct(box).forces
    assert np.linalg.norm(found - box) < 0.1 * np.linalg.norm(box)
    assert not found[0].any()
