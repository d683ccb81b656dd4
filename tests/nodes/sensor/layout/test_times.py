"""Units of times, stamps that rise, and the account of a source."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.layout import UnstatedError
from sparseskin.nodes.sensor.layout.tally import Tally
from sparseskin.nodes.sensor.layout.times import (
    NS,
    Stamps,
    clock_ns,
    is_time_name,
    named_unit,
    unit_of,
)

UNITS = st.sampled_from(["ns", "us", "ms", "s"])


@given(
    UNITS,
    st.lists(st.integers(0, 10**9), min_size=1, max_size=20),
    st.integers(0, 10**9),
)
def test_whole_times_become_exact_stamps_in_any_blocks(unit, steps, first):
    times = (first + np.cumsum(steps)).tolist()
    stamps = Stamps(unit)
    n = len(times) // 2
    found = [*stamps.stamps(times[:n], "f"), *stamps.stamps(times[n:], "f")]
    exact = [(time - times[0]) * NS[unit] for time in times]
    assert all(after > before for before, after in pairwise(found))
    n_repeated = sum(after == before for before, after in pairwise(exact))
    assert stamps.n_repeated >= n_repeated
    assert max(np.abs(np.subtract(found, exact))) <= stamps.n_repeated


@given(UNITS, st.floats(2.1, 95.0), st.integers(2, 50))
def test_the_unit_of_a_rate_that_only_one_unit_gives_is_found(unit, rate_hz, n):
    times = np.arange(n) * 1e9 / rate_hz / NS[unit]
    assert unit_of(times.tolist(), "f") == unit


@given(UNITS, st.floats(9.1e8, 4.1e9), st.floats(1e-3, 100))
def test_dates_have_the_unit_of_their_size(unit, first_s, step_s):
    times = (first_s + step_s * np.arange(5)) * 1e9 / NS[unit]
    assert unit_of(times.tolist(), "f") == unit


def test_a_unit_that_may_be_one_of_two_is_not_chosen():
    with pytest.raises(
        UnstatedError, match=r"time_unit=s \(0.5 Hz\) or time_unit=ms \(500 Hz\)"
    ):
        unit_of([0, 2, 4, 6], "f")


def test_times_that_fall_are_refused_with_their_frame():
    stamps = Stamps("ms")
    stamps.stamps([5, 7], "log.csv")
    with pytest.raises(SourceError, match=r"log\.csv: the time of frame 3 is before"):
        stamps.stamps([6], "log.csv")


@given(st.integers(0, 86_399), st.lists(st.integers(0, 40_000), min_size=1, max_size=9))
def test_times_of_day_go_on_at_midnight(first_s, steps_s):
    seconds = first_s + np.cumsum(steps_s)
    of_day = [int(second % 86_400) * 10**9 for second in seconds]
    found = Stamps("clock").stamps(of_day, "f")
    exact = (seconds - seconds[0]) * 10**9
    assert np.abs(found - exact).max() <= len(steps_s)


@given(
    st.integers(0, 23), st.integers(0, 59), st.integers(0, 59), st.integers(0, 999_999)
)
def test_a_time_of_day_is_read(hours, minutes, seconds, micros):
    text = f"{hours:02d}:{minutes:02d}:{seconds:02d}.{micros:06d}"
    exact = ((hours * 60 + minutes) * 60 + seconds) * 10**9 + micros * 1000
    assert clock_ns(text) == exact


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("time_ms", "ms"),
        ("t [s]", "s"),
        ("Timestamp (us)", "us"),
        ("stamp_ns", "ns"),
        ("%time", "ns"),
        ("time", ""),
        ("__time", ""),
        ("elapsed_seconds", "s"),
        ("header.stamp", ""),
        ("time_milliseconds", "ms"),
        ("time_microseconds", "us"),
        ("time_nanoseconds", "ns"),
        ("Time (msec)", "ms"),
        ("t_usecs", "us"),
        ("time_min", "min"),
        ("Time [h]", "h"),
        ("time_days", "d"),
        ("Time (hundredths of a second)", ""),
    ],
)
def test_names_of_times_state_their_unit(name, unit):
    assert is_time_name(name)
    assert named_unit(name) == unit


@pytest.mark.parametrize(
    "name", ["taxel1", "temperature", "s0", "datum", "timer2", "total"]
)
def test_other_names_are_no_times(name):
    assert not is_time_name(name)


def test_items_that_are_not_accounted_for_end_the_reading():
    tally = Tally("lines")
    tally.take(10, 5)
    tally.drop("comments", 2)
    tally.check("f")
    assert tally.text == "12 lines: 5 frames of 10 lines, 2 comments"
    with pytest.raises(SourceError, match="f: it states 13 lines, but holds 12"):
        tally.check("f", 13)
    tally.n_items += 1
    with pytest.raises(SourceError, match="13 lines were read, 12 are accounted for"):
        tally.check("f")
