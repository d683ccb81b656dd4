"""The gate of a writer: who is let in, by which keys, and that it is said who was not."""

import contextlib
import socket
import time
from pathlib import Path

import numpy as np
import pytest
import zmq
from conftest import PATIENCE_S, wait_until
from other_user import NOBODY, give

from sparseskin.launch.commands.cli import main
from sparseskin.messages import Taxels, decode
from sparseskin.nodes.network import gate as gate_module
from sparseskin.nodes.network import sockets
from sparseskin.nodes.network.gate import Gate
from sparseskin.nodes.network.keys import (
    KeyFileError,
    KeyPair,
    known_names,
    make_key_files,
    read_key_pair,
    read_public_key,
)
from sparseskin.nodes.network.network import Network
from sparseskin.nodes.network.sockets import Peer, Reader, Writer, make_context

TAXELS = "/skin/taxels"


def key_pair():
    public, secret = zmq.curve_keypair()
    return KeyPair(public.decode(), secret.decode())


SERVER = key_pair()
LISTED = key_pair()
UNLISTED = key_pair()


class Station:
    """A writer behind a gate, served as a runner serves it."""

    def __init__(self, endpoint, keys):
        self.context = make_context()
        self.lines = []
        known = {UNLISTED.public: "mallory", LISTED.public: "desk"}
        self.gate = Gate(
            self.context,
            keys,
            {LISTED.public: "desk"},
            known,
            lambda line: self.lines.append(line),
        )
        self.writer = Writer(self.context, endpoint, gate=self.gate)

    def serve(self):
        self.gate.serve()
        self.writer.serve_subscriptions()

    def until(self, done, what):
        poller = zmq.Poller()
        for served in (*self.gate.sockets, self.writer.socket):
            poller.register(served, zmq.POLLIN)
        deadline_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline_s, (
                f"gave up waiting for {what}: {self.lines}"
            )
            poller.poll(10)
            self.serve()

    def said(self, words):
        return any(words in line for line in self.lines)


@pytest.fixture
def station():
    with closing_station() as made:
        yield made


@contextlib.contextmanager
def closing_station(keys=SERVER, endpoint="tcp://127.0.0.1:*"):
    made = Station(endpoint, keys)
    yield made
    made.context.destroy(linger=0)


def half_open(station):
    """A connection whose peer says nothing."""
    stranger = socket.create_connection(
        ("127.0.0.1", int(station.writer.endpoint.rsplit(":", 1)[1]))
    )
    stranger.settimeout(PATIENCE_S)
    return stranger


def listen(context, station, keys, server_key, now_ns=lambda: 0):
    lines = []
    security = keys and {"key_pair": vars(keys), "allowed": {}, "names": {}}
    config = {"name": "reader", "endpoint": "inproc://reader", "security": security}
    node = Network(
        context, {**config, "distant_inputs": {TAXELS: "edge"}}, now_ns, lines.append
    )
    reader = node.make_reader([TAXELS])
    node.connect([Peer("writer", station.writer.endpoint, "edge", server_key)])
    return reader, node, lines


@pytest.mark.parametrize("endpoint", ["tcp://127.0.0.1:*", "ipc://{}/s"])
@pytest.mark.parametrize("keys", [SERVER, None], ids=["keys", "no keys"])
def test_who_is_on_the_list_gets_every_message(context, endpoint, keys, tmp_path):
    with closing_station(keys, endpoint.format(tmp_path)) as station:
        theirs = (LISTED, SERVER.public) if keys else (None, "")
        reader, node, _ = listen(context, station, *theirs)
        station.until(lambda: "reader" in station.writer.present, "the reader")
        forces = np.ones((2, 2), np.float32)
        station.writer.send(Taxels(stamp_ns=0, patch="skin", seq=7, forces=forces))
        wait_until(lambda: bool(reader.socket.poll(0)), "a message")
        assert decode(*reader.receive()).seq == 7
        node.serve()
        assert node.heard == {"writer": True}
        assert station.lines == []


@pytest.mark.parametrize(
    ("keys", "server_key", "words"),
    [
        (UNLISTED, SERVER.public, "its key is that of mallory, and not on the list"),
        (key_pair(), SERVER.public, "is not known here, and not on the list"),
        (LISTED, UNLISTED.public, "it has a wrong key for this host"),
        (None, "", "it uses no key"),
    ],
    ids=["not listed", "unknown", "wrong server key", "no key"],
)
def test_who_is_not_let_in_gets_nothing_and_is_named(
    station, context, keys, server_key, words
):
    reader, node, _ = listen(context, station, keys, server_key)
    station.until(lambda: station.said(words), words)
    station.writer.send(
        Taxels(stamp_ns=0, patch="skin", forces=np.ones((2, 2), np.float32))
    )
    assert station.writer.present == set()
    assert reader.receive() is None
    node.serve()
    assert node.heard == {"writer": False}
    line = next(line for line in station.lines if words in line)
    # who shows no key may be gone before its address can be asked for
    if "list" in words:
        assert "turned away 127.0.0.1" in line


