"""Projections: Phi itself, in another order of taxels and rows."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.reconstructor.solvers.projection import (
    PlainProjection,
    SbheProjection,
    make_projection,
)

KINDS = [
    ("sbhe", 1600, 533, 32),
    ("sbhe", 95, 40, 32),
    ("sbhe", 20, 7, 32),
    ("sbhe", 7, 7, 1),
    ("sbhe", 300, 100, 128),
    ("gaussian", 143, 60, 32),
    ("subsample", 143, 60, 32),
]


@pytest.mark.parametrize(("kind", "n", "m", "block"), KINDS)
def test_it_is_phi_and_its_transpose(kind: str, n: int, m: int, block: int) -> None:
    phi = make_phi(kind, n, m, seed=1, block=block)
    projection = make_projection(phi)
    dense = phi.dense()
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, n)).astype(np.float32)
    y, z = rng.normal(size=(2, m)).astype(np.float32)
    rows, forward = np.empty((2, projection.n_rows), np.float32), np.empty(n, np.float32)
    projection.rows_of(y, rows[0])
    projection.rows_of(z, rows[1])
    assert float(rows[0] @ rows[1]) == pytest.approx(float(y @ z), abs=1e-3)

    projection.adjoint(rows[0], forward)
    expected = (dense.T @ y)[projection.order] / phi.lipschitz
    np.testing.assert_allclose(forward, expected, atol=1e-5)

    through = np.empty((2, projection.n_rows), np.float32)
    projection.forward(x, through)
    for one, result in zip(x, through, strict=True):
        taxels = np.empty(n)
        taxels[projection.order] = one
        projection.rows_of((dense @ taxels).astype(np.float32), rows[0])
        np.testing.assert_allclose(result, rows[0], atol=1e-4)


class OwnPhi(SbhePhi):
    """Options that a user may have changed."""


def test_the_fast_way_is_for_the_built_in_phi() -> None:
    assert isinstance(make_projection(SbhePhi(300, 100, 0)), SbheProjection)
    assert isinstance(make_projection(SbhePhi(300, 100, 0, 32)), SbheProjection)
    assert isinstance(make_projection(OwnPhi(300, 100, 0)), PlainProjection)


@pytest.mark.parametrize(("kind", "block"), [("sbhe", 32), ("sbhe", 128), ("subsample", 32)])
def test_it_becomes_the_projection_of_another_row_subset_and_back(kind: str, block: int) -> None:
    n, m = 300, 100
    phases = row_subsets(make_phi(kind, n, m, seed=1, block=block), "rotating")
    projection = make_projection(phases[0])
    x = np.random.default_rng(0).normal(size=n).astype(np.float32)
    for phi in (*phases, phases[0]):
        projection.use(phi)
        rows, expected = (np.zeros((1, projection.n_rows), np.float32) for _ in range(2))
        projection.forward(x[projection.order][None], rows)
        projection.rows_of((phi.dense() @ x).astype(np.float32), expected[0])
        np.testing.assert_allclose(rows, expected, atol=1e-4)
