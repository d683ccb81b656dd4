"""Matrices for short wires: their operators, and that sums stay where their wires are."""

import numpy as np
import pytest

from sparseskin.checks import check_phi
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_rotating_solver

SHAPES = [(8, 8), (5, 7), (1, 9)]


def laid_out(kind, shape, m, seed=0):
    phi = make_phi(kind, shape[0] * shape[1], m, seed)
    phi.lay_out(np.ones(shape, dtype=np.bool_))
    return phi


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", ["local:4", "row_local"])
def test_row_subsets_together_measure_all_rows(kind, shape):
    n = shape[0] * shape[1]
    phi = laid_out(kind, shape, max(n // 3, shape[0] + 1))
    subsets = row_subsets(phi, "rotating")
    assert len({one.fingerprint for one in subsets}) == len(subsets) >= 2
    for one in subsets:
        assert one.m == phi.m
        check_phi(one)
    assert np.linalg.matrix_rank(np.concatenate([one.dense() for one in subsets])) == n


@pytest.mark.parametrize("side", [4, 16])
def test_a_block_sums_taxels_of_its_neighbourhood_alone(side):
    blocks = laid_out(f"local:{side}", (32, 48), 512).permutation.reshape(-1, 32)
    rows, cols = np.divmod(blocks, 48)
    # A block of 32 fills two neighbourhoods of 4 x 4, and lies within larger ones.
    n_neighbourhoods = [
        len(set(zip(r // side, c // side, strict=True))) for r, c in zip(rows, cols, strict=True)
    ]
    assert set(n_neighbourhoods) == {max(1, 32 // side**2)}
    assert np.sort(blocks.ravel()).tolist() == list(range(32 * 48))


def test_a_mask_is_laid_out_by_its_existing_taxels():
    exists = np.ones((8, 8), dtype=np.bool_)
    exists[2:5, 3:6] = False
    phi = make_phi("local:4", 55, 20, 0)
    phi.lay_out(exists)
    check_phi(phi)
    for kind in ("local:4", "adaptive", "row_local", "sbhe"):
        with pytest.raises(PhiError, match="n = 55, but 64 taxels exist"):
            make_phi(kind, 55, 20, 0).lay_out(np.ones((8, 8), dtype=np.bool_))
    with pytest.raises(PhiError, match="without gaps"):
        make_phi("row_local", 55, 20, 0).lay_out(exists)


def test_driven_sums_give_the_signs_of_a_pattern():
    """y_t = 2 s_t - s_0 of the driven sums s is what the matrix states, times sqrt(n_cols)."""
    phi = laid_out("row_local", (4, 8), 4 * 8)
    x = np.random.default_rng(0).random((4, 8)).astype(np.float32)
    driven = (phi.patterns > 0).astype(np.float64) @ x.T
    y = np.concatenate([driven[:1], 2 * driven[1:] - driven[0]]) / np.sqrt(8)
    np.testing.assert_allclose(phi.forward(x.ravel()), y.ravel(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["local:8", "row_local"])
def test_a_static_press_is_reconstructed_from_rotating_rows(kind):
    shape = (16, 16)
    press = np.zeros(shape, np.float32)
    press[4:9, 6:11] = 1.0
    subsets = row_subsets(laid_out(kind, shape, 96), "rotating")
    solver = make_rotating_solver("skin", subsets, make_basis("haar", *shape), None)
    for k in range(30):
        phi = subsets[k % len(subsets)]
        solver.use(phi)
        forces = solver.solve(phi.forward(press.ravel()))
    assert np.abs(forces - press).max() < 0.05


def test_too_few_measurements_for_a_pattern_are_refused():
    with pytest.raises(PhiError, match="m = 7 is not allowed; allowed: 8 or more"):
        laid_out("row_local", (8, 8), 7)


def test_one_pattern_of_all_columns_has_nothing_to_rotate():
    phi = laid_out("row_local", (8, 8), 8)
    assert row_subsets(phi, None) == [phi]
