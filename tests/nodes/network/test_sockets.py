"""The sockets: nothing is lost for want of a subscription, what is latched reaches all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import zmq
from conftest import wait_until
from zmq_contexts import context as context
from zmq_contexts import wait_for_reader

from sparseskin.messages import Message, PhiState, Taxels, TruncatedError, decode
from sparseskin.messages.wire import Payload, wire_bytes
from sparseskin.nodes.network.sockets import Reader, Writer

TAXELS, PHI = "/skin/taxels", "/skin/phi"


@pytest.fixture(params=["inproc://writer", "tcp://127.0.0.1:*", "ipc://{}/s"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Any) -> str:
    return str(request.param).format(tmp_path)


class Pair:
    """A writer and its readers over one endpoint."""

    def __init__(self, context: zmq.Context[Any], endpoint: str) -> None:
        self._context = context
        self.writer = Writer(context, endpoint)

    def reader(self, name: str, *topics: str) -> Reader:
        return Reader(self._context, name, [self.writer.endpoint], topics)

    def is_present(self, name: str) -> bool:
        self.writer.serve_subscriptions()
        return name in self.writer.present

    def next_message(self, reader: Reader) -> Message:
        return decode(*self.next_messages(reader, 1)[0])

    def next_messages(self, reader: Reader, n: int) -> list[tuple[bytes, Payload]]:
        found: list[tuple[bytes, Payload]] = []

        def came() -> bool:
            while len(found) < n and (parts := reader.receive()) is not None:
                found.append(parts)
            return len(found) == n

        wait_until(came, f"{n} messages")
        return found


@pytest.fixture
def pair(context: zmq.Context[Any], endpoint: str) -> Pair:
    return Pair(context, endpoint)


def taxels(seq: int) -> Taxels:
    return Taxels(stamp_ns=seq, patch="skin", seq=seq, forces=np.ones((2, 2), np.float32))


def phi() -> PhiState:
    return PhiState(
        stamp_ns=0, patch="skin", kind="full", n=4, m=4, block=1, seed=0, fingerprint="0" * 16
    )


def test_a_present_reader_misses_nothing(pair: Pair) -> None:
    reader = pair.reader("reader", TAXELS)
    wait_until(lambda: pair.is_present("reader"), "the reader")
    for seq in range(500):
        pair.writer.send(taxels(seq))
    found = [decode(*parts).seq for parts in pair.next_messages(reader, 500)]
    assert found == list(range(500))


def test_a_late_subscriber_receives_latched_messages_only(pair: Pair) -> None:
    pair.writer.send(phi())
    pair.writer.send(taxels(0))
    for name in ("first", "second"):
        reader = pair.reader(name, TAXELS, PHI)
        wait_until(lambda name=name: pair.is_present(name), name)  # type: ignore[misc]
        pair.writer.send(taxels(1))
        assert pair.next_message(reader) == phi()
        assert pair.next_message(reader).seq == 1


def test_a_reader_that_leaves_is_no_longer_present(pair: Pair) -> None:
    reader = pair.reader("reader", TAXELS)
    wait_until(lambda: pair.is_present("reader"), "the reader")
    reader.socket.close()
    wait_until(lambda: not pair.is_present("reader"), "its leaving")


def test_a_writer_knows_when_all_that_it_sent_is_processed(pair: Pair) -> None:
    reader = pair.reader("reader", TAXELS)
    wait_until(lambda: pair.is_present("reader"), "the reader")
    pair.writer.send(taxels(0))
    ask = pair.writer.ask()
    assert pair.writer.awaits(ask)
    frame, (topic, note) = pair.next_messages(reader, 2)
    assert decode(*frame).seq == 0
    assert reader.is_ask(topic)
    reader.answer(bytes(note))

    def has_answered() -> bool:
        return pair.is_present("reader") and not pair.writer.awaits(ask)

    wait_until(has_answered, "the answer")
    assert pair.writer.has_answered("reader", ask)


def test_a_topic_that_begins_like_another_is_not_taken_for_it(pair: Pair) -> None:
    reader = pair.reader("reader", TAXELS)
    wait_until(lambda: pair.is_present("reader"), "the reader")
    pair.writer.socket.send(b"/skin/taxels_raw\0payload")
    pair.writer.socket.send(b"/skin/taxels")
    # Of several parts each is a message: these are two of no payload, and one of another topic.
    pair.writer.socket.send_multipart((b"/skin/taxels", b"part", b"/skin/taxels"))
    pair.writer.send(taxels(3))
    found = pair.next_messages(reader, 4)
    assert found[:3] == [(b"/skin/taxels", b"")] * 3
    for wrong in found[:3]:
        with pytest.raises(TruncatedError):
            decode(*wrong)
    assert decode(*found[3]).seq == 3


def test_a_message_without_a_reader_is_not_encoded(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded: list[Message] = []

    def encode(message: Message) -> bytes:
        encoded.append(message)
        return wire_bytes(message)

    monkeypatch.setattr("sparseskin.nodes.network.sockets.wire_bytes", encode)
    pair.writer.send(taxels(0))
    assert not encoded
    reader = pair.reader("reader", TAXELS)
    wait_until(lambda: pair.is_present("reader"), "the reader")
    pair.writer.send(taxels(1))
    assert [message.seq for message in encoded] == [1]
    assert pair.next_message(reader).seq == 1


def test_junk_subscriptions_do_no_harm(context: zmq.Context[Any]) -> None:
    writer = Writer(context, "inproc://junk")
    junk = context.socket(zmq.XSUB)
    junk.connect(writer.endpoint)
    for note in (b"", b"\x01", b"\x02x", b"\x01@\xff\xfe", b"\x01" + b"t" * 200, b"\x00@gone"):
        junk.send(note)
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS])

    wait_for_reader(writer, "reader")
    writer.send(taxels(0))
    wait_until(lambda: reader.receive() is not None, "a frame")
