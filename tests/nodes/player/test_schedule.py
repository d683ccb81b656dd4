"""Times at which recorded messages are due: no accumulated error, no jump at a pause."""

from sparseskin.nodes.player.schedule import Schedule

MS = 1_000_000


def test_targets_are_absolute():
    rate = 0.1
    schedule = Schedule(first_ns=500, rate=rate)
    schedule.begin(1_000_000)
    for k in range(0, 100_000, 777):
        assert schedule.due_ns(500 + k * MS) == 1_000_000 + round(k * MS / rate)


def test_a_change_of_rate_while_paused_keeps_the_position():
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.toggle_pause(now_ns=40 * MS)
    schedule.change_rate(4.0, now_ns=50 * MS)
    assert schedule.due_ns(40 * MS) is None
    schedule.toggle_pause(now_ns=100 * MS)
    assert schedule.due_ns(40 * MS) == 100 * MS
    assert schedule.due_ns(80 * MS) == 110 * MS
