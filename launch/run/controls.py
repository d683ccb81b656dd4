"""The controls of a running graph, at its control socket: one JSON object a line, for programs of
the same user.

It lies in the folder of the notes, which no other user may enter. A client writes requests
{id, node, command, value} and reads their answers {"answer": ...}; {"watch": true} brings
{"graph": ...} too, again and again; {"describe": NODE or null} brings {"description": ...}, once;
{"stop": true} ends the graph as Ctrl-C does, and brings {"stopping": true}.
"""

import contextlib
import json
import os
import secrets
import signal
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sparseskin.launch.launchfile.spec import LAUNCHER, LaunchFile
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.files import is_served
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.control import MAX_DEPTH, Connection, is_shallow

from .fleet import Fleet
from .live_recording import LiveRecording
from .process import NodeProcess, awake_s
from .running import GraphError
from .state import graph_description, graph_state

NEWS_S = 0.5
"""Longest time between two published states of the graph; a change is published at once."""

Reply = Callable[[dict[str, Any]], None]
"""Called with the answer: {id, node, done, text}."""

PATIENCE_S = 20.0
"""Longest time that a node may take to answer, seconds. Chosen: a dense matrix of 4096 taxels takes
some seconds to make, compiled loops as long to compile, and more where the host is busy."""
MAX_OPEN = 256
"""Most requests without an answer."""
MAX_CLIENTS = 32
MAX_LINE_BYTES = 65536


@dataclass
class _Open:
    """A request that a node has not answered yet."""

    id: str
    node: str
    command: str
    reply: Reply
    deadline_s: float


class Requests:
    """Passes requests on to nodes, and returns each answer once. For requests to the launcher
    itself `own` is called with (command, value, answer); it calls answer(done, text).
    """

    def __init__(
        self,
        nodes: Mapping[str, NodeProcess],
        own: Callable[[str, Any, Callable[[bool, str], None]], None],
    ) -> None:
        self._nodes = nodes
        self._own = own
        self._open: dict[str, _Open] = {}

    def take(self, request: Mapping[str, Any], reply: Reply) -> None:
        """Pass on one request {id, node, command, value}; the reply is called once."""
        number, node, command = (request.get(key) for key in ("id", "node", "command"))
        asked = _Open(str(number)[:64], str(node)[:64], str(command)[:64], reply, 0.0)
        if not (isinstance(number, str) and isinstance(node, str) and isinstance(command, str)):
            _answer(asked, False, "expected the texts id, node and command")
        elif not is_shallow(request.get("value")):
            _answer(asked, False, f"value: nested more than {MAX_DEPTH} deep")
        elif node == LAUNCHER:
            try:
                self._own(command, request.get("value"), lambda *what: _answer(asked, *what))
            except RefusedError as error:
                _answer(asked, False, str(error))
        elif fault := self._fault(node, command, request.get("value")):
            _answer(asked, False, fault)
        else:
            asked.deadline_s = awake_s() + PATIENCE_S
            key = secrets.token_hex(8)
            self._open[key] = asked
            self._nodes[node].command(command, id=key, value=request.get("value"))

    def answered(self, event: Mapping[str, Any]) -> None:
        """Return the answer of a node."""
        asked = self._open.pop(event["id"], None)
        if asked is not None:
            _answer(asked, event["done"], event["text"])

    def expire(self) -> None:
        """Answer in place of nodes that are late or gone."""
        now_s = awake_s()
        for key, asked in list(self._open.items()):
            node = self._nodes.get(asked.node)
            gone = node is None or node.exit_code() is not None
            if gone or asked.deadline_s < now_s:
                del self._open[key]
                why = (
                    "has ended"
                    if gone
                    else f"has not answered within {PATIENCE_S:g} s, and may still do it"
                )
                _answer(asked, False, f"{asked.node} {why}")

    def _fault(self, node: str, command: str, value: Any) -> str:
        """Why a request cannot be passed on; "" where it can."""
        if node not in self._nodes:
            return f"{node[:64]}: no such node{did_you_mean(node, [*self._nodes, LAUNCHER])}"
        process = self._nodes[node]
        known = ("set", *process.spec.cls.commands)
        if command not in known:
            return f"{node}: has no command '{command[:64]}'{did_you_mean(command, known)}"
        if command == "set" and not (isinstance(value, dict) and value):
            return f"{node}: set: expected settings and their values"
        if not process.ready or process.ended or process.exit_code() is not None:
            return f"{node} does not run just now"
        if len(self._open) >= MAX_OPEN:
            return f"{MAX_OPEN} requests wait for an answer already"
        return ""


