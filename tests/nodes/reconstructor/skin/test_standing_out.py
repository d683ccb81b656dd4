"""What stands out of the noise: sums of squares of which a part lies beyond the skin."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matrices import grids

from sparseskin.nodes.reconstructor.skin.standing_out import (
    N_SUMS,
    deviations_of,
    scales_of,
    standing_out,
)
from sparseskin.nodes.reconstructor.skin.tiles import SHIFTS, WINDOW, Tiles

NUMBERS = st.integers(0, len(SHIFTS) - 1)
SIDES = st.integers(1, 20)


def of_shape(shape):
    return Tiles(shape, np.arange(shape[0] * shape[1]))


def squares_of(window):
    """The squares of 3, 6 and 12 cells a side of a window, one after the other."""
    square = window.reshape(WINDOW, WINDOW)
    for side in (3, 6, 12):
        for row in range(0, WINDOW, side):
            for col in range(0, WINDOW, side):
                yield square[row : row + side, col : col + side]


@settings(max_examples=20)
@given(shape=st.tuples(SIDES, SIDES), number=NUMBERS)
def test_the_variance_of_a_sum_is_the_number_of_taxels_in_its_square(shape, number):
    tiles = of_shape(shape)
    deviations = deviations_of(tiles)
    exists = tiles.windows(np.append(np.ones(shape), 0).astype(np.float32), number)
    of_windows = deviations.of_kinds[deviations.kinds[number]]
    assert of_windows.shape == (len(exists), N_SUMS)
    for window, found in zip(exists, of_windows, strict=True):
        counts = [square.sum() for square in squares_of(window)]
        np.testing.assert_allclose(found[1:] ** 2, counts, rtol=1e-6)
        assert found[0] == window.max()


@settings(max_examples=10)
@given(mask=grids(), number=NUMBERS)
def test_the_variance_of_a_sum_with_copies_of_taxels_is_at_least_its_own(mask, number):
    n = int(mask.sum())
    tiles = Tiles(mask.shape, np.flatnonzero(mask))
    deviations = deviations_of(tiles)
    of_windows = deviations.of_kinds[deviations.kinds[number]]
    read = tiles.cut(tiles.canvas, number)
    for window, found in zip(read, of_windows, strict=True):
        for square, deviation in zip(squares_of(window), found[1:], strict=True):
            copies = np.bincount(square.reshape(-1), minlength=n + 1)[:n]
            # Copies of a taxel outside of the square count, too.
            assert np.square(copies).sum() <= deviation**2 * (1 + 1e-6)


@pytest.mark.parametrize("shape", [(64, 64), (1, 400), (3, 200), (20, 20)])
def test_noise_stands_out_as_rarely_whatever_the_shape(shape):
    tiles = of_shape(shape)
    scales = scales_of(tiles)
    kinds = deviations_of(tiles).kinds
    rng = np.random.default_rng(0)
    n = shape[0] * shape[1]
    n_standing = []
    for k in range(300):
        noise = np.append(rng.standard_normal(n), 0).astype(np.float32)
        number = k % len(SHIFTS)
        part = standing_out(tiles.windows(noise, number), scales[kinds[number]])
        n_standing.append(np.count_nonzero(part))
    # Four windows of a skin of 64 x 64.
    assert 1 < np.mean(n_standing) < 6
