"""OMP: exact on what is sparse, and it finds by itself how sparse."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.base import IdentityBasis
from sparseskin.nodes.reconstructor.solvers.omp import OmpSolver


@pytest.mark.parametrize("kind", ["sbhe", "gaussian"])
def test_few_taxels_are_reconstructed_exactly(kind: str) -> None:
    phi = make_phi(kind, 400, 160, seed=0, block=256)
    rng = np.random.default_rng(1)
    truth = np.zeros(400, dtype=np.float32)
    truth[rng.permutation(400)[:12]] = rng.uniform(0.3, 1.5, 12)
    solver = OmpSolver(phi, IdentityBasis(20, 20))
    np.testing.assert_allclose(solver.solve(phi.forward(truth)).ravel(), truth, atol=1e-5)


def test_noise_alone_has_next_to_no_support() -> None:
    phi = make_phi("sbhe", 1024, 512, seed=0)
    rng = np.random.default_rng(3)
    solver = OmpSolver(phi, IdentityBasis(32, 32))
    sizes = [
        np.count_nonzero(solver.solve(rng.normal(0, 0.01, 512).astype(np.float32)))
        for _ in range(20)
    ]
    assert np.mean(sizes) < 3
