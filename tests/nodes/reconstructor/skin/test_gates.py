"""Denoisers of tiles: learned gates, Haar shrinkage by a formula."""

import numpy as np
import pytest
from damaged import npz

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.skin.formula import shrink
from sparseskin.nodes.reconstructor.skin.gates import Gates, gates_of
from sparseskin.nodes.reconstructor.skin.tiles import WINDOW, inner


def stored_gates():
    return gates_of(None)


def test_a_tile_is_the_part_that_passes_and_the_sum_of_gated_filters():
    gates = stored_gates()
    u = 3 * np.random.default_rng(0).standard_normal(WINDOW * WINDOW)
    a = gates.filters @ u
    size = 4 * ((1 + np.abs(a)) ** 0.25 - 1)
    levels = np.concatenate([np.sign(a) * size, size])
    h = np.maximum(gates.hidden @ levels + gates.hidden_0, 0)
    g = np.clip(gates.gates @ h + gates.gates_0, 0, 1)
    tiles, error = gates.denoise(u.astype(np.float32)[None])
    tile = g[-1] * inner(u) + gates.synthesis @ (a * (g[:-1] - g[-1]))
    np.testing.assert_allclose(tiles[0], np.maximum(tile, 0), atol=1e-4)
    np.testing.assert_allclose(
        error, np.exp(gates.error @ h + gates.error_0), rtol=1e-4
    )


@pytest.mark.parametrize("denoise", [stored_gates().denoise, shrink])
def test_forces_far_above_the_noise_stay_as_they_are(denoise):
    """Else a floor in parts of the forces would be left however little noise there is."""
    row, col = np.mgrid[:WINDOW, :WINDOW] - 5.5
    edge = np.where(row > 0, 1.0, 0.2)
    pad = np.exp(-(row**2 + col**2) / 18)
    u = np.float32(1e5) * np.array([edge, pad], dtype=np.float32).reshape(2, -1)
    tiles, _ = denoise(u)
    assert np.linalg.norm(tiles - inner(u)) < 1e-3 * np.linalg.norm(inner(u))


@pytest.mark.parametrize(("height", "spread"), [(3.0, 9), (10.0, 2), (30.0, 1)])
def test_the_expected_error_of_shrinkage_is_the_true_one(height, spread):
    """Stein's estimate has no bias, where no force is so small that it is clipped at 0."""
    row, col = np.mgrid[:WINDOW, :WINDOW] - 5.5
    pad = 20 + height * np.exp(-(row**2 + col**2) / (2 * spread)).reshape(-1)
    noise = np.random.default_rng(0).standard_normal((2000, WINDOW**2))
    tiles, error = shrink((pad + noise).astype(np.float32))
    np.testing.assert_allclose(
        np.mean(error), np.mean(np.square(tiles - inner(pad))), rtol=0.02
    )


def test_haar_coefficients_of_one_group_are_shrunk_alike():
    """An edge along the middle is one coefficient: its gain is that of the formula."""
    window = np.where(np.mgrid[:WINDOW, :WINDOW][0] < 6, 5.0, 0.0).astype(np.float32)
    tiles, _ = shrink(window.reshape(1, -1))
    mean = gain = 2.5 * 8.0  # of the mean, and of the one detail of the coarsest group
    expected = [
        mean / (1 + (2.5 / mean**2) ** 2) / 8
        + sign * gain / (1 + (7.5 / gain**2) ** 2) / 8
        for sign in (1, -1)
    ]
    np.testing.assert_allclose(tiles.reshape(8, 8)[[0, -1], 0], expected, atol=1e-5)


def written(**changes):
    stored = stored_gates()
    names = (
        "filters",
        "hidden",
        "hidden_0",
        "gates",
        "gates_0",
        "synthesis",
        "error",
        "error_0",
    )
    arrays = {name: getattr(stored, name) for name in names} | changes
    return npz(**{name: value for name, value in arrays.items() if value is not None})


def test_a_file_gives_its_weights_again():
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
def test_a_file_that_holds_no_gates_is_refused(content, named):
    with pytest.raises(SolverError, match=named):
        Gates.read(content, "mine.npz")
