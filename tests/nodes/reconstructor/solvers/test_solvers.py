"""Facts that hold for every registered solver, whatever its method."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import SOLVERS, Solver, make_solver

SHAPE, N = (16, 16), 256
#: All but the one that needs taxels read one by one: it has tests of its own.
INVERTING = sorted(SOLVERS.keys() - {"interpolation"})


def solver_for(name: str, phi: Phi, shape: tuple[int, int] = SHAPE, **settings: Any) -> Solver:
    return make_solver(name, phi, make_basis("haar", *shape), **settings)


def phi_for(name: str, n: int = N, m: int = 100) -> Phi:
    """A measurement matrix that the solver can use."""
    return make_phi("subsample" if name == "interpolation" else "sbhe", n, m, seed=2)


def measured(phi: Phi, n_frames: int = 12) -> Floats:
    return phi.forward(noisy(sliding_disc(SHAPE, n_frames)).reshape(n_frames, -1))


@pytest.mark.parametrize(
    ("name", "kind"), [*((name, "sbhe") for name in INVERTING), ("skin", "gaussian")]
)
def test_missing_taxels_are_0_and_the_others_near_the_truth(name: str, kind: str) -> None:
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


@pytest.mark.parametrize("name", SOLVERS)
def test_setup_steps_and_finish_are_solve(name: str) -> None:
    phi = phi_for(name)
    whole, pieces = solver_for(name, phi), solver_for(name, phi)
    for y in measured(phi):
        pieces.setup(y)
        for _ in range(pieces.n_steps):
            pieces.step()
        np.testing.assert_array_equal(pieces.finish(), whole.solve(y))
    with pytest.raises(SolverError, match=f"{name}: no step is left"):
        pieces.step()


@pytest.mark.parametrize("name", SOLVERS)
def test_reset_forgets_and_the_same_measurements_give_the_same_bits(name: str) -> None:
    phi = phi_for(name)
    solver = solver_for(name, phi)
    first = np.array([solver.solve(y) for y in measured(phi)])
    solver.reset()
    again = np.array([solver.solve(y) for y in measured(phi)])
    np.testing.assert_array_equal(again, first)


@pytest.mark.parametrize("name", SOLVERS)
def test_estimates_are_the_callers_own_y_is_left_alone_and_of_nothing_they_are_0(name: str) -> None:
    phi = phi_for(name)
    y = measured(phi)
    kept = y.copy()
    solver = solver_for(name, phi)
    first = solver.solve(y[8])
    copy = first.copy()
    solver.solve(y[9])
    np.testing.assert_array_equal(first, copy)
    np.testing.assert_array_equal(y, kept)
    solver.reset()
    np.testing.assert_array_equal(solver.solve(np.zeros_like(y[0])), 0)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize(("shape", "m"), [((1, 1), 1), ((3, 1), 2)])
def test_tiny_skins_work(name: str, shape: tuple[int, int], m: int) -> None:
    n = shape[0] * shape[1]
    phi = phi_for(name, n, m)
    solver = solver_for(name, phi, shape)
    for x in np.random.default_rng(0).random((3, n), dtype=np.float32):
        assert np.isfinite(solver.solve(phi.forward(x))).all()


@pytest.mark.parametrize("name", SOLVERS)
def test_a_measurement_that_is_not_finite_leaves_no_trace(name: str) -> None:
    phi = phi_for(name)
    solver, untroubled = solver_for(name, phi), solver_for(name, phi)
    for y in measured(phi, 4):
        with pytest.raises(SolverError, match=r"measurement 17 is .*; allowed: finite"):
            solver.solve(np.where(np.arange(100) == 17, np.float32(np.nan), y))
        np.testing.assert_array_equal(solver.solve(y), untroubled.solve(y))


@pytest.mark.parametrize("name", INVERTING)
def test_what_cannot_be_made_is_named(name: str) -> None:
    phi = make_phi("sbhe", N, 100, seed=2)
    with pytest.raises(SolverError, match=f"{name}: iterations = 0 is not allowed; allowed: an"):
        solver_for(name, phi, iterations=0)
    with pytest.raises(SolverError, match=r'setting "iteration" is not known.*iterations'):
        solver_for(name, phi, iteration=3)


@pytest.mark.parametrize(("name", "lambda_n"), [("fista", -0.1), ("tv", np.nan), ("fista", "0.1")])
def test_a_lambda_that_is_no_weight_is_named(name: str, lambda_n: Any) -> None:
    with pytest.raises(SolverError, match=f"{name}: lambda_n = .*a finite number of newtons"):
        solver_for(name, make_phi("sbhe", N, 100, seed=2), lambda_n=lambda_n)
