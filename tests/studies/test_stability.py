"""The stability study of solvers: theory, sweeps, and their figures."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.studies.evaluate import SUM_SOLVERS
from sparseskin.studies.frames import PadFrames
from sparseskin.studies.harness import Measurement
from sparseskin.studies.stability import sweeps
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


def test_every_solver_is_swept_over_what_it_has_beside_the_readings(monkeypatch, tmp_path):
    monkeypatch.setattr(sweeps, "EXCERPTS", sweeps.EXCERPTS[:1])
    asked = {one.label: one for one in sweeps.experiments(quick=True, seed=0)}
    assert set(asked["noise"].candidates) == {*SUM_SOLVERS, "readings"}
    assert "fista: 20" in asked["iterations"].candidates
    rows = sweeps.swept(
        replace(asked["bits"], measurements=[Measurement(bits=8)]), tmp_path, "serial"
    )
    assert set(rows["solver"]) == set(SUM_SOLVERS)
    assert (rows[["value", "mean_db", "noisy_mean_db"]].min() >= [8, 30, 30]).all()
    rows = sweeps.swept(asked["iterations"], tmp_path, "serial").set_index(["solver", "value"])
    assert rows.loc[("fista", 20), "mean_db"] > rows.loc[("fista", 1), "mean_db"]


def test_failing_is_said_on_both_sides_of_the_best_value():
    heights = {1: 40.0, 2: 44.0, 3: 45.0, 4: 43.0, 5: 41.9, 6: 30.0}
    rows = pd.DataFrame(
        {"value": v, "mean_db": h, "touched_db": 10.0, "noisy_mean_db": 40.0, "noisy_touched_db": 9}
        for v, h in heights.items()
    )
    assert (failing(rows, Sweep("")), failing(rows[1:4], Sweep(""))) == ("≤ 1 and ≥ 5", "nowhere")
    assert failing(rows, Sweep("", against_readings=True)) == "≥ 6"


def test_pads_have_about_the_coefficients_asked_for_and_not_more():
    take = PadFrames(40, 60, 3, 1).open(0)
    (((first, noisy), *_),) = take.parts()
    count = np.count_nonzero(np.abs(make_basis("haar", 40, 40).analysis(first)) > 1e-4)
    assert 45 <= count <= 60
    assert 0 < np.std(noisy - first) < 0.1
