"""An observer of a topic: it reads the messages, and no node waits for it."""

import time
import uuid
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import wait_until
from processes import announced

from sparseskin.launch.attach.stream import Losses, TopicStream
from sparseskin.launch.commands.cli import main
from sparseskin.launch.run.running import RunningGraph, RunningNode
from sparseskin.messages import End, Taxels, decode, size_bytes
from sparseskin.nodes.network.gate import Gate
from sparseskin.nodes.network.keys import KeyFileError, make_key_files, read_key_pair
from sparseskin.nodes.network.sockets import QUEUE_FRAMES, Writer, make_context

TOPIC = "/skin/taxels"
RUN_ID = "0123456789abcdef"


class Publisher:
    """A writer of taxels, and the note of its graph; with a key file, it asks for that key."""

    def __init__(self, key_file=None):
        self.context = make_context()
        pair = read_key_pair(key_file) if key_file else None
        key = pair.public if pair else ""
        self.gate = Gate(self.context, pair, {key: "own"}, {}, print) if pair else None
        endpoint = f"ipc://@sparseskin-{uuid.uuid4().hex}"
        self.writer = Writer(self.context, endpoint, "sensor", gate=self.gate)
        nodes = {"sensor": RunningNode("sensor", self.writer.endpoint, [TOPIC], key)}
        offset_ns = time.time_ns() - time.monotonic_ns()
        self.graph = RunningGraph("graph", 1, offset_ns, "", nodes, str(key_file or ""))
        self.n = 0

    def send(self, n, n_rows=4, period_ns=0):
        """Send `n` messages, stamped by the clock, or with a period from 1 s on."""
        forces = np.zeros((n_rows, 4), dtype=np.float32)
        for k in range(n):
            stamp_ns = 10**9 + k * period_ns if period_ns else time.time_ns()
            message = Taxels(stamp_ns=stamp_ns, patch="skin", forces=forces)
            self.writer.send(message.published(RUN_ID, self.n))
            self.n += 1

    def end(self):
        end = End(stamp_ns=1, patch="skin", of="taxels", n_messages=self.n)
        self.writer.send(end.published(RUN_ID, self.n))

    def wait_for_subscription(self):
        def there():
            if self.gate is not None:
                self.gate.serve()
            return bool(self.writer.socket.poll(0))

        wait_until(there, "the subscription")
        self.writer.serve_subscriptions()


@pytest.fixture
def publisher(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    made = Publisher()
    with announced(made.graph):
        yield made
    made.context.destroy(linger=0)


def take(stream, n):
    """The next n messages."""
    found = []
    for arrivals in stream.batches(60):
        found += arrivals
        if len(found) >= n:
            break
    return found


def test_it_sees_the_messages_as_they_are_sent_and_when(publisher):
    with TopicStream(publisher.graph, TOPIC) as stream:
        publisher.wait_for_subscription()
        assert publisher.writer.present == set()  # no writer waits for it
        assert not publisher.writer.awaits(publisher.writer.ask())
        publisher.send(3)
        publisher.end()
        *frames, end = take(stream, 4)
    assert [(one.seq, one.run_id, one.ends) for one in frames] == [
        (k, RUN_ID, False) for k in range(3)
    ]
    assert (end.seq, end.ends) == (3, True)
    for one in frames:
        assert decode(one.topic, one.payload).stamp_ns == one.stamp_ns < one.at_ns
        assert one.n_bytes == size_bytes(decode(one.topic, one.payload))


def test_one_that_does_not_read_holds_up_nobody_and_learns_what_it_lost(publisher):
    n = 6 * QUEUE_FRAMES
    losses = Losses()
    with TopicStream(publisher.graph, TOPIC) as stream:
        publisher.wait_for_subscription()
        publisher.send(n, n_rows=64)  # this returns only if nobody waits
        found = []
        for arrivals in stream.batches(60):
            found += arrivals
            if not arrivals:
                break
        publisher.send(1)
        found += take(stream, 1)
    for one in found:
        losses.add(one)
    assert found[-1].seq == n
    assert 0 < losses.n == n + 1 - len(found)


def test_a_patient_reader_receives_what_is_queued_at_the_writer(publisher):
    with TopicStream(publisher.graph, TOPIC, patience_s=0.01) as stream:
        publisher.wait_for_subscription()
        publisher.send(1)
        found = take(stream, 1)
        publisher.send(QUEUE_FRAMES // 2, n_rows=64)  # far more than it reads ahead
        found += take(stream, QUEUE_FRAMES // 2)
    assert [one.seq for one in found] == list(range(QUEUE_FRAMES // 2 + 1))


def test_invalid_messages_are_counted_and_skipped(publisher):
    with TopicStream(publisher.graph, TOPIC) as stream:
        publisher.wait_for_subscription()
        for payload in (b"", b"nonsense", b"\x81\xa6schema\xa3end"):
            publisher.writer.socket.send(TOPIC.encode() + b"\0" + payload)
        publisher.send(1)
        assert ([one.seq for one in take(stream, 1)], stream.unreadable) == ([0], 3)


def test_where_keys_are_asked_for_it_has_that_of_the_graph(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    key_file, _ = make_key_files("own", tmp_path)
    guarded = Publisher(key_file)
    with announced(guarded.graph), TopicStream(guarded.graph, TOPIC) as stream:
        guarded.wait_for_subscription()
        guarded.send(2)
        assert [one.seq for one in take(stream, 2)] == [0, 1]
    guarded.context.destroy(linger=0)
    key_file.chmod(0o644)
    with pytest.raises(KeyFileError, match=r"own\.key"):
        TopicStream(guarded.graph, TOPIC)


def test_it_ends_with_its_graph(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    gone = Publisher()
    with TopicStream(gone.graph, TOPIC) as stream:
        assert [one for arrivals in stream.batches(None) for one in arrivals] == []
    gone.context.destroy(linger=0)


def test_echo_for_a_person_shows_some_and_counts_the_others(publisher, monkeypatch, capsys):
    monkeypatch.setattr("sparseskin.launch.commands.topic.give_way", lambda: None)

    def publish():
        publisher.wait_for_subscription()
        publisher.send(30, period_ns=100_000_000)
        publisher.end()

    with ThreadPoolExecutor(1) as pool:
        published = pool.submit(publish)
        assert main(["topic", "echo", "skin/taxels", "--max-hz", "4"]) == 0
        published.result()
    printed = capsys.readouterr()
    assert (printed.out.count("---\n"), printed.out.count("--- (2 not shown)\n")) == (1, 9)
    assert printed.err.endswith(f"{TOPIC}: 10 shown, 20 not shown, 0 lost\n")
