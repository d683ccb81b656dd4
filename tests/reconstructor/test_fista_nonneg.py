"""FISTA under x >= 0: better than without where the negative is half of the error."""

from __future__ import annotations

import numpy as np
from reconstructor.pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.reconstructor.fista import FistaSolver
from sparseskin.nodes.reconstructor.fista_nonneg import FistaNonnegSolver
from sparseskin.nodes.reconstructor.haar import HaarBasis


def test_the_same_problem_with_x_not_negative_is_restored_better() -> None:
    phi = make_phi("sbhe", 1600, 200, seed=0)
    truth = sliding_disc((40, 40), 16)
    y = phi.forward(noisy(truth).reshape(-1, 1600))
    solvers = [
        cls(phi, HaarBasis(40, 40), iterations=30, lambda_n=0.00625)
        for cls in (FistaSolver, FistaNonnegSolver)
    ]
    plain, nonneg = (np.array([solver.solve(one) for one in y])[10:] for solver in solvers)
    assert psnr_db(nonneg, truth[10:]) > psnr_db(plain, truth[10:]) + 0.5


def test_an_orthonormal_full_measurement_is_one_step_of_shrinking_and_cutting_off() -> None:
    phi = make_phi("full", 256, 256, seed=0)
    basis = HaarBasis(16, 16)
    frame = noisy(sliding_disc((16, 16), 12))[-1]
    theta = basis.analysis(frame)
    shrunk = np.sign(theta) * np.maximum(np.abs(theta) - 0.05, 0)
    solver = FistaNonnegSolver(phi, HaarBasis(16, 16), iterations=1, lambda_n=0.05)
    expected = np.maximum(basis.synthesis(shrunk.astype(np.float32)), 0)
    np.testing.assert_allclose(solver.solve(frame.ravel()), expected, atol=1e-5)
