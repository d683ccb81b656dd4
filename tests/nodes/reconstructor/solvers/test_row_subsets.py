"""Solvers under rotating rows: each reconstructs frames of all row subsets."""

import numpy as np
import pytest
from pressed import noisy, psnr_db, sliding_disc

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.solvers.base import RotatingSolver, make_rotating_solver

SHAPE, N = (24, 24), 576


def phases_for(ratio):
    return row_subsets(make_phi("sbhe", N, N // ratio, seed=0), "rotating")


def restored(solver, phases, frames):
    found = []
    for k, taxels in enumerate(frames):
        phi = phases[k % len(phases)]
        solver.use(phi)
        found.append(solver.solve(phi.forward(taxels.reshape(-1))))
    return np.array(found)


def solver_for(name, phases):
    return make_rotating_solver(name, phases, make_basis("haar", *SHAPE))


@pytest.mark.parametrize("name", ["skin", "fista", "tv"])
def test_every_solver_follows_the_row_subsets(name):
    phases = phases_for(3)
    truth = sliding_disc(SHAPE, 40)
    solver = solver_for(name, phases)
    assert isinstance(solver, SkinSolver if name == "skin" else RotatingSolver)
    found = restored(solver, phases, noisy(truth))
    assert psnr_db(found[20:], truth[20:]) > 33


def test_what_fixed_rows_cannot_see_rotating_ones_do():
    """Of a still scene all of W has been read in a few frames."""
    truth = np.repeat(sliding_disc(SHAPE, 12, touch_at=0)[-1:], 60, axis=0)
    rotating = phases_for(4)
    errors = [
        psnr_db(restored(solver_for("skin", phases), phases, noisy(truth))[40:], truth[40:])
        for phases in (rotating[:1], rotating)
    ]
    assert errors[1] > errors[0] + 1


def test_a_row_subset_that_it_was_not_made_for_is_refused():
    other = make_phi("sbhe", N, N // 3, seed=9)
    for name in ("fista", "tv"):
        with pytest.raises(SolverError, match=f"was not made for phi {other.fingerprint}"):
            solver_for(name, phases_for(3)).use(other)
    with pytest.raises(SolverError, match="is 144 x 576; allowed: 192 x 576"):
        solver_for("skin", phases_for(3)).use(make_phi("sbhe", N, 144, seed=0))


def test_a_touch_too_weak_for_one_frame_is_found_by_a_round_of_them():
    """0.04 N on 4 x 4 taxels at M = N/8, as long as it stays: half of what it is, at least."""
    phases = phases_for(8)
    truth = np.zeros((80, *SHAPE), dtype=np.float32)
    truth[10:, 9:13, 6:10] = 0.04
    found = restored(solver_for("skin", phases), phases, noisy(truth))
    assert found[40:, 9:13, 6:10].mean() > 0.02
