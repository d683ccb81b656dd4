"""W of a quad tree: orthonormal on any grid, and the code of its nodes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matrices import grids

from sparseskin.nodes.compressor.phi.quadtree import Quadtree


def dense(tree):
    return np.stack([tree.analysis(one) for one in np.eye(tree.n)], axis=1)


@given(exists=grids(), data=st.data())
def test_rows_are_orthonormal_and_synthesis_the_transpose_on_any_grid(exists, data):
    tree = Quadtree(exists, data.draw(st.integers(1, int(exists.sum()))))
    matrix = dense(tree)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(tree.n), atol=1e-12)
    rows = np.random.default_rng(0).standard_normal(tree.n)
    np.testing.assert_allclose(tree.synthesis(rows), matrix.T @ rows, atol=1e-10)
    if tree.levels:
        outside = matrix[tree.tile_of_row] == 0
        assert np.abs(matrix[outside]).max(initial=0) < 1e-12


@pytest.mark.parametrize("shape", [(1, 16), (5, 7), (31, 11)])
def test_first_rows_are_the_normalised_sums_of_tiles(shape):
    tree = Quadtree(np.ones(shape, np.bool_), shape[0] * shape[1])
    matrix = dense(tree)[: tree.n_tiles]
    counts = np.count_nonzero(matrix, axis=1)
    assert counts.sum() == tree.n
    np.testing.assert_allclose(matrix.max(axis=1), 1 / np.sqrt(counts))
    assert counts.max() <= 64


@given(exists=grids(), data=st.data())
def test_the_code_of_nodes_is_read_back(exists, data):
    tree = Quadtree(exists, int(exists.sum()))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    chosen = rng.random(tree.n_nodes) < data.draw(st.sampled_from([0.0, 0.05, 0.5, 1.0]))
    np.testing.assert_array_equal(tree.decoded(tree.coded(chosen)), chosen)


@given(code=st.binary(min_size=1, max_size=40))
def test_any_other_code_is_refused(code):
    tree = Quadtree(np.ones((20, 20), np.bool_), 400)
    given_code = np.frombuffer(code, dtype=np.uint8)
    try:
        chosen = tree.decoded(given_code)
    except ValueError:
        return
    np.testing.assert_array_equal(tree.coded(chosen), given_code)


@pytest.mark.parametrize("m", [50, 533])
def test_a_code_has_at_most_the_stated_bytes(m):
    tree = Quadtree(np.ones((40, 40), np.bool_), m)
    n_chosen = (m - tree.n_tiles) // 3
    rng = np.random.default_rng(0)
    for start in (0, tree.levels[1].first, tree.levels[2].first):
        chosen = np.zeros(tree.n_nodes, np.bool_)
        some = np.arange(start, tree.n_nodes)
        chosen[rng.permutation(some)[:n_chosen]] = True
        assert tree.coded(chosen).size <= tree.most_code_bytes(m - tree.n_tiles)
