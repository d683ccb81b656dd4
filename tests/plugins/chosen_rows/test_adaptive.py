"""Rows that the edge chooses anew in each frame, and their tree."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matrices import grids

from sparseskin.checks import check_phi
from sparseskin.nodes.compressor.phi.base import follow, make_phi
from sparseskin.nodes.errors import PhiError
from sparseskin.plugins.chosen_rows.adaptive import AdaptiveChoice, HeldRows
from sparseskin.plugins.chosen_rows.quadtree import Quadtree


def phi_of(exists, m):
    phi = make_phi("adaptive", int(exists.sum()), m, seed=0)
    phi.lay_out(exists)
    return phi


def measured(phi, choice, x):
    return choice.measure(phi.tree.analysis(x.reshape(-1)).take)


def press(n_rows, n_cols, row, col):
    frame = np.zeros((n_rows, n_cols), np.float32)
    frame[row : row + 3, col : col + 4] = [[0.2, 0.5, 0.4, 0.1]] * 3
    return frame


@given(exists=grids(), data=st.data())
def test_m_rows_are_read_each_once_and_are_those_of_the_code(exists, data):
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    n = int(exists.sum())
    m = data.draw(st.integers(min(n, 4), n))
    phi = phi_of(exists, m)
    other = phi_of(exists, m)
    choice = AdaptiveChoice(phi)
    for _ in range(3):
        x = np.maximum(rng.normal(-0.5, 1, phi.n), 0).astype(np.float32)
        w = phi.tree.analysis(x)
        asked = []

        def read(wanted, w=w, asked=asked):
            asked.extend(wanted)
            return w[wanted]

        y = choice.measure(read)
        assert len(asked) == len(set(asked)) == m
        np.testing.assert_array_equal(np.sort(asked), phi.rows)
        np.testing.assert_array_equal(y, phi.forward(x))
        follow(other, nodes=phi.tree.coded(phi.chosen))
        np.testing.assert_array_equal(other.rows, phi.rows)


def test_a_matrix_is_dense_orthonormal_and_its_adjoint_the_transpose():
    exists = np.ones((9, 13), np.bool_)
    exists[2:5, 3] = False
    phi = phi_of(exists, 40)
    measured(phi, AdaptiveChoice(phi), np.random.default_rng(0).random(phi.n))
    check_phi(phi)
    np.testing.assert_allclose(phi.dense() @ phi.dense().T, np.eye(40), atol=1e-12)


def test_a_contact_of_few_taxels_is_measured_whole_in_its_first_frame():
    phi = phi_of(np.ones((40, 40), np.bool_), 200)
    choice = AdaptiveChoice(phi)
    held = HeldRows(phi)
    for frame in (
        np.zeros((40, 40), np.float32),
        press(40, 40, 17, 22),
        press(40, 40, 18, 23),
    ):
        y = measured(phi, choice, frame)
        held.begin()
        held.read(phi.rows, y)
        np.testing.assert_allclose(held.update(), frame.reshape(-1), atol=1e-6)
        held.end()


def test_every_row_is_read_in_a_bounded_number_of_frames():
    rng = np.random.default_rng(0)
    phi = phi_of(np.ones((16, 16), np.bool_), 64)
    choice = AdaptiveChoice(phi)
    seen = np.zeros(256, np.bool_)
    touched = np.zeros((16, 16))
    for _ in range(300):
        # A corner changes all the time, and the rest is still.
        touched[:8, :8] = rng.random((8, 8))
        touched[8:, 8:] = 0.3
        measured(phi, choice, touched)
        seen[phi.rows] = True
    assert seen.all()


def test_a_fingerprint_is_of_the_numbers_and_of_the_grid():
    grids = [np.ones(shape, np.bool_) for shape in ((10, 10), (5, 20), (20, 5))]
    prints = {phi_of(grid, m).fingerprint for grid in grids for m in (20, 30)}
    assert len(prints) == 6
    assert phi_of(grids[0], 20).fingerprint in prints


@pytest.mark.parametrize(("n", "m", "least"), [(100, 3, 4), (3, 2, 3)])
def test_fewer_measurements_than_a_sum_and_a_node_are_refused(n, m, least):
    with pytest.raises(
        PhiError, match=rf"m = {m} is not allowed; allowed: {least}\.\.{n}"
    ):
        make_phi("adaptive", n, m, seed=0)


def code_of(phi, n_nodes):
    return phi.tree.coded(np.arange(phi.tree.n_nodes) < n_nodes)


GRID = np.ones((16, 16), np.bool_)


@pytest.mark.parametrize(
    ("phi", "code", "text"),
    [
        (phi_of(GRID, 64), None, "come without the nodes of their rows"),
        (
            phi_of(GRID, 64),
            code_of(phi_of(GRID, 64), 21),
            r"nodes of 67 .* expected m = 64",
        ),
        (
            phi_of(GRID, 64),
            code_of(phi_of(GRID, 64), 19),
            r"nodes of 61 .* expected m = 64",
        ),
        (phi_of(GRID, 64), np.array([255], np.uint8), "malformed: too short"),
        (
            phi_of(GRID, 64),
            np.array([128, 0, 0], np.uint8),
            "malformed: not as it is coded",
        ),
        (
            make_phi("sbhe", 256, 64, seed=0),
            np.array([0], np.uint8),
            "measurements with nodes; ",
        ),
    ],
)
def test_nodes_that_do_not_fit_are_refused(phi, code, text):
    with pytest.raises(PhiError, match=text):
        follow(phi, nodes=code)


def dense_of(tree):
    return np.stack([tree.analysis(one) for one in np.eye(tree.n)], axis=1)


@given(exists=grids(), data=st.data())
def test_rows_are_orthonormal_and_synthesis_the_transpose_on_any_grid(exists, data):
    tree = Quadtree(exists, data.draw(st.integers(1, int(exists.sum()))))
    matrix = dense_of(tree)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(tree.n), atol=1e-12)
    rows = np.random.default_rng(0).standard_normal(tree.n)
    np.testing.assert_allclose(tree.synthesis(rows), matrix.T @ rows, atol=1e-10)
    if tree.levels:
        is_in_tile = matrix[: tree.n_tiles] != 0
        touches = (np.abs(matrix) > 1e-12).astype(int) @ is_in_tile.T.astype(int) > 0
        assert touches.sum(axis=1).tolist() == [1] * tree.n


@pytest.mark.parametrize("shape", [(1, 16), (5, 7), (31, 11)])
def test_first_rows_are_the_normalised_sums_of_tiles(shape):
    tree = Quadtree(np.ones(shape, np.bool_), shape[0] * shape[1])
    matrix = dense_of(tree)[: tree.n_tiles]
    counts = np.count_nonzero(matrix, axis=1)
    assert counts.sum() == tree.n
    np.testing.assert_allclose(matrix.max(axis=1), 1 / np.sqrt(counts))
    assert counts.max() <= 64


@given(exists=grids(), data=st.data())
def test_the_code_of_nodes_is_read_back(exists, data):
    tree = Quadtree(exists, int(exists.sum()))
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    chosen = rng.random(tree.n_nodes) < data.draw(
        st.sampled_from([0.0, 0.05, 0.5, 1.0])
    )
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
        chosen[rng.permutation(np.arange(start, tree.n_nodes))[:n_chosen]] = True
        assert tree.coded(chosen).size <= tree.most_code_bytes(m - tree.n_tiles)
