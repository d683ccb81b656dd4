"""The sockets: nothing is lost for want of a subscription, what is latched reaches all."""

import numpy as np
import pytest
from conftest import wait_until
from zmq_contexts import context as context
from zmq_contexts import wait_for_reader

from sparseskin.messages import PhiState, Taxels, TruncatedError, decode
from sparseskin.nodes.network.sockets import Reader, Writer

TAXELS, PHI = "/skin/taxels", "/skin/phi"


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
    return Taxels(stamp_ns=seq, patch="skin", seq=seq, forces=np.ones((2, 2), np.float32))


@pytest.mark.parametrize("endpoint", ["inproc://writer", "tcp://127.0.0.1:*", "ipc://{}/s"])
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
    of_phi = {"kind": "full", "n": 4, "m": 4, "block": 1, "seed": 0, "fingerprint": "0" * 16}
    phi = PhiState(stamp_ns=0, patch="skin", **of_phi)
    pair.writer.send(phi)
    pair.writer.send(taxels(0))
    for name in ("first", "second"):
        reader = pair.reader(TAXELS, PHI, name=name)
        pair.writer.send(taxels(1))
        state, frame = (decode(*parts) for parts in pair.next_messages(reader, 2))
        assert (state, frame.seq) == (phi, 1)


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
