"""Windows and tiles of a skin: nothing is lost at any shift, and who is whose neighbour."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matrices import grids

from sparseskin.nodes.reconstructor.skin.tiles import (
    SHIFTS,
    TILE,
    WINDOW,
    Tiles,
    inner,
    nearest_taxels,
    neighbours_of,
    tiles_of,
)

NUMBERS = st.integers(0, len(SHIFTS) - 1)


def tiles_on(mask):
    return Tiles(mask.shape, np.flatnonzero(mask))


def numbered(mask):
    """A vector of taxels with the number of each, from 1 on, and the 0 behind them."""
    return np.append(np.arange(1, mask.sum() + 1), 0).astype(np.float32)


@settings(max_examples=20)
@given(mask=grids(), number=NUMBERS)
def test_tiles_of_any_shift_hold_each_taxel_once(mask, number):
    tiles = tiles_on(mask)
    vector = numbered(mask)
    cut = inner(tiles.windows(vector, number))
    np.testing.assert_array_equal(tiles.taxels(cut, number), vector[:-1])
    assert tiles.shares[number].sum() == pytest.approx(1.0)
    assert len(tiles.shares[number]) == len(cut) <= tiles.most


@settings(max_examples=20)
@given(mask=grids())
def test_the_most_tiles_are_those_of_one_more_along_each_side(mask):
    tiles = tiles_on(mask)
    assert tiles.most == max(len(share) for share in tiles.shares)
    n_windows = math.prod(-(-side // TILE) + 1 for side in mask.shape)
    assert tiles.most <= n_windows


def test_each_shift_comes_once_in_64():
    assert len(set(SHIFTS)) == TILE * TILE
    assert all(0 <= side < TILE for shift in SHIFTS for side in shift)


@settings(max_examples=15)
@given(mask=grids(), number=NUMBERS)
def test_a_window_has_two_cells_around_its_tile(mask, number):
    """A cell without a taxel reads one of its eight neighbours, or 0."""
    tiles = tiles_on(mask)
    windows = tiles.windows(numbered(mask), number).reshape(-1, WINDOW, WINDOW)
    row, col = SHIFTS[number]
    n_across = -(-(mask.shape[1] + col) // TILE)
    image = np.zeros(mask.shape)
    image[mask] = numbered(mask)[:-1]
    for k, window in enumerate(windows):
        top = TILE * (k // n_across) - row - 2
        left = TILE * (k % n_across) - col - 2
        for r, c in np.ndindex(WINDOW, WINDOW):
            place = top + r, left + c
            is_inside = all(0 <= x < n for x, n in zip(place, mask.shape, strict=True))
            if is_inside and mask[place]:
                assert window[r, c] == image[place]
            elif not is_inside:
                assert window[r, c] == 0


@settings(max_examples=20)
@given(mask=grids())
def test_a_cell_reads_the_nearest_taxel_within_one_cell(mask):
    nearest = nearest_taxels(mask)
    for row, col in np.ndindex(mask.shape):
        around = [
            (math.hypot(r - row, c - col), r * mask.shape[1] + c)
            for r, c in np.ndindex(mask.shape)
            if mask[r, c] and max(abs(r - row), abs(c - col)) <= 1
        ]
        if not around:
            assert nearest[row, col] == mask.size
            continue
        closest = min(around)[0]
        assert nearest[row, col] in [cell for far, cell in around if far == closest]


@settings(max_examples=20)
@given(mask=grids())
def test_a_missing_neighbour_is_the_taxel_itself(mask):
    tiles = tiles_on(mask)
    neighbours = neighbours_of(tiles)
    place = {cell: k for k, cell in enumerate(zip(*np.nonzero(mask), strict=True))}
    for (row, col), k in place.items():
        steps = (((1, 0), (0, 1)), ((-1, 0), (0, -1)))
        for side, axes in enumerate(steps):
            for axis, (down, across) in enumerate(axes):
                expected = place.get((row + down, col + across), k)
                assert neighbours[side, axis, k] == expected


@pytest.mark.parametrize(
    ("shape", "n_windows"), [((64, 64), 81), ((200, 64), 81), ((8, 8), 4), ((9, 8), 6)]
)
def test_on_small_skins_noise_exceeds_less(shape, n_windows):
    tiles = tiles_on(np.ones(shape, dtype=np.bool_))
    expected = math.sqrt(math.log(n_windows) / math.log(81))
    assert tiles.strictness == pytest.approx(expected)


def test_skins_that_are_alike_share_their_tiles():
    cells = np.arange(12)
    assert tiles_of((3, 4), cells) is tiles_of((3, 4), cells.copy())
    assert tiles_of((3, 4), cells) is not tiles_of((4, 3), cells)
