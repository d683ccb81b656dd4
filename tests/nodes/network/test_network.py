"""Sockets between nodes, and other hosts: their clocks, who is asked for them, and the end."""

import time

import numpy as np
import pytest
import zmq
from conftest import wait_until
from processes import wait_for_reader

from sparseskin.messages import PhiState, Taxels, TruncatedError, decode
from sparseskin.nodes.clock import SAME_CLOCK
from sparseskin.nodes.network import sockets
from sparseskin.nodes.network.network import (
    ASK_NS,
    END_RECEIVED_NS,
    FIRST_NS,
    N_FIRST,
    Network,
)
from sparseskin.nodes.network.sockets import Peer, Reader, Writer

LEFT = "/left/taxels"
RIGHT = "/right/taxels"
HERE = "/here/taxels"
PAIR = dict(
    zip(("public", "secret"), map(bytes.decode, zmq.curve_keypair()), strict=True)
)
SECURITY = {"key_pair": PAIR, "allowed": {}, "names": {}}
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
    assert node.clock_of(LEFT) is None
    assert node.clock_of(HERE) == SAME_CLOCK
    peers = [
        Peer(f"sensor_{host}", writer.endpoint, host)
        for host, writer in writers.items()
    ]
    node.connect(peers)
    assert node.heard == {"sensor_left": False, "sensor_right": False}

    def known():
        for writer in writers.values():
            writer.serve_subscriptions()
        node.serve()
        while (parts := reader.receive()) is not None:
            assert reader.is_ask(parts[0])
            assert node.take_time(bytes(parts[1]))
        return node.clock_of(LEFT) is not None and node.clock_of(RIGHT) is not None

    wait_until(known, "the clocks of both hosts")
    for topic, host in ((LEFT, "left"), (RIGHT, "right")):
        estimate = node.clock_of(topic)
        assert abs(estimate.offset_ns - AHEAD_NS[host]) <= estimate.uncertainty_ns
        assert node.clocks()[host][0] == estimate.offset_ns
    assert node.heard == {"sensor_left": True, "sensor_right": True}
    assert node.clock_of(HERE) == SAME_CLOCK
    writers["left"].socket.close()

    def is_silent():
        node.serve()
        return not node.heard["sensor_left"]

    wait_until(is_silent, "its leaving")
    assert lines[-1] == "disconnected: sensor_left on left"
    assert "connected: sensor_left on left" in lines


@pytest.mark.parametrize(
    ("n_times", "period_ns"), [(N_FIRST - 1, FIRST_NS), (N_FIRST, ASK_NS)]
)
def test_other_hosts_are_asked_for_the_time(context, monkeypatch, n_times, period_ns):
    node, _ = network(context, distant_inputs={LEFT: "edge"})
    asked = []
    monkeypatch.setattr(node.make_reader([LEFT]), "ask_time", asked.append)
    node.serve()
    assert asked == []  # there is no other host
    node.connect([Peer("sensor", "inproc://nobody", "edge")])
    for k in range(n_times):
        assert node.take_time(b"sensor!%d:%d:%d" % (k, k, k))
    for now_ns in (0, 1, period_ns - 1, period_ns, 2 * period_ns):
        monkeypatch.setattr(node, "_now_ns", lambda now_ns=now_ns: now_ns)
        node.serve()
    assert asked == [0, period_ns, 2 * period_ns]


def test_without_other_hosts_all_topics_have_the_clock_of_this_one(context):
    node, _ = network(context)
    assert node.clock_of(HERE) == SAME_CLOCK


def test_a_path_on_which_a_writer_listens_is_not_taken_from_it(context, tmp_path):
    endpoint = f"ipc://{tmp_path}/sensor"
    writer = Writer(context, endpoint, "sensor")
    with pytest.raises(zmq.ZMQError) as raised:
        Writer(context, endpoint, "other")
    assert raised.value.errno == zmq.EADDRINUSE
    reader = Reader(context, "reader", [endpoint], [LEFT])
    wait_for_reader(writer, "reader")
    assert reader.receive() is None


