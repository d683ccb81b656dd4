"""What holds of every measurement matrix: its adjoint, and its dense form."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi


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
