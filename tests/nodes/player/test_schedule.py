"""Times at which recorded messages are due: no accumulated error, no jump at a pause."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.player.schedule import Schedule

MS = 1_000_000


@pytest.mark.parametrize("rate", [0.1, 1.0, 10.0])
def test_targets_are_absolute(rate: float) -> None:
    schedule = Schedule(first_ns=500, rate=rate)
    schedule.begin(1_000_000)
    for k in range(0, 100_000, 777):
        assert schedule.due_ns(500 + k * MS) == 1_000_000 + round(k * MS / rate)


@given(st.integers(0, 10**9), st.integers(0, 10**10), st.floats(0.1, 10), st.integers(0, 10**10))
def test_a_pause_moves_every_target_by_its_length(
    until_ns: int, pause_ns: int, rate: float, stamp_ns: int
) -> None:
    schedule = Schedule(first_ns=0, rate=rate)
    schedule.begin(0)
    before = schedule.due_ns(stamp_ns)
    schedule.toggle_pause(until_ns)
    assert schedule.due_ns(stamp_ns) is None
    schedule.toggle_pause(until_ns + pause_ns)
    after = schedule.due_ns(stamp_ns)
    assert before is not None
    assert after is not None
    assert abs(after - before - pause_ns) <= 20  # rounding to whole nanoseconds, at rate 0.1


def test_frames_played_in_time_do_not_move_the_schedule() -> None:
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.stepped(3 * MS)
    assert schedule.due_ns(5 * MS) == 5 * MS
    schedule.toggle_pause(now_ns=4 * MS)
    schedule.stepped(3 * MS)  # before the position of the pause: it does not go back
    schedule.toggle_pause(now_ns=100 * MS)
    assert schedule.due_ns(5 * MS) == 101 * MS


def test_a_change_of_rate_while_paused_keeps_the_position() -> None:
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.toggle_pause(now_ns=40 * MS)
    schedule.change_rate(4.0, now_ns=50 * MS)
    assert schedule.due_ns(40 * MS) is None
    schedule.toggle_pause(now_ns=100 * MS)
    assert schedule.due_ns(40 * MS) == 100 * MS
    assert schedule.due_ns(80 * MS) == 110 * MS
