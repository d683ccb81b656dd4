"""State of the patches of a batch: patches without a frame, resets, divergence; bad arguments."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from patch_streams import copied, stream

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import SettingsError, SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.batch.backend import Backend
from sparseskin.nodes.reconstructor.batch.solver import BatchFrame, BatchSolver
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver

SHAPE = (20, 16)
MASK = np.ones(SHAPE, dtype=np.bool_)
N = MASK.size
PRESS = stream("peg", 3, "rotating", shape=SHAPE, n_frames=16)
M = PRESS.phis[0].m


def solver_of(n_patches: int, **options: Any) -> BatchSolver:
    return BatchSolver(PRESS.phis, MASK, n_patches, **options)


def frames_of(solver: BatchSolver, first: int = 0, last: int = len(PRESS.y)) -> list[BatchFrame]:
    """Frames of the press, the same for all patches."""
    return [
        copied(solver.solve(np.tile(PRESS.y[k], (solver.n_patches, 1)), phi_of(k)))
        for k in range(first, last)
    ]


def phi_of(frame: int) -> Any:
    return PRESS.phis[frame % len(PRESS.phis)]


def assert_same(mine: BatchFrame, other: BatchFrame, patch: int) -> None:
    for name, array in vars(mine).items():
        np.testing.assert_allclose(array[patch], getattr(other, name)[patch], rtol=0, atol=1e-4)


def test_a_patch_without_a_frame_keeps_its_state() -> None:
    solver, other = solver_of(2), solver_of(2)
    frames_of(solver, 0, 6)
    frames_of(other, 0, 6)
    for k in (6, 7):
        y = np.array([PRESS.y[k], np.full(M, np.nan)])
        solver.solve(y, phi_of(k), active=[True, False])
    last = np.tile(PRESS.y[6], (2, 1))
    assert_same(solver.solve(last, phi_of(6)), other.solve(last, phi_of(6)), 1)


def test_idle_patches_do_not_change_the_others() -> None:
    solver, all_active = solver_of(3), solver_of(3)
    for k, y in enumerate(PRESS.y):
        given = np.tile(y, (3, 1))
        mine = solver.solve(given, phi_of(k), active=np.array([True, k % 2 == 0, False]))
        assert_same(mine, all_active.solve(given, phi_of(k)), 0)


def test_after_a_reset_the_same_frames_give_the_same() -> None:
    solver = solver_of(2)
    first = frames_of(solver)
    solver.reset()
    for mine, other in zip(frames_of(solver), first, strict=True):
        assert_same(mine, other, 0)
        assert_same(mine, other, 1)


def test_one_patch_is_reset_without_the_other() -> None:
    solver, other, new = solver_of(2), solver_of(2), solver_of(2)
    for one in (solver, other):
        frames_of(one, 0, 8)
    solver.reset([False, True])
    mine = frames_of(solver, 8)
    assert_same(mine[-1], frames_of(other, 8)[-1], 0)
    assert_same(mine[-1], frames_of(new, 8)[-1], 1)


@pytest.mark.parametrize("device", ["strict", "cpu"])
def test_measurements_on_the_device_that_are_not_finite_flag_their_patch_alone(device: str) -> None:
    if device == "cpu" and find_spec("torch") is None:
        pytest.skip("torch is not installed")
    solver, other = (solver_of(2, device=device) for _ in range(2))
    for k in range(4):
        y = np.tile(PRESS.y[k], (2, 1))
        _, alike = other.advance(other.backend.array(y), phi_of(k))
        if k == 2:
            y[1, 5] = np.nan
        _, mine = solver.advance(solver.backend.array(y), phi_of(k))
        assert_same(mine, alike, 0)
        if k == 2:
            assert mine.finite.tolist() == [True, False]
            assert not mine.trusted[1]
            assert mine.error[1] == np.inf
            assert not mine.forces[1].any()
        else:
            assert mine.finite.all()
    # It begins anew with the next frame.
    new = solver_of(2, device=device)
    assert_same(mine, frames_of(new, 3, 4)[0], 1)


def test_an_impossible_frame_is_not_trusted() -> None:
    solver = solver_of(1)
    frames_of(solver)
    rng = np.random.default_rng(0)
    frame = solver.solve(rng.normal(0, 3, (1, M)), phi_of(len(PRESS.y)))
    assert frame.finite[0]
    assert not frame.trusted[0]


def test_forces_can_stay_on_the_device() -> None:
    solver, other = solver_of(1), solver_of(1)
    forces, frame = solver.advance(PRESS.y[0][None], with_forces=False)
    assert frame.forces.shape == (0, *SHAPE)
    np.testing.assert_array_equal(np.array(forces), other.solve(PRESS.y[0][None]).forces)


def test_the_measurements_held_out_are_those_of_the_default_solver() -> None:
    alone, solver = SkinSolver(PRESS.phis[0], make_basis("haar", *SHAPE)), solver_of(1)
    for k, phi in enumerate(PRESS.phis):
        alone.use(phi)
        alone.solve(PRESS.y[k])
        np.testing.assert_array_equal(solver.unfitted(phi), alone.unfitted)


@pytest.mark.parametrize(
    ("y", "options", "message"),
    [
        (np.zeros((1, M)), {}, "y has shape"),
        (np.zeros((2, M + 1)), {}, "y has shape"),
        ([[0.0] * M], {}, "y has shape"),
        (np.full((2, M), "1"), {}, "real numbers"),
        (np.zeros((2, M), complex), {}, "real numbers"),
        (np.full((2, M), np.nan), {}, "measurement 0 of patch 0 is nan"),
        (np.full((2, M), 1e300), {}, "measurement 0 of patch 0 is inf"),
        (np.full((2, M), -2e14), {}, "within"),
        (np.zeros((2, M)), {"active": [1, 0]}, "active is int"),
        (np.zeros((2, M)), {"active": [True]}, "expected bool of shape"),
        (np.zeros((2, M)), {"phi": make_phi("sbhe", N, M, 1)}, "was not made for phi"),
    ],
)
def test_bad_frames_are_refused(y: Any, options: Any, message: str) -> None:
    with pytest.raises(SolverError, match=message):
        solver_of(2).solve(y, **options)


def test_a_refused_frame_changes_nothing() -> None:
    solver = solver_of(1)
    with pytest.raises(SolverError):
        solver.solve(np.full((1, M), np.nan))
    for mine, other in zip(frames_of(solver), frames_of(solver_of(1)), strict=True):
        assert_same(mine, other, 0)


@pytest.mark.parametrize(
    ("phis", "mask", "n_patches", "message"),
    [
        ([], MASK, 1, "allowed: .sbhe."),
        ([make_phi("gaussian", N, M, 0)], MASK, 1, "allowed: .sbhe."),
        ([make_phi("sbhe", N, 95, 0)], MASK, 1, "allowed: 96 or more"),
        ([make_phi("sbhe", 64, 64, 0)], np.ones((8, 8), bool), 1, "allowed: 96 or more"),
        ([make_phi("sbhe", N, M, seed) for seed in (0, 1)], MASK, 1, "no row subset"),
        (PRESS.phis, MASK[:-1], 1, "expected bool with"),
        (PRESS.phis, MASK.astype(int), 1, "the mask is int"),
        (PRESS.phis, MASK, 0, "n_patches"),
        (PRESS.phis, MASK, 1.5, "n_patches"),
    ],
)
def test_bad_batches_are_refused(phis: Any, mask: Any, n_patches: Any, message: str) -> None:
    with pytest.raises(SolverError, match=message):
        BatchSolver(phis, mask, n_patches)


@pytest.mark.parametrize(
    "option", [{"iterations": 0}, {"max_iterations": 1001}, {"seed": -1}, {"mode": "fast"}]
)
def test_bad_options_are_refused_by_their_name(option: Any) -> None:
    with pytest.raises(SolverError, match=next(iter(option))):
        solver_of(1, **option)


@pytest.mark.parametrize("device", ["gpu", "cpu:1", "cuda:", "tpu"])
def test_an_unknown_device_is_refused(device: str) -> None:
    with pytest.raises(SettingsError, match=f"device: '{device}'"):
        Backend(device)