def test_a_refusal_has_one_reason_in_the_log(monkeypatch):
    # A handshake that takes too long, as on a busy host, is another reason.
    for module in (gate_module, sockets):
        monkeypatch.setattr(module, "HANDSHAKE_MS", round(1e3 * PATIENCE_S))
    with closing_station() as station:
        # Before the second refusal the end of the first connection is read: no other one.
        for keys, words in (
            (UNLISTED, "its key is that of mallory"),
            (key_pair(), "is not known here"),
        ):
            of_process = make_context()
            # A new try could be broken off in its handshake, which is another reason.
            of_process.setsockopt(zmq.RECONNECT_IVL, -1)
            try:
                _, node, lines = listen(of_process, station, keys, SERVER.public)

                # The reader leaves once it knows: a broken handshake is another reason.
                def is_refused(node=node, lines=lines, station=station, words=words):
                    node.serve()
                    return bool(lines) and station.said(words)

                station.until(is_refused, words)
            finally:
                of_process.destroy(linger=0)
        others = [line for line in station.lines if "not on the list" not in line]
        assert others == []


def test_who_sends_garbage_is_named_and_harms_nobody(station, context):
    with half_open(station) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\nHost: skin\r\n\r\n" * 50)
        station.until(lambda: bool(station.lines), "a line")
    assert "turned away" in station.lines[0]
    _listening = listen(context, station, LISTED, SERVER.public)
    station.until(lambda: "reader" in station.writer.present, "the reader")


def test_refusals_of_many_addresses_fill_neither_memory_nor_log(station):
    n_more = 10_000
    address = "10.0.{}.7:1234"
    reason = "it uses no key"
    for k in range(gate_module.MAX_REFUSALS + n_more):
        station.gate._log_refusal(address.format(k), reason)
    assert len(station.gate._refused) == gate_module.MAX_REFUSALS + 1
    one_by_one, together = (
        [line for line in station.lines if ("one of many" in line) == is_other]
        for is_other in (False, True)
    )
    assert len(one_by_one) == gate_module.MAX_REFUSALS
    assert [line.partition("(")[2] for line in together] == [
        *("", *(f"{10**k} times)" for k in range(1, 5)))
    ]
    for _ in range(9):
        station.gate._log_refusal(address.format(0), reason)
    assert station.lines[-1] == f"turned away {address.format(0)}: {reason} (10 times)"


def test_more_connections_than_there_may_be_are_turned_away(
    station, context, monkeypatch
):
    monkeypatch.setattr(gate_module, "MAX_CONNECTIONS", 3)
    readers = [
        Reader(context, f"reader_{k}", (), [TAXELS], keys=LISTED) for k in range(4)
    ]
    for reader in readers[:3]:
        reader.connect(station.writer.endpoint, SERVER.public)
    station.until(lambda: len(station.writer.present) == 3, "as many as there may be")
    readers[3].connect(station.writer.endpoint, SERVER.public)
    station.until(lambda: station.said("there are 3 connections already"), "the limit")
    assert len(station.writer.present) == 3


def test_a_refused_reader_tries_again_by_itself(station, context):
    now_ns = 0
    _reader, node, lines = listen(
        context, station, UNLISTED, SERVER.public, lambda: now_ns
    )
    station.until(lambda: station.said("mallory"), "the refusal")

    def served_again():
        nonlocal now_ns
        now_ns += 100_000_000
        node.serve()
        return "reader" in station.writer.present

    wait_until(lambda: bool(served_again() or lines), "the reader's own line")
    assert "cannot connect to writer on edge" in lines[0]
    assert "it does not let this host in (the key is not on its list)" in lines[0]
    station.gate._allowed[UNLISTED.public] = (
        "mallory"  # somebody has put it on the list
    )
    station.until(served_again, "the reader")


def test_the_silent_connection_is_named_and_not_the_reader_that_came_after_it(
    station, context
):
    with half_open(station) as stranger:
        station.until(lambda: bool(station.gate._pending), "the stranger")
        reader, _, _ = listen(context, station, LISTED, SERVER.public)
        station.until(lambda: "reader" in station.writer.present, "the reader")
        assert len(station.gate._pending) == 1
        station.until(lambda: bool(station.lines), "a line")
        port = stranger.getsockname()[1]
        while stranger.recv(100):  # ZeroMQ's greeting, then the end
            pass
    reader.socket.close()
    station.until(lambda: not station.gate._open, "the end of the reader")
    (line,) = station.lines
    assert line.startswith(f"turned away 127.0.0.1:{port}: ")
    assert "sent nothing for 2 s" in line


def test_half_open_connections_are_bounded_and_keep_no_reader_out(
    station, context, monkeypatch
):
    monkeypatch.setattr(gate_module, "MAX_PENDING", 3)
    strangers = [half_open(station) for _ in range(10)]
    station.until(lambda: station.said("(10 times)") or station.said("too many"), "it")
    _reader = listen(context, station, LISTED, SERVER.public)
    station.until(lambda: "reader" in station.writer.present, "the reader")
    assert len(station.gate._pending) <= 3
    for stranger in strangers[:7]:
        while stranger.recv(100):  # ZeroMQ's greeting, then the end
            pass
    assert all("127.0.0.1" in line for line in station.lines)
    for stranger in strangers:
        stranger.close()