def test_a_question_whose_time_is_no_number_is_not_answered(context):
    writer = Writer(context, "inproc://writer", "sensor", now_ns=time.monotonic_ns)
    reader = Reader(context, "reader", [writer.endpoint], [LEFT])
    wait_for_reader(writer, "reader")
    stranger = context.socket(zmq.XSUB)
    stranger.connect(writer.endpoint)
    # The last one is answered: those before it were read, too.
    for t1 in (b"x", b"-1", b"", b"9" * 50, b"7"):
        stranger.send(b"\x01@reader!" + t1)

    def has_note():
        writer.serve_subscriptions()
        return bool(reader.socket.poll(0))

    wait_until(has_note, "an answer")
    _, note = reader.receive()
    assert bytes(note).startswith(b"sensor!7:")


def test_a_writer_reports_the_time_to_those_alone_who_are_there(context):
    writer = Writer(context, "inproc://writer", "sensor", now_ns=time.monotonic_ns)
    stranger = context.socket(zmq.XSUB)
    stranger.connect(writer.endpoint)
    for note in (
        b"@monitor!5",
        b"@!5",
        b"@monitor!" + b"9" * 50,
        b"@monitor!x",
        b"@monitor!-1",
    ):
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
def test_a_gate_guards_what_has_keys_or_can_be_reached_over_tcp(
    context, tmp_path, config, guarded
):
    config = {
        k: v.format(tmp_path) if k == "endpoint" else v for k, v in config.items()
    }
    node, _ = network(context, **config)
    # The writer, and of the gate its authentication socket and its monitor.
    assert len(node.poller.sockets) == (3 if guarded else 1)
    assert bool(node.writer.socket.getsockopt(zmq.ZAP_DOMAIN)) is guarded
    assert node.writer.socket.getsockopt(zmq.CURVE_SERVER) == ("security" in config)


def wait_for_answer(node, reader):
    """Let a distant reader answer, until the node knows that the end was received."""

    def answered():
        if (parts := reader.receive()) is not None:
            reader.answer(bytes(parts[1]))
        node.writer.serve_subscriptions()
        return node.end_received()

    wait_until(answered, "its answer")


def test_the_end_is_received_once_every_distant_reader_has_answered(context):
    assert network(context)[0].end_received()  # no reader on another host
    node, lines = network(context, endpoint="inproc://end", distant_readers=["desk"])
    reader = Reader(context, "desk", [node.writer.endpoint], [HERE])
    wait_for_reader(node.writer, "desk")
    assert not node.end_received()

    wait_for_answer(node, reader)
    assert lines == []


def test_a_distant_reader_that_never_answers_delays_the_end_by_a_bounded_time(context):
    now_ns = 0
    lines = []
    config = {
        "name": "sensor",
        "endpoint": "inproc://sensor",
        "distant_readers": ["desk"],
    }
    node = Network(context, config, lambda: now_ns, lines.append)
    for now_ns in (0, END_RECEIVED_NS - 1):  # noqa: B007 - read by the clock
        assert not node.end_received()
    now_ns = END_RECEIVED_NS
    assert node.end_received()
    assert lines == ["the end was not received within 30 s by desk"]


TAXELS = "/skin/taxels"
PHI = "/skin/phi"


class Pair:
    """A writer and its readers over one endpoint."""

    def __init__(self, context, endpoint="inproc://writer"):
        self._context = context
        self.writer = Writer(context, endpoint)

    def reader(self, *topics, name="reader"):
        """A reader that is present."""
        reader = Reader(self._context, name, [self.writer.endpoint], topics)
        wait_for_reader(self.writer, name)
        return reader

    def next_messages(self, reader, n=1):
        found = []

        def came():
            while len(found) < n and (parts := reader.receive()) is not None:
                found.append(parts)
            return len(found) == n

        wait_until(came, f"{n} messages")
        return found


@pytest.fixture
def pair(context):
    return Pair(context)


def taxels(seq):
    return Taxels(
        stamp_ns=seq, patch="skin", seq=seq, forces=np.ones((2, 2), np.float32)
    )


def test_a_reader_knows_whether_a_message_waits(pair):
    reader = pair.reader(TAXELS)
    assert not reader.has_waiting
    pair.writer.send(taxels(0))
    wait_until(lambda: reader.has_waiting, "the message")
    assert reader.take(1, [TAXELS.encode()]) is not None
    assert not reader.has_waiting


