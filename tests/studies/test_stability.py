"""The stability study of solvers: theory, wrong matrices, faults, and its figures."""

import math

import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.stability import excerpts, sweeps
from sparseskin.studies.stability.phase import weak_threshold
from sparseskin.studies.stability.sweeps import Sweep, failing


@pytest.mark.parametrize("delta", [0.1, 0.3, 0.5, 0.9])
def test_weak_threshold_is_where_the_cone_of_l1_has_as_many_dimensions_as_measurements(delta):
    # Amelunxen, Lotz, McCoy, Tropp (2014), Proposition 4.5, computed in its own way.
    share = weak_threshold(delta) * delta

    def dimension(tau):
        tail = quad(lambda u: (u - tau) ** 2 * math.exp(-u * u / 2), tau, tau + 12)[0]
        return share * (1 + tau**2) + (1 - share) * math.sqrt(2 / math.pi) * tail

    found = minimize_scalar(dimension, bounds=(0.0, 8.0), method="bounded")
    assert float(found.fun) == pytest.approx(delta, abs=2e-4)


@pytest.mark.parametrize("solver", SUM_SOLVERS)
def test_every_solver_can_be_put_through_every_kind_of_point(solver, monkeypatch):
    monkeypatch.setattr(excerpts, "EXCERPTS", excerpts.EXCERPTS[:1])
    point = {"sweep": "bits", "value": 12, "solver": solver, "ratio": 3, "seed": 0}
    assert sweeps.measure(point)["psnr_db"] > 30.0
    asked = sweeps.points(quick=True, seed=0)
    swept = {p["sweep"] for p in asked if p["solver"] == solver}
    assert swept >= {"step", "noise", "block", "bits"}


def test_a_solver_that_diverges_is_a_figure_and_no_error(monkeypatch):
    monkeypatch.setattr(excerpts, "EXCERPTS", excerpts.EXCERPTS[:1])
    point = {"sweep": "step", "value": 2.5, "solver": "fista", "ratio": 3, "seed": 0}
    figures = sweeps.measure(point)
    assert figures["blown_up"] > 0.0
    assert figures["psnr_db"] < 0.0


def test_failing_is_said_on_both_sides_of_the_best_value():
    heights = {1: 40.0, 2: 44.0, 3: 45.0, 4: 43.0, 5: 41.9, 6: 30.0}
    rows = pd.DataFrame(
        {"value": v, "psnr_db": h, "touched_db": 10.0, "noisy_psnr_db": 40.0, "noisy_touched_db": 9}
        for v, h in heights.items()
    )
    assert failing(rows, Sweep("")) == "≤ 1 and ≥ 5"
    assert failing(rows[1:4], Sweep("")) == "nowhere"
    assert failing(rows, Sweep("", against_readings=True)) == "≥ 6"
