"""Orthonormal rows of any Phi."""

import numpy as np
import pytest
from stretched import Stretched

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.reconstructor.skin.rows import HadamardRows, WhitenedRows, rows_of

KINDS = ("sbhe", "gaussian", "subsample", "full", "local:4")


def made(kind):
    n, m = 144, 144 if kind == "full" else 48
    if kind == "stretched":
        return Stretched(make_phi("gaussian", n, m, seed=0))
    return make_phi(kind, n, m, seed=0)


@pytest.mark.parametrize("kind", [*KINDS, "stretched"])
def test_rows_are_orthonormal_their_adjoint_the_transpose_and_measurements_those_that_are_read(
    kind,
):
    phi = made(kind)
    rows = rows_of(phi)
    dense = np.stack([rows.forward(one) for one in np.eye(rows.n, dtype=np.float32)], axis=1)
    np.testing.assert_allclose(dense @ dense.T, np.eye(rows.n_rows), atol=1e-4)
    rng = np.random.default_rng(0)
    x = rng.standard_normal(rows.n, dtype=np.float32)
    y = rng.standard_normal(rows.n_rows, dtype=np.float32)
    assert rows.forward(x) @ y == pytest.approx(x @ rows.adjoint(y), abs=1e-3)
    found = rows.forward(x[rows.taxel])[rows.read]
    np.testing.assert_allclose(rows.values(phi.forward(x)), found, atol=1e-4)


def test_all_rows_of_a_hadamard_ensemble_are_known_and_read_in_turn():
    subsets = row_subsets(make_phi("sbhe", 144, 48, seed=0), "rotating")
    rows = rows_of(subsets[0])
    assert isinstance(rows, HadamardRows)
    read = []
    for phi in subsets:
        rows.use(phi)
        read += rows.read.tolist()
    assert sorted(set(read)) == list(range(144))


def test_directions_that_are_hardly_measured_are_left_out():
    phi = made("stretched")
    assert isinstance(phi, Stretched)
    phi.lengths[:5] = 1e-3
    rows = rows_of(phi)
    assert isinstance(rows, WhitenedRows)
    assert rows.n_rows == phi.m - 5
