"""Statistics of streams: exact means, quantiles within their bin width, the last minute."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.monitor import statistics
from sparseskin.nodes.monitor.statistics import COLUMNS, MIN_CAPACITY, SPAN_S, History, Quantiles


@given(st.lists(st.floats(1.1e3, 0.9e12), min_size=1), st.sampled_from([0.01, 0.5, 0.9, 0.99]))
def test_a_quantile_is_right_within_a_quarter_percent(values, q):
    quantiles = Quantiles()
    for value in values:
        quantiles.add(value)
    exact = np.quantile(values, q, method="inverted_cdf") / 1e6
    assert quantiles.quantile_ms(q) == pytest.approx(exact, rel=0.0026)


def row(time_s):
    """A row whose every value follows from its time."""
    return (time_s, *(time_s + k for k in range(1, len(COLUMNS))))


def filled(n_rows, period_s):
    history = History()
    for k in range(n_rows):
        history.add(*row(k * period_s))
    return history


def test_it_grows_no_further_than_its_greatest_size(monkeypatch):
    monkeypatch.setattr(statistics, "MAX_CAPACITY", 2 * MIN_CAPACITY)
    n = 5 * MIN_CAPACITY
    first, rows = filled(n, 0.0).since(0)
    assert (first, len(rows)) == (3 * MIN_CAPACITY, 2 * MIN_CAPACITY)


@given(st.integers(1, 9000), st.floats(0.0, 0.2), st.integers(0, 9000))
def test_it_is_the_end_of_a_plain_list(n_rows, period_s, n):
    history = filled(n_rows, period_s)
    plain = [row(k * period_s) for k in range(n_rows)]
    assert history.n == n_rows
    first, rows = history.since(n)
    assert first >= n
    assert [tuple(kept) for kept in rows] == plain[first:]
    oldest, _ = history.since(0)
    # Nothing of the last minute is missing: what is gone is older than that.
    assert oldest == 0 or plain[-1][0] - plain[oldest - 1][0] >= SPAN_S
