"""Rotating rows: each phase is a matrix of its own, and together they read everything."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.compressor.rotation import phases_of, turns
from sparseskin.nodes.errors import PhiError

SIZES = [(1, 1), (31, 7), (95, 40), (400, 50), (784, 262), (1600, 534), (1600, 533)]


@pytest.mark.parametrize("kind", ["sbhe", "subsample"])
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_each_phase_passes_the_dot_test_and_is_its_dense_matrix(kind: str, n: int, m: int) -> None:
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal(n).astype(np.float32), rng.standard_normal(m).astype(np.float32)
    for phi in phases_of(make_phi(kind, n, m, seed=3), "rotating"):
        forth = float(phi.forward(x).astype(float) @ y)
        back = float(x.astype(float) @ phi.adjoint(y))
        assert abs(forth - back) <= 2e-6 * float(np.linalg.norm(x) * np.linalg.norm(y))
        np.testing.assert_allclose(phi.forward(x), phi.dense() @ x, atol=2e-5)
        np.testing.assert_allclose(phi.adjoint(y), phi.dense().T @ y, atol=2e-5)


@pytest.mark.parametrize("kind", ["sbhe", "subsample"])
@pytest.mark.parametrize("ratio", [1, 2, 4, 5, 8])
def test_together_the_phases_are_w_each_row_of_it_once(kind: str, ratio: int) -> None:
    n = 800
    phases = phases_of(make_phi(kind, n, n // ratio, seed=1), "rotating")
    rows = np.concatenate([phi.rows for phi in phases])  # type: ignore[attr-defined]
    np.testing.assert_array_equal(np.sort(rows), np.arange(n))
    whole = np.concatenate([phi.dense() for phi in phases])
    np.testing.assert_allclose(whole @ whole.T, np.eye(n), atol=1e-12)


@given(n=st.integers(1, 300), data=st.data())
@settings(max_examples=80, deadline=None)
def test_every_row_has_its_turn_and_none_more_than_twice(n: int, data: st.DataObject) -> None:
    m = data.draw(st.integers(1, n))
    order = np.random.default_rng(data.draw(st.integers(0, 99))).permutation(n)
    found = turns(order, m)
    assert len(found) == -(-n // m)
    assert all(rows.size == m and (np.diff(rows) > 0).all() for rows in found)
    times = np.bincount(np.concatenate(found), minlength=n)
    assert 1 <= times.min() <= times.max() <= 2
    np.testing.assert_array_equal(found[0], np.sort(order[:m]))


def test_the_first_phase_is_the_fixed_matrix_and_the_others_are_told_apart() -> None:
    phi = make_phi("sbhe", 1600, 400, seed=2)
    phases = phases_of(phi, "rotating")
    assert phases_of(phi, "fixed") == [phi]
    assert phases[0].fingerprint == phi.fingerprint
    assert len({phase.fingerprint for phase in phases}) == 4


def test_a_ratio_that_does_not_divide_takes_no_turn_more() -> None:
    settings = CompressorSettings(rows="rotating")
    assert settings.n_measurements(1600) == 534
    assert CompressorSettings().n_measurements(1600) == 533
    assert len(phases_of(make_phi("sbhe", 1600, 534, seed=0), "rotating")) == 3


def test_what_cannot_rotate_is_named() -> None:
    for kind in ("gaussian", "full"):
        with pytest.raises(PhiError, match=f'rows: "rotating" is not allowed for phi "{kind}"'):
            CompressorSettings(phi=kind, rows="rotating").check()
        with pytest.raises(PhiError, match="allowed: sbhe, subsample"):
            phases_of(make_phi(kind, 64, 64, seed=0), "rotating")
    with pytest.raises(PhiError, match=r"m = 24 of n = 1600; allowed: m of 25 or more \(N/64\)"):
        phases_of(make_phi("sbhe", 1600, 24, seed=0), "rotating")
