"""OAMP: fast where its assumptions hold, and tame where they do not."""

from __future__ import annotations

import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.nodes.reconstructor.solvers.oamp import OampSolver


def test_from_nothing_it_is_better_than_fista_of_as_many_iterations() -> None:
    phi = make_phi("sbhe", 1600, 533, seed=0)
    truth = sliding_disc((40, 40), 12)[-1]
    y = phi.forward(noisy(truth[None])[0].ravel())
    oamp = OampSolver(phi, HaarBasis(40, 40), iterations=20).solve(y)
    fista = FistaSolver(phi, HaarBasis(40, 40), iterations=20, lambda_n=0.00625).solve(y)
    assert psnr_db(oamp, truth) > psnr_db(fista, truth) + 3


@pytest.mark.parametrize("block", [2, 32])
@pytest.mark.parametrize("ratio", [8, 16])
def test_few_measurements_in_small_blocks_do_not_make_it_diverge(block: int, ratio: int) -> None:
    phi = make_phi("sbhe", 1600, 1600 // ratio, seed=0, block=block)
    truth = sliding_disc((40, 40), 40, peak_n=1.5)
    solver = OampSolver(phi, HaarBasis(40, 40))
    for y in phi.forward(noisy(truth).reshape(-1, 1600)):
        assert solver.solve(y).max() < 10
