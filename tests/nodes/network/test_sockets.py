"""The sockets: nothing is lost for want of a subscription, what is latched reaches all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from conftest import wait_until

from sparseskin.messages import MalformedError, Message, PhiState, Taxels, decode
from sparseskin.messages.wire import Payload
from sparseskin.nodes.network.direct import DirectInlet, DirectOutlet
from sparseskin.nodes.network.poll import Poll
from sparseskin.nodes.network.sockets import Reader, Writer, make_context

TAXELS, PHI = "/skin/taxels", "/skin/phi"


@pytest.fixture
def context() -> Iterator[zmq.Context[Any]]:
    made = make_context()
    yield made
    made.destroy(linger=0)


@pytest.fixture(params=["inproc://writer", "tcp://127.0.0.1:*", "ipc://{}/s"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Any) -> str:
    return str(request.param).format(tmp_path)


class Pair:
    """A writer and its readers over one transport: an endpoint of ZeroMQ, or "direct"."""

    def __init__(self, context: zmq.Context[Any], endpoint: str, folder: Path) -> None:
        self._context, self._path = context, str(folder / "direct.unix")
        self._is_direct = endpoint == "direct"
        self._poll = Poll()
        outlet = DirectOutlet(self._path, self._poll, print) if self._is_direct else None
        self.writer = Writer(
            context, "inproc://beside" if self._is_direct else endpoint, direct=outlet
        )

    def reader(self, name: str, *topics: str) -> Reader:
        if not self._is_direct:
            return Reader(self._context, name, [self.writer.endpoint], topics)
        reader = Reader(self._context, name, (), topics, direct=DirectInlet(self._poll, print))
        reader.connect_direct(self._path)
        return reader

    def is_present(self, name: str) -> bool:
        self._poll.look()
        self.writer.serve_subscriptions()
        return name in self.writer.present

    def next_message(self, reader: Reader) -> Message:
        return decode(*self.next_messages(reader, 1)[0])

    def next_messages(self, reader: Reader, n: int) -> list[tuple[bytes, Payload]]:
        found: list[tuple[bytes, Payload]] = []

        def came() -> bool:
            self._poll.look()
            while len(found) < n and (parts := reader.receive()) is not None:
                found.append(parts)
            return len(found) == n

        wait_until(came, f"{n} messages")
        return found


@pytest.fixture(params=["inproc://writer", "tcp://127.0.0.1:*", "ipc://{}/s", "direct"])
def pair(request: pytest.FixtureRequest, tmp_path: Path, context: zmq.Context[Any]) -> Pair:
    return Pair(context, str(request.param).format(tmp_path), tmp_path)


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
    reader.close()
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
    assert isinstance(note, bytes)
    reader.answer(note)

    def has_answered() -> bool:
        return pair.is_present("reader") and not pair.writer.awaits(ask)

    wait_until(has_answered, "the answer")
    assert pair.writer.has_answered("reader", ask)


def test_a_topic_that_begins_like_another_is_not_taken_for_it(pair: Pair) -> None:
    reader = pair.reader("reader", TAXELS)
    wait_until(lambda: pair.is_present("reader"), "the reader")
    pair.writer.publish((b"/skin/taxels_raw", b"payload"))
    # Of no part, and of more than any message has, nothing is left but the topic.
    pair.writer.publish((b"/skin/taxels",))
    pair.writer.publish((b"/skin/taxels", b"part", b"part"))
    pair.writer.send(taxels(3))
    found = pair.next_messages(reader, 3)
    assert found[:2] == [(b"/skin/taxels", b""), (b"/skin/taxels", (b"part", b"part"))]
    for wrong in found[:2]:
        with pytest.raises(MalformedError):
            decode(*wrong)
    assert decode(*found[2]).seq == 3


def test_of_a_message_with_too_many_parts_nothing_is_left(
    context: zmq.Context[Any], endpoint: str, tmp_path: Path
) -> None:
    pair = Pair(context, endpoint, tmp_path)
    reader = pair.reader("reader", TAXELS)
    wait_until(lambda: pair.is_present("reader"), "the reader")
    pair.writer.publish((b"/skin/taxels", *[b"part"] * 16))
    assert pair.next_messages(reader, 1) == [(b"/skin/taxels", b"")]


def test_an_endpoint_in_use_is_refused(context: zmq.Context[Any], endpoint: str) -> None:
    writer = Writer(context, endpoint)
    with pytest.raises(zmq.ZMQError):
        Writer(context, writer.endpoint)


def test_junk_subscriptions_do_no_harm(context: zmq.Context[Any]) -> None:
    writer = Writer(context, "inproc://junk")
    junk = context.socket(zmq.XSUB)
    junk.connect(writer.endpoint)
    for note in (b"", b"\x01", b"\x02x", b"\x01@\xff\xfe", b"\x01" + b"t" * 200, b"\x00@gone"):
        junk.send(note)
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS])

    def is_present() -> bool:
        writer.serve_subscriptions()
        return "reader" in writer.present

    wait_until(is_present, "the reader")
    writer.send(taxels(0))
    wait_until(lambda: (parts := reader.receive()) is not None and len(parts[1]) == 2, "a frame")
