"""The writers on another host: whether they are heard, and how far their clock is ahead."""

from __future__ import annotations

import time
from typing import Any

import pytest
import zmq
from conftest import wait_until
from zmq_contexts import context as context
from zmq_contexts import wait_for_reader

from sparseskin.nodes.network.peers import ASK_NS, FIRST_NS, N_FIRST, Peers
from sparseskin.nodes.network.sockets import Peer, Reader, Writer, read_times

TAXELS = "/skin/taxels"
AHEAD_NS = 7_000_000_000


def there_ns() -> int:
    return time.monotonic_ns() + AHEAD_NS


def test_the_clock_of_another_host_is_known_within_its_uncertainty(
    context: zmq.Context[Any],
) -> None:
    writer = Writer(context, "tcp://127.0.0.1:*", "sensor", now_ns=there_ns)
    reader = Reader(context, "monitor", (), [TAXELS])
    said: list[str] = []
    peers = Peers(reader, said.append)
    peers.connect([Peer("sensor", writer.endpoint, "edge")])
    assert peers.clock_of("edge") is None
    assert peers.heard == {"sensor": False}

    def known() -> bool:
        writer.serve_subscriptions()
        peers.serve(time.monotonic_ns())
        while (parts := reader.receive()) is not None:
            assert reader.is_ask(parts[0])
            assert peers.take_time(parts[1], time.monotonic_ns())
        return peers.clock_of("edge") is not None

    wait_until(known, "the time there")
    estimate = peers.clock_of("edge")
    assert estimate is not None
    assert abs(estimate.offset_ns - AHEAD_NS) <= estimate.uncertainty_ns
    assert peers.heard == {"sensor": True}
    writer.socket.close()

    def is_silent() -> bool:
        peers.serve(time.monotonic_ns())
        return not peers.heard["sensor"]

    wait_until(is_silent, "its leaving")
    assert said == ["connected: sensor on edge", "disconnected: sensor on edge"]


@pytest.mark.parametrize(
    ("n_times", "period_ns"), [(0, FIRST_NS), (N_FIRST - 1, FIRST_NS), (N_FIRST, ASK_NS)]
)
def test_other_hosts_are_asked_for_the_time_once_a_period_and_oftener_at_first(
    context: zmq.Context[Any], monkeypatch: pytest.MonkeyPatch, n_times: int, period_ns: int
) -> None:
    reader = Reader(context, "monitor", (), [TAXELS])
    asked: list[int] = []
    monkeypatch.setattr(reader, "ask_time", asked.append)
    peers = Peers(reader, lambda line: None)
    peers.serve(0)
    assert asked == []  # there is no other host
    peers.connect([Peer("sensor", "inproc://nobody", "edge")])
    for k in range(n_times):
        assert peers.take_time(b"sensor!%d:%d:%d" % (k, k, k), k)
    for now_ns in (0, 1, period_ns - 1, period_ns, 2 * period_ns):
        peers.serve(now_ns)
    assert asked == [0, period_ns, 2 * period_ns]


def test_a_writer_reports_the_time_to_those_alone_who_are_there(context: zmq.Context[Any]) -> None:
    writer = Writer(context, "inproc://writer", "sensor", now_ns=there_ns)
    stranger = context.socket(zmq.XSUB)
    stranger.connect(writer.endpoint)
    for note in (b"@monitor!5", b"@!5", b"@monitor!" + b"9" * 50, b"@monitor!x", b"@monitor!-1"):
        stranger.send(b"\x01" + note)
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS])

    wait_for_reader(writer, "reader")
    assert not stranger.poll(0)
    assert reader.receive() is None


def test_a_time_is_read_as_it_was_written() -> None:
    assert read_times(b"sensor!1:2:3") == ("sensor", 1, 2, 3)
    for note in (b"sensor:7", b"sensor!1:2", b"sensor!1:2:x", b"sensor!1:2:" + b"9" * 30):
        assert read_times(note) is None
