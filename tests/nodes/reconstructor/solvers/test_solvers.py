"""Facts that hold for every registered solver, whatever its method, under rotating rows too."""

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.checks import check_solver
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.solvers.base import (
    SOLVERS,
    RotatingSolver,
    make_rotating_solver,
    make_solver,
)

SHAPE = (16, 16)
N = 256
#: All but the one of a plug-in that needs taxels read one by one: it has tests of its own.
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
    restored = np.array(
        [solver.solve(y) for y in phi.forward((noisy(truth) * mask)[:, mask])]
    )
    assert restored.dtype == np.float32
    assert restored.min() >= 0
    np.testing.assert_array_equal(restored[:, ~mask], 0)
    assert psnr_db(restored[12:], truth[12:]) > 28
    assert psnr_db(restored[:4], truth[:4]) > 40


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
    with pytest.raises(
        SolverError, match=f"{name}: iterations = 0 is not allowed; allowed: an"
    ):
        solver_for(name, phi, iterations=0)
    with pytest.raises(
        SolverError, match=r'setting "iteration" is not known.*iterations'
    ):
        solver_for(name, phi, iteration=3)


@pytest.mark.parametrize("lambda_n", [-0.1, np.nan, "0.1"])
def test_a_lambda_that_is_no_weight_is_named(lambda_n):
    with pytest.raises(
        SolverError, match=r"fista: lambda_n = .*a finite number of newtons"
    ):
        solver_for("fista", make_phi("sbhe", N, 100, seed=2), lambda_n=lambda_n)


SIDES = (24, 24)
N_SIDES = 576


def phases_for(ratio):
    return row_subsets(make_phi("sbhe", N_SIDES, N_SIDES // ratio, seed=0), "rotating")


def restored(solver, phases, frames):
    found = []
    for k, taxels in enumerate(frames):
        phi = phases[k % len(phases)]
        solver.use(phi)
        found.append(solver.solve(phi.forward(taxels.reshape(-1))))
    return np.array(found)


def solver_of(name, phases):
    return make_rotating_solver(name, phases, make_basis("haar", *SIDES))


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_every_solver_follows_the_row_subsets(name):
    phases = phases_for(3)
    truth = sliding_disc(SIDES, 40)
    solver = solver_of(name, phases)
    assert isinstance(solver, SkinSolver if name == "skin" else RotatingSolver)
    assert psnr_db(restored(solver, phases, noisy(truth))[20:], truth[20:]) > 33


def test_what_fixed_rows_cannot_see_rotating_ones_do():
    """Of a still scene all of W has been read in a few frames."""
    truth = np.repeat(sliding_disc(SIDES, 12, touch_at=0)[-1:], 60, axis=0)
    rotating = phases_for(4)
    errors = [
        psnr_db(
            restored(solver_of("skin", phases), phases, noisy(truth))[40:], truth[40:]
        )
        for phases in (rotating[:1], rotating)
    ]
    assert errors[1] > errors[0] + 1


def test_a_row_subset_that_it_was_not_made_for_is_refused():
    other = make_phi("sbhe", N_SIDES, N_SIDES // 3, seed=9)
    with pytest.raises(SolverError, match=f"was not made for phi {other.fingerprint}"):
        solver_of("fista", phases_for(3)).use(other)
    with pytest.raises(SolverError, match="is 144 x 576; allowed: 192 x 576"):
        solver_of("skin", phases_for(3)).use(make_phi("sbhe", N_SIDES, 144, seed=0))


def test_a_touch_too_weak_for_one_frame_is_found_by_a_round_of_them():
    """0.04 N on 4 x 4 taxels at M = N/8, as long as it stays: half of what it is, at least."""
    phases = phases_for(8)
    truth = np.zeros((80, *SIDES), dtype=np.float32)
    truth[10:, 9:13, 6:10] = 0.04
    found = restored(solver_of("skin", phases), phases, noisy(truth))
    assert found[40:, 9:13, 6:10].mean() > 0.02
