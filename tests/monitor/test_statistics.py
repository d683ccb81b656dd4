"""Statistics without end: exact means, quantiles within their stated width."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.monitor.statistics import Extent, Quantiles


@given(st.lists(st.floats(-1e6, 1e6), min_size=1))
def test_extent_agrees_with_numpy(values: list[float]) -> None:
    extent = Extent()
    for value in values:
        extent.add(value)
    summary = extent.summary()
    assert summary is not None
    assert (summary["min"], summary["max"]) == (min(values), max(values))
    assert summary["mean"] == pytest.approx(np.mean(values), abs=1e-6)


@given(st.lists(st.floats(1.1e3, 0.9e12), min_size=1), st.sampled_from([0.01, 0.5, 0.9, 0.99]))
def test_a_quantile_is_right_within_a_quarter_percent(values: list[float], q: float) -> None:
    quantiles = Quantiles()
    for value in values:
        quantiles.add(value)
    exact = np.quantile(values, q, method="inverted_cdf") / 1e6
    assert quantiles.quantile_ms(q) == pytest.approx(exact, rel=0.0026)


def test_durations_outside_the_range_count_at_its_ends() -> None:
    quantiles = Quantiles()
    for value in (-5.0, 0.0, 1e15):
        quantiles.add(value)
    assert quantiles.quantile_ms(0.5) == pytest.approx(1e-3, rel=0.01)
    assert quantiles.quantile_ms(1.0) == pytest.approx(1e6, rel=0.01)


def test_nothing_added_gives_nothing() -> None:
    assert Extent().summary() is None
    assert Quantiles().summary() is None
