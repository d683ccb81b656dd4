"""The control socket, both ends over a real socket."""

import json
import selectors
import signal
import socket
import stat
from pathlib import Path

import pytest
from conftest import wait_until

from sparseskin.launch.run.controls import MAX_CLIENTS, MAX_LINE_BYTES, ControlServer
from sparseskin.launch.run.running import GraphError
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.process.control import MAX_QUEUED_BYTES, ControlClient


class Line:
    """A server that answers every request with its number, clients of it, and its loop."""

    def __init__(self, path):
        self.path = str(path)
        self._selector = selectors.DefaultSelector()
        self.unwatch = self._selector.unregister
        self.taken = []
        self.server = ControlServer(
            *(self.path, self), *(self._take, lambda node: {"of": node})
        )
        self._clients = []

    def watch(self, fd, on_ready):
        self._selector.register(fd, selectors.EVENT_READ, on_ready)

    def serve(self):
        for key, _ in self._selector.select(0.01):
            key.data()

    def _take(self, request, reply):
        self.taken.append(request)
        reply({"id": request.get("id")})

    def client(self):
        self._clients.append(ControlClient(self.path))
        return self._clients[-1]

    def receive(self, client, n=1):
        """The next n objects that a client is sent."""
        found = []

        def done():
            self.serve()
            found.extend(client.receive() or [])
            return len(found) >= n

        wait_until(done, f"{n} objects")
        assert len(found) == n
        return found

    def is_left(self, client):
        """True if the server has closed a client's line, once all that waits is read."""
        self.serve()
        return client.receive() is None

    def close(self):
        for client in self._clients:
            client.close()
        self.server.close()
        self._selector.close()


@pytest.fixture
def line(tmp_path):
    line = Line(tmp_path / "graph.sock")
    yield line
    line.close()


def test_a_request_may_come_in_pieces(line):
    client = line.client()
    data = json.dumps({"id": "ä"}, ensure_ascii=False).encode() + b"\n"
    for k in range(len(data)):
        client.connection.sendall(data[k : k + 1])
        line.serve()
    assert line.receive(client) == [{"answer": {"id": "ä"}}]


def test_only_watchers_receive_the_state_of_the_graph(line):
    watcher, other = line.client(), line.client()
    assert not line.server.watched
    watcher.send({"watch": True})
    other.send({"id": "1"})
    line.receive(other)
    wait_until(lambda: (line.serve(), line.server.watched)[1], "the watcher")
    line.server.publish({"graph": {"nodes": []}})
    assert (line.receive(watcher), other.receive()) == ([{"graph": {"nodes": []}}], [])
    watcher.close()
    wait_until(
        lambda: (line.serve(), not line.server.watched)[1], "the watcher to leave"
    )


@pytest.mark.parametrize("node", ["sensor", None])
def test_who_asks_for_a_description_receives_it_once(line, node):
    client = line.client()
    client.send({"describe": node})
    assert line.receive(client) == [{"description": {"of": node}}]
    assert line.taken == []
    line.server.publish({"graph": {}})
    client.send({"id": "1"})
    assert line.receive(client) == [{"answer": {"id": "1"}}]


def test_a_request_to_stop_is_confirmed_and_interrupts_the_launcher(line, monkeypatch):
    raised = []
    monkeypatch.setattr(signal, "raise_signal", raised.append)
    client = line.client()
    client.send({"stop": True})
    assert line.receive(client) == [{"stopping": True}]
    assert raised == [signal.SIGINT]
    client.send({"stop": False, "id": "2"})
    assert line.receive(client) == [{"answer": {"id": "2"}}]
    assert raised == [signal.SIGINT]


@pytest.mark.parametrize("bad", [b"{", b"[1, 2]", b"", b"\xff\xfe", b"[" * 5000])
def test_a_line_that_is_no_request_is_refused_and_the_next_is_taken(line, bad):
    client = line.client()
    client.connection.sendall(bad + b'\n{"id": "2"}\n')
    refused, answered = line.receive(client, 2)
    assert refused == {"error": "expected one JSON object a line"}
    assert (answered, line.taken) == ({"answer": {"id": "2"}}, [{"id": "2"}])


def test_a_line_without_end_is_cut_off(line):
    client, other = line.client(), line.client()
    client.connection.sendall(b"x" * (MAX_LINE_BYTES + 1))
    wait_until(lambda: line.is_left(client), "the client to be left")
    other.send({"id": "1"})
    assert line.receive(other) == [{"answer": {"id": "1"}}]


def test_a_watcher_that_does_not_read_holds_up_nobody(line):
    deaf, good = line.client(), line.client()
    for client in (deaf, good):
        client.send({"watch": True})
        client.send({"id": "1"})
        line.receive(good if client is good else deaf)
    state = {"graph": "x" * 50_000}
    n = 4 * MAX_QUEUED_BYTES // 50_000
    for _ in range(n):
        line.server.publish(state)
        assert line.receive(good) == [state]
        line.server.flush()
    found = []
    wait_until(
        lambda: bool(found.extend(deaf.receive() or []) or found),
        "what it was sent first",
    )
    assert found[0] == state
    assert len(found) < n


def test_one_client_too_many_is_turned_away_until_another_leaves(line):
    clients = [line.client() for _ in range(MAX_CLIENTS)]
    for client in clients:
        client.send({"id": "1"})
        line.receive(client)
    turned_away = line.client()
    wait_until(lambda: line.is_left(turned_away), "the client to be turned away")
    clients[3].close()
    wait_until(
        lambda: (line.serve(), len(line.server._clients))[1] < MAX_CLIENTS, "room"
    )
    client = line.client()
    client.send({"id": "1"})
    assert line.receive(client) == [{"answer": {"id": "1"}}]


def test_the_user_alone_may_connect_to_one_graph_and_learns_that_it_is_gone(line):
    with pytest.raises(
        GraphError, match="a graph listens there; SPARSESKIN_RUNTIME_DIR names"
    ):
        Line(Path(line.path))
    client = line.client()
    assert stat.S_IMODE(Path(line.path).stat().st_mode) == 0o600
    client.send({"id": "1"})
    line.receive(client)
    line.server.close()
    assert client.receive() is None
    assert not client.send({"id": "2"})
    assert not Path(line.path).exists()


@pytest.mark.parametrize("name", ["none.sock", "file", "left.sock"])
def test_where_nobody_listens_an_error_is_reported(tmp_path, name):
    (tmp_path / "file").touch()
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(tmp_path / "left.sock"))
    with pytest.raises(SparseskinError, match=f"{name}: no graph listens there: "):
        ControlClient(str(tmp_path / name))
