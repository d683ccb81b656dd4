"""Other hosts: their clocks by topic, who is asked for them, access control, and the end."""

import time

import pytest
import zmq
from conftest import wait_until
from zmq_contexts import context as context
from zmq_contexts import wait_for_reader

from sparseskin.nodes.clock import SAME_CLOCK
from sparseskin.nodes.network.network import END_RECEIVED_NS, Network
from sparseskin.nodes.network.peers import ASK_NS, FIRST_NS, N_FIRST, Peers
from sparseskin.nodes.network.sockets import Peer, Reader, Writer

LEFT, RIGHT, HERE = "/left/taxels", "/right/taxels", "/here/taxels"
SECURITY = {"own": [k.decode() for k in zmq.curve_keypair()], "allowed": {}, "known": {}}
AHEAD_NS = {"left": 7_000_000_000, "right": -3_000_000_000}


def network(context, **config):
    lines = []
    stated = {"name": "monitor", "endpoint": "inproc://monitor", **config}
    return Network(context, stated, time.monotonic_ns, lines.append), lines


def test_each_topic_has_the_clock_of_its_writers_host(context):
    node, lines = network(context, distant_inputs={LEFT: "left", RIGHT: "right"})
    reader = node.make_reader([LEFT, RIGHT, HERE])
    writers = {
        host: Writer(
            *(context, "tcp://127.0.0.1:*", f"sensor_{host}"),
            now_ns=lambda ahead_ns=ahead_ns: time.monotonic_ns() + ahead_ns,
        )
        for host, ahead_ns in AHEAD_NS.items()
    }
    assert (node.clock_of(LEFT), node.clock_of(HERE)) == (None, SAME_CLOCK)
    peers = [Peer(f"sensor_{host}", writer.endpoint, host) for host, writer in writers.items()]
    node.connect(reader, peers)
    assert node.peers.heard == {"sensor_left": False, "sensor_right": False}

    def known():
        for writer in writers.values():
            writer.serve_subscriptions()
        node.serve()
        while (parts := reader.receive()) is not None:
            assert reader.is_ask(parts[0])
            assert node.peers.take_time(bytes(parts[1]), time.monotonic_ns())
        return node.clock_of(LEFT) is not None and node.clock_of(RIGHT) is not None

    wait_until(known, "the clocks of both hosts")
    for topic, host in ((LEFT, "left"), (RIGHT, "right")):
        estimate = node.clock_of(topic)
        assert abs(estimate.offset_ns - AHEAD_NS[host]) <= estimate.uncertainty_ns
        assert node.peers.clocks()[host][0] == estimate.offset_ns
    assert node.peers.heard == {"sensor_left": True, "sensor_right": True}
    assert node.clock_of(HERE) == SAME_CLOCK
    writers["left"].socket.close()

    def is_silent():
        node.serve()
        return not node.peers.heard["sensor_left"]

    wait_until(is_silent, "its leaving")
    assert lines[-1] == "disconnected: sensor_left on left"
    assert "connected: sensor_left on left" in lines


@pytest.mark.parametrize(("n_times", "period_ns"), [(N_FIRST - 1, FIRST_NS), (N_FIRST, ASK_NS)])
def test_other_hosts_are_asked_for_the_time_once_a_period_and_oftener_at_first(
    context, monkeypatch, n_times, period_ns
):
    reader = Reader(context, "monitor", (), [LEFT])
    asked = []
    monkeypatch.setattr(reader, "ask_time", asked.append)
    peers = Peers(lambda line: None)
    peers.watch(reader)
    peers.serve(0)
    assert asked == []  # there is no other host
    peers.connect(reader, Peer("sensor", "inproc://nobody", "edge"))
    for k in range(n_times):
        assert peers.take_time(b"sensor!%d:%d:%d" % (k, k, k), k)
    for now_ns in (0, 1, period_ns - 1, period_ns, 2 * period_ns):
        peers.serve(now_ns)
    assert asked == [0, period_ns, 2 * period_ns]


def test_a_writer_reports_the_time_to_those_alone_who_are_there(context):
    writer = Writer(context, "inproc://writer", "sensor", now_ns=time.monotonic_ns)
    stranger = context.socket(zmq.XSUB)
    stranger.connect(writer.endpoint)
    for note in (b"@monitor!5", b"@!5", b"@monitor!" + b"9" * 50, b"@monitor!x", b"@monitor!-1"):
        stranger.send(b"\x01" + note)
    reader = Reader(context, "reader", [writer.endpoint], [LEFT])
    wait_for_reader(writer, "reader")
    assert not stranger.poll(0)
    assert reader.receive() is None


@pytest.mark.parametrize(
    ("config", "guarded"),
    [
        ({}, False),
        ({"endpoint": "ipc://{}/s"}, False),
        ({"endpoint": "tcp://127.0.0.1:*"}, True),
        ({"public": "tcp://127.0.0.1:*"}, True),
        ({"endpoint": "ipc://{}/s", "security": SECURITY}, True),
    ],
    ids=["inproc", "ipc", "tcp", "public", "keys"],
)
def test_a_gate_guards_what_has_keys_or_can_be_reached_over_tcp(context, tmp_path, config, guarded):
    config = {k: v.format(tmp_path) if k == "endpoint" else v for k, v in config.items()}
    node, _ = network(context, **config)
    # The writer, and of the gate its authentication socket and its monitor.
    assert len(node.poller.sockets) == (3 if guarded else 1)
    assert bool(node.writer.socket.getsockopt(zmq.ZAP_DOMAIN)) is guarded
    assert node.writer.socket.getsockopt(zmq.CURVE_SERVER) == ("security" in config)


def test_the_end_is_received_once_every_distant_reader_has_answered(context):
    assert network(context)[0].end_received()  # no reader on another host
    node, lines = network(context, endpoint="inproc://end", distant_readers=["desk"])
    reader = Reader(context, "desk", [node.writer.endpoint], [HERE])
    wait_for_reader(node.writer, "desk")
    assert not node.end_received()

    def answered():
        if (parts := reader.receive()) is not None:
            reader.answer(bytes(parts[1]))
        node.writer.serve_subscriptions()
        return node.end_received()

    wait_until(answered, "its answer")
    assert lines == []


def test_a_distant_reader_that_never_answers_delays_the_end_by_a_bounded_time(context):
    now_ns, lines = 0, []
    config = {"name": "sensor", "endpoint": "inproc://sensor", "distant_readers": ["desk"]}
    node = Network(context, config, lambda: now_ns, lines.append)
    for now_ns in (0, END_RECEIVED_NS - 1):  # noqa: B007 - read by the clock
        assert not node.end_received()
    now_ns = END_RECEIVED_NS
    assert node.end_received()
    assert lines == ["the end was not received within 30 s by desk"]
