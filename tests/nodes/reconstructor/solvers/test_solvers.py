"""Facts that hold for every registered solver, whatever its method."""

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.checks import check_solver
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import SOLVERS, make_rotating_solver, make_solver

SHAPE, N = (16, 16), 256
#: All but the one that needs taxels read one by one: it has tests of its own.
INVERTING = sorted(SOLVERS.keys() - {"interpolation"})


def solver_for(name, phi, shape=SHAPE, **settings):
    return make_solver(name, phi, make_basis("haar", *shape), **settings)


def phi_for(name, n=N, m=100):
    """A measurement matrix that the solver can use."""
    return make_phi("subsample" if name == "interpolation" else "sbhe", n, m, seed=2)


def measured(phi, n_frames=12):
    return phi.forward(noisy(sliding_disc(SHAPE, n_frames)).reshape(n_frames, -1))


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, "sbhe") for name in INVERTING), ("skin", "gaussian")]
)
def test_missing_taxels_are_0_and_the_others_near_the_truth(name, kind):
    shape = (24, 31)
    mask = np.ones(shape, dtype=np.bool_)
    mask[:4, :5] = mask[-1, -1] = False
    n = int(mask.sum())
    phi = make_phi(kind, n, n // 2, seed=1)
    truth = sliding_disc(shape, 20) * mask
    solver = make_solver(name, phi, make_basis("haar", *shape), mask)
    restored = np.array([solver.solve(y) for y in phi.forward((noisy(truth) * mask)[:, mask])])
    assert restored.dtype == np.float32
    assert restored.min() >= 0
    np.testing.assert_array_equal(restored[:, ~mask], 0)
    assert psnr_db(restored[12:], truth[12:]) > 28
    untouched = psnr_db(restored[:4], truth[:4])
    assert untouched > 40


@pytest.mark.parametrize("rows", ["fixed", "rotating"])
@pytest.mark.parametrize("name", SOLVERS)
def test_a_solver_is_one(name, rows):
    phis = row_subsets(phi_for(name), rows if name in INVERTING else "fixed")
    solver = make_rotating_solver(name, phis, make_basis("haar", *SHAPE))
    assert check_solver(solver)["error"] < 0.6
    for y in measured(phis[0]):
        solver.use(phis[0])
        solver.setup(y)
        for _ in range(solver.n_steps):
            solver.step()
    with pytest.raises(SolverError, match=f"{name}: no step is left"):
        solver.step()


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize(("shape", "m"), [((1, 1), 1), ((3, 1), 2)])
def test_tiny_skins_work(name, shape, m):
    n = shape[0] * shape[1]
    phi = phi_for(name, n, m)
    solver = solver_for(name, phi, shape)
    for x in np.random.default_rng(0).random((3, n), dtype=np.float32):
        assert np.isfinite(solver.solve(phi.forward(x))).all()


@pytest.mark.parametrize("name", INVERTING)
def test_what_cannot_be_made_is_named(name):
    phi = make_phi("sbhe", N, 100, seed=2)
    with pytest.raises(SolverError, match=f"{name}: iterations = 0 is not allowed; allowed: an"):
        solver_for(name, phi, iterations=0)
    with pytest.raises(SolverError, match=r'setting "iteration" is not known.*iterations'):
        solver_for(name, phi, iteration=3)


@pytest.mark.parametrize(("name", "lambda_n"), [("fista", -0.1), ("tv", np.nan), ("fista", "0.1")])
def test_a_lambda_that_is_no_weight_is_named(name, lambda_n):
    with pytest.raises(SolverError, match=f"{name}: lambda_n = .*a finite number of newtons"):
        solver_for(name, make_phi("sbhe", N, 100, seed=2), lambda_n=lambda_n)
