"""Offsets of other clocks, and stamps of a source on the graph's clock, against known delays."""

import random
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from sparseskin.nodes import clock as clock_module
from sparseskin.nodes.clock import (
    DRIFT_PPM,
    MAX_CONTRADICTIONS,
    ClockOffset,
    SystemClock,
)
from sparseskin.nodes.sensor.device_clock import DeviceClock, line_below

MS = 1_000_000
S = 1000 * MS


def exchange(clock, at_ns, offset_ns, there_ns, back_ns, held_ns=0):
    """One exchange that begins at `at_ns`, with a clock that is `offset_ns` ahead."""
    t2_ns = at_ns + there_ns + offset_ns
    t4_ns = at_ns + there_ns + held_ns + back_ns
    return clock.add(at_ns, t2_ns, t2_ns + held_ns, t4_ns)


@pytest.mark.parametrize(("offset_ns", "now_ns"), [(None, 1000), (0, 40), (7, 47)])
def test_the_system_clock_is_the_monotonic_one_moved(monkeypatch, offset_ns, now_ns):
    here = SimpleNamespace(time_ns=lambda: 1000, monotonic_ns=lambda: 40)
    monkeypatch.setattr(clock_module, "time", here)
    clock = SystemClock(offset_ns)
    here.time_ns = lambda: 0  # the time of day is set; the clock goes on
    assert clock.now_ns() == now_ns


@given(
    offset_ns=st.integers(-(10**18), 10**18),
    delays=st.lists(
        st.tuples(st.integers(0, S), st.integers(0, S)), min_size=1, max_size=100
    ),
)
def test_the_true_offset_lies_within_the_uncertainty_however_unequal_the_delays(
    offset_ns, delays
):
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
def test_an_exchange_contradicts_the_others_if_their_intervals_do_not_touch(
    apart_ns, used
):
    clock = ClockOffset()
    exchange(clock, 0, 0, MS, MS)
    found = clock.estimate(2 * MS)
    assert exchange(clock, 0, 2 * found.uncertainty_ns + apart_ns, MS, MS) is used


def test_a_clock_that_was_set_is_estimated_anew_and_times_that_run_backwards_are_refused():
    clock = ClockOffset()
    for k in range(10):
        exchange(clock, k * S, 3 * S, MS, MS)
    used = [
        exchange(clock, (10 + k) * S, 9 * S, MS, MS) for k in range(MAX_CONTRADICTIONS)
    ]
    assert used == [False] * (MAX_CONTRADICTIONS - 1) + [True]
    assert clock.estimate(13 * S).offset_ns == 9 * S
    clock = ClockOffset()
    assert not clock.add(100, 200, 300, 99)  # the answer before the question
    assert not clock.add(100, 300, 200, 400)  # sent before it arrived
    # held for longer than the whole exchange took
    assert not clock.add(100, 200, 900, 400)
    assert clock.estimate(500) is None


JITTER = 5 * MS
SETTLED_S = 5
WITHIN = MS // 2
"""True time, arrival, and time of a frame, nanoseconds."""


@given(
    heights=st.lists(st.integers(0, 10**6), min_size=2, max_size=64),
    slope=st.floats(-1, 1),
)
def test_the_line_is_that_of_the_linear_program(heights, slope):
    points = [(1e6 * k, slope * 1e6 * k + h) for k, h in enumerate(heights)]
    found = line_below(points)
    assert found is not None
    (x0, y0), b = found
    x, y = np.array(points).T / 1e6
    left = y - (y0 / 1e6 + b * (x - x0 / 1e6))
    assert left.min() >= -1e-9
    best = linprog(
        [-len(x), -x.sum()], np.c_[np.ones(len(x)), x], y, bounds=(None, None)
    )
    assert left.sum() == pytest.approx(y.sum() + best.fun, abs=1e-6)


