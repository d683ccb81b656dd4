"""Total variation: better than FISTA on a disc, and what theory says of an edge."""

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.limits import reconstruction_warnings
from sparseskin.nodes.reconstructor.solvers.base import make_rotating_solver
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.studies.baselines.total_variation import TvSolver
from sparseskin.studies.evaluate import VARIATION


def test_it_is_made_by_name_and_states_what_its_settings_may_be():
    subsets = row_subsets(make_phi("sbhe", 256, 86, seed=0), "rotating")
    solver = make_rotating_solver(VARIATION, subsets, make_basis("haar", 16, 16))
    assert solver.name == "tv"
    (warning,) = reconstruction_warnings(VARIATION, "haar", 256, 86, {"lambda_n": 0.1})
    assert warning.endswith("advised: 0.002 to 0.03")
    with pytest.raises(
        SolverError, match=r"tv: lambda_n = .*a finite number of newtons"
    ):
        TvSolver(subsets[0], HaarBasis(16, 16), lambda_n=np.nan)


def test_a_sliding_disc_is_reconstructed_better_than_by_fista():
    phi = make_phi("sbhe", 1600, 400, seed=0)
    truth = sliding_disc((40, 40), 30)
    y = phi.forward(noisy(truth).reshape(-1, 1600))
    psnr = []
    for cls in (TvSolver, FistaSolver):
        solver = cls(phi, HaarBasis(40, 40))
        psnr.append(
            psnr_db(np.array([solver.solve(one) for one in y])[15:], truth[15:])
        )
    assert psnr[0] > psnr[1] + 3


def test_an_edge_is_shrunk_as_theory_predicts_and_less_where_the_last_frame_had_it():
    """min 1/2 |x - y|^2 + lambda TV: each side of a lone step moves by lambda / its length."""
    y = np.repeat(np.float32([0.2, 0.8]), [6, 10])
    solver = TvSolver(
        make_phi("full", 16, 16, 0), HaarBasis(1, 16), iterations=1000, lambda_n=0.06
    )
    expected = np.repeat([0.2 + 0.06 / 6, 0.8 - 0.06 / 10], [6, 10])
    np.testing.assert_allclose(solver.solve(y).ravel(), expected, atol=1e-4)
    y = np.repeat(np.float32([0.2, 0.8]), [6, 10])
    solver = TvSolver(
        make_phi("full", 16, 16, 0), HaarBasis(1, 16), iterations=300, lambda_n=0.06
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
        make_phi("full", 32, 32, seed=0),
        HaarBasis(4, 9),
        mask,
        iterations=200,
        lambda_n=0.1,
    )
    np.testing.assert_allclose(solver.solve(y[mask])[mask], y[mask], atol=1e-5)