def test_of_too_many_connections_one_of_the_busiest_address_is_closed(
    station, monkeypatch
):
    closed = []
    monkeypatch.setattr(
        gate_module, "_shut_down", lambda fd, address: closed.append(address)
    )
    station.gate._pending = {
        3: "10.0.0.1:1",
        4: "10.0.0.7:1",
        5: "10.0.0.7:2",
        6: "10.0.0.2:1",
    }
    station.gate._close_one()
    assert closed == ["10.0.0.7:1"]
    assert list(station.gate._pending) == [3, 5, 6]
    ours, theirs = socket.socketpair()
    with ours, theirs:
        gate_module._shut_down(ours.fileno(), "10.0.0.7:1234")
        theirs.sendall(b"still open")
        assert ours.recv(100) == b"still open"


def test_keys_belong_together_and_the_command_names_both_files(
    tmp_path, monkeypatch, capsys
):
    secret, public = make_key_files("edge", tmp_path / "own")
    pair = read_key_pair(secret)
    assert pair.public == read_public_key(public)
    assert secret.stat().st_mode & 0o777 == 0o600
    assert pair.secret not in public.read_text()
    assert pair.secret not in repr(pair)
    assert known_names(secret.parent) == {pair.public: "edge"}
    monkeypatch.chdir(tmp_path)
    assert main(["keys", "make", "desk"]) == 0
    assert sorted(path.name for path in Path("keys").iterdir()) == [
        "desk.key",
        "desk.pub",
    ]
    before = Path("keys/desk.key").read_text()
    assert main(["keys", "make", "desk"]) == 2
    assert (
        "keys/desk.key: exists already, and is not written over"
        in capsys.readouterr().err
    )
    assert Path("keys/desk.key").read_text() == before


@pytest.mark.parametrize("name", ["", "Edge", "../edge", "a" * 40])
def test_what_is_no_name_makes_no_key(tmp_path, name):
    with pytest.raises(KeyFileError, match="NAME"):
        make_key_files(name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_secret_that_others_can_get_at_or_own_is_refused(tmp_path):
    secret, _ = make_key_files("edge", tmp_path)
    for mode in (0o640, 0o620):
        secret.chmod(mode)
        with pytest.raises(
            KeyFileError, match=rf"edge.key: mode {mode:04o} .*allowed: 0600"
        ):
            read_key_pair(secret)
    secret.chmod(0o600)
    give(secret)
    with pytest.raises(
        KeyFileError, match=rf"edge.key: belongs to user {NOBODY}, not to you"
    ):
        read_key_pair(secret)


@pytest.mark.parametrize(("what", "mode"), [("file", 0o646), ("folder", 0o777)])
def test_a_public_key_that_others_can_replace_or_own_is_refused(tmp_path, what, mode):
    _, public = make_key_files("edge", tmp_path)
    given = public if what == "file" else tmp_path
    before = given.stat().st_mode
    given.chmod(mode)
    with pytest.raises(
        KeyFileError, match=rf": mode {mode:04o} lets other users replace the key"
    ):
        read_public_key(public)
    assert known_names(tmp_path) == {}
    given.chmod(before)
    give(given)
    with pytest.raises(
        KeyFileError, match=rf"^{given}: belongs to user {NOBODY}, who can"
    ):
        read_public_key(public)


def test_a_public_key_that_others_cannot_replace_is_read(tmp_path):
    secret, public = make_key_files("edge", tmp_path)
    tmp_path.chmod(0o1777)
    public.chmod(0o664)
    assert read_public_key(public) == read_key_pair(secret).public


@pytest.mark.parametrize(
    "text",
    ["", "# nothing\n", "short\n", "a" * 40 + "\n" + "b" * 40, "é" * 40, "\0" * 40],
)
def test_what_holds_no_key_is_refused_by_name(tmp_path, text):
    path = tmp_path / "edge.key"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(
        KeyFileError, match=r"edge.key: (expected one key of 40|holds no secret)"
    ):
        read_key_pair(path)


def test_the_error_of_a_missing_key_names_the_command_that_makes_it(tmp_path):
    with pytest.raises(
        KeyFileError, match=r"edge.key: No such file.*sparseskin keys make edge"
    ):
        read_key_pair(tmp_path / "edge.key")


def test_the_oldest_of_too_many_connections_that_read_nothing_is_closed(
    station, monkeypatch
):
    monkeypatch.setattr(gate_module, "MAX_PENDING", 3)
    # Numbers of no open descriptor.
    first, *others, last = range(2**30, 2**30 + 4)
    for fd in (first, *others):
        station.gate._note(zmq.EVENT_ACCEPTED, fd)
    assert list(station.gate._pending) == [first, *others]
    assert station.lines == []
    station.gate._note(zmq.EVENT_ACCEPTED, last)
    assert list(station.gate._pending) == [*others, last]
    assert len(station.lines) == 1
