"""The cosine and wavelet bases: orthonormal at any size, and what PyWavelets and SciPy define."""

from __future__ import annotations

import numpy as np
import pytest
import pywt
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.fft import dctn

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import BASES, Basis, make_basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.bases.separable import DctBasis, WaveletBasis


def normal(shape: tuple[int, int], seed: int = 5) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@given(
    name=st.sampled_from(sorted(BASES)),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    seed=st.integers(0, 99),
)
@settings(max_examples=100, deadline=None)
def test_every_basis_reconstructs_any_size_and_passes_the_dot_test(
    name: str, shape: tuple[int, int], seed: int
) -> None:
    basis: Basis = make_basis(name, *shape)
    image, theta = normal(shape, seed), normal(shape, seed + 1)
    np.testing.assert_allclose(basis.synthesis(basis.analysis(image)), image, atol=2e-5)
    left = float(np.vdot(basis.analysis(image).astype(float), theta))
    right = float(np.vdot(image.astype(float), basis.synthesis(theta)))
    assert left == pytest.approx(right, abs=1e-4 * max(1.0, float(np.linalg.norm(image))) ** 2)


@pytest.mark.filterwarnings("ignore:Level value of 5 is too high")
@pytest.mark.parametrize("name", ["db2", "db4", "sym4", "coif1"])
def test_where_sides_are_powers_of_two_it_is_the_periodic_transform_of_pywavelets(
    name: str,
) -> None:
    image = normal((32, 32))
    found = pywt.wavedec2(image.astype(float), name, mode="periodization", level=5)
    expected, _ = pywt.coeffs_to_array(found)
    ours = make_basis(name, 32, 32).analysis(image)
    # The same numbers; PyWavelets transposes horizontal and vertical details in its array.
    np.testing.assert_allclose(np.sort(np.abs(ours).ravel()), np.sort(np.abs(expected).ravel()),
                               atol=2e-5)  # fmt: skip
    np.testing.assert_allclose(ours[0, 0], expected[0, 0], atol=2e-5)


def test_the_cosine_basis_is_the_transform_of_scipy() -> None:
    image = normal((28, 33))
    expected = dctn(image.astype(float), norm="ortho")
    np.testing.assert_allclose(DctBasis(28, 33).analysis(image), expected, atol=2e-5)


@pytest.mark.parametrize("shape", [(40, 40), (33, 47), (12, 32)])
def test_the_shortest_wavelet_is_the_haar_basis_up_to_signs(shape: tuple[int, int]) -> None:
    image = normal(shape)
    np.testing.assert_allclose(
        np.abs(WaveletBasis(*shape, wavelet="db1").analysis(image)),
        np.abs(HaarBasis(*shape).analysis(image)),
        atol=2e-5,
    )


def test_any_orthogonal_wavelet_is_had_by_its_name_in_the_module() -> None:
    image = normal((40, 40))
    basis = make_basis("sparseskin.nodes.reconstructor.bases.separable:sym8", 40, 40)
    np.testing.assert_allclose(basis.synthesis(basis.analysis(image)), image, atol=2e-5)


@pytest.mark.parametrize("name", ["bior2.2", "dmey", "nothing"])
def test_what_is_no_orthogonal_wavelet_is_refused(name: str) -> None:
    with pytest.raises(SolverError, match=f'basis "{name}": '):
        WaveletBasis(8, 8, wavelet=name)
