"""Projections: Phi itself, in another order of taxels and rows."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.reconstructor.solvers.projection import (
    PlainProjection,
    Projection,
    SbheProjection,
    make_projection,
)

CASES = [
    *[("sbhe", 1600, 533, 32), ("sbhe", 95, 40, 32), ("sbhe", 300, 100, 128)],
    *[("sbhe", 1, 1, 1), ("sbhe", 7, 3, 4), ("sbhe", 255, 9, 256), ("sbhe", 300, 300, 2)],
    *[("local:4", 144, 48, 32), ("gaussian", 143, 60, 32), ("subsample", 143, 60, 32)],
]
COMPILED = [False, *([True] if find_spec("numba") else [])]


def assert_is(projection: Projection, phi: Phi) -> None:
    """Both directions are those of the dense matrix."""
    dense = phi.dense()
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, phi.n)).astype(np.float32)
    y, z = rng.normal(size=(2, phi.m)).astype(np.float32)
    y.setflags(write=False)  # as measurements are that come over the wire
    rows, forward = np.empty((2, projection.n_rows), np.float32), np.empty(phi.n, np.float32)
    projection.rows_of(y, rows[0])
    projection.rows_of(z, rows[1])
    assert float(rows[0] @ rows[1]) == pytest.approx(float(y @ z), abs=1e-3)

    projection.adjoint(rows[0], forward)
    expected = (dense.T @ y)[projection.order] / phi.lipschitz
    np.testing.assert_allclose(forward, expected, atol=1e-5)

    through = np.empty((2, projection.n_rows), np.float32)
    projection.forward(x, through)
    for one, result in zip(x, through, strict=True):
        taxels = np.empty(phi.n)
        taxels[projection.order] = one
        projection.rows_of((dense @ taxels).astype(np.float32), rows[0])
        np.testing.assert_allclose(result, rows[0], atol=1e-4)


@pytest.mark.parametrize("compiled", COMPILED)
@pytest.mark.parametrize(("kind", "n", "m", "block"), CASES)
def test_it_is_phi_and_its_transpose(kind: str, n: int, m: int, block: int, compiled: bool) -> None:
    phi = make_phi(kind, n, m, seed=1, block=block)
    assert_is(make_projection(phi, compiled), phi)


@pytest.mark.parametrize("compiled", COMPILED)
@pytest.mark.parametrize(("kind", "block"), [("sbhe", 32), ("sbhe", 128), ("subsample", 32)])
def test_it_becomes_the_projection_of_another_row_subset_and_back(
    kind: str, block: int, compiled: bool
) -> None:
    subsets = row_subsets(make_phi(kind, 300, 100, seed=1, block=block), "rotating")
    projection = make_projection(subsets[0], compiled)
    for phi in (*subsets, subsets[0]):
        projection.use(phi)
        assert_is(projection, phi)


class OwnPhi(SbhePhi):
    """Operators that a user may have changed."""


def test_a_class_of_ones_own_is_applied_by_its_operators() -> None:
    assert isinstance(make_projection(make_phi("local:4", 64, 16, 0)), SbheProjection)
    assert isinstance(make_projection(OwnPhi(300, 100, 0)), PlainProjection)
