"""Rows of the scrambled block Hadamard ensemble: spread over the blocks, or drawn at random."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.checks import check_phi
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import KINDS, RANDOM, SPREAD, block_of, make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets

SIZES = st.integers(1, 700)
BLOCKS = st.sampled_from([1, 2, 4, 8, 32, 64, 256, 1024])
SEEDS = st.integers(0, 2**32 - 1)


def sbhe(n, m, seed=0, block=256, rule=SPREAD):
    return make_phi("sbhe", n, m, seed, block, rule)


def starts(phi):
    """The sum of each block is its first row."""
    ends = np.cumsum(phi.sizes)
    return ends - phi.sizes


def numbers_of(phi, rows):
    """Number of rows of each block."""
    blocks = np.searchsorted(np.cumsum(phi.sizes), rows, side="right")
    return np.bincount(blocks, minlength=len(phi.sizes))


@given(n=SIZES, data=st.data(), block=BLOCKS, seed=SEEDS)
def test_fixed_rows_are_the_sums_and_others_in_proportion(n, data, block, seed):
    m = data.draw(st.integers(1, n))
    phi = sbhe(n, m, seed, block)
    assert phi.rows.size == m
    assert (np.diff(phi.rows) > 0).all()
    assert phi.rows[0] >= 0
    assert phi.rows[-1] < n
    held = np.isin(starts(phi), phi.rows)
    sizes = np.array(phi.sizes)
    if m < len(sizes):
        # Nothing but sums, those of the largest blocks.
        assert held.sum() == m
        assert sizes[held].min() >= sizes[~held].max()
        return
    assert held.all()
    others = numbers_of(phi, phi.rows) - 1
    proportional = (m - len(sizes)) * (sizes - 1) / max(1, n - len(sizes))
    assert (np.abs(others - proportional) < 1).all()
    check_phi(phi)


@given(n=SIZES, data=st.data(), block=BLOCKS, seed=SEEDS)
def test_each_row_subset_has_rows_of_each_block_in_proportion_and_together_they_have_all(
    n, data, block, seed
):
    m = data.draw(st.integers(-(-n // 64), n))
    subsets = row_subsets(sbhe(n, m, seed, block), "rotating")
    assert len(subsets) == -(-n // m)
    times = np.zeros(n, dtype=np.intp)
    for phi in subsets:
        assert phi.rows.size == m
        assert (np.diff(phi.rows) > 0).all()
        numbers = numbers_of(phi, phi.rows)
        assert (np.abs(numbers - m * np.array(phi.sizes) / n) < 1).all()
        times[phi.rows] += 1
    assert times.min() >= 1
    assert times.max() <= 2
    check_phi(phi)


@given(n=SIZES, data=st.data(), block=BLOCKS, rule=st.sampled_from([RANDOM, SPREAD]))
def test_fewer_rows_of_one_seed_are_among_the_more(n, data, block, rule):
    few, many = sorted(data.draw(st.tuples(st.integers(1, n), st.integers(1, n))))
    phis = [sbhe(n, m, 3, block, rule) for m in (few, many)]
    np.testing.assert_array_equal(phis[0].permutation, phis[1].permutation)
    assert set(phis[0].rows) <= set(phis[1].rows)


def test_rule_1_is_that_of_version_0_1():
    for rows in ("fixed", "rotating"):
        first = row_subsets(sbhe(96, 30, 7, 32, RANDOM), rows)[0]
        assert first.fingerprint == "443e07fb12311131"  # by the code of version 0.1


def test_blocks_are_of_256_but_of_32_where_sums_are_wires_or_the_papers():
    assert {block_of(kind, None) for kind in KINDS} == {256}
    assert block_of("local:8", None) == 32
    assert block_of("local:8", 64) == 64
    phi = make_phi("sbhe", 1600, 533, 0)
    assert (phi.block, phi.rule) == (256, SPREAD)
    assert CompressorSettings(rows="paper").rows_and_m(1600) == ("fixed", 533)
