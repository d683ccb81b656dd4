"""Solver tv: the optimum of its problem, and warm starts."""

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.nodes.reconstructor.solvers.tv import TvSolver


def test_a_sliding_disc_is_reconstructed_better_than_by_fista():
    phi = make_phi("sbhe", 1600, 400, seed=0)
    truth = sliding_disc((40, 40), 30)
    y = phi.forward(noisy(truth).reshape(-1, 1600))
    psnr = []
    for cls in (TvSolver, FistaSolver):
        solver = cls(phi, HaarBasis(40, 40))
        psnr.append(psnr_db(np.array([solver.solve(one) for one in y])[15:], truth[15:]))
    assert psnr[0] > psnr[1] + 3


def test_a_step_is_shrunk_as_theory_predicts():
    """min 1/2 |x - y|^2 + lambda TV: each side of a lone step moves by lambda / its length."""
    y = np.repeat(np.float32([0.2, 0.8]), [6, 10])
    solver = TvSolver(
        make_phi("full", 16, 16, seed=0), HaarBasis(1, 16), iterations=1000, lambda_n=0.06
    )
    expected = np.repeat([0.2 + 0.06 / 6, 0.8 - 0.06 / 10], [6, 10])
    np.testing.assert_allclose(solver.solve(y).ravel(), expected, atol=1e-4)


def test_an_edge_of_the_last_frame_is_shrunk_less():
    y = np.repeat(np.float32([0.2, 0.8]), [6, 10])
    solver = TvSolver(
        make_phi("full", 16, 16, seed=0), HaarBasis(1, 16), iterations=300, lambda_n=0.06
    )
    first = np.ptp(solver.solve(y))
    for _ in range(5):
        last = np.ptp(solver.solve(y))
    assert first == pytest.approx(0.584, abs=1e-3)
    assert 0.6 - last < 0.6 * (0.6 - first)


def test_differences_over_missing_taxels_do_not_count():
    """Two halves of a skin, a column missing between them, are two skins."""
    mask = np.ones((4, 9), dtype=np.bool_)
    mask[:, 4] = False
    y = np.where(np.indices((4, 9))[1] < 4, 0.3, 0.9).astype(np.float32)
    solver = TvSolver(
        make_phi("full", 32, 32, seed=0), HaarBasis(4, 9), mask, iterations=200, lambda_n=0.1
    )
    np.testing.assert_allclose(solver.solve(y[mask])[mask], y[mask], atol=1e-5)
