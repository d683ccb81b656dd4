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


def test_at_rate_0_everything_is_due() -> None:
    schedule = Schedule(first_ns=0, rate=0.0)
    schedule.begin(10**18)
    assert schedule.due_ns(10**15) == 0


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


def test_a_change_of_rate_goes_on_from_where_it_is() -> None:
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.change_rate(2.0, now_ns=100 * MS)
    assert schedule.due_ns(100 * MS) == 100 * MS
    assert schedule.due_ns(300 * MS) == 200 * MS


def test_paused_it_plays_one_frame_a_step_and_goes_on_from_there() -> None:
    schedule = Schedule(first_ns=0, rate=1.0, paused=True)
    schedule.begin(0)
    assert schedule.due_ns(0) is None
    for frame in range(3):
        schedule.step(now_ns=5)
        assert schedule.due_ns(frame * MS) == 0
        schedule.stepped(frame * MS)
        assert schedule.due_ns((frame + 1) * MS) is None
    schedule.toggle_pause(now_ns=1000 * MS)
    assert schedule.due_ns(3 * MS) == 1001 * MS


def test_a_step_while_playing_pauses() -> None:
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.step(now_ns=2 * MS)
    assert schedule.paused
    assert schedule.due_ns(3 * MS) == 0
    schedule.stepped(3 * MS)
    assert schedule.due_ns(4 * MS) is None


def test_steps_are_counted_and_a_resumption_discards_them() -> None:
    schedule = Schedule(first_ns=0, rate=1.0, paused=True)
    schedule.begin(0)
    for _ in range(2):
        schedule.step(now_ns=0)
    for frame in range(2):
        assert schedule.due_ns(frame * MS) == 0
        schedule.stepped(frame * MS)
    assert schedule.due_ns(2 * MS) is None
    schedule.step(now_ns=0)
    schedule.toggle_pause(now_ns=10 * MS)
    schedule.toggle_pause(now_ns=20 * MS)
    assert schedule.due_ns(2 * MS) is None


def test_frames_played_in_time_do_not_move_the_schedule() -> None:
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.stepped(3 * MS)
    assert schedule.due_ns(5 * MS) == 5 * MS
    schedule.toggle_pause(now_ns=4 * MS)
    schedule.stepped(3 * MS)  # before the position of the pause: it does not go back
    schedule.toggle_pause(now_ns=100 * MS)
    assert schedule.due_ns(5 * MS) == 101 * MS


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_after_a_seek_its_stamp_is_due_at_once_and_others_relative_to_it(rate: float) -> None:
    schedule = Schedule(first_ns=50 * MS, rate=rate)
    schedule.begin(0)
    for target_ns in (400 * MS, 60 * MS):
        schedule.seek(target_ns, now_ns=7 * MS)
        assert schedule.due_ns(target_ns) == 7 * MS
        assert schedule.due_ns(target_ns + 8 * MS) == 7 * MS + round(8 * MS / rate)


def test_a_seek_while_paused_is_due_when_it_is_resumed() -> None:
    schedule = Schedule(first_ns=0, rate=2.0, paused=True)
    schedule.begin(0)
    schedule.seek(300 * MS, now_ns=5 * MS)
    assert schedule.due_ns(300 * MS) is None
    schedule.toggle_pause(now_ns=90 * MS)
    assert schedule.due_ns(300 * MS) == 90 * MS
    assert schedule.due_ns(302 * MS) == 91 * MS


def test_a_change_of_rate_while_paused_keeps_the_position() -> None:
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.toggle_pause(now_ns=40 * MS)
    schedule.change_rate(4.0, now_ns=50 * MS)
    assert schedule.due_ns(40 * MS) is None
    schedule.toggle_pause(now_ns=100 * MS)
    assert schedule.due_ns(40 * MS) == 100 * MS
    assert schedule.due_ns(80 * MS) == 110 * MS
