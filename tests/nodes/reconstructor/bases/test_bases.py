"""Bases: orthonormal at any size, and Haar as its definition says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.checks import check_basis
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import BASES, make_basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis


def normal(shape, seed=5):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def paired(samples):
    """One level along axis 0 from the definition; also how many approximations there are."""
    pairs = len(samples) // 2
    a = samples[0 : 2 * pairs : 2]
    b = samples[1 : 2 * pairs : 2]
    approximations = np.concatenate([(a + b) / np.sqrt(2), samples[2 * pairs :]])
    return np.concatenate([approximations, (a - b) / np.sqrt(2)]), len(approximations)


def haar_by_definition(image):
    pyramid = image.astype(np.float64)
    rows, cols = pyramid.shape
    while rows > 1 or cols > 1:
        by_rows, next_rows = paired(pyramid[:rows, :cols].copy())
        by_both, next_cols = paired(by_rows.T)
        pyramid[:rows, :cols] = by_both.T
        rows = next_rows
        cols = next_cols
    return pyramid


@given(
    name=st.sampled_from(sorted(BASES)),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
)
def test_every_basis_of_any_size_is_orthonormal(name, shape):
    check_basis(make_basis(name, *shape))


@pytest.mark.parametrize("shape", [(1, 1), (31, 1), (5, 7), (12, 32)])
def test_haar_is_its_definition(shape):
    image = normal(shape)
    assert HaarBasis(*shape).analysis(image) == pytest.approx(
        haar_by_definition(image), abs=3e-6
    )


def test_wrong_shapes_and_types_are_named():
    basis = make_basis("haar", 5, 7)
    with pytest.raises(
        SolverError, match=r"image has shape \(7, 5\); expected \(5, 7\)"
    ):
        basis.analysis(normal((7, 5)))
    with pytest.raises(SolverError, match=r"coefficients has shape \(35,\)"):
        basis.synthesis(normal((35,)))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("harr", 'basis "harr" is not known.*haar'),
        ("no_such_module:Basis", "no_such_module"),
        ("collections:OrderedDict", "no basis: it lacks n_rows, n_cols, analysis"),
        ("decimal:Decimal", "does not take n_rows, n_cols"),
    ],
)
def test_what_cannot_be_made_is_named(name, said):
    with pytest.raises(SolverError, match=said):
        make_basis(name, 4, 4)


def test_a_class_of_ones_own_is_made_by_its_path():
    basis = make_basis("sparseskin.nodes.reconstructor.bases.haar:HaarBasis", 4, 6)
    assert basis.n_rows == 4
    assert basis.n_cols == 6
