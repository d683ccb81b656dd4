"""Rates, sizes and ages of messages that came at known times."""

import numpy as np
import pytest

from sparseskin.launch.attach.rates import MAX_KEPT, Samples, figures_of, text_of
from sparseskin.launch.attach.stream import Arrival

MS = 1_000_000


def arrival(seq, at_ms, *, stamp_ms=None, n=92, run="a"):
    """A message of n + 8 bytes that came at a time; stamped 2 ms earlier by default."""
    stamp_ms = at_ms - 2 if stamp_ms is None else stamp_ms
    return Arrival(
        b"/skin/x", bytes(n), round(at_ms * MS), run, seq, round(stamp_ms * MS), ends=False
    )


def end(n_messages, run="a"):
    return Arrival(b"/skin/x", b"", 0, run, n_messages, 0, ends=True)


def samples(*arrivals):
    made = Samples()
    for one in arrivals:
        made.add(one)
    return made


def test_rates_are_those_of_the_numbers_and_of_the_arrivals():
    # 100 Hz sent, two of three messages lost.
    made = samples(*(arrival(3 * k, 30 * k) for k in range(11)))
    figures = figures_of(made.last(1000))
    assert figures["sent_hz"] == pytest.approx(100)
    assert figures["arrives_hz"] == pytest.approx(100 / 3)
    assert figures["interval_ms"] is None
    assert made.lost == 20
    assert text_of(figures) == "100 Hz, 33.33 here | 3.33 kB/s | p50 2.00, p99 2.00 ms old"


def test_intervals_are_between_messages_with_none_lost_between():
    stamps_ms = {0: 0, 1: 10, 2: 22, 5: 50, 6: 58}
    made = samples(*(arrival(seq, 99 * seq, stamp_ms=ms) for seq, ms in stamps_ms.items()))
    between = figures_of(made.last(1000))["interval_ms"]
    assert (between["min"], between["max"]) == pytest.approx((8, 12))
    assert (between["mean"], between["std"]) == (pytest.approx(10), pytest.approx(np.sqrt(8 / 3)))


def test_rates_are_the_same_however_late_messages_are_read():
    # 1 kHz, every 50 ms what has come since, but for half a second in which nothing is taken in.
    at_ms = [50 * (k // 50 + 1) if not 400 <= k < 900 else 900 for k in range(1000)]
    made = samples(*(arrival(k, at_ms[k], stamp_ms=k) for k in range(1000)))
    for window in (2, 50, 990):
        figures = figures_of(made.last(window))
        assert figures["arrives_hz"] == pytest.approx(1000)
        assert figures["bytes_per_s"] == pytest.approx(100_000)


def test_bytes_a_second_leave_out_what_came_before_the_first_interval():
    made = samples(arrival(0, 0, n=9_992), arrival(1, 500), arrival(2, 1000, n=192))
    figures = figures_of(made.last(1000))
    assert (figures["bytes_per_s"], figures["size_bytes"]["max"]) == (pytest.approx(300), 10_000)


def test_a_delay_is_from_stamp_to_arrival():
    made = samples(*(arrival(k, 10 * k, stamp_ms=9 * k) for k in range(101)))
    figures = figures_of(made.last(1000))["delay_ms"]
    assert (figures["p50"], figures["p99"], figures["max"]) == pytest.approx((50, 99, 100))
    late = made.last(1000)
    late[1:, 4] = 0  # all but the first may have waited
    assert figures_of(late)["delay_ms"]["max"] == 0


def test_where_too_few_came_there_is_no_figure():
    assert text_of(figures_of(samples().last(9))) == ""
    assert text_of(figures_of(samples(arrival(0, 1)).last(9))) == "p50 2.00, p99 2.00 ms old"


B = {"run": "b"}


@pytest.mark.parametrize(
    ("arrivals", "lost", "kept"),
    [
        # None before the first.
        ([arrival(70, 1), arrival(71, 2), arrival(75, 3)], 3, [70, 71, 75]),
        ([arrival(70, 1), end(75)], 4, [70]),
        ([end(75)], 0, []),
        ([arrival(8, 1), arrival(9, 2), arrival(3, 50, **B), arrival(5, 60, **B)], 1, [3, 5]),
        # Played in a loop.
        ([arrival(8, 1), arrival(9, 2), arrival(0, 3), arrival(1, 4)], 0, [0, 1]),
    ],
)
def test_gaps_in_the_numbers_of_one_run_are_losses(arrivals, lost, kept):
    made = samples(*arrivals)
    assert (made.lost, made.last(1000)[:, 2].tolist()) == (lost, kept)


def test_a_long_run_is_bounded_and_its_last_messages_are_kept():
    made = samples(*(arrival(k, k) for k in range(MAX_KEPT + 10)))
    seqs = made.last(2 * MAX_KEPT)[:, 2]
    assert (made.n, len(seqs), seqs[-1]) == (MAX_KEPT + 10, MAX_KEPT, MAX_KEPT + 9)
    assert np.all(np.diff(seqs) == 1)
