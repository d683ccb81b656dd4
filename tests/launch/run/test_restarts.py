"""When a node that failed is started again, and how often."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.run.restarts import ON_FAILURE, RestartPolicy, Restarts
from sparseskin.nodes.errors import SparseskinError


def test_each_restart_waits_twice_as_long_up_to_the_longest():
    policy = RestartPolicy(
        ON_FAILURE, max_restarts=10, restart_delay_s=0.5, restart_max_delay_s=5.0
    )
    restarts, waits_s = Restarts(policy), []
    for k in range(7):
        assert restarts.failed(100.0 + k, f"{k}") is None
        waits_s.append(restarts.due_s - 100.0 - k)
    assert (waits_s, restarts.total) == ([0.5, 1.0, 2.0, 4.0, 5.0, 5.0, 5.0], 7)
    assert list(restarts.failures) == [*"0123456"]


def test_by_default_a_sixth_failure_within_a_minute_is_one_too_many():
    restarts = Restarts(RestartPolicy(ON_FAILURE))
    waits_s = []
    for k in range(5):
        assert restarts.failed(100.0 + 10 * k, "died") is None
        waits_s.append(restarts.due_s - 100.0 - 10 * k)
    assert waits_s == [0.25, 0.5, 1.0, 2.0, 4.0]
    assert restarts.failed(159.9, "died")
    assert restarts.total == 5
    # A minute after the first one, one more is allowed.
    assert restarts.failed(160.0, "died") is None
    assert restarts.due_s == 160.0 + 4.0
    assert restarts.total == 6


def test_by_default_the_longest_wait_is_five_seconds_and_a_hang_ten():
    restarts = Restarts(RestartPolicy(ON_FAILURE, max_restarts=9))
    for k in range(8):
        restarts.failed(100.0, f"{k}")
    assert restarts.due_s == 105.0
    assert RestartPolicy().hang_s == 10.0
    assert not RestartPolicy().restarts


def test_a_policy_that_is_not_known_is_refused():
    with pytest.raises(SparseskinError, match="restart"):
        RestartPolicy("sometimes")


def test_why_a_node_failed_is_known_of_the_last_ten_times():
    restarts = Restarts(RestartPolicy(ON_FAILURE, max_restarts=20))
    for k in range(12):
        restarts.failed(100.0 + k, f"{k}")
    assert list(restarts.failures) == [f"{k}" for k in range(2, 12)]
    assert restarts.total == 12


def test_a_node_that_is_never_restarted_gives_no_reason_for_it():
    restarts = Restarts(RestartPolicy())
    assert restarts.failed(1.0, "died") == ""
    assert restarts.total == 0
    assert restarts.due_s is None


@pytest.mark.parametrize(
    ("key", "low", "high"),
    [
        ("max_restarts", 1, 1000),
        ("restart_window_s", 1.0, 86400.0),
        ("restart_delay_s", 0.0, 60.0),
        ("restart_max_delay_s", 0.0, 3600.0),
        ("hang_s", 0.0, 3600.0),
    ],
)
def test_numbers_of_a_policy_outside_their_range_are_refused(key, low, high):
    for allowed in (low, high):
        assert getattr(RestartPolicy(**{key: allowed}), key) == allowed
    for refused in (low - 1, high + 1):
        with pytest.raises(SparseskinError, match=key):
            RestartPolicy(**{key: refused})


@given(
    st.integers(1, 5),
    st.floats(1.0, 100.0),
    st.lists(st.floats(0.0, 50.0), max_size=40),
)
def test_no_window_holds_more_restarts_than_are_allowed(max_restarts, window_s, gaps_s):
    policy = RestartPolicy(
        ON_FAILURE, max_restarts=max_restarts, restart_window_s=window_s
    )
    restarts, done_s, now_s = Restarts(policy), [], 0.0
    for gap_s in gaps_s:
        now_s += gap_s
        given_up = restarts.failed(now_s, "")
        recent = [s for s in done_s if s > now_s - window_s]
        assert (given_up is not None) == (len(recent) >= max_restarts)
        if given_up is None:
            done_s.append(now_s)
