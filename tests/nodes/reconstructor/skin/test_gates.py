"""Denoisers of tiles: learned gates, Haar shrinkage by a formula; batches of frames."""

import numpy as np
import pytest
from bags import chain
from damaged import npz
from pressed import noisy, sliding_disc

from sparseskin.messages import Reconstruction
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROTATING, row_subsets
from sparseskin.nodes.errors import SettingsError, SolverError
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.skin.batch import SkinBatch
from sparseskin.nodes.reconstructor.skin.formula import shrink
from sparseskin.nodes.reconstructor.skin.gates import WINDOW, Gates, gates_of, inner
from sparseskin.nodes.reconstructor.solvers.base import make_rotating_solver


def stored_gates():
    return gates_of(None)


def test_a_tile_is_the_part_that_passes_and_the_sum_of_gated_filters():
    gates, u = stored_gates(), 3 * np.random.default_rng(0).standard_normal(WINDOW * WINDOW)
    a = gates.filters @ u
    size = 4 * ((1 + np.abs(a)) ** 0.25 - 1)
    levels = np.concatenate([np.sign(a) * size, size])
    h = np.maximum(gates.hidden @ levels + gates.hidden_0, 0)
    g = np.clip(gates.gates @ h + gates.gates_0, 0, 1)
    tiles, error = gates.denoise(u.astype(np.float32)[None])
    tile = g[-1] * inner(u) + gates.synthesis @ (a * (g[:-1] - g[-1]))
    np.testing.assert_allclose(tiles[0], np.maximum(tile, 0), atol=1e-4)
    np.testing.assert_allclose(error, np.exp(gates.error @ h + gates.error_0), rtol=1e-4)


@pytest.mark.parametrize("denoise", [stored_gates().denoise, shrink])
def test_forces_far_above_the_noise_stay_as_they_are(denoise):
    """Else a floor in parts of the forces would be left however little noise there is."""
    row, col = np.mgrid[:WINDOW, :WINDOW] - 5.5
    edge, pad = np.where(row > 0, 1.0, 0.2), np.exp(-(row**2 + col**2) / 18)
    u = np.float32(1e5) * np.array([edge, pad], dtype=np.float32).reshape(2, -1)
    tiles, _ = denoise(u)
    assert np.linalg.norm(tiles - inner(u)) < 1e-3 * np.linalg.norm(inner(u))


@pytest.mark.parametrize(("height", "spread"), [(3.0, 9), (10.0, 2), (30.0, 1)])
def test_the_expected_error_of_shrinkage_is_the_true_one(height, spread):
    """Stein's estimate has no bias, where no force is so small that it is clipped at 0."""
    row, col = np.mgrid[:WINDOW, :WINDOW] - 5.5
    pad = 20 + height * np.exp(-(row**2 + col**2) / (2 * spread)).reshape(-1)
    noise = np.random.default_rng(0).standard_normal((2000, WINDOW**2))
    tiles, error = shrink((pad + noise).astype(np.float32))
    np.testing.assert_allclose(np.mean(error), np.mean(np.square(tiles - inner(pad))), rtol=0.02)


def test_haar_coefficients_of_one_group_are_shrunk_alike():
    """An edge along the middle is one coefficient: its gain is that of the formula."""
    window = np.where(np.mgrid[:WINDOW, :WINDOW][0] < 6, 5.0, 0.0).astype(np.float32)
    tiles, _ = shrink(window.reshape(1, -1))
    mean = gain = 2.5 * 8.0  # of the mean, and of the one detail of the coarsest group
    expected = [
        mean / (1 + (2.5 / mean**2) ** 2) / 8 + sign * gain / (1 + (7.5 / gain**2) ** 2) / 8
        for sign in (1, -1)
    ]
    np.testing.assert_allclose(tiles.reshape(8, 8)[[0, -1], 0], expected, atol=1e-5)


def written(**changes):
    stored = stored_gates()
    names = ("filters", "hidden", "hidden_0", "gates", "gates_0", "synthesis", "error", "error_0")
    arrays = {name: getattr(stored, name) for name in names} | changes
    return npz(**{name: value for name, value in arrays.items() if value is not None})


def test_a_file_gives_its_weights_again():
    read = Gates.read(written(), "mine.npz")
    np.testing.assert_array_equal(read.filters, stored_gates().filters)
    assert len(read.fingerprint) == 16


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"no archive", "mine.npz: holds no gates"),
        (written(error=None), "error"),
        (written(error_0=np.zeros(3)), r"error_0 has shape \(3,\); expected .* \(1,\)"),
        (written(hidden=np.zeros((2, 2))), "hidden has shape"),
        (written(gates_0=np.full(129, np.nan)), "gates_0 .* finite"),
        (written(filters=np.array([object()])), "holds no gates"),
    ],
)
def test_a_file_that_holds_no_gates_is_refused(content, named):
    with pytest.raises(SolverError, match=named):
        Gates.read(content, "mine.npz")


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
    bus = chain(sensor=common | skin, compressor=common, reconstructor=common | solver)
    made = [message for messages in bus.frames(20) for message in messages]
    return [message for message in made if isinstance(message, Reconstruction)]


def test_a_node_publishes_the_same_frames_by_a_batch():
    for one, other in zip(node_frames(""), node_frames("numpy"), strict=True):
        np.testing.assert_allclose(other.forces, one.forces, atol=1e-4 * 2.5)
        np.testing.assert_allclose(other.error, one.error, rtol=1e-3)
        assert one.reason == other.reason


def test_devices_and_matrices_that_are_not_there_are_refused():
    with pytest.raises(SettingsError, match="device: is not available with solver fista"):
        Reconstructor.Settings(preset="paper", device="numpy").check()
    phi = make_phi("gaussian", SHAPE[0] * SHAPE[1], 90, seed=0)
    with pytest.raises(SolverError, match='phi "gaussian" is not available there; allowed: sbhe'):
        SkinBatch([phi], HaarBasis(*SHAPE), None, 2, "numpy")
    pytest.importorskip("torch")
    with pytest.raises(SettingsError, match=r"device: 'gpu0': .* allowed: numpy, or a device"):
        solvers(FIXED, "gpu0")
