"""Fewer, larger taxels: groups of neighbours, and the interpolation that keeps their sums."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.studies.baselines.larger import LargerTaxels, neighbours


@st.composite
def masks(draw):
    """Masks of 1 to 12 rows and columns with a taxel at least."""
    shape = draw(st.tuples(st.integers(1, 12), st.integers(1, 12)))
    mask = np.random.default_rng(draw(st.integers(0, 99))).random(shape) < draw(
        st.floats(0.2, 1)
    )
    mask.flat[0] = True
    return mask


@given(masks(), st.data(), st.integers(0, 9))
def test_sums_of_groups_are_kept_and_forces_are_not_negative(mask, data, seed):
    larger = LargerTaxels(mask, data.draw(st.integers(1, int(mask.sum()))))
    taxels = (
        np.random.default_rng(seed).exponential(1.0, mask.shape).astype(np.float32)
        * mask
    )
    taxels *= np.random.default_rng(seed + 1).random(mask.shape) < 0.3
    forces = larger.reconstruct(taxels).forces
    assert (forces >= 0).all()
    assert (forces[~mask] == 0).all()
    assert np.allclose(larger.sums(forces), larger.sums(taxels), rtol=1e-4, atol=1e-5)


@given(masks(), st.data())
def test_groups_are_of_equal_size_to_within_one_taxel(mask, data):
    m = data.draw(st.integers(1, int(mask.sum())))
    sizes = np.bincount(neighbours(mask, m), minlength=m)
    assert sizes.size == m
    assert sizes.max() - sizes.min() <= 1


@pytest.mark.parametrize(("ratio", "side"), [(4, 2), (16, 4), (64, 8)])
def test_groups_of_a_square_number_are_squares(ratio, side):
    groups = neighbours(np.ones((40, 40), np.bool_), 1600 // ratio).reshape(40, 40)
    tiles = groups.reshape(40 // side, side, 40 // side, side)
    assert (tiles == tiles[:, :1, :, :1]).all()


def test_all_taxels_and_even_loads_are_as_they_are():
    taxels = np.random.default_rng(0).random((6, 7), dtype=np.float32)
    mask = np.ones(taxels.shape, np.bool_)
    assert np.allclose(
        LargerTaxels(mask, 42).reconstruct(taxels).forces, taxels, atol=1e-6
    )
    even = LargerTaxels(mask, 8).reconstruct(np.full_like(taxels, 0.7)).forces
    assert np.allclose(even, 0.7, atol=1e-5)
