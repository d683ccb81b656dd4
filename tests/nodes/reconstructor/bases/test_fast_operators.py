"""Compiled operators: what their numpy forms are, a frame or many."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis

if importlib.util.find_spec("numba") is None:
    pytest.skip("numba is not installed (extra fast)", allow_module_level=True)

from sparseskin.nodes.reconstructor.solvers.fast import CompiledFista, CompiledProjection

SHAPES = [
    *[(1, 1), (1, 2), (2, 1), (3, 3), (1, 9), (31, 1), (5, 7), (6, 10), (2, 12)],
    *[(12, 32), (28, 28), (33, 47), (40, 40), (64, 64)],
]


def normal(*shape: int, seed: int = 5) -> Floats:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize("shape", SHAPES)
def test_haar_of_compiled_iterations_is_the_basis_of_numpy(shape: tuple[int, int]) -> None:
    """Of all measurements of an image, one step of FISTA without shrinking finds its theta."""
    n = shape[0] * shape[1]
    phi = SbhePhi(n, n, 0)
    fista = CompiledFista(phi, HaarBasis(*shape), np.ones(shape, np.bool_), 0.0)
    image, start = normal(*shape), normal(*shape, seed=6)
    fista.begin(phi.forward(image.reshape(-1)), start)
    np.testing.assert_allclose(fista.image(), start, atol=3e-6)
    fista.advance(np.zeros(1, np.float32))
    np.testing.assert_allclose(fista.image(), image, atol=3e-6)


@pytest.mark.parametrize(
    ("n", "m", "block"),
    [
        *[(1600, 533, 32), (95, 40, 32), (300, 100, 128)],
        *[(1, 1, 1), (7, 3, 4), (255, 9, 256), (300, 300, 2)],
    ],
)
def test_a_projection_is_phi_in_another_order_and_its_transpose(n: int, m: int, block: int) -> None:
    phi = SbhePhi(n, m, 1, block)
    projection = CompiledProjection(phi)
    x, y = normal(2, n), normal(m)
    rows, through, back = (np.empty(k, np.float32) for k in (n, (2, n), n))
    y.setflags(write=False)  # as measurements are that come over the wire
    projection.rows_of(y, rows)
    assert np.vdot(rows, rows) == pytest.approx(np.vdot(y, y), rel=1e-5)
    taxels = np.empty((2, n), np.float32)
    taxels[:, projection.order] = x
    projection.forward(x, through)
    for one, result in zip(taxels, through, strict=True):
        expected = np.empty(n, np.float32)
        projection.rows_of(phi.forward(one), expected)
        np.testing.assert_allclose(result, expected, atol=2e-6)
    projection.adjoint(rows, back)
    np.testing.assert_allclose(back, phi.adjoint(y)[projection.order], atol=2e-6)
