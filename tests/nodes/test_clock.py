"""The offset of another clock: within its stated uncertainty, whatever the delays and the drift."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes import clock as clock_module
from sparseskin.nodes.clock import DRIFT_PPM, MAX_CONTRADICTIONS, ClockOffset, SystemClock

MS = 1_000_000
S = 1000 * MS


def exchange(clock, at_ns, offset_ns, there_ns, back_ns, held_ns=0):
    """One exchange that begins at `at_ns`, with a clock that is `offset_ns` ahead."""
    t2_ns = at_ns + there_ns + offset_ns
    t4_ns = at_ns + there_ns + held_ns + back_ns
    return clock.add(at_ns, t2_ns, t2_ns + held_ns, t4_ns)


@pytest.mark.parametrize(("offset_ns", "now_ns"), [(None, 1000), (0, 40), (7, 47)])
def test_the_system_clock_is_the_monotonic_one_moved_to_the_time_of_day_or_as_stated(
    monkeypatch, offset_ns, now_ns
):
    here = SimpleNamespace(time_ns=lambda: 1000, monotonic_ns=lambda: 40)
    monkeypatch.setattr(clock_module, "time", here)
    clock = SystemClock(offset_ns)
    here.time_ns = lambda: 0  # the time of day is set; the clock goes on
    assert clock.now_ns() == now_ns


@given(
    offset_ns=st.integers(-(10**18), 10**18),
    delays=st.lists(st.tuples(st.integers(0, S), st.integers(0, S)), min_size=1, max_size=100),
)
def test_the_true_offset_lies_within_the_uncertainty_however_unequal_the_delays(offset_ns, delays):
    clock = ClockOffset()
    now_ns = 0
    for there_ns, back_ns in delays:
        assert exchange(clock, now_ns, offset_ns, there_ns, back_ns)
        now_ns += there_ns + back_ns + 250 * MS
        found = clock.estimate(now_ns)
        assert abs(found.offset_ns - offset_ns) <= found.uncertainty_ns


@given(ppm=st.floats(-DRIFT_PPM, DRIFT_PPM), seconds=st.integers(1, 3600))
def test_a_drifting_clock_stays_within_the_uncertainty(ppm, seconds):
    clock = ClockOffset()
    for k in range(min(seconds, 100)):
        at_ns = k * S
        exchange(clock, at_ns, round(at_ns * ppm / 1e6), 100_000, 300_000)
    now_ns = seconds * S
    found = clock.estimate(now_ns)
    assert abs(found.offset_ns - now_ns * ppm / 1e6) <= found.uncertainty_ns + 1


@pytest.mark.parametrize(("apart_ns", "used"), [(0, True), (1, False)])
def test_an_exchange_contradicts_the_others_if_their_intervals_do_not_touch(apart_ns, used):
    clock = ClockOffset()
    exchange(clock, 0, 0, MS, MS)
    found = clock.estimate(2 * MS)
    assert exchange(clock, 0, 2 * found.uncertainty_ns + apart_ns, MS, MS) is used


def test_a_clock_that_was_set_is_estimated_anew_after_a_few_exchanges():
    clock = ClockOffset()
    for k in range(10):
        exchange(clock, k * S, 3 * S, MS, MS)
    used = [exchange(clock, (10 + k) * S, 9 * S, MS, MS) for k in range(MAX_CONTRADICTIONS)]
    assert used == [False] * (MAX_CONTRADICTIONS - 1) + [True]
    assert clock.estimate(13 * S).offset_ns == 9 * S


def test_times_that_run_backwards_are_refused():
    clock = ClockOffset()
    assert not clock.add(100, 200, 300, 99)  # the answer before the question
    assert not clock.add(100, 300, 200, 400)  # sent before it arrived
    assert not clock.add(100, 200, 900, 400)  # held for longer than the whole exchange took
    assert clock.estimate(500) is None
