"""Interpolation between taxels that were read one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.compressor.phi.identity import SubsamplePhi
from sparseskin.nodes.reconstructor.bases.base import IdentityBasis
from sparseskin.plugins.chosen_rows.acts import ActsPhi
from sparseskin.plugins.chosen_rows.interpolation import InterpolationSolver


def slope(rows, cols):
    i, j = np.indices((rows, cols))
    return (0.2 + 0.03 * i + 0.01 * j).astype(np.float32)


def acts(shape, taxels):
    phi = ActsPhi(shape[0] * shape[1], len(taxels), seed=0)
    phi.choose(np.sort(taxels))
    return phi


def fixed(shape, taxels):
    phi = SubsamplePhi(shape[0] * shape[1], len(taxels), seed=0)
    phi._keep(np.sort(taxels))
    return phi


SAMPLINGS = pytest.mark.parametrize("sampled", [acts, fixed])


@SAMPLINGS
@pytest.mark.parametrize("shape", [(33, 17), (2, 2)])
def test_a_slope_is_reconstructed_from_its_corners_and_some_taxels_between(
    shape, sampled
):
    rows, cols = shape
    numbers = np.arange(rows * cols).reshape(shape)
    phi = sampled(
        shape, np.union1d(numbers[:: rows - 1, :: cols - 1], numbers[1::5, 2::7])
    )
    image = slope(rows, cols)
    restored = InterpolationSolver(phi, IdentityBasis(*shape)).solve(
        phi.forward(image.ravel())
    )
    np.testing.assert_allclose(restored, image, atol=1e-5)


@SAMPLINGS
@pytest.mark.parametrize("shape", [(1, 20), (20, 1)])
def test_a_skin_of_one_row_or_column_is_interpolated_along_it(shape, sampled):
    phi = sampled(shape, np.array([2, 9, 17]))
    image = slope(*shape)
    restored = InterpolationSolver(phi, IdentityBasis(*shape)).solve(
        phi.forward(image.ravel())
    )
    np.testing.assert_allclose(restored.ravel()[2:18], image.ravel()[2:18], atol=1e-6)
    np.testing.assert_array_equal(restored.ravel()[:2], image.ravel()[2])
    np.testing.assert_array_equal(restored.ravel()[18:], image.ravel()[17])


@given(
    rows=st.integers(1, 14),
    cols=st.integers(1, 14),
    part=st.floats(0, 1),
    seed=st.integers(0, 99),
    sampling=st.sampled_from([SubsamplePhi, ActsPhi]),
)
def test_taxels_keep_their_readings_and_the_others_lie_between(
    rows, cols, part, seed, sampling
):
    rng = np.random.default_rng(seed)
    mask = rng.random((rows, cols)) < 0.8
    mask[0, 0] = True
    n = int(mask.sum())
    phi = sampling(n, max(1, round(part * n)), seed)
    y = rng.random(phi.m).astype(np.float32)
    restored = InterpolationSolver(phi, IdentityBasis(rows, cols), mask).solve(y)
    np.testing.assert_array_equal(restored[mask][phi.rows], y)
    assert restored[mask].min() >= y.min() - 1e-6
    assert restored[mask].max() <= y.max() + 1e-6
    assert not restored[~mask].any()


def test_a_taxel_is_the_mean_of_the_lines_on_which_it_lies_between_readings():
    phi = acts((3, 3), np.array([0, 2, 6, 8]))
    y = np.array([1, 5, 2, 2], dtype=np.float32)
    restored = InterpolationSolver(phi, IdentityBasis(3, 3)).solve(y)
    np.testing.assert_allclose(
        restored[[0, 1, 1, 2], [1, 0, 2, 1]], [3, 1.5, 3.5, 2], rtol=1e-6
    )
    # The middle is on both diagonals; of its row and its column nothing is read.
    assert restored[1, 1] == pytest.approx((1.5 + 3.5) / 2)
