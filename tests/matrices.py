"""What holds of every measurement matrix: its adjoint, and its dense form; and any grid."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Mask


@st.composite
def grids(draw: st.DrawFn) -> Mask:
    """Grids of up to 24 x 24 cells of which some are taxels, one at least."""
    rows, cols = (draw(st.integers(1, 24)) for _ in range(2))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    exists = rng.random((rows, cols)) < draw(st.sampled_from([0.1, 0.7, 1.0]))
    exists[rng.integers(rows), rng.integers(cols)] = True
    return exists


def assert_operators(phi: Phi, atol: float = 2e-5) -> None:
    """The dot test <Phi u, v> = <u, Phi^T v>, both directions as by the dense matrix, and the bound
    of its largest eigenvalue where that is more than 1.
    """
    rng = np.random.default_rng(5)
    u, v = (rng.standard_normal(size).astype(np.float32) for size in (phi.n, phi.m))
    ahead, back, dense = phi.forward(u), phi.adjoint(v), phi.dense()
    assert dense.shape == (phi.m, phi.n)
    assert dense.dtype == np.float64
    # float32 rounding, relative to the lengths of the vectors
    scale = float(np.linalg.norm(u) * np.linalg.norm(v)) * np.sqrt(phi.lipschitz)
    assert abs(float(ahead.astype(float) @ v) - float(u.astype(float) @ back)) <= 2e-6 * scale
    np.testing.assert_allclose(ahead, dense @ u, atol=atol)
    np.testing.assert_allclose(back, dense.T @ v, atol=atol)
    if phi.lipschitz != 1:
        largest = np.linalg.eigvalsh(dense @ dense.T)[-1]
        assert phi.lipschitz >= largest * (1 - 1e-6)
