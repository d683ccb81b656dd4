"""The sockets: nothing is lost for want of a subscription, what is latched reaches all."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zmq
from conftest import wait_until

from sparseskin.messages import MalformedError, Message, PhiState, Taxels, decode
from sparseskin.messages.wire import Payload
from sparseskin.nodes.network.sockets import Reader, Writer, make_context

TAXELS, PHI = "/skin/taxels", "/skin/phi"


@pytest.fixture(params=["inproc://writer", "tcp://127.0.0.1:*", "ipc://{}/s"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Any) -> str:
    return str(request.param).format(tmp_path)


@pytest.fixture
def context() -> Iterator[zmq.Context[Any]]:
    made = make_context()
    yield made
    made.destroy(linger=0)


def taxels(seq: int) -> Taxels:
    return Taxels(stamp_ns=seq, patch="skin", seq=seq, forces=np.ones((2, 2), np.float32))


def phi() -> PhiState:
    return PhiState(
        stamp_ns=0, patch="skin", kind="full", n=4, m=4, block=1, seed=0, fingerprint="0" * 16
    )


def next_message(reader: Reader) -> Message:
    found: list[tuple[bytes, Payload]] = []

    def came() -> bool:
        parts = reader.receive()
        if parts is not None:
            found.append(parts)
        return bool(found)

    wait_until(came, "a message")
    return decode(*found[0])


def is_present(writer: Writer, name: str) -> bool:
    writer.serve_subscriptions()
    return name in writer.present


def test_a_present_reader_misses_nothing(context: zmq.Context[Any], endpoint: str) -> None:
    writer = Writer(context, endpoint)
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS])
    wait_until(lambda: is_present(writer, "reader"), "the reader")
    for seq in range(500):
        writer.send(taxels(seq))
    assert [next_message(reader).seq for _ in range(500)] == list(range(500))


def test_a_late_subscriber_receives_latched_messages_only(
    context: zmq.Context[Any], endpoint: str
) -> None:
    writer = Writer(context, endpoint)
    writer.send(phi())
    writer.send(taxels(0))
    for name in ("first", "second"):
        reader = Reader(context, name, [writer.endpoint], [TAXELS, PHI])
        wait_until(lambda name=name: is_present(writer, name), name)  # type: ignore[misc]
        writer.send(taxels(1))
        assert next_message(reader) == phi()
        assert next_message(reader).seq == 1


def test_a_reader_that_leaves_is_no_longer_present(
    context: zmq.Context[Any], endpoint: str
) -> None:
    writer = Writer(context, endpoint)
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS])
    wait_until(lambda: is_present(writer, "reader"), "the reader")
    reader.socket.close()
    wait_until(lambda: not is_present(writer, "reader"), "its leaving")


def test_a_topic_that_begins_like_another_is_not_taken_for_it(
    context: zmq.Context[Any], endpoint: str
) -> None:
    writer = Writer(context, endpoint)
    reader = Reader(context, "reader", [writer.endpoint], [TAXELS])
    wait_until(lambda: is_present(writer, "reader"), "the reader")
    writer.socket.send_multipart((b"/skin/taxels_raw", b"payload"))
    for n_parts in (0, 2, 16):
        writer.socket.send_multipart((b"/skin/taxels", *[b"part"] * n_parts))
    writer.send(taxels(3))
    found: list[tuple[bytes, Payload]] = []

    def took_all() -> bool:
        parts = reader.receive()
        if parts is not None:
            found.append(parts)
        return len(found) == 4

    wait_until(took_all, "four messages")
    # Of no part, and of more than any message has, nothing is left but the topic.
    assert found[0] == found[2] == (b"/skin/taxels", b"")
    assert found[1] == (b"/skin/taxels", (b"part", b"part"))
    for wrong in found[:3]:
        with pytest.raises(MalformedError):
            decode(*wrong)
    assert decode(*found[3]).seq == 3


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
    wait_until(lambda: is_present(writer, "reader"), "the reader")
    writer.send(taxels(0))
    assert next_message(reader).seq == 0