def run(clock, stamp, seconds, rate_hz=100, begin_s=0, seed=0):
    """Frames whose delay is uniform in 0 to 5 ms; `stamp` of a true time."""
    rng, arrived, found = random.Random(seed), 0, []
    for k in range(int(seconds * rate_hz)):
        true_ns = round(begin_s * S) + k * S // rate_hz
        arrived = max(arrived, true_ns + rng.randint(0, JITTER))
        found.append((true_ns, arrived, clock.map(stamp(true_ns), arrived)))
    return found


def check_order(readings):
    times = [time for _, _, time in readings]
    assert all(b > a for a, b in pairwise(times))
    # Frames that arrive at once are a nanosecond apart.
    assert all(time <= arrived + len(times) for _, arrived, time in readings)


def worst(readings, from_s):
    return max(abs(time - true) for true, _, time in readings if true >= from_s * S)


@settings(max_examples=25)
@given(
    ppm=st.floats(-50_000, 50_000),
    bits=st.sampled_from([None, 16, 24, 32]),
    tick_ns=st.sampled_from([1000, 250_000 / 3, 100_000]),
    first=st.integers(0, 2**32),
    rate_hz=st.sampled_from([100, 333, 1000]),
    seed=st.integers(0, 2**16),
)
def test_a_frame_soon_has_its_true_time(ppm, bits, tick_ns, first, rate_hz, seed):
    wrap = None if bits is None else 1 << bits
    clock = DeviceClock("board", pytest.fail, tick_ns, wrap)

    def stamp(true_ns):
        ticks = first + int(true_ns * (1 + ppm * 1e-6) / tick_ns)
        return ticks if wrap is None else ticks % wrap

    readings = run(clock, stamp, 12, rate_hz, seed=seed)
    check_order(readings)
    assert worst(readings, SETTLED_S) < WITHIN
    state = clock.state()
    assert (state["clock"], state["clock_restarts"]) == ("source", 0)
    tick_ppm = tick_ns / (10 * S) * 1e6
    assert (
        abs(state["clock_drift_ppm"] - ppm) < 3 * state["clock_drift_sd_ppm"] + tick_ppm
    )
    # 1.44 ms is the standard deviation of a uniform delay; frames that overtake none have less.
    assert 4 * state["clock_jitter_after_ms"] < state["clock_jitter_before_ms"] < 2


# a little back: delays alone show it, in 5 s
@pytest.mark.parametrize(
    ("set_ns", "known_s"),
    [
        (lambda true: true - 20 * S, 0.0),  # started again
        (lambda true: true + S // 10, 0.0),  # set forward
        (
            lambda true: true - S // 50,
            6.0,
        ),
    ],
)
def test_a_clock_that_was_set_is_noticed_and_mapped_anew(set_ns, known_s):
    lines = []
    clock = DeviceClock("board", lines.append)
    readings = run(clock, lambda true: true, 20)
    readings += run(clock, set_ns, 20, begin_s=20)
    check_order(readings)
    assert lines == ["board: its clock was set or started again; it is mapped anew"]
    assert clock.state()["clock_restarts"] == 1
    assert worst([one for one in readings if one[0] < 20 * S], SETTLED_S) < WITHIN
    assert worst(readings, 20 + known_s + SETTLED_S) < WITHIN


@pytest.mark.parametrize(
    "stamp", [lambda true: 2 * true, lambda true: 7, lambda true: true // MS]
)
def test_stamps_that_do_not_run_as_time_are_not_used(stamp):
    lines = []
    clock = DeviceClock("driver", lines.append)
    readings = run(clock, stamp, 15)
    check_order(readings)
    assert all(0 <= time - arrived <= len(readings) for _, arrived, time in readings)
    assert clock.state() == {"clock": "arrival", "clock_restarts": 0}
    assert ["do not run as time does, within 10%" in line for line in lines] == [True]


def test_after_a_silence_that_is_longer_than_a_line_frames_have_their_arrival_at_first():
    clock = DeviceClock("board", pytest.fail)
    run(clock, lambda true: true, 10)
    assert clock.state()["clock"] == "source"
    first, *others = run(clock, lambda true: true, 10, begin_s=60)
    assert first[1] == first[2]
    assert worst(others, 60 + SETTLED_S) < WITHIN
