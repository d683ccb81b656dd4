"""ISTA: the article's iteration, line by line."""

from __future__ import annotations

import numpy as np
import pytest
from reconstructor.pressed import noisy, sliding_disc

from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.reconstructor.haar import HaarBasis
from sparseskin.nodes.reconstructor.ista import IstaSolver


@pytest.mark.parametrize("kind", ["sbhe", "gaussian"])
def test_a_warm_started_sequence_is_the_articles_iteration(kind: str) -> None:
    phi = make_phi(kind, 256, 100, seed=1)
    basis = HaarBasis(16, 16)
    units = np.eye(256, dtype=np.float32).reshape(256, 16, 16)
    psi = np.stack([basis.synthesis(u).ravel() for u in units], axis=1).astype(np.float64)
    A, lam, L = phi.dense() @ psi, 0.01, phi.lipschitz
    solver = IstaSolver(phi, HaarBasis(16, 16), iterations=12, lambda_n=lam)
    theta = np.zeros(256)
    for frame in noisy(sliding_disc((16, 16), 8)):
        y = phi.forward(frame.ravel())
        for _ in range(12):
            v = theta + A.T @ (y - A @ theta) / L
            theta = np.sign(v) * np.maximum(np.abs(v) - lam / L, 0)
        expected = np.maximum(psi @ theta, 0).reshape(16, 16)
        np.testing.assert_allclose(solver.solve(y), expected, atol=1e-4)
