"""Reweighted l1: what the last frame had is hardly shrunk in this one."""

from __future__ import annotations

import numpy as np
from reconstructor.pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.reconstructor.fista_nonneg import FistaNonnegSolver
from sparseskin.nodes.reconstructor.haar import HaarBasis
from sparseskin.nodes.reconstructor.reweighted import ReweightedSolver


def test_it_is_better_than_the_same_lambda_without_weights() -> None:
    phi = make_phi("sbhe", 1600, 400, seed=0)
    truth = sliding_disc((40, 40), 30)
    y = phi.forward(noisy(truth).reshape(-1, 1600))
    solvers = [
        cls(phi, HaarBasis(40, 40), iterations=20, lambda_n=0.0125)
        for cls in (FistaNonnegSolver, ReweightedSolver)
    ]
    plain, weighted = (np.array([solver.solve(one) for one in y])[15:] for solver in solvers)
    assert psnr_db(weighted, truth[15:]) > psnr_db(plain, truth[15:]) + 1


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
