"""Learned gates: their formula, their file, and the tiles of a skin."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.skin.gates import (
    INNER,
    SHIFTS,
    TILE,
    WINDOW,
    Gates,
    Tiles,
    standing_out,
    stored_gates,
)


def open_gates(passed: float) -> Gates:
    """Gates that let every filter pass, each of which reads a taxel of the tile, or the tile."""
    stored = stored_gates()
    k = stored.filters.shape[0]
    filters = np.zeros_like(stored.filters)
    filters[: TILE * TILE, INNER] = np.eye(TILE * TILE)
    return replace(
        stored,
        filters=filters,
        gates=np.zeros_like(stored.gates),
        gates_0=np.append(np.ones(k), passed).astype(np.float32),
        synthesis=np.eye(TILE * TILE, k, dtype=np.float32),
        error=np.zeros_like(stored.error),
        error_0=np.array([np.log(0.25)], dtype=np.float32),
    )


def windows(count: int = 5, seed: int = 0) -> Floats:
    shape = (count, WINDOW * WINDOW)
    return 3 * np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


@pytest.mark.parametrize("passed", [0.0, 0.3, 1.0])
def test_open_gates_return_the_positive_part_of_the_tile(passed: float) -> None:
    u = windows()
    tiles, error = open_gates(passed).denoise(u)
    np.testing.assert_allclose(tiles, np.maximum(u[:, INNER], 0), atol=1e-5)
    np.testing.assert_allclose(error, 0.25, rtol=1e-3)


def test_a_tile_is_the_part_that_passes_and_the_sum_of_gated_filters() -> None:
    gates, u = stored_gates(), windows(1)[0].astype(np.float64)
    a = gates.filters @ u
    size = 4 * ((1 + np.abs(a)) ** 0.25 - 1)
    levels = np.concatenate([np.sign(a) * size, size])
    h = np.maximum(gates.hidden @ levels + gates.hidden_0, 0)
    g = np.clip(gates.gates @ h + gates.gates_0, 0, 1)
    tiles, error = gates.denoise(u.astype(np.float32)[None])
    tile = g[-1] * u[INNER] + gates.synthesis @ (a * (g[:-1] - g[-1]))
    np.testing.assert_allclose(tiles[0], np.maximum(tile, 0), atol=1e-4)
    np.testing.assert_allclose(error, np.exp(gates.error @ h + gates.error_0), rtol=1e-4)


def test_noise_alone_is_removed_and_large_forces_are_kept() -> None:
    noise = windows(400) / 3
    tiles, error = stored_gates().denoise(noise)
    assert np.mean(np.square(tiles)) < 0.02
    assert np.mean(error) < 0.05
    plate = np.full_like(noise, 50)
    kept, _ = stored_gates().denoise(plate + noise)
    assert np.mean(np.square(kept - 50)) < 1


def test_windows_in_which_nothing_stands_out_are_quiet() -> None:
    noise = windows(4000) / 3
    assert 0.01 < np.mean(standing_out(noise) > 0) < 0.1
    single, square, weak = np.zeros((3, 1, WINDOW, WINDOW), dtype=np.float32)
    single[0, 5, 5], square[0, 3:6, 6:9], weak[:] = 6, 1.5, 0.3
    for one in (single, square, weak):
        assert standing_out(one.reshape(1, -1)) == 1
        assert standing_out(one.reshape(1, -1) / 3) == 0


def test_what_stands_out_grows_without_a_jump() -> None:
    window = np.zeros((1, WINDOW * WINDOW), dtype=np.float32)
    heights = np.linspace(3, 6, 301, dtype=np.float32)
    parts = [float(standing_out(window + h * (np.arange(144) == 77))[0]) for h in heights]
    assert (parts[0], parts[-1]) == (0, 1)
    assert 0 <= np.diff(parts).min() <= np.diff(parts).max() < 0.02


def test_forces_far_above_the_noise_stay_as_they_are() -> None:
    """Else a floor in parts of the forces would be left however little noise there is."""
    row, col = np.mgrid[:WINDOW, :WINDOW] - 5.5
    edge, pad = np.where(row > 0, 1.0, 0.2), np.exp(-(row**2 + col**2) / 18)
    u = np.float32(1e5) * np.array([edge, pad], dtype=np.float32).reshape(2, -1)
    tiles, _ = stored_gates().denoise(u)
    assert np.linalg.norm(tiles - u[:, INNER]) < 1e-3 * np.linalg.norm(u[:, INNER])


def written(**changes: object) -> bytes:
    stored = stored_gates()
    names = ("filters", "hidden", "hidden_0", "gates", "gates_0", "synthesis", "error", "error_0")
    arrays = {name: getattr(stored, name) for name in names} | changes
    content = BytesIO()
    np.savez(content, **{name: value for name, value in arrays.items() if value is not None})
    return content.getvalue()


def test_a_file_gives_its_weights_again() -> None:
    read = Gates.read(written(), "mine.npz")
    np.testing.assert_array_equal(read.filters, stored_gates().filters)
    assert len(read.fingerprint) == 16


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"no archive", "mine.npz: holds no gates"),
        (written(error=None), "error"),
        (written(error_0=np.zeros(3)), r"error_0 has shape \(3,\); expected .* \(1,\)"),
        (written(hidden=np.zeros((2, 2))), "hidden has shape"),
        (written(gates_0=np.full(129, np.nan)), "gates_0 .* finite"),
        (written(filters=np.array([object()])), "holds no gates"),
    ],
)
def test_a_file_that_holds_no_gates_is_refused(content: bytes, named: str) -> None:
    with pytest.raises(SolverError, match=named):
        Gates.read(content, "mine.npz")


def test_each_shift_comes_once_in_64() -> None:
    assert len(set(SHIFTS)) == len(SHIFTS) == TILE * TILE


@given(
    n_rows=st.integers(1, 20),
    n_cols=st.integers(1, 20),
    number=st.integers(0, len(SHIFTS) - 1),
    seed=st.integers(0, 99),
)
def test_tiles_hold_each_taxel_once_and_windows_its_neighbours(
    n_rows: int, n_cols: int, number: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((n_rows, n_cols)) < 0.8
    mask[rng.integers(n_rows), rng.integers(n_cols)] = True
    n = int(mask.sum())
    places = np.full(mask.shape, n)
    places[mask] = rng.permutation(n)
    read, back, share = Tiles(mask, places, n).tables(number)
    x = np.append(rng.random(n), 0)
    inner = x[read][:, INNER]
    np.testing.assert_array_equal(inner.reshape(-1)[back], x[:-1])
    np.testing.assert_allclose(share.sum(), 1, rtol=1e-5)
    # Each cell of a window holds the taxel there, or one of its eight neighbours; 0 if none exists.
    image = np.pad(np.where(mask, x[places], 0), WINDOW)
    row, col = divmod(int(np.flatnonzero(mask)[0]), n_cols)
    at = int(back[places[row, col]])
    r, c = divmod(at % (TILE * TILE), TILE)
    window = x[read[at // (TILE * TILE)]].reshape(WINDOW, WINDOW)
    top, left = row - r - 2 + WINDOW, col - c - 2 + WINDOW
    for i, j in np.ndindex(WINDOW, WINDOW):
        near = image[top + i - 1 : top + i + 2, left + j - 1 : left + j + 2]
        inside = 0 <= top + i - WINDOW < n_rows and 0 <= left + j - WINDOW < n_cols
        if not inside or not near.any():
            assert window[i, j] == 0
        elif near[1, 1] > 0:
            assert window[i, j] == near[1, 1]
        else:
            assert window[i, j] in near[near > 0]