def _answer(asked: _Open, done: bool, text: str) -> None:
    asked.reply({"id": asked.id, "node": asked.node, "done": done, "text": text})


class ControlServer:
    """The launcher's end of the control socket at `path`, served in the loop of the fleet.

    `take` is called with (request, reply); `describe` with the name of a node, or None, and returns
    the description of the graph.
    Raises GraphError if the socket cannot be made, or another process listens there.
    """

    def __init__(
        self,
        path: str,
        fleet: Fleet,
        take: Callable[[Mapping[str, Any], Reply], None],
        describe: Callable[[str | None], dict[str, Any]],
    ) -> None:
        self._path = path
        self._fleet = fleet
        self._take = take
        self._describe = describe
        self._clients: list[Connection] = []
        if is_served(Path(path)):  # a process of another container can have the same number
            raise GraphError(f"{path}: a graph listens there; SPARSESKIN_RUNTIME_DIR names another")
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            Path(path).unlink(missing_ok=True)  # left by a process that had the same number
            self._socket.bind(path)
            os.chmod(path, 0o600)
        except OSError as error:
            raise GraphError(f"{path}: {error.strerror}") from error
        self._socket.listen(MAX_CLIENTS)
        self._socket.setblocking(False)
        fleet.watch(self._socket, self._accept)

    @property
    def watched(self) -> bool:
        """True if a client watches the state of the graph."""
        return any(client.watches for client in self._clients)

    def flush(self) -> None:
        """Send what is queued; drop the clients that do not read."""
        for client in [client for client in self._clients if not client.flush()]:
            self._drop(client)

    def publish(self, fields: dict[str, Any]) -> None:
        """Send one object, which a newer one will replace, to all clients that watch and have read
        what was sent before.
        """
        for client in [one for one in self._clients if one.watches and one.idle]:
            self._send(client, fields)

    def close(self) -> None:
        for client in list(self._clients):
            self._drop(client)
        self._socket.close()
        Path(self._path).unlink(missing_ok=True)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # it has left, or no descriptor is free
            connection, _ = self._socket.accept()
            if len(self._clients) >= MAX_CLIENTS:
                connection.close()
                return
            client = Connection(connection, MAX_LINE_BYTES)
            self._clients.append(client)
            self._fleet.watch(connection, partial(self._serve, client))

    def _serve(self, client: Connection) -> None:
        lines = client.lines()
        if lines is None:
            self._drop(client)
            return
        for line in lines:
            try:
                request = json.loads(line)
            except (ValueError, RecursionError):
                request = None
            if not isinstance(request, dict):
                self._send(client, {"error": "expected one JSON object a line"})
            elif request.get("watch"):
                client.watches = True
            elif "describe" in request:
                self._send(client, {"description": self._describe(request["describe"])})
            elif request.get("stop") is True:
                self._send(client, {"stopping": True})
                signal.raise_signal(signal.SIGINT)
            else:
                self._take(request, lambda answer: self._send(client, {"answer": answer}))

    def _send(self, client: Connection, fields: Mapping[str, Any]) -> None:
        if client in self._clients and not client.send(fields):
            self._drop(client)

    def _drop(self, client: Connection) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._fleet.unwatch(client.connection)
            client.connection.close()


class Controls:
    """Requests to the nodes of a graph of this launcher, and news of it, at its control socket.
    Raises GraphError if the socket cannot be made.
    """

    def __init__(self, launch: LaunchFile, fleet: Fleet, path: str) -> None:
        self._launch = launch
        self._fleet = fleet
        self._recording = LiveRecording(launch, fleet)
        self._requests = Requests(fleet.nodes, self._recording.command)
        self._server = ControlServer(path, fleet, self._requests.take, self._describe)
        self._next_s = 0.0
        self._conditions: list[str] = []
        fleet.hear = self._hear

    def serve(self) -> None:
        """Publish the state of the graph; answer in place of nodes that are late."""
        self._requests.expire()
        self._server.flush()
        conditions = [self._fleet.condition(node) for node in self._fleet]
        if conditions == self._conditions and awake_s() < self._next_s:
            return
        self._conditions = conditions
        self._next_s = awake_s() + NEWS_S
        if self._server.watched:
            state = graph_state(self._launch, self._fleet, self._recording.out)
            self._server.publish({"graph": state})

    def close(self) -> None:
        """Accept no more requests."""
        self._server.close()

    def _describe(self, node: str | None) -> dict[str, Any]:
        return graph_description(self._launch, self._fleet, self._recording.out, node)

    def _hear(self, node: NodeProcess, event: dict[str, Any]) -> None:
        self._recording.hear(node, event["event"])
        if event["event"] == "answer":
            self._requests.answered(event)
            self._next_s = 0.0
