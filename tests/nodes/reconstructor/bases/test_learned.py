"""A learned basis: orthonormal on any grid, from a file that is checked, sparser than its start."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.nodes.errors import SettingsError, SolverError
from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.bases.learned import (
    LearnedBasis,
    draw_windows,
    learn_atoms,
    read_atoms,
)
from sparseskin.nodes.reconstructor.node import Reconstructor

GRIDS = [(40, 40), (64, 64), (28, 28), (12, 32), (33, 47), (5, 3), (1, 9), (1, 1)]


def some_atoms(tile: int = 8, seed: int = 1) -> Doubles:
    matrix = np.random.default_rng(seed).normal(size=(tile * tile, tile * tile))
    return np.linalg.qr(matrix)[0].astype(np.float64)


def normal(shape: tuple[int, int], seed: int = 2) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize("shape", GRIDS)
@pytest.mark.parametrize("tile", [2, 5, 8])
def test_it_is_orthonormal_on_any_grid(shape: tuple[int, int], tile: int) -> None:
    basis = LearnedBasis(*shape, atoms=some_atoms(tile))
    image, coefficients = normal(shape), normal(shape, 3)
    np.testing.assert_allclose(basis.synthesis(basis.analysis(image)), image, atol=1e-5)
    # The dot test: <Psi^T image, coefficients> = <image, Psi coefficients>.
    left = np.vdot(basis.analysis(image).astype(float), coefficients)
    right = np.vdot(image.astype(float), basis.synthesis(coefficients))
    assert left == pytest.approx(right, rel=1e-4, abs=1e-4)


def test_a_coefficient_is_an_atom_on_its_tile() -> None:
    atoms = some_atoms(4)
    basis = LearnedBasis(8, 12, atoms=atoms)
    coefficients = np.zeros((8, 12), np.float32)
    coefficients[4 + 1, 8 + 2] = 1  # atom 6 of the tile that begins there
    image = basis.synthesis(coefficients)
    np.testing.assert_allclose(image[4:, 8:], atoms[6].reshape(4, 4), atol=1e-6)
    assert not image[:4].any()
    assert not image[:, :8].any()


def test_a_tile_that_is_cut_off_keeps_the_first_atom() -> None:
    flat = np.full((1, 16), 0.25)
    atoms = np.linalg.qr(np.vstack([flat, np.eye(16)[1:]]).T)[0].T
    basis = LearnedBasis(6, 4, atoms=atoms)
    found = basis.analysis(np.ones((6, 4), np.float32))
    assert np.count_nonzero(np.abs(found) > 1e-5) == 2


def saved(path: Path, **arrays: Any) -> str:
    np.savez(path, **arrays)
    return str(path)


def test_it_is_had_by_the_name_of_its_file(tmp_path: Path) -> None:
    path = saved(tmp_path / "my skin.npz", atoms=some_atoms(4))
    basis = make_basis(f"learned:{path}", 10, 9)
    expected = LearnedBasis(10, 9, atoms=some_atoms(4))
    np.testing.assert_array_equal(
        basis.analysis(normal((10, 9))), expected.analysis(normal((10, 9)))
    )
    assert isinstance(basis, LearnedBasis)
    assert basis.label.startswith("learned:my_skin#")
    assert basis.label != LearnedBasis(10, 9, atoms=some_atoms(4, seed=7), name="my skin").label


def test_a_file_that_is_none_is_named_in_one_line(tmp_path: Path) -> None:
    text = tmp_path / "text.npz"
    text.write_text("not an archive")
    array = tmp_path / "array.npz"
    with array.open("wb") as file:
        np.save(file, np.eye(4))
    nan, off = some_atoms(2), some_atoms(2)
    nan[1, 1] = np.nan
    off[0] *= 1.01
    os.mkfifo(tmp_path / "pipe.npz")
    cases = {
        str(tmp_path / "missing.npz"): "No such file",
        str(tmp_path / "pipe.npz"): "is no regular file",
        str(tmp_path): "Is a directory",
        str(text): "no file of learn-basis",
        str(array): "no file of learn-basis",
        saved(tmp_path / "other.npz", forces=np.eye(4)): "no file of learn-basis",
        saved(tmp_path / "shape.npz", atoms=np.eye(5)): r"of shape \(5, 5\); expected float",
        saved(tmp_path / "whole.npz", atoms=np.eye(4, dtype=int)): "atoms are int64",
        saved(tmp_path / "small.npz", atoms=np.eye(1)): r"tiles of 1; allowed: 2\.\.32",
        saved(tmp_path / "nan.npz", atoms=nan): "not finite",
        saved(tmp_path / "off.npz", atoms=off): "not orthonormal: off by 0.02",
        saved(tmp_path / "pickle.npz", atoms=np.array([{}])): "no file of learn-basis",
    }
    for path, said in cases.items():
        with pytest.raises(SolverError, match=said) as raised:
            read_atoms(path)
        assert str(raised.value).startswith(f'basis "learned:{path}": ')
        assert "\n" not in str(raised.value)


def test_a_launch_file_is_refused_before_anything_starts_where_its_file_is_missing() -> None:
    with pytest.raises(SettingsError, match=r'basis: basis "learned:nowhere\.npz": No such'):
        Reconstructor.Settings(basis="learned:nowhere.npz").check()


def test_only_a_launch_file_can_name_a_file(tmp_path: Path) -> None:
    path = saved(tmp_path / "b.npz", atoms=some_atoms(4))
    settings = Reconstructor.Settings(basis=f"learned:{path}")
    settings.check()
    assert settings.changed({"iterations": 5}).basis == settings.basis
    with pytest.raises(SettingsError, match="is not allowed while the graph runs"):
        Reconstructor.Settings().changed({"basis": f"learned:{path}"})


def sparse_windows(k: int, seed: int = 4) -> tuple[Doubles, Doubles]:
    """Windows that are one to three of some atoms each, and the atoms."""
    rng = np.random.default_rng(seed)
    atoms = some_atoms(4, seed)
    coefficients = np.zeros((k, 16))
    for row in coefficients:
        n_atoms = rng.integers(1, 4)
        row[rng.permutation(16)[:n_atoms]] = rng.uniform(0.5, 2, n_atoms)
    return coefficients @ atoms, atoms


def test_atoms_that_windows_were_made_of_are_found_again() -> None:
    windows, atoms = sparse_windows(2000)
    found = learn_atoms(windows, 0.7)
    np.testing.assert_allclose(found @ found.T, np.eye(16), atol=1e-10)
    # Each one, but for its sign and its number.
    assert np.abs(found @ atoms.T).max(axis=0).min() > 0.999


def test_atoms_are_sorted_by_the_energy_they_hold() -> None:
    windows, _ = sparse_windows(500)
    energy = np.square(windows @ learn_atoms(windows, 0.1).T).sum(axis=0)
    assert (np.diff(energy) <= 1e-9).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), tile=st.integers(2, 6))
def test_windows_are_pieces_of_frames_with_a_force_and_no_missing_taxel(
    seed: int, tile: int
) -> None:
    rng = np.random.default_rng(seed)
    frames = [rng.random((9, 11)).astype(np.float32) * (rng.random((9, 11)) < 0.2) for _ in "ab"]
    mask = np.ones((9, 11), np.bool_)
    mask[0, :] = mask[:, 0] = False
    frames[0][0, :] = frames[1][0, :] = 7.0  # where no taxel is
    windows = draw_windows(frames, mask, tile, 0.05, np.random.default_rng(seed))
    assert windows.shape[1] == tile * tile
    assert (windows.max(axis=1) > 0.05).all()
    assert windows.max() < 7
    again = draw_windows(frames, mask, tile, 0.05, np.random.default_rng(seed))
    np.testing.assert_array_equal(windows, again)


def test_a_tile_that_does_not_fit_and_frames_without_a_force_are_refused() -> None:
    frames = [np.zeros((9, 11), np.float32)]
    rng = np.random.default_rng(0)
    with pytest.raises(SolverError, match=r"tile: 10 .* frames of 9 x 11; allowed: 2\.\.9"):
        draw_windows(frames, None, 10, 0.05, rng)
    with pytest.raises(SolverError, match=r"no window of 8 x 8 taxels has a force above 0\.05"):
        draw_windows(frames, None, 8, 0.05, rng)
