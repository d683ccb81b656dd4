"""Solvers in compiled loops: the forces that numpy finds, on any skin, and never compiled late."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from pressed import noisy, sliding_disc

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.numerics import compiled as fast
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import Solver, make_solver

if importlib.util.find_spec("numba") is None:
    pytest.skip("numba is not installed (extra fast)", allow_module_level=True)

from sparseskin.nodes.numerics import kernels as fast_kernels
from sparseskin.nodes.reconstructor.solvers.fast import CompiledFista, CompiledProjection

GRIDS = [
    ((28, 28), 60),
    ((12, 32), 0),
    ((33, 47), 100),
    ((40, 40), 0),
    ((64, 64), 0),
    ((15, 21), 0),
]
SMOOTH_FIRST = (33, 47)


def mask_of(shape: tuple[int, int], n_missing: int) -> Mask:
    mask = np.ones(shape, dtype=np.bool_)
    mask.reshape(-1)[np.random.default_rng(0).permutation(mask.size)[:n_missing]] = False
    return mask


def made(name: str, phi: SbhePhi, mask: Mask, how: str) -> Solver:
    return make_solver(name, phi, make_basis("haar", *mask.shape), mask, fast=how)


def streams(name: str, mask: Mask, ratio: int, n_frames: int = 25) -> tuple[Floats, Floats, Floats]:
    """A stream restored in compiled loops, with numpy, and with numpy from measurements that differ
    by 1e-7 N."""
    n = int(mask.sum())
    phi = SbhePhi(n, n // ratio, 0)
    y = phi.forward((noisy(sliding_disc(mask.shape, n_frames)) * mask)[:, mask])
    nudged = y + np.random.default_rng(0).normal(scale=1e-7, size=y.shape).astype(np.float32)
    solvers = [made(name, phi, mask, how) for how in ("on", "off", "off")]
    ways = zip(solvers, (y, y, nudged), strict=True)
    on, off, other = (np.array([solver.solve(one) for one in given]) for solver, given in ways)
    return on, off, other


@pytest.mark.parametrize(("shape", "n_missing"), GRIDS)
def test_fista_finds_the_forces_of_numpy_to_within_10_micronewtons(
    shape: tuple[int, int], n_missing: int
) -> None:
    on, off, _ = streams("fista", mask_of(shape, n_missing), 3)
    assert on.max() > 0.1
    np.testing.assert_allclose(on, off, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("shape", "n_missing"), GRIDS)
def test_skin_finds_the_forces_of_numpy_to_within_10_micronewtons(
    shape: tuple[int, int], n_missing: int
) -> None:
    """A frame of 30 iterations from nothing at first contact may be off by some more.

    The first frames of one grid are estimated by the smooth model, whose conjugate gradients
    amplify rounding: there, compiled loops are as near to numpy as numpy is to itself.
    """
    on, off, nudged = streams("skin", mask_of(shape, n_missing), 3)
    assert on.max() > 0.1
    error = np.abs(on - off).max(axis=(1, 2))
    by_rounding = np.abs(nudged - off).max(axis=(1, 2))
    most = (1e-5, 5e-5)
    if shape == SMOOTH_FIRST:
        most = 10 * np.median(by_rounding), 10 * by_rounding.max()
    assert np.median(error) < most[0]
    assert error.max() < most[1]


@pytest.mark.parametrize(("shape", "n_missing"), [((33, 47), 100), ((40, 40), 0)])
def test_skin_finds_the_forces_of_numpy_where_rows_rotate(
    shape: tuple[int, int], n_missing: int
) -> None:
    """Rows of earlier frames count in either way, blocks of the last taxels included.

    Frames of nearly 30 iterations amplify rounding, by how much the kernel of BLAS decides: in each
    frame, compiled loops are as near to numpy as numpy is to itself with measurements that differ
    by 1e-7 N. Conjugate gradients amplify it by far more: frames from the first on that the smooth
    model estimates are not compared.
    """
    mask = mask_of(shape, n_missing)
    n = int(mask.sum())
    phases = row_subsets(SbhePhi(n, -(-n // 3), 3), "rotating")
    solvers = [made("skin", phases[0], mask, how) for how in ("on", *["off"] * 4)]
    rng = np.random.default_rng(0)
    errors, by_rounding = [], []
    for k, frame in enumerate(noisy(sliding_disc(shape, 25)) * mask):
        phi = phases[k % 3]
        y = phi.forward(frame[mask])
        nudges = rng.normal(scale=1e-7, size=(3, y.size)).astype(np.float32)
        on, off, *others = map(_solved, solvers, [phi] * 5, [y, y, *(y + nudges)])
        if any(getattr(solver, "model") == "smooth" for solver in solvers):  # noqa: B009
            break
        errors.append(float(np.abs(on - off).max()))
        by_rounding.append(float(np.abs(others - off).max()))
    assert len(errors) > 8  # three frames of the contact at least
    assert max(errors[:5]) < 1e-5  # before the contact
    assert (np.array(errors) < 5 * np.array(by_rounding)).all()


def _solved(solver: Solver, phi: Phi, y: Floats) -> Floats:
    solver.use(phi)
    return solver.solve(y)


def test_where_numpy_itself_depends_on_rounding_skin_is_as_near_as_numpy_is_to_itself() -> None:
    """At N/8 measurements that differ by 1e-7 N give other thresholds, and other forces."""
    mask = np.ones((40, 40), dtype=np.bool_)
    phi = SbhePhi(1600, 200, 0)
    truth = sliding_disc((40, 40), 25)
    y = phi.forward(noisy(truth).reshape(-1, 1600))
    nudge = np.random.default_rng(0).normal(scale=1e-7, size=y.shape).astype(np.float32)
    on, off, nudged = (made("skin", phi, mask, how) for how in ("on", "off", "off"))
    found = np.array(
        [
            [on.solve(one), off.solve(one), nudged.solve(one + more)]
            for one, more in zip(y, nudge, strict=True)
        ]
    )
    error = np.sqrt(np.mean((found[:, 0] - found[:, 1]) ** 2))
    by_rounding = np.sqrt(np.mean((found[:, 2] - found[:, 1]) ** 2))
    assert error < 10 * by_rounding
    # Rounding is no relevant part of the error of a reconstruction: 1 % of its energy at most.
    assert error < 0.1 * np.sqrt(np.mean((found[:, 1] - truth) ** 2))


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_a_hundred_frames_compile_nothing(name: str) -> None:
    loops = [f for f in vars(fast_kernels).values() if hasattr(f, "signatures")]
    mask = mask_of((20, 20), 7)
    phi = SbhePhi(393, 131, 0)
    solver = made(name, phi, mask, "on")
    before = [len(f.signatures) for f in loops]
    assert all(len(f.signatures) == 1 for f in fast_kernels.LOOPS[name])
    for frame in noisy(sliding_disc((20, 20), 100)):
        y = phi.forward(frame[mask])
        y.setflags(write=False)
        solver.solve(y)
    assert [len(f.signatures) for f in loops] == before


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_off_gives_the_bits_of_an_installation_without_numba(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mask = np.ones((16, 16), dtype=np.bool_)
    phi = SbhePhi(256, 85, 0)
    y = phi.forward(noisy(sliding_disc((16, 16), 12)).reshape(-1, 256))
    off = made(name, phi, mask, "off")
    monkeypatch.setattr(fast, "find_spec", lambda module: None)
    monkeypatch.delenv(fast.ENVIRONMENT, raising=False)
    without = made(name, phi, mask, "auto")
    for one in y:
        np.testing.assert_array_equal(off.solve(one), without.solve(one))


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_the_same_measurements_give_the_same_bits_again(name: str) -> None:
    mask = np.ones((24, 24), dtype=np.bool_)
    phi = SbhePhi(576, 192, 0)
    y = phi.forward(noisy(sliding_disc((24, 24), 12)).reshape(-1, 576))
    solver, other = made(name, phi, mask, "on"), made(name, phi, mask, "on")
    first = [solver.solve(one) for one in y]
    np.testing.assert_array_equal(first, [other.solve(one) for one in y])


def test_frames_in_pieces_and_at_once_are_the_same_to_the_bit() -> None:
    mask = np.ones((12, 32), dtype=np.bool_)
    phi = SbhePhi(384, 128, 0)
    pieces, whole = made("fista", phi, mask, "on"), made("fista", phi, mask, "on")
    for frame in noisy(sliding_disc((12, 32), 8)):
        y = phi.forward(frame.reshape(-1))
        pieces.setup(y)
        for _ in range(pieces.n_steps):
            pieces.step()
        np.testing.assert_array_equal(pieces.finish(), whole.solve(y))


class OwnPhi(SbhePhi):
    """Options that a user may have changed."""


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_a_phi_of_ones_own_and_others_go_the_way_of_numpy(name: str) -> None:
    basis = make_basis("haar", 8, 8)
    for phi in (OwnPhi(64, 30, 0), make_phi("gaussian", 64, 30, 0)):
        solver = make_solver(name, phi, basis, fast="on")
        off = make_solver(name, phi, basis, fast="off")
        parts = [*vars(solver).values()]
        assert not any(isinstance(p, (CompiledFista, CompiledProjection)) for p in parts)
        y = phi.forward(np.abs(phi.dense()[0]).astype(np.float32))
        np.testing.assert_array_equal(solver.solve(y), off.solve(y))


def test_a_solver_without_compiled_loops_takes_the_setting_and_refuses_a_wrong_word() -> None:
    phi, basis = SbhePhi(64, 30, 0), make_basis("haar", 8, 8)
    assert make_solver("ista", phi, basis, fast="on").solve(np.zeros(30, np.float32)).max() == 0
    with pytest.raises(SettingsError, match="fast: 'yes' is not known"):
        make_solver("ista", phi, basis, fast="yes")


@pytest.mark.parametrize("name", ["skin", "fista"])
def test_a_skin_beyond_16_bits_is_compiled_too_and_finds_the_forces_of_numpy(name: str) -> None:
    """2^16 cells need 2^16 + 1 places, one for those without a taxel."""
    mask = mask_of((256, 256 if name == "skin" else 264), 100)
    n = int(mask.sum())
    phi = SbhePhi(n, n // 3, 0)
    on, off = (made(name, phi, mask, how) for how in ("on", "off"))
    parts = vars(on).values()
    assert any(isinstance(p, (CompiledFista, CompiledProjection)) for p in parts)
    for frame in noisy(sliding_disc(mask.shape, 4)) * mask:
        y = phi.forward(frame[mask])
        np.testing.assert_allclose(on.solve(y), off.solve(y), rtol=0, atol=5e-5)


def test_rotating_rows_give_what_numpy_gives() -> None:
    phi = SbhePhi(1600, 533, 0)
    phases = phi.row_subsets()
    taxels = noisy(sliding_disc((40, 40), 20)).reshape(-1, 1600)
    mask = np.ones((40, 40), dtype=np.bool_)
    on, off = made("skin", phi, mask, "on"), made("skin", phi, mask, "off")
    errors = []
    for t, frame in enumerate(taxels):
        one = phases[t % len(phases)]
        y = one.forward(frame)
        on.use(one)
        off.use(one)
        errors.append(np.abs(on.solve(y) - off.solve(y)).max())
    assert np.median(errors) < 1e-5
