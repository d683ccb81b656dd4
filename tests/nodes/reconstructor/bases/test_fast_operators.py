"""Compiled operators: what their numpy forms are, a frame or many, and nothing allocated."""

from __future__ import annotations

import importlib.util
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.programs import run
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.bases.shifted_haar import ShiftedHaar

if importlib.util.find_spec("numba") is None:
    pytest.skip("numba is not installed (extra fast)", allow_module_level=True)

from sparseskin.nodes.reconstructor.solvers.fast import CompiledFista, CompiledProjection

SHAPES = [
    *[(1, 1), (1, 2), (2, 1), (3, 3), (1, 9), (31, 1), (5, 7), (6, 10), (2, 12)],
    *[(12, 32), (28, 28), (33, 47), (40, 40), (64, 64)],
]


def normal(*shape: int, seed: int = 5) -> Floats:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def assert_transposed(measured: Floats, v: Floats, u: Floats, spread: Floats) -> None:
    """<A u, v> = <u, A^T v>."""
    there = np.vdot(measured.astype(float), v.astype(float))
    back = np.vdot(u.astype(float), spread.astype(float))
    assert abs(there - back) <= 2e-6 * np.linalg.norm(u) * np.linalg.norm(v)


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


def allocated_bytes(function: Callable[[], object]) -> int:
    """The most that a thousand calls have at any time beyond what was there."""
    function()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        for _ in range(1000):
            function()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


def test_a_thousand_applications_allocate_no_arrays() -> None:
    """The smallest array here is of 4 x 1365 bytes; views and numbers are a few hundred."""
    n, m = 4096, 1365
    phi, basis = SbhePhi(n, m, 0), HaarBasis(64, 64)
    x, u, y = normal(1, n), normal(1, n), normal(1, m)
    image, theta = x.reshape(64, 64), u.reshape(64, 64)
    batch, thetas, measured = normal(4, 64, 64), normal(4, 64, 64), normal(4, m)
    shifted = ShiftedHaar((64, 64), np.arange(n).reshape(64, 64), n)
    shrink = shifted.shrinking(normal(n), np.array(0.01, np.float32))
    for function in (
        lambda: phi.forward(x[0], y[0]),
        lambda: phi.adjoint(y[0], x[0]),
        lambda: phi.forward(batch.reshape(4, n), measured),
        lambda: basis.analysis(image, theta),
        lambda: basis.synthesis(theta, image),
        lambda: basis.analysis(batch, thetas),
        lambda: run(shrink),
    ):
        assert allocated_bytes(function) < 4000
