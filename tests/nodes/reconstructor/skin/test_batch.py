"""Solver `skin` for several patches at once: each has the forces of a solver of its own."""

import numpy as np
import pytest
from pressed import noisy, sliding_disc

from sparseskin.messages import Reconstruction
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING, row_subsets
from sparseskin.nodes.errors import SettingsError, SolverError
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.skin.batch import SkinBatch
from sparseskin.nodes.reconstructor.solvers.base import make_rotating_solver
from sparseskin.nodes.sensor.node import Sensor

SHAPE, N_FRAMES = (20, 18), 30
MASK = np.ones(SHAPE, np.bool_)
MASK[:3, :5] = False
STREAMS = [noisy(sliding_disc(SHAPE, N_FRAMES, peak_n=peak), seed=peak) for peak in (1, 2)]


def solvers(rows, device="numpy", **settings):
    """Row subsets; the solvers of a batch of two patches, and two of their own."""
    n = int(MASK.sum())
    phis = row_subsets(make_phi("sbhe", n, n // 3, seed=0), rows)
    basis = HaarBasis(*SHAPE)
    batch = SkinBatch(phis, basis, MASK, 2, device, **settings).patches
    own = [
        make_rotating_solver("skin", phis, basis, MASK, fast="off", **settings) for _ in range(2)
    ]
    return phis, batch, own


def solved(phi, patches, ys):
    """Forces, errors and flags of a frame of some patches."""
    for solver, y in zip(patches, ys, strict=True):
        solver.use(phi)
        solver.setup(y)
    found = []
    for solver in patches:
        for _ in range(solver.n_steps):
            solver.step()
        found.append((solver.finish(), solver.error, solver.trusted, solver.noise2))
    return found


def assert_same(found, expected):
    for (forces, *numbers), (own_forces, *own_numbers) in zip(found, expected, strict=True):
        assert np.abs(forces - own_forces).max() <= 1e-4 * max(own_forces.max(), 0.1)
        np.testing.assert_allclose(numbers, own_numbers, rtol=1e-3)


@pytest.mark.parametrize("device", ["numpy", "cpu"])
@pytest.mark.parametrize("settings", [{}, {"iterations": 3}])
def test_each_patch_is_reconstructed_as_by_a_solver_of_its_own(device, settings):
    if device == "cpu":
        pytest.importorskip("torch")
    phis, batch, own = solvers(ROTATING, device, **settings)
    for k in range(N_FRAMES):
        phi = phis[k % len(phis)]
        ys = [phi.forward(stream[k][MASK]) for stream in STREAMS]
        assert_same(solved(phi, batch, ys), solved(phi, own, ys))


def test_a_patch_without_frames_keeps_its_state_and_one_that_is_reset_forgets():
    """After 8 frames of 8 steps the tiles have the shifts of the first frame again."""
    (phi,), batch, own = solvers(FIXED)
    ys = [phi.forward(stream[:, MASK]) for stream in STREAMS]
    for k in range(8):
        assert_same(solved(phi, batch, [y[k] for y in ys]), solved(phi, own, [y[k] for y in ys]))
    for k in range(8, 16):
        solved(phi, batch[:1], [ys[0][k]])
    batch[0].reset()
    own[0].reset()
    for k in range(8, 16):
        assert_same(solved(phi, batch, [y[k] for y in ys]), solved(phi, own, [y[k] for y in ys]))


def test_a_warm_start_is_that_of_its_patch():
    (phi,), batch, own = solvers(FIXED)
    warm, y = STREAMS[1][-1] * MASK, phi.forward(STREAMS[0][-1][MASK])
    for solver in (batch[1], own[1]):
        solver.setup(y, warm)
        solver.step()
    np.testing.assert_allclose(batch[1].finish(), own[1].finish(), atol=1e-4)


def node_frames(device):
    """Frames of a reconstructor of four patches, two of which are idle in turn, at 8 steps."""
    common = {"patch": "body", "patches": ("left", "right", "back", "hand")}
    skin = {"simulated": {"rows": 16, "cols": 16}, "source": "scene:walk", "active": 0.5}
    solver = {"iterations": 8, "device": device, "fast": "off"}
    bus = Bus(
        {
            "sensor": (Sensor, Sensor.Settings(**common, **skin)),
            "compressor": (Compressor, Compressor.Settings(**common)),
            "reconstructor": (Reconstructor, Reconstructor.Settings(**common, **solver)),
        }
    )
    made = [message for messages in bus.frames(20) for message in messages]
    return [message for message in made if isinstance(message, Reconstruction)]


def test_a_node_publishes_the_same_frames_by_a_batch():
    for one, other in zip(node_frames(""), node_frames("numpy"), strict=True):
        np.testing.assert_allclose(other.forces, one.forces, atol=1e-4 * 2.5)
        np.testing.assert_allclose(other.error, one.error, rtol=1e-3)
        assert one.reason == other.reason


def test_a_device_is_for_solver_skin_alone():
    with pytest.raises(SettingsError, match="device: is not available with solver fista"):
        Reconstructor.Settings(preset="paper", device="numpy").check()


def test_devices_and_matrices_that_are_not_there_are_refused():
    phi = make_phi("gaussian", SHAPE[0] * SHAPE[1], 90, seed=0)
    with pytest.raises(SolverError, match='phi "gaussian" is not available there; allowed: sbhe'):
        SkinBatch([phi], HaarBasis(*SHAPE), None, 2, "numpy")
    pytest.importorskip("torch")
    with pytest.raises(SettingsError, match=r"device: 'gpu0': .* allowed: numpy, or a device"):
        solvers(FIXED, "gpu0")
