"""Solvers in compiled loops: the forces that numpy finds, on any skin, and never compiled late."""

import importlib.util

import numpy as np
import pytest
from pressed import noisy, sliding_disc

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver

if importlib.util.find_spec("numba") is None:
    pytest.skip("numba is not installed (extra fast)", allow_module_level=True)

from sparseskin.nodes.reconstructor.skin.compiled_vectors import CompiledVectors
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.solvers.fast import CompiledFista


def mask_of(shape, n_missing):
    mask = np.ones(shape, dtype=np.bool_)
    mask.reshape(-1)[np.random.default_rng(0).permutation(mask.size)[:n_missing]] = (
        False
    )
    return mask


def made(name, phi, mask, how, **more):
    return make_solver(
        name, phi, make_basis("haar", *mask.shape), mask, fast=how, **more
    )


@pytest.mark.parametrize(
    ("name", "shape", "n_missing"),
    [("fista", (33, 47), 100), ("fista", (10, 6), 3), ("skin", (15, 21), 20)],
)
def test_the_forces_are_those_of_numpy_to_within_10_micronewtons(
    name, shape, n_missing
):
    mask = mask_of(shape, n_missing)
    n = int(mask.sum())
    phi = SbhePhi(n, n // 3, 0)
    y = phi.forward((noisy(sliding_disc(shape, 25)) * mask)[:, mask])
    on, off = (
        np.array([solver.solve(one) for one in y])
        for solver in (made(name, phi, mask, how) for how in ("on", "off"))
    )
    assert on.max() > 0.1
    assert np.abs(on - off).max(axis=(1, 2)).max() < 1e-5


def is_compiled(solver):
    if isinstance(solver, SkinSolver):
        return isinstance(solver._estimator.vectors, CompiledVectors)
    return any(isinstance(part, CompiledFista) for part in vars(solver).values())


class OwnPhi(SbhePhi):
    """Options that a user may have changed."""


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_a_phi_of_ones_own_and_others_go_the_way_of_numpy(name):
    basis = make_basis("haar", 8, 8)
    for phi in (OwnPhi(64, 30, 0), make_phi("gaussian", 64, 30, 0)):
        solver = make_solver(name, phi, basis, fast="on")
        off = make_solver(name, phi, basis, fast="off")
        assert not is_compiled(solver)
        y = phi.forward(np.abs(phi.dense()[0]).astype(np.float32))
        np.testing.assert_array_equal(solver.solve(y), off.solve(y))


class WithoutLoops(FistaSolver):
    """A solver of the user's own without the setting `fast`."""

    def __init__(self, phi, basis, mask=None):
        super().__init__(phi, basis, mask, fast="off")


def test_a_solver_without_compiled_loops_takes_the_setting():
    phi = make_phi("sbhe", 64, 30, 0)
    basis = make_basis("haar", 8, 8)
    solver = make_solver(f"{__name__}:WithoutLoops", phi, basis, fast="on")
    assert solver.solve(np.zeros(30, np.float32)).max() == 0


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_a_skin_beyond_16_bits_is_compiled_too_and_finds_the_forces_of_numpy(name):
    """2^16 cells need 2^16 + 1 places, one for those without a taxel."""
    mask = mask_of((256, 256 if name == "skin" else 264), 100)
    n = int(mask.sum())
    phi = SbhePhi(n, n // 3, 0)
    on, off = (made(name, phi, mask, how, iterations=3) for how in ("on", "off"))
    assert is_compiled(on)
    for frame in noisy(sliding_disc(mask.shape, 2, touch_at=0)) * mask:
        y = phi.forward(frame[mask])
        np.testing.assert_allclose(on.solve(y), off.solve(y), rtol=0, atol=1e-5)
