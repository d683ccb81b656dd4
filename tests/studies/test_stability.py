"""The stability study of solvers: theory, wrong matrices, faults, and its figures."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.stability import excerpts, sweeps
from sparseskin.studies.stability.excerpts import (
    BLOWN_UP_DB,
    SHAPE,
    contacts,
    count_coefficients,
    excerpt,
    psnr_of,
    touched_snr,
)
from sparseskin.studies.stability.phase import weak_threshold
from sparseskin.studies.stability.sweeps import LongRows, Sweep, failing


@pytest.mark.parametrize("delta", [0.1, 0.3, 0.5, 0.9])
def test_weak_threshold_is_where_the_cone_of_l1_has_as_many_dimensions_as_measurements(
    delta: float,
) -> None:
    # Amelunxen, Lotz, McCoy, Tropp (2014), Proposition 4.5, computed in its own way.
    share = weak_threshold(delta) * delta

    def dimension(tau: float) -> float:
        tail = quad(lambda u: (u - tau) ** 2 * math.exp(-u * u / 2), tau, tau + 12)[0]
        return share * (1 + tau**2) + (1 - share) * math.sqrt(2 / math.pi) * tail

    found = minimize_scalar(dimension, bounds=(0.0, 8.0), method="bounded")
    assert float(found.fun) == pytest.approx(delta, abs=2e-4)


def test_long_rows_make_steps_as_many_times_too_long() -> None:
    phi = LongRows(100, 30, 0, times=2.0)
    matrix = phi.dense()
    x, y = np.arange(100, dtype=np.float32) / 100, np.arange(30, dtype=np.float32) / 30
    np.testing.assert_allclose(phi.forward(x), matrix @ x, atol=1e-5)
    np.testing.assert_allclose(phi.adjoint(y), matrix.T @ y, atol=1e-5)
    np.testing.assert_allclose(matrix @ matrix.T, 2.0 * np.eye(30), atol=1e-6)


@pytest.mark.parametrize("n_coefficients", [20, 60, 250])
def test_pads_have_about_the_coefficients_that_are_asked_for(n_coefficients: int) -> None:
    for seed in range(3):
        frame = contacts(SHAPE, n_coefficients, np.random.default_rng(seed))
        count = count_coefficients(make_basis("haar", *SHAPE).analysis(frame))
        assert 0.6 * n_coefficients < count <= n_coefficients
        assert frame.min() == 0.0
        assert 0.2 <= frame.max() <= 1.5


def test_psnr_and_snr_of_what_is_perfect_void_or_blown_up() -> None:
    truth = excerpt(2)
    assert psnr_of(0.0) == 100.0
    assert psnr_of(math.inf) == BLOWN_UP_DB
    assert touched_snr(np.zeros_like(truth), truth) == pytest.approx(0.0)
    assert touched_snr(1.1 * truth, truth) == pytest.approx(20.0, abs=1e-3)
    assert touched_snr(np.full_like(truth, np.nan), truth) == BLOWN_UP_DB


@pytest.mark.parametrize("solver", SUM_SOLVERS)
def test_every_solver_can_be_put_through_every_kind_of_point(
    solver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(excerpts, "EXCERPTS", excerpts.EXCERPTS[:1])
    point = {"sweep": "bits", "value": 12, "solver": solver, "ratio": 3, "seed": 0}
    assert sweeps.measure(point)["psnr_db"] > 30.0
    asked = sweeps.points(quick=True, seed=0)
    swept = {p["sweep"] for p in asked if p["solver"] == solver}
    assert swept >= {"step", "noise", "block", "bits"}


def test_a_solver_that_diverges_is_a_figure_and_no_error() -> None:
    point = {"sweep": "step", "value": 2.5, "solver": "fista", "ratio": 3, "seed": 0}
    figures = sweeps.measure(point)
    assert figures["blown_up"] > 0.0
    assert figures["psnr_db"] < 0.0


def test_failing_is_said_on_both_sides_of_the_best_value() -> None:
    heights = {1: 40.0, 2: 44.0, 3: 45.0, 4: 43.0, 5: 41.9, 6: 30.0}
    rows = pd.DataFrame(
        {"value": v, "psnr_db": h, "touched_db": 10.0, "noisy_psnr_db": 40.0, "noisy_touched_db": 9}
        for v, h in heights.items()
    )
    assert failing(rows, Sweep("")) == "≤ 1 and ≥ 5"
    assert failing(rows[1:4], Sweep("")) == "nowhere"
    assert failing(rows, Sweep("", against_readings=True)) == "≥ 6"
