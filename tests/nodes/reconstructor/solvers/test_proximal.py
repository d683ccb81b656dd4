"""Proximal solvers: the iteration of the article, the optimum of each problem, and warm starts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.solvers.base import Solver
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.nodes.reconstructor.solvers.proximal import (
    FistaNonnegSolver,
    ReweightedSolver,
    TvSolver,
)


@pytest.mark.parametrize(
    ("better", "worse", "m", "settings", "gain_db"),
    [
        (FistaNonnegSolver, FistaSolver, 200, {"iterations": 30, "lambda_n": 0.00625}, 0.5),
        (ReweightedSolver, FistaNonnegSolver, 400, {"iterations": 20, "lambda_n": 0.0125}, 1),
        (TvSolver, FistaNonnegSolver, 400, {}, 3),
    ],
)
def test_a_sliding_disc_is_reconstructed_better(
    better: type[Solver], worse: type[Solver], m: int, settings: dict[str, Any], gain_db: float
) -> None:
    phi = make_phi("sbhe", 1600, m, seed=0)
    truth = sliding_disc((40, 40), 30)
    y = phi.forward(noisy(truth).reshape(-1, 1600))
    psnr = []
    for cls in (better, worse):
        solver = cls(phi, HaarBasis(40, 40), **settings)
        psnr.append(psnr_db(np.array([solver.solve(one) for one in y])[15:], truth[15:]))
    assert psnr[0] > psnr[1] + gain_db


def test_a_large_coefficient_of_the_last_frame_loses_its_bias() -> None:
    """With Phi = 1 a pressed tile is shrunk by lambda at first, and by far less afterwards."""
    phi = make_phi("full", 64, 64, seed=0)
    frame = np.full(64, 0.5, dtype=np.float32)
    solver = ReweightedSolver(phi, HaarBasis(8, 8), lambda_n=0.1)
    first = 0.5 - solver.solve(frame).mean()
    for _ in range(10):
        last = 0.5 - solver.solve(frame).mean()
    assert abs(first - 0.1 / 8) < 1e-5
    assert last < 0.15 * first


def test_a_step_is_shrunk_as_theory_predicts() -> None:
    """min 1/2 |x - y|^2 + lambda TV: each side of a lone step moves by lambda / its length."""
    y = np.repeat(np.float32([0.2, 0.8]), [6, 10])
    solver = TvSolver(
        make_phi("full", 16, 16, seed=0), HaarBasis(1, 16), iterations=1000, lambda_n=0.06
    )
    expected = np.repeat([0.2 + 0.06 / 6, 0.8 - 0.06 / 10], [6, 10])
    np.testing.assert_allclose(solver.solve(y).ravel(), expected, atol=1e-4)


def test_an_edge_of_the_last_frame_is_shrunk_less() -> None:
    y = np.repeat(np.float32([0.2, 0.8]), [6, 10])
    solver = TvSolver(
        make_phi("full", 16, 16, seed=0), HaarBasis(1, 16), iterations=300, lambda_n=0.06
    )
    first = np.ptp(solver.solve(y))
    for _ in range(5):
        last = np.ptp(solver.solve(y))
    assert first == pytest.approx(0.584, abs=1e-3)
    assert 0.6 - last < 0.6 * (0.6 - first)


def test_differences_over_missing_taxels_do_not_count() -> None:
    """Two halves of a skin, a column missing between them, are two skins."""
    mask = np.ones((4, 9), dtype=np.bool_)
    mask[:, 4] = False
    y = np.where(np.indices((4, 9))[1] < 4, 0.3, 0.9).astype(np.float32)
    solver = TvSolver(
        make_phi("full", 32, 32, seed=0), HaarBasis(4, 9), mask, iterations=200, lambda_n=0.1
    )
    np.testing.assert_allclose(solver.solve(y[mask])[mask], y[mask], atol=1e-5)
