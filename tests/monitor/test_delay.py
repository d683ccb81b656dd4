"""Latency across hosts: by the clock of the host that watches, with what it may be wrong by."""

from __future__ import annotations

import numpy as np
import pytest

from sparseskin.messages import Reconstruction
from sparseskin.nodes.clock_offset import SAME_CLOCK, ClockEstimate
from sparseskin.nodes.monitor.delay import Delay, same_clock

MS = 1_000_000


def restored(stamp_ns: int, done_ns: int) -> Reconstruction:
    return Reconstruction(
        stamp_ns=stamp_ns,
        patch="skin",
        forces=np.zeros((2, 2), np.float32),
        phi="0" * 16,
        iterations=1,
        residual=0.0,
        solve_ns=0,
        done_ns=done_ns,
    )


@pytest.mark.parametrize("ahead_ms", [-5000, 0, 700])
def test_an_offset_of_the_clock_that_stamped_is_taken_out(ahead_ms: int) -> None:
    edge = ClockEstimate(ahead_ms * MS, MS // 2)
    delay = Delay(lambda topic: edge if topic == "/skin/taxels" else SAME_CLOCK)
    acquired_ns = 10_000 * MS  # on our clock
    message = restored(acquired_ns + ahead_ms * MS, acquired_ns + 4 * MS)
    assert delay.of(message) == 4 * MS
    assert delay.uncertainty_ns == MS // 2


def test_an_offset_of_the_clock_that_restored_is_taken_out() -> None:
    desk = ClockEstimate(3 * MS, MS)
    delay = Delay(lambda topic: desk if topic == "/skin/reconstruction" else SAME_CLOCK)
    assert delay.of(restored(1000 * MS, 1012 * MS)) == 9 * MS
    assert delay.uncertainty_ns == MS


def test_two_hosts_that_are_not_ours_add_their_uncertainties() -> None:
    clocks = {
        "/skin/taxels": ClockEstimate(5 * MS, 2 * MS),
        "/skin/reconstruction": ClockEstimate(-MS, MS),
    }
    delay = Delay(clocks.get)
    assert delay.of(restored(105 * MS, 109 * MS)) == 10 * MS
    assert delay.uncertainty_ns == 3 * MS


def test_of_one_host_nothing_is_uncertain() -> None:
    delay = Delay(same_clock)
    assert delay.of(restored(5 * MS, 7 * MS)) == 2 * MS
    assert delay.uncertainty_ns == 0


def test_while_a_clock_is_not_known_there_is_no_latency() -> None:
    assert Delay(lambda topic: None).of(restored(1, 2)) is None
