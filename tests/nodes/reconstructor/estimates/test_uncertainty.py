"""Bands of 1.645 deviations hold nine tenths of the true forces."""

import numpy as np
import pytest
from pressed import noisy
from watched import DESK_SHAPE as SHAPE
from watched import Desk, N

from sparseskin.messages import Reconstruction, decode, encode
from sparseskin.nodes.compressor.phi.base import BLOCK, RANDOM, SUMS, make_phi
from sparseskin.nodes.compressor.phi.rotation import PAPER_BLOCK
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.estimates.uncertainty import Uncertainty
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.solvers.base import make_solver, solver_class
from sparseskin.studies.presses import press_frames

#: Moving bodies that the constants were not fitted on, and how much of them is held at least and
#: at most. Smooth contacts are better than they show; small ones with an edge are worse.
HELD = {"plate": (0.85, 0.97), "peg": (0.75, 0.96), "gaussian": (0.9, 1.0)}


def held(preset, body):
    """Parts of the touched and of the untouched taxels whose true force is within the band."""
    chosen = dict(PRESETS[preset])
    name = chosen.pop("solver")
    truth = np.array([frame for frame, _ in press_frames(body, SHAPE, 150, 1)])
    shape = truth.shape[1:]
    n = truth[0].size
    # The rows that belong to the preset.
    block, rule = (PAPER_BLOCK, RANDOM) if preset == "paper" else (BLOCK, SUMS)
    phi = make_phi("sbhe", n, n // 3, 0, block, rule)
    solver = make_solver(name, phi, make_basis(chosen["basis"], *shape))
    uncertainty = Uncertainty(
        solver.mask, phi.ratio, solver_class(name).calibrated, rule=rule
    )
    within = np.zeros(truth.shape, np.bool_)
    for k, y in enumerate(phi.forward(noisy(truth).reshape(-1, n))):
        forces = solver.solve(y)
        residual = float(np.sqrt(np.mean((phi.forward(forces.reshape(-1)) - y) ** 2)))
        within[k] = np.abs(forces - truth[k]) <= 1.645 * uncertainty.update(
            forces, residual
        )
    touched = truth > 0.01
    return float(within[touched].mean()), float(within[~touched].mean())


@pytest.mark.parametrize(
    ("preset", "body"), [*(("skin", body) for body in HELD), ("paper", "peg")]
)
def test_bands_hold_nine_tenths_of_the_touched_taxels_of_a_press(preset, body):
    touched, untouched = held(preset, body)
    least, most = HELD[body]
    assert least < touched < most
    # An untouched taxel is nearly always 0, as it should be.
    assert untouched > 0.98


def test_deviations_scale_with_the_range_of_the_skin_and_are_0_without_a_taxel():
    frames = np.random.default_rng(0).uniform(0, 1, (5, 9, 7)).astype(np.float32)
    mask = np.ones((9, 7), np.bool_)
    mask[2, 3] = False
    small, large = (Uncertainty(mask, 3.0, SkinSolver.calibrated) for _ in range(2))
    for frame in frames:
        sd = small.update(frame, 0.02)
        assert sd[2, 3] == 0
        np.testing.assert_allclose(
            large.update(1000 * frame, 20.0), 1000 * sd, rtol=1e-4
        )


def deviations_by_definition(frame, r, factor):
    """Standard deviations of a first frame, taxel by taxel: no mean of frames is there yet."""
    x = frame.astype(np.float64)
    edged = np.pad(x, ((0, 1), (0, 1)), mode="edge")
    both = np.abs(edged[1:, :-1] - x) + np.abs(edged[:-1, 1:] - x)
    around = np.pad(both, 1, mode="edge")
    g = np.zeros_like(x)
    for row, col in np.ndindex(x.shape):
        g[row, col] = around[row : row + 3, col : col + 3].mean()
    p = (0.2 * x**2 + 0.03 * r**2) / (x + 0.3 * r)
    return factor * np.sqrt(r * np.sqrt(p * np.sqrt(g**2 + r**2)))


def test_the_first_frame_is_the_definition_on_all_edges_of_the_skin():
    frame = np.random.default_rng(0).uniform(0, 0.01, (9, 7)).astype(np.float32)
    frame[:3, :2] += 0.5
    frame[6:, 4:] += 0.5
    factor, power = SkinSolver.calibrated[SUMS]["fixed"]
    sd = Uncertainty(np.ones((9, 7), np.bool_), 3.0, SkinSolver.calibrated).update(
        frame, 0.02
    )
    expected = deviations_by_definition(frame, 0.02, factor * 3.0**power)
    assert (sd > 0).all()
    np.testing.assert_allclose(sd, expected, rtol=1e-4)


def reconstructed(**settings):
    phi = make_phi("sbhe", N, N // 3, seed=0)
    desk = Desk(phi, **settings)
    found = desk.messages(np.zeros((1, phi.m), np.float32))
    (reconstruction,) = (one for one in found if isinstance(one, Reconstruction))
    return reconstruction, desk.lines


@pytest.mark.parametrize("solver", ["skin", "fista"])
def test_it_travels_with_the_forces_where_it_is_asked_for(solver):
    asked, _ = reconstructed(solver=solver, uncertainty=True)
    assert asked.sd.shape == (1, *SHAPE)
    assert decode(*encode(asked)) == asked
    plain, _ = reconstructed(solver=solver)
    assert plain.sd is None
    assert decode(*encode(plain)) == plain