def test_nodes_of_a_process_share_poller_and_gate_and_read_within_it(context, tmp_path):
    tmp_path.chmod(0o700)
    config = {"endpoint": "tcp://127.0.0.1:*", "companions": ["sensor", "echo"]}
    sensor, _ = network(context, **config, name="sensor")
    echo = Network(
        context,
        {**config, "name": "echo"},
        time.monotonic_ns,
        print,
        sensor.poller,
        sensor,
    )
    reader = echo.make_reader([TAXELS])
    # The endpoint for others is not that on which companions read.
    echo.connect([Peer("sensor", "tcp://127.0.0.1:1")])
    wait_for_reader(sensor.writer, "echo")
    sensor.writer.send(taxels(7))
    wait_until(lambda: reader.socket in dict(sensor.poller.poll(0)), "the message")
    assert decode(*reader.receive()).seq == 7


@pytest.mark.parametrize(
    "endpoint", ["inproc://writer", "tcp://127.0.0.1:*", "ipc://{}/s"]
)
def test_a_reader_misses_nothing_while_it_is_present(context, endpoint, tmp_path):
    pair = Pair(context, endpoint.format(tmp_path))
    reader = pair.reader(TAXELS)
    for seq in range(500):
        pair.writer.send(taxels(seq))
    found = [decode(*parts).seq for parts in pair.next_messages(reader, 500)]
    assert found == list(range(500))
    reader.socket.close()

    def has_left():
        pair.writer.serve_subscriptions()
        return not pair.writer.present

    wait_until(has_left, "its leaving")


def test_a_late_subscriber_receives_latched_messages_only(pair):
    of_phi = {
        "kind": "full",
        "n": 4,
        "m": 4,
        "block": 1,
        "seed": 0,
        "fingerprint": "0" * 16,
    }
    phi = PhiState(stamp_ns=0, patch="skin", **of_phi)
    pair.writer.send(phi)
    pair.writer.send(taxels(0))
    for name in ("first", "second"):
        reader = pair.reader(TAXELS, PHI, name=name)
        pair.writer.send(taxels(1))
        state, frame = (decode(*parts) for parts in pair.next_messages(reader, 2))
        assert state == phi
        assert frame.seq == 1


def test_a_writer_knows_when_all_that_it_sent_is_processed(pair):
    reader = pair.reader(TAXELS)
    pair.writer.send(taxels(0))
    ask = pair.writer.ask()
    assert pair.writer.awaits(ask)
    frame, (topic, note) = pair.next_messages(reader, 2)
    assert decode(*frame).seq == 0
    assert reader.is_ask(topic)
    reader.answer(bytes(note))

    def has_answered():
        pair.writer.serve_subscriptions()
        return not pair.writer.awaits(ask)

    wait_until(has_answered, "the answer")
    assert pair.writer.has_answered("reader", ask)


def test_a_topic_that_begins_like_another_is_not_taken_for_it(pair):
    reader = pair.reader(TAXELS)
    pair.writer.socket.send(b"/skin/taxels_raw\0payload")
    pair.writer.socket.send(b"/skin/taxels")
    # Of several parts each is a message: these are two of no payload, and one of another topic.
    pair.writer.socket.send_multipart((b"/skin/taxels", b"part", b"/skin/taxels"))
    pair.writer.send(taxels(3))
    *wrong, last = pair.next_messages(reader, 4)
    assert wrong == [(b"/skin/taxels", b"")] * 3
    with pytest.raises(TruncatedError):
        decode(*wrong[0])
    assert decode(*last).seq == 3


def test_a_topic_beyond_the_counted_subscriptions_is_sent(context, monkeypatch):
    monkeypatch.setattr(sockets, "MAX_SUBSCRIPTIONS", 2)
    writer = Writer(context, "inproc://writer", "sensor")
    reader = Reader(context, "reader", [writer.endpoint], [LEFT, RIGHT, HERE])
    wait_for_reader(writer, "reader")
    for patch in ("left", "right", "here"):
        forces = np.ones((2, 2), np.float32)
        writer.send(Taxels(stamp_ns=0, patch=patch, forces=forces))
    topics = []
    for _ in range(3):
        wait_until(lambda: bool(reader.socket.poll(0)), "a message")
        topics.append(decode(*reader.receive()).topic)
    assert topics == [LEFT, RIGHT, HERE]


