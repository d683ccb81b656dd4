"""The Haar basis: orthonormal at any size, and the same as PyWavelets' where that defines one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import pywt
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.reconstructor.bases.base import Basis, IdentityBasis, make_basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis

SHAPES = [
    *[(1, 1), (1, 2), (2, 1), (2, 2), (3, 3), (1, 3), (1, 9), (9, 1), (31, 1), (5, 7), (6, 10)],
    *[(12, 32), (28, 28), (33, 31), (36, 36), (40, 40), (64, 64), (1, 200)],
]


def normal(shape: tuple[int, ...], seed: int = 5) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def paired(samples: Doubles) -> tuple[Doubles, int]:
    """One level along axis 0 from the definition; also how many approximations there are."""
    pairs = len(samples) // 2
    a, b = samples[0 : 2 * pairs : 2], samples[1 : 2 * pairs : 2]
    approximations = np.concatenate([(a + b) / np.sqrt(2), samples[2 * pairs :]])
    return np.concatenate([approximations, (a - b) / np.sqrt(2)]), len(approximations)


def haar_by_definition(image: npt.NDArray[np.float32]) -> Doubles:
    pyramid = image.astype(np.float64)
    rows, cols = pyramid.shape
    while rows > 1 or cols > 1:
        corner = pyramid[:rows, :cols].copy()
        by_rows, next_rows = paired(corner)
        by_both, next_cols = paired(by_rows.T)
        pyramid[:rows, :cols] = by_both.T
        rows, cols = next_rows, next_cols
    return pyramid


def matrix_of(basis: Basis) -> Doubles:
    """Psi, column by column."""
    n = basis.n_rows * basis.n_cols
    units = np.eye(n, dtype=np.float32).reshape(n, basis.n_rows, basis.n_cols)
    return np.stack([basis.synthesis(u).ravel() for u in units], axis=1).astype(np.float64)


@pytest.mark.parametrize("shape", SHAPES)
def test_analysis_is_the_definition(shape: tuple[int, int]) -> None:
    image = normal(shape)
    np.testing.assert_allclose(
        HaarBasis(*shape).analysis(image), haar_by_definition(image), atol=3e-6
    )


@given(n_rows=st.integers(1, 40), n_cols=st.integers(1, 40), seed=st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_any_size_is_reconstructed_keeps_lengths_and_passes_the_dot_test(
    n_rows: int, n_cols: int, seed: int
) -> None:
    basis = HaarBasis(n_rows, n_cols)
    image, theta = normal((n_rows, n_cols), seed), normal((n_rows, n_cols), seed + 1)
    coefficients = basis.analysis(image)
    np.testing.assert_allclose(coefficients, haar_by_definition(image), atol=5e-6)
    np.testing.assert_allclose(basis.synthesis(coefficients), image, atol=5e-6)
    np.testing.assert_allclose(
        np.linalg.norm(coefficients), np.linalg.norm(image), rtol=1e-5, atol=1e-6
    )
    there = float(np.vdot(coefficients.astype(float), theta.astype(float)))
    back = float(np.vdot(image.astype(float), basis.synthesis(theta).astype(float)))
    scale = float(np.linalg.norm(image) * np.linalg.norm(theta))
    assert abs(there - back) <= 2e-6 * scale


@pytest.mark.parametrize("shape", [(5, 7), (28, 28), (1, 9), (12, 32), (3, 3), (1, 1), (16, 16)])
def test_the_dense_matrix_is_orthonormal_and_analysis_its_transpose(shape: tuple[int, int]) -> None:
    basis = HaarBasis(*shape)
    psi = matrix_of(basis)
    np.testing.assert_allclose(psi.T @ psi, np.eye(len(psi)), atol=1e-6)
    image = normal(shape)
    np.testing.assert_allclose(basis.analysis(image).ravel(), psi.T @ image.ravel(), atol=5e-6)


@pytest.mark.parametrize("side", [1, 2, 4, 8, 16, 32, 64])
def test_full_depth_is_pywavelets_at_powers_of_two(side: int) -> None:
    image = normal((side, side))
    depth = side.bit_length() - 1
    theirs = pywt.wavedec2(image.astype(float), "haar", mode="periodization", level=depth)
    pyramid, _ = pywt.coeffs_to_array(theirs)
    np.testing.assert_allclose(HaarBasis(side, side).analysis(image), pyramid, atol=5e-6)


@pytest.mark.parametrize(
    ("shape", "levels"), [((28, 28), 2), ((40, 40), 3), ((12, 32), 2), ((6, 10), 1), ((2, 12), 1)]
)
def test_bands_are_pywavelets_as_long_as_sides_halve(shape: tuple[int, int], levels: int) -> None:
    image = normal(shape)
    mine = HaarBasis(*shape).analysis(image)
    bands = pywt.wavedec2(image.astype(float), "haar", mode="periodization", level=levels)[1:]
    for (below, right, diagonal), level in zip(reversed(bands), range(1, levels + 1), strict=True):
        rows, cols = shape[0] >> level, shape[1] >> level
        np.testing.assert_allclose(mine[rows : 2 * rows, :cols], below, atol=5e-6)
        np.testing.assert_allclose(mine[:rows, cols : 2 * cols], right, atol=5e-6)
        np.testing.assert_allclose(mine[rows : 2 * rows, cols : 2 * cols], diagonal, atol=5e-6)


@pytest.mark.parametrize("shape", [(64, 64), (32, 8), (16, 16)])
def test_an_even_pressure_is_one_coefficient(shape: tuple[int, int]) -> None:
    coefficients = HaarBasis(*shape).analysis(np.ones(shape, dtype=np.float32))
    assert coefficients[0, 0] == pytest.approx(np.sqrt(shape[0] * shape[1]), rel=1e-6)
    coefficients[0, 0] = 0
    np.testing.assert_allclose(coefficients, 0, atol=1e-6)


@pytest.mark.parametrize("name", ["haar", "identity"])
def test_out_is_filled_and_returned_and_the_input_left_alone(name: str) -> None:
    basis = make_basis(name, 5, 7)
    image = normal((5, 7))
    before = image.copy()
    theta, back = np.full_like(image, 9), np.full_like(image, 9)
    assert basis.analysis(image, theta) is theta
    assert basis.synthesis(theta, back) is back
    np.testing.assert_array_equal(theta, basis.analysis(image))
    np.testing.assert_array_equal(image, before)
    np.testing.assert_allclose(back, image, atol=2e-6)


def test_identity_leaves_all_as_it_is() -> None:
    image = normal((5, 7))
    basis = IdentityBasis(5, 7)
    np.testing.assert_array_equal(basis.analysis(image), image)
    np.testing.assert_array_equal(basis.synthesis(image), image)


def test_wrong_shapes_and_types_are_named() -> None:
    basis = make_basis("haar", 5, 7)
    with pytest.raises(SolverError, match=r"image has shape \(7, 5\); expected \(5, 7\)"):
        basis.analysis(normal((7, 5)))
    with pytest.raises(SolverError, match=r"coefficients has shape \(35,\)"):
        basis.synthesis(normal((35,)))
    with pytest.raises(SolverError, match="out is float64"):
        basis.analysis(normal((5, 7)), np.empty((5, 7)))  # type: ignore[arg-type]
    with pytest.raises(SolverError, match="contiguous"):
        basis.analysis(normal((5, 7)), np.empty((7, 5), dtype=np.float32).T)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("harr", 'basis "harr" is not known.*haar'),
        ("no_such_module:Basis", "no_such_module"),
        ("collections:OrderedDict", "no basis: it lacks n_rows, n_cols, analysis"),
        ("decimal:Decimal", "does not take n_rows, n_cols"),
    ],
)
def test_what_cannot_be_made_is_named(name: str, said: str) -> None:
    with pytest.raises(SolverError, match=said):
        make_basis(name, 4, 4)


def test_an_empty_grid_is_refused() -> None:
    with pytest.raises(SolverError, match="0 x 4"):
        make_basis("haar", 0, 4)


def test_a_class_of_ones_own_is_made_by_its_path() -> None:
    basis = make_basis("sparseskin.nodes.reconstructor.bases.haar:HaarBasis", 4, 6)
    assert (basis.n_rows, basis.n_cols) == (4, 6)
