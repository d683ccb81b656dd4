"""Bases of studies: orthonormal at any size, and what PyWavelets and SciPy say."""

import numpy as np
import pytest
import pywt
from hypothesis import given
from hypothesis import strategies as st
from scipy.fft import dctn

from sparseskin.checks import check_basis
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.studies.baselines.wavelets import BASES, DctBasis, WaveletBasis


def normal(shape):
    return np.random.default_rng(5).standard_normal(shape).astype(np.float32)


@given(
    name=st.sampled_from(sorted(BASES)),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
)
def test_every_basis_of_any_size_is_orthonormal(name, shape):
    check_basis(make_basis(BASES[name], *shape))


@pytest.mark.filterwarnings("ignore:Level value of 5 is too high")
@pytest.mark.parametrize("name", ["haar", "db4"])
def test_where_sides_are_powers_of_two_it_is_the_periodic_transform_of_pywavelets(name):
    image = normal((32, 32))
    coefficients = pywt.wavedec2(
        image.astype(float), name, mode="periodization", level=5
    )
    expected, _ = pywt.coeffs_to_array(coefficients)
    analysed = make_basis(BASES[name], 32, 32).analysis(image)
    np.testing.assert_allclose(analysed, expected, atol=2e-5)


def test_the_cosine_basis_is_the_transform_of_scipy():
    image = normal((28, 33))
    expected = dctn(image.astype(float), norm="ortho")
    np.testing.assert_allclose(DctBasis(28, 33).analysis(image), expected, atol=2e-5)


@pytest.mark.parametrize("name", ["bior2.2", "dmey", "nothing"])
def test_what_is_no_orthogonal_wavelet_is_refused(name):
    with pytest.raises(SolverError, match=f'basis "{name}": '):
        WaveletBasis(8, 8, wavelet=name)
