"""Bands of 1.645 deviations hold nine tenths of the true forces."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from reconstructor.pressed import noisy
from reconstructor.test_row_watch import SHAPE, Desk, N

from sparseskin.messages import Reconstruction, ShapeError, decode, encode
from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.reconstructor.basis import make_basis
from sparseskin.nodes.reconstructor.presets import PRESETS
from sparseskin.nodes.reconstructor.solver import make_solver
from sparseskin.nodes.reconstructor.uncertainty import CALIBRATED, Uncertainty
from sparseskin.studies.targets_scenes import random_scene

Floats = npt.NDArray[np.float32]
#: Scenes that the constants were not fitted on.
SCENES = (0, 2, 4, 6)


@pytest.mark.parametrize("preset", ["skin", "paper"])
def test_bands_hold_nine_tenths_of_the_touched_taxels(preset: str) -> None:
    chosen = dict(PRESETS[preset])
    name = chosen.pop("solver")
    held = []
    for scene in SCENES:
        truth = np.array(list(random_scene(scene, 100)[1]))
        phi = make_phi("sbhe", N, N // 3, seed=0)
        solver = make_solver(name, phi, make_basis(chosen["basis"], *SHAPE))
        uncertainty = Uncertainty(solver.mask, phi.ratio, name)
        for frame, y in zip(truth, phi.forward(noisy(truth).reshape(-1, N)), strict=True):
            forces = solver.solve(y)
            residual = float(np.sqrt(np.mean((phi.forward(forces.reshape(-1)) - y) ** 2)))
            band = 1.645 * uncertainty.update(forces, residual)
            held += (np.abs(forces - frame) <= band)[frame > 0.01].tolist()
    assert 0.85 < np.mean(held) < 0.97


def test_the_deviation_is_above_0_where_a_taxel_is_and_0_elsewhere() -> None:
    mask = np.ones((5, 7), np.bool_)
    mask[2, 3] = False
    sd = Uncertainty(mask, 3.0, "skin").update(np.zeros((5, 7), np.float32), 0.01)
    assert sd.dtype == np.float32
    assert (sd[mask] > 0).all()
    assert sd[2, 3] == 0


def test_a_force_that_wanders_is_less_certain_than_one_that_stands() -> None:
    uncertainty = Uncertainty(np.ones((1, 2), np.bool_), 3.0, "skin")
    rng = np.random.default_rng(0)
    for _ in range(50):
        sd = uncertainty.update(np.array([[0.5, 0.5 + rng.normal(0, 0.05)]], np.float32), 0.01)
    assert sd[0, 1] > 3 * sd[0, 0]


def restored(**settings: object) -> tuple[Reconstruction, list[str]]:
    phi = make_phi("sbhe", N, N // 3, seed=0)
    desk = Desk(phi, **settings)
    found = desk.messages(np.zeros((1, phi.m), np.float32))
    (reconstruction,) = (one for one in found if isinstance(one, Reconstruction))
    return reconstruction, desk.lines


@pytest.mark.parametrize("solver", CALIBRATED)
def test_it_travels_with_the_forces_where_it_is_asked_for(solver: str) -> None:
    asked, _ = restored(solver=solver, uncertainty=True)
    assert asked.sd is not None
    assert asked.sd.shape == SHAPE
    assert decode(*encode(asked)) == asked
    plain, _ = restored(solver=solver)
    assert plain.sd is None
    assert decode(*encode(plain)) == plain


def test_of_a_solver_whose_errors_are_not_known_none_is_published_and_that_is_said() -> None:
    reconstruction, lines = restored(solver="ista", uncertainty=True)
    assert reconstruction.sd is None
    assert lines == [
        "uncertainty: how far solver ista is off is not known, and none is published; "
        "known: skin, fista"
    ]


def test_deviations_of_another_shape_are_refused() -> None:
    with pytest.raises(ShapeError, match="sd: shape"):
        Reconstruction(
            stamp_ns=0, patch="skin", forces=np.zeros((2, 3), np.float32), phi="0" * 16,
            iterations=1, residual=0.0, solve_ns=0, done_ns=0, sd=np.zeros((3, 2), np.float32),
        )  # fmt: skip