def test_an_answer_to_another_writer_is_none_to_this_one(context):
    """A reader subscribes to its answers at all writers that it reads."""
    writers = [Writer(context, f"inproc://{name}", name) for name in ("left", "right")]
    reader = Reader(context, "desk", [writer.endpoint for writer in writers], [LEFT])
    for writer in writers:
        wait_for_reader(writer, "desk")
    left, right = writers
    for _ in range(3):
        last = right.ask()
    ask = left.ask()
    reader.answer(b"right:%d" % last)

    def right_has_it():
        for writer in writers:
            writer.serve_subscriptions()
        return right.has_answered("desk", last)

    wait_until(right_has_it, "its answer")
    assert left.awaits(ask)
    assert not left.has_answered("desk", ask)


def test_the_end_is_asked_for_again_where_a_reader_has_come_since(context):
    config = {"endpoint": "inproc://end", "distant_readers": ["desk"]}
    node, lines = network(context, **config)
    assert not node.end_received()
    reader = Reader(context, "desk", [node.writer.endpoint], [HERE])
    wait_for_reader(node.writer, "desk")
    node.end_repeated()

    wait_for_answer(node, reader)
    assert lines == []


def test_of_a_stream_that_has_not_ended_nothing_is_asked(context):
    node, _ = network(context, endpoint="inproc://end", distant_readers=["desk"])
    node.end_repeated()
    assert node.writer.ask() == 1


def test_a_writer_that_refused_is_asked_again_when_its_time_has_come(context):
    """Whichever others still wait for theirs."""
    config = {"distant_inputs": {LEFT: "edge", RIGHT: "edge"}}
    node, _ = network(context, **config)
    node.make_reader([LEFT, RIGHT])
    names = ("left", "right")
    writers = {name: Writer(context, f"inproc://{name}", name) for name in names}
    node.connect([Peer(name, writers[name].endpoint, "edge") for name in names])
    later_ns = time.monotonic_ns() + 10**15
    node._retry_ns = {"inproc://left": later_ns, "inproc://right": 0}
    node.serve()
    assert node._retry_ns == {"inproc://left": later_ns}


def test_who_comes_after_an_ask_is_not_waited_for(pair):
    early = pair.reader(TAXELS, name="early")
    ask = pair.writer.ask()
    _late = pair.reader(TAXELS, name="late")
    assert pair.writer.awaits(ask)
    _, note = pair.next_messages(early)[0]
    early.answer(bytes(note))

    def has_answered():
        pair.writer.serve_subscriptions()
        return not pair.writer.awaits(ask)

    wait_until(has_answered, "the answer")


def test_who_observes_is_not_asked(pair, context):
    endpoints = [pair.writer.endpoint]
    _observer = Reader(context, "page", endpoints, [TAXELS], observes=True)
    wait_for_reader(pair.writer, "page")
    assert not pair.writer.awaits(pair.writer.ask())


class Subscriber:
    """Subscriptions to a writer, one by one, and what it logs of them."""

    def __init__(self, context):
        self.lines = []
        self.writer = Writer(context, "inproc://writer", log=self.lines.append)
        self.socket = context.socket(zmq.SUB)
        self.socket.connect(self.writer.endpoint)

    def joins(self, topic):
        self.socket.subscribe(topic)

        def has_come():
            self.writer.serve_subscriptions()
            return topic in self.writer._prefixes

        wait_until(has_come, "the subscription")


def test_more_subscriptions_than_a_reader_needs_are_logged_once(context, monkeypatch):
    monkeypatch.setattr(sockets, "MAX_SUBSCRIPTIONS", 3)
    subscriber = Subscriber(context)
    for topic in (b"/a", b"/b", b"/c"):
        subscriber.joins(topic)
    assert subscriber.lines == []
    for _ in range(2):
        subscriber.socket.subscribe(b"/a")

    def is_logged():
        subscriber.writer.serve_subscriptions()
        return bool(subscriber.lines)

    wait_until(is_logged, "a line")
    assert len(subscriber.lines) == 1


def test_subscriptions_that_have_ended_do_not_count(context, monkeypatch):
    monkeypatch.setattr(sockets, "MAX_SUBSCRIPTIONS", 3)
    subscriber = Subscriber(context)
    subscriber.joins(b"/a")
    subscriber.joins(b"/b")
    subscriber.socket.unsubscribe(b"/a")
    subscriber.socket.unsubscribe(b"/b")
    subscriber.joins(b"/c")
    assert subscriber.lines == []
    assert subscriber.writer._n_subscriptions == 1
