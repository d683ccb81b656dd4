"""Direct links: whole messages in order, bounded queues, no peer that does harm, no file left."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Thread

import pytest
import zmq
from conftest import PATIENCE_S, wait_until
from hypothesis import given
from hypothesis import strategies as st
from other_user import become_nobody

from sparseskin.messages.errors import MalformedError, MessageError, OversizedError
from sparseskin.messages.wire import MAX_MESSAGE_BYTES
from sparseskin.nodes.network import direct
from sparseskin.nodes.network.direct import DirectInlet, DirectOutlet, Link, LinkEndedError, framed
from sparseskin.nodes.network.poll import Poll

FRAMES, STATE = b"/skin/taxels", b"/skin/phi"


class Side:
    """One end of links, with what it waits with and what it logged."""

    def __init__(self) -> None:
        self.poll = Poll()
        self.lines: list[str] = []
        self.refused: list[MessageError] = []


class Sender(Side):
    def __init__(self, path: Path) -> None:
        super().__init__()
        self.outlet = DirectOutlet(str(path), self.poll, self.lines.append)
        self.notes: list[bytes] = []

    def serve(self) -> None:
        self.poll.look()
        while (received := self.outlet.note()) is not None:
            self.notes.append(received[0])

    def has(self, topic: bytes) -> bool:
        self.serve()
        return self.outlet.wants(topic)


class Receiver(Side):
    def __init__(self, path: Path, *topics: bytes) -> None:
        super().__init__()
        self.inlet = DirectInlet(self.poll, self.lines.append, self.refused.append)
        for topic in topics:
            self.inlet.subscribe(topic)
        self.inlet.connect(str(path))

    def received(self) -> list[Sequence[bytes]]:
        self.inlet.serve()
        found = []
        while (parts := self.inlet.receive()) is not None:
            found.append(parts)
        return found


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "7.0.unix"


@pytest.fixture
def sender(path: Path) -> Iterator[Sender]:
    made = Sender(path)
    yield made
    made.outlet.close()


def until_received(sender: Sender, receiver: Receiver, n: int) -> list[Sequence[bytes]]:
    found: list[Sequence[bytes]] = []

    def came() -> bool:
        sender.serve()
        found.extend(receiver.received())
        return len(found) >= n

    wait_until(came, f"{n} messages")
    return found


def connection_to(path: Path) -> socket.socket:
    made = socket.socket(socket.AF_UNIX)
    made.connect(str(path))
    return made


def is_closed(sender: Sender, connection: socket.socket) -> bool:
    """True if the other side has closed a connection."""
    sender.serve()
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False


def link_pair(max_bytes: int = MAX_MESSAGE_BYTES, buffer: int = 64) -> tuple[socket.socket, Link]:
    ours, theirs = socket.socketpair()
    return ours, Link(theirs, max_bytes, buffer)


@given(
    st.lists(st.lists(st.binary(max_size=200), min_size=1, max_size=16), max_size=6),
    st.integers(1, 300),
)
def test_messages_arrive_whole_and_in_order_however_they_are_cut(
    messages: list[list[bytes]], n_chunk: int
) -> None:
    ours, link = link_pair()
    data = b"".join(b"".join(framed(parts)[0]) for parts in messages)  # type: ignore[arg-type]
    found: deque[Sequence[bytes]] = deque()
    for begin in range(0, len(data), n_chunk):
        ours.send(data[begin : begin + n_chunk])
        while link.read(found):
            pass
    assert list(found) == messages
    ours.close()
    with pytest.raises(LinkEndedError):
        link.read(found)
    link.socket.close()


@given(st.binary(min_size=1, max_size=400))
def test_any_bytes_are_messages_or_are_refused_by_name(data: bytes) -> None:
    ours, link = link_pair(max_bytes=300)
    ours.send(data)
    found: deque[Sequence[bytes]] = deque()
    with contextlib.suppress(MalformedError, OversizedError):
        while link.read(found):
            pass
    n_bytes = sum(framed(parts)[1] for parts in found)
    assert b"".join(b"".join(framed(parts)[0]) for parts in found) == data[:n_bytes]  # type: ignore[arg-type]
    ours.close()
    link.socket.close()


@pytest.mark.parametrize(
    ("head", "error"),
    [
        (struct.pack("<I", 0), MalformedError),
        (struct.pack("<I", 17), MalformedError),
        (struct.pack("<2I", 1, MAX_MESSAGE_BYTES + 1), OversizedError),
        (struct.pack("<17I", 16, *[2**32 - 1] * 16), OversizedError),
    ],
)
def test_a_head_that_no_peer_sends_ends_the_link_before_its_message_comes(
    head: bytes, error: type[MessageError]
) -> None:
    ours, link = link_pair()
    ours.send(head)
    with pytest.raises(error):
        link.read(deque())
    ours.close()
    link.socket.close()


@pytest.mark.parametrize("n_bytes", [0, 16_384, 262_144, 2_000_000])
def test_a_message_of_any_size_arrives(sender: Sender, path: Path, n_bytes: int) -> None:
    receiver = Receiver(path, FRAMES)
    wait_until(lambda: sender.has(FRAMES), "the subscription")
    large = os.urandom(n_bytes)
    for k in range(3):
        sender.outlet.send((FRAMES, b"%d" % k, memoryview(large)), frame=True)
    found = until_received(sender, receiver, 3)
    assert found == [[FRAMES, b"%d" % k, large] for k in range(3)]


def test_of_what_waits_for_a_slow_reader_the_oldest_frames_are_dropped_and_no_state(
    sender: Sender, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(direct, "MAX_WAITING", 20)
    receiver = Receiver(path, FRAMES, STATE)
    wait_until(lambda: sender.has(STATE), "the subscription")
    frame = bytes(100_000)
    for k in range(200):
        sender.outlet.send((FRAMES, b"%d" % k, frame), frame=True)
        if k == 100:
            sender.outlet.send((STATE, b"state"))
    sender.outlet.send((FRAMES, b"200", frame), frame=True)
    found: list[Sequence[bytes]] = []

    def came() -> bool:
        sender.serve()
        found.extend(receiver.received())
        return bool(found) and found[-1][1] == b"200"

    wait_until(came, "the newest frame")
    numbers = [int(parts[1]) for parts in found if parts[0] == FRAMES]
    n_before = next(k for k, number in enumerate(numbers) if number != k)
    # What the kernel held, then the newest ones that were allowed to wait beside the state.
    assert numbers == [*range(n_before), *range(201 - 19, 201)]
    assert [STATE, b"state"] in found


def test_a_reader_that_never_reads_costs_another_nothing(sender: Sender, path: Path) -> None:
    _stalled, receiver = Receiver(path, FRAMES), Receiver(path, FRAMES)
    wait_until(lambda: sender.has(FRAMES) and len(sender.notes) == 2, "both subscriptions")
    found: list[Sequence[bytes]] = []
    for k in range(100):
        sender.outlet.send((FRAMES, b"%d" % k, bytes(16_384)), frame=True)
        found += until_received(sender, receiver, 1)
    assert [int(parts[1]) for parts in found] == list(range(100))


def test_a_reader_connects_again_to_a_writer_that_was_started_again(path: Path) -> None:
    first = Sender(path)
    receiver = Receiver(path, FRAMES)
    wait_until(lambda: first.has(FRAMES), "the subscription")
    first.outlet.send((FRAMES, b"before"), frame=True)
    first.outlet.close()  # with what it has sent still unread
    assert not path.exists()
    second = Sender(path)

    def subscribed() -> bool:
        found.extend(receiver.received())
        return second.has(FRAMES)

    found: list[Sequence[bytes]] = []
    wait_until(subscribed, "the subscription of the reader that connects again")
    second.outlet.send((FRAMES, b"after"), frame=True)
    found += until_received(second, receiver, 1)
    assert found == [[FRAMES, b"before"], [FRAMES, b"after"]]
    second.outlet.close()


def test_a_message_that_its_writer_did_not_finish_is_dropped(path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    receiver = Receiver(path, FRAMES)
    connection, _ = listener.accept()
    connection.send(b"".join(framed((FRAMES, b"whole"))[0]))  # type: ignore[arg-type]
    connection.send(b"".join(framed((FRAMES, b"cut off"))[0])[:-1])  # type: ignore[arg-type]
    connection.close()
    listener.close()
    found: list[Sequence[bytes]] = []

    def ended() -> bool:
        found.extend(receiver.received())
        return receiver.inlet.is_broken

    wait_until(ended, "the end of the link")
    assert found == [[FRAMES, b"whole"]]
    assert receiver.refused == []


def test_what_a_writer_sends_that_is_no_message_is_refused_by_name(path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    receiver = Receiver(path, FRAMES)
    connection, _ = listener.accept()
    connection.send(b"GET / HTTP/1.1\r\n\r\n")
    wait_until(lambda: not receiver.received() and bool(receiver.refused), "the refusal")
    assert [error.reason for error in receiver.refused] == ["malformed"]
    connection.close()
    listener.close()


@pytest.mark.parametrize(
    "junk",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        struct.pack("<2I", 1, 10_000),
        b"".join(framed((b"\x02/skin/taxels",))[0]),  # type: ignore[arg-type]
        b"".join(framed((b"",))[0]),  # type: ignore[arg-type]
        b"".join(framed((b"\x01/skin/taxels", b"more"))[0]),  # type: ignore[arg-type]
    ],
)
def test_a_reader_that_sends_anything_else_than_subscriptions_is_cut_off(
    sender: Sender, path: Path, junk: bytes
) -> None:
    good = Receiver(path, FRAMES)
    wait_until(lambda: sender.has(FRAMES), "the subscription")
    bad = connection_to(path)
    bad.send(junk)
    wait_until(lambda: sender.serve() is None and bool(sender.lines), "a line")
    (line,) = sender.lines
    assert line.startswith("a link that carries no subscriptions is closed: ")
    wait_until(lambda: is_closed(sender, bad), "the end of the connection")
    sender.outlet.send((FRAMES, b"0"), frame=True)
    assert until_received(sender, good, 1) == [[FRAMES, b"0"]]
    bad.close()


def test_links_and_subscriptions_beyond_a_bound_are_refused(
    sender: Sender, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(direct, "MAX_LINKS", 2)
    monkeypatch.setattr(direct, "MAX_TOPICS", 3)
    first = connection_to(path)
    for k in range(4):
        first.send(b"".join(framed((b"\x01%d" % k,))[0]))  # type: ignore[arg-type]
    wait_until(lambda: sender.serve() is None and bool(sender.lines), "a line")
    assert sender.lines[0].endswith("malformed or too many")
    assert not any(sender.has(b"%d" % k) for k in range(4))
    others = [connection_to(path) for _ in range(3)]
    wait_until(lambda: sender.serve() is None and len(sender.lines) == 2, "a second line")
    assert sender.lines[1] == "turned away a reader: there are 2 links already"
    for one in (first, *others):
        one.close()


def test_a_subscription_ends_with_the_last_link_that_has_it(sender: Sender, path: Path) -> None:
    first, second = Receiver(path, FRAMES), Receiver(path, FRAMES)
    wait_until(lambda: sender.serve() is None and len(sender.notes) == 2, "both subscriptions")
    first.inlet.unsubscribe(FRAMES)
    second.inlet.unsubscribe(b"/skin/never")
    second.inlet.subscribe(STATE)
    wait_until(lambda: sender.has(STATE), "the further subscription")
    assert sender.has(FRAMES)
    second.inlet.close()
    wait_until(lambda: not sender.has(FRAMES), "the end of the last link")
    leaves = sender.notes[3:]
    assert sorted(leaves) == [b"\x00" + STATE, b"\x00" + FRAMES]


def test_what_waits_is_still_sent_for_a_while_when_a_writer_ends(path: Path) -> None:
    sender, receiver = Sender(path), Receiver(path, FRAMES)
    wait_until(lambda: sender.has(FRAMES), "the subscription")
    for k in range(5):
        sender.outlet.send((FRAMES, b"%d" % k, bytes(300_000)), frame=True)
    found: list[Sequence[bytes]] = []

    def whole() -> bool:
        found.extend(receiver.received())
        return len(found) >= 5

    ends = Thread(target=sender.outlet.close, args=(1000 * int(PATIENCE_S),))
    ends.start()
    wait_until(whole, "what waited")  # the reader goes on while its writer ends
    ends.join()
    assert [bytes(parts[1]) for parts in found] == [b"%d" % k for k in range(5)]
    receiver.inlet.close()


def test_a_path_in_use_is_refused_and_one_that_was_left_is_taken_over(path: Path) -> None:
    first = Sender(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(zmq.ZMQError, match="Address already in use"):
        Sender(path)
    first.outlet._listener.close()  # as of a process that was killed
    second = Sender(path)
    receiver = Receiver(path, FRAMES)
    wait_until(lambda: second.has(FRAMES), "the subscription")
    receiver.inlet.close()
    second.outlet.close()
    assert not path.exists()


def foreign(connection: socket.socket) -> int:
    return os.geteuid() + 1


def test_processes_of_another_user_are_refused_on_both_sides(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender = Sender(path)
    monkeypatch.setattr(direct, "peer_uid", foreign)
    receiver = Receiver(path, FRAMES)
    with connection_to(path) as stranger:
        wait_until(lambda: is_closed(sender, stranger), "the end of the connection")
    uid = os.geteuid() + 1
    assert sender.lines[0] == f"turned away user {uid}: links are for the user of the graph alone"
    assert receiver.lines == [f"cannot connect to {path}: user {uid} listens there"]
    assert receiver.inlet.is_broken
    sender.outlet.close()


@pytest.fixture
def as_nobody() -> Callable[[str], str]:
    return become_nobody()


def test_the_kernel_names_the_user_at_the_other_end(
    tmp_path: Path, as_nobody: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir("/tmp")
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.geteuid() and folder != Path("/"):
            folder.chmod(folder.stat().st_mode | 0o011)
    path = tmp_path / "open.unix"
    sender = Sender(path)
    path.chmod(0o666)  # as if the folder did not keep others out
    code = f"import socket; s = socket.socket(socket.AF_UNIX); s.connect({str(path)!r})"
    assert as_nobody(code) == ""
    wait_until(lambda: sender.serve() is None and bool(sender.lines), "a line")
    assert sender.lines == ["turned away user 65534: links are for the user of the graph alone"]
    sender.outlet.close()


def test_a_writer_without_a_free_descriptor_sleeps_and_accepts_later(
    sender: Sender, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    accept = sender.outlet._listener.accept
    tries: list[None] = []

    class Full:
        """A listener that has no descriptor left."""

        fileno = sender.outlet._listener.fileno
        close = sender.outlet._listener.close

        def accept(self) -> tuple[socket.socket, object]:
            tries.append(None)
            if len(tries) < 3:
                raise OSError(errno.EMFILE, "Too many open files")
            return accept()

    monkeypatch.setattr(sender.outlet, "_listener", Full())
    receiver = Receiver(path, FRAMES)
    wait_until(lambda: sender.has(FRAMES), "the subscription")
    assert len(tries) == 3
    assert sender.lines == ["no file descriptor is free for a link"]
    sender.outlet.send((FRAMES, b"0"), frame=True)
    assert until_received(sender, receiver, 1) == [[FRAMES, b"0"]]
