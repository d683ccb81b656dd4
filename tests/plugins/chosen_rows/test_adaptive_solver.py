"""The default solver on rows that are chosen anew in each frame."""

from itertools import pairwise

import numpy as np
import pytest

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.plugins.chosen_rows.solver import AdaptiveSkinSolver
from sparseskin.studies.evaluate import Reading, Scores, make_method
from sparseskin.studies.presses import press_frames


def method(shape, ratio, mask=None, **more):
    return make_method(
        PRESETS["skin"],
        shape,
        ratio,
        0,
        phi="adaptive",
        rows="fixed",
        mask=mask,
        **more,
    )


def frames_of(shape, n, body="peg", **how):
    return [truth for truth, _ in press_frames(body, shape, n, 0, **how)]


def error(found, truth):
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def test_a_small_contact_is_reconstructed_at_n_over_8_from_its_first_frame_on():
    made = method((40, 40), 8)
    frames = frames_of((40, 40), 60, course="sudden", active=0.02)
    solved = [made.reconstruct(frame) for frame in frames]
    errors = [
        error(a.forces, b) for a, b in zip(solved, frames, strict=True) if b.any()
    ]
    assert len(errors) > 20
    assert max(errors) < 0.05


def test_on_a_moving_noisy_press_it_is_above_the_reading_of_all_taxels():
    noise = NoiseModel.for_range(PAPER_F_MAX_N)
    made = method((40, 40), 4, sigma_end=noise.sigma_end)
    found = Scores()
    read = Scores()
    for truth, taxels in press_frames(
        "gaussian", (40, 40), 60, 0, speed=0.25, noise=noise
    ):
        found.add(made.reconstruct(taxels), truth)
        read.add(Reading().reconstruct(taxels), truth)
    assert np.mean(found.contact_db) > np.mean(read.contact_db) + 2


@pytest.mark.parametrize(("shape", "ratio"), [((1, 1), 1), ((1, 16), 4), ((33, 7), 3)])
def test_a_still_press_on_any_skin_is_known_after_all_rows_are_read(shape, ratio):
    mask = np.ones(shape, np.bool_)
    mask[8:11, 3:] = False
    made = method(shape, ratio, mask)
    truth = np.where(mask, np.random.default_rng(0).uniform(0.1, 1, shape), 0).astype(
        np.float32
    )
    for _ in range(120):
        found = made.reconstruct(truth).forces
    np.testing.assert_allclose(found, truth, atol=0.03)
    assert not found[~mask].any()


def test_lost_frames_are_made_up_for_by_later_ones():
    """Half of the frames are lost, at random, while a contact moves, and then none."""
    made = method((24, 24), 4)
    rng = np.random.default_rng(0)
    frames = frames_of((24, 24), 60, active=0.1)
    for frame in frames:
        y = made.measure(frame)
        if rng.random() < 0.5:
            made.solve(y)
    for _ in range(40):
        found = made.reconstruct(frames[-1]).forces
    assert error(found, frames[-1]) < 0.01


def test_a_host_that_begins_in_the_middle_does_not_trust_what_it_has_not_read():
    frames = frames_of((24, 24), 40, active=0.3)
    edge = method((24, 24), 8)
    host = method((24, 24), 8)
    for frame in frames:
        edge.measure(frame)
    trusted = []
    errors = []
    for _ in range(150):
        y = edge.measure(frames[-1])
        host.solver.phi.choose(edge.solver.phi.chosen)
        found = host.solver.solve(y)
        trusted.append(host.solver.trusted)
        errors.append(error(found, frames[-1]))
    assert errors[0] > 0.25
    assert not trusted[0]
    assert errors[-1] < 0.02
    assert trusted[-1]
    assert not any(t for t, e in zip(trusted, errors, strict=True) if e > 0.5)


def test_a_dense_random_skin_at_n_over_8_is_not_trusted():
    made = method((32, 32), 8)
    rng = np.random.default_rng(0)
    for _ in range(12):
        made.reconstruct((rng.random((32, 32)) < 0.5).astype(np.float32))
        assert not made.solver.trusted
        assert made.solver.error > 0.2


def test_after_reset_and_in_steps_the_same_frames_give_the_same_bits():
    made = method((24, 24), 4)
    frames = frames_of((24, 24), 30, body="fingertips", active=0.2)
    once = [made.reconstruct(frame).forces for frame in frames]
    made.reset()
    for before, frame in zip(once, frames, strict=True):
        made.solver.setup(made.measure(frame))
        for _ in range(made.solver.n_steps):
            made.solver.step()
        np.testing.assert_array_equal(made.solver.finish(), before)


def adaptive(n, m):
    return make_phi("adaptive", n, m, seed=0)


def test_a_phi_gets_the_grid_of_the_solver_and_keeps_the_one_it_has():
    phi = adaptive(64, 16)
    assert isinstance(
        make_solver("skin", phi, make_basis("haar", 8, 8)), AdaptiveSkinSolver
    )
    assert phi.exists.shape == (8, 8)
    with pytest.raises(SolverError, match="laid out on another grid"):
        make_solver("skin", phi, make_basis("haar", 4, 16))


def test_measurements_that_are_no_forces_are_refused_and_leave_no_trace():
    made = method((16, 16), 4)
    frames = frames_of((16, 16), 30, active=0.2)
    for frame in frames:
        expected = made.reconstruct(frame).forces
    made.reset()
    for k, (frame, _) in enumerate(pairwise([*frames, frames[-1]])):
        y = made.measure(frame)
        if k == 15:
            wrong = y.copy()
            wrong[3] = 1e20
            with pytest.raises(SolverError):
                made.solver.solve(wrong)
        found = made.solver.solve(y)
    np.testing.assert_array_equal(found, expected)
