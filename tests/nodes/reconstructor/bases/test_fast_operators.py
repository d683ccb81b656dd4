"""Compiled operators: what their numpy forms are, a frame or many, and nothing allocated."""

from __future__ import annotations

import importlib.util
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import PhiError, SolverError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.programs import run
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.bases.shifted_haar import ShiftedHaar

if importlib.util.find_spec("numba") is None:
    pytest.skip("numba is not installed (extra fast)", allow_module_level=True)

from sparseskin.nodes.compressor.phi.sbhe import CompiledSbhe
from sparseskin.nodes.reconstructor.bases.fast_haar import CompiledHaar
from sparseskin.nodes.reconstructor.solvers.fast import CompiledProjection

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
def test_haar_is_the_basis_of_numpy_and_its_transpose(shape: tuple[int, int]) -> None:
    n = shape[0] * shape[1]
    basis, compiled = HaarBasis(*shape), CompiledHaar(*shape)
    images, thetas = normal(3, n), normal(3, n, seed=6)
    found, back = np.empty_like(images), np.empty_like(images)
    compiled.analysis(images, found)
    compiled.synthesis(thetas, back)
    expected = basis.analysis(images.reshape(3, *shape)).reshape(3, n)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    np.testing.assert_allclose(
        back, basis.synthesis(thetas.reshape(3, *shape)).reshape(3, n), atol=2e-6
    )
    assert_transposed(found, thetas, images, back)


@given(n=st.integers(1, 300), data=st.data(), block=st.sampled_from([1, 2, 4, 8, 32, 64, 256]))
@settings(max_examples=60, deadline=None)
def test_sbhe_of_any_size_and_block_is_that_of_numpy_and_its_transpose(
    n: int, data: st.DataObject, block: int
) -> None:
    m = data.draw(st.integers(1, n))
    phi = SbhePhi(n, m, data.draw(st.integers(0, 2**32 - 1)), block)
    compiled = CompiledSbhe(phi)
    x, y = normal(2, n), normal(2, m, seed=6)
    measured = compiled.forward(x, np.empty((2, m), np.float32))
    spread = compiled.adjoint(y, np.empty((2, n), np.float32))
    np.testing.assert_allclose(measured, phi.forward(x), atol=2e-6)
    np.testing.assert_allclose(spread, phi.adjoint(y), atol=2e-6)
    assert_transposed(measured, y, x, spread)


@pytest.mark.parametrize(("n", "m", "block"), [(1600, 533, 32), (95, 40, 32), (300, 100, 128)])
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


def test_a_frame_gives_the_same_bits_alone_and_in_a_batch() -> None:
    haar, phi = CompiledHaar(28, 28), CompiledSbhe(SbhePhi(784, 261, 0))
    x = normal(5, 784)
    many, one = np.empty_like(x), np.empty((1, 784), np.float32)
    y_many, y_one = np.empty((5, 261), np.float32), np.empty((1, 261), np.float32)
    haar.analysis(x, many)
    phi.forward(x, y_many)
    for k in range(5):
        np.testing.assert_array_equal(haar.analysis(x[k : k + 1], one)[0], many[k])
        np.testing.assert_array_equal(phi.forward(x[k : k + 1], y_one)[0], y_many[k])


def test_wrong_shapes_and_types_are_named() -> None:
    haar, phi = CompiledHaar(5, 7), CompiledSbhe(SbhePhi(35, 12, 0))
    with pytest.raises(SolverError, match=r"shape \(35,\); expected .* shape \(35, 35\)"):
        haar.analysis(normal(35), normal(35))
    with pytest.raises(SolverError, match="float64"):
        haar.synthesis(normal(1, 35), np.empty((1, 35)))  # type: ignore[arg-type]
    with pytest.raises(PhiError, match=r"shape \(1, 35\); expected .* shape \(1, 12\)"):
        phi.forward(normal(1, 35), normal(1, 35))
    with pytest.raises(PhiError, match="writable"):
        phi.adjoint(normal(2, 24)[:, ::2], normal(2, 35))


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
    compiled, haar = CompiledSbhe(phi), CompiledHaar(64, 64)
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
        lambda: compiled.forward(x, y),
        lambda: compiled.adjoint(y, x),
        lambda: haar.analysis(x, u),
        lambda: haar.synthesis(u, x),
    ):
        assert allocated_bytes(function) < 4000
