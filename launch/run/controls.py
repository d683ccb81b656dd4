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
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from sparseskin.launch.launchfile.load import single_node
from sparseskin.launch.launchfile.spec import LAUNCHER, LIVE_RECORDER, LaunchFile
from sparseskin.nodes.errors import RefusedError, SparseskinError
from sparseskin.nodes.files import is_served
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.process.control import MAX_DEPTH, Connection, Document, is_shallow

from .fleet import Fleet
from .process import NodeProcess, awake_s
from .running import GraphError
from .state import graph_description, graph_state

NEWS_S = 0.5
"""Longest time between two published states of the graph; a change is published at once."""

Reply = Callable[[Document], None]
"""Called with the answer: {id, node, done, text}."""
Say = Callable[[bool, str], None]
"""Called with the answer to one request: done or not, and the text."""

PATIENCE_S = 20.0
"""Longest time that a node may take to answer, seconds. Chosen: a dense matrix of 4096 taxels takes
some seconds to make, compiled loops as long to compile, and more where the host is busy."""
MAX_OPEN = 256
"""Most requests without an answer."""
MAX_CLIENTS = 32
"""Most programs that are connected at once; a command is connected as long as it asks."""
MAX_LINE_BYTES = 65536
"""Longest request: settings may be tables of some hundred values."""


class Requests:
    """Passes requests on to nodes, and returns each answer once. For requests to the launcher
    itself `own` is called with (command, value, answer); it calls answer(done, text).
    """

    def __init__(
        self, nodes: Mapping[str, NodeProcess], own: Callable[[str, Any, Say], None]
    ) -> None:
        self._nodes = nodes
        self._own = own
        self._open: dict[str, tuple[str, Say, float]] = {}

    def take(self, request: Mapping[str, Any], reply: Reply) -> None:
        """Pass on one request {id, node, command, value}; the reply is called once."""
        # Whatever a client sends is answered, and so named, by texts of a bounded length.
        stated = [request.get(key) for key in ("id", "node", "command")]
        number, node, command = map(str, stated)
        value = request.get("value")

        def say(done: bool, text: str) -> None:
            answer = {
                "id": number[:64],
                "node": node[:64],
                "done": done,
                "text": text,
            }
            reply(answer)

        try:
            if not all(isinstance(entry, str) for entry in stated):
                raise RefusedError("expected the texts id, node and command")
            if not is_shallow(value):
                raise RefusedError(f"value: nested more than {MAX_DEPTH} deep")
            if node == LAUNCHER:
                self._own(command, value, say)
                return
            self._check(node, command, value)
        except RefusedError as error:
            say(False, str(error))
            return

        # Numbers of clients may be equal; towards the node each request has a key of its own.
        key = secrets.token_hex(8)
        self._open[key] = node, say, awake_s() + PATIENCE_S
        self._nodes[node].command(command, id=key, value=value)

    def answered(self, event: Mapping[str, Any]) -> None:
        """Return the answer of a node."""
        # A node may answer after its request has been answered in its place.
        if event["id"] in self._open:
            _, say, _ = self._open.pop(event["id"])
            say(event["done"], event["text"])

    def expire(self) -> None:
        """Answer in place of nodes that are late or gone."""
        for key, request in list(self._open.items()):
            name, say, deadline_s = request
            node = self._nodes.get(name)
            if node is None or node.exit_code() is not None:
                why = "has ended"
            elif deadline_s < awake_s():
                why = f"has not answered within {PATIENCE_S:g} s, and may still do it"
            else:
                continue
            del self._open[key]
            say(False, f"{name} {why}")

    def _check(self, name: str, command: str, value: Any) -> None:
        """Raise RefusedError if a request cannot be passed on."""
        if name not in self._nodes:
            hint = did_you_mean(name, [*self._nodes, LAUNCHER])
            raise RefusedError(f"{name[:64]}: no such node{hint}")
        node = self._nodes[name]
        commands = ("set", *node.spec.cls.commands)
        if command not in commands:
            hint = did_you_mean(command, commands)
            raise RefusedError(f"{name}: has no command '{command[:64]}'{hint}")
        if command == "set" and not (isinstance(value, dict) and value):
            raise RefusedError(f"{name}: set: expected settings and their values")
        if not node.ready or node.ended or node.exit_code() is not None:
            raise RefusedError(f"{name} does not run just now")
        if len(self._open) >= MAX_OPEN:
            raise RefusedError(f"{MAX_OPEN} requests wait for an answer already")


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
        describe: Callable[[str | None], Document],
    ) -> None:
        self._path = path
        self._fleet = fleet
        self._take = take
        self._describe = describe
        self._clients: list[Connection] = []
        # A process of another container can have the same number.
        if is_served(Path(path)):
            raise GraphError(
                f"{path}: a graph listens there; SPARSESKIN_RUNTIME_DIR names another"
            )
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            # Left by a process that had the same number.
            Path(path).unlink(missing_ok=True)
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
        for client in list(self._clients):
            if not client.flush():
                self._drop(client)

    def publish(self, fields: Document) -> None:
        """Send one object, which a newer one will replace, to all clients that watch and have read
        what was sent before.
        """
        for client in list(self._clients):
            if client.watches and client.idle:
                self._send(client, fields)

    def close(self) -> None:
        # Whoever waits for the end of the graph sees it by this.
        for client in list(self._clients):
            self._drop(client)
        self._socket.close()
        Path(self._path).unlink(missing_ok=True)

    def _accept(self) -> None:
        # It may have left, or no descriptor is free.
        with contextlib.suppress(OSError):
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
            # Anything may come: a deep nest of brackets makes the parser recurse.
            try:
                request = json.loads(line)
            except (ValueError, RecursionError):
                request = None
            if not isinstance(request, dict):
                self._send(client, {"error": "expected one JSON object a line"})
            elif request.get("watch"):
                client.watches = True
            elif "describe" in request:
                description = self._describe(request["describe"])
                self._send(client, {"description": description})
            elif request.get("stop") is True:
                # The handler of the launcher counts it as an interrupt.
                self._send(client, {"stopping": True})
                signal.raise_signal(signal.SIGINT)
            else:
                self._take(request, partial(self._answer, client))

    def _answer(self, client: Connection, answer: Mapping[str, Any]) -> None:
        self._send(client, {"answer": answer})

    def _send(self, client: Connection, fields: Mapping[str, Any]) -> None:
        if client in self._clients and not client.send(fields):
            self._drop(client)

    def _drop(self, client: Connection) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._fleet.unwatch(client.connection)
            client.connection.close()


class LiveRecording:
    """Starts a recorder of all topics on request, as one node more, and stops it on request."""

    def __init__(self, launch: LaunchFile, fleet: Fleet) -> None:
        self._launch = launch
        self._fleet = fleet
        self._node = ""
        self._say: Say | None = None
        self._n = 0
        self.out: str | None = None

    def command(self, name: str, value: Any, say: Say) -> None:
        """Take the request "record": true or false.
        Raises RefusedError if it is not that, or a recording cannot begin or end just now.
        """
        if name != "record" or not isinstance(value, bool):
            raise RefusedError(
                f"launch: {name}: expected the command 'record', true or false"
            )
        if self._say is not None:
            raise RefusedError("record: the last request is still being done")
        # Two pages may ask at once: the second one is told.
        if value and self.out is not None:
            raise RefusedError(f"record: already on: {self.out}")
        if not value and self.out is None:
            raise RefusedError("record: not on")
        if value:
            self._begin()
        else:
            self._fleet.nodes[self._node].command("stop")
        # Answered once the recorder has started, or has closed its file.
        self._say = say

    def hear(self, node: NodeProcess, event: str) -> None:
        """Handle the start, the end and a failure of the recorder."""
        if node.name != self._node or self.out is None:
            return
        out = self.out
        if event == "ready":
            self._done(True, f"recording to {out}")
        elif event in ("failed", "error", "died"):
            self.out = None
            reason = node.refusal or "cannot be recorded; see the log"
            self._done(False, f"{out}: {reason}")
        elif event == "ended":
            self.out = None
            # A recorder that was ended early has no report.
            recording = node.report.get("recording", {})
            n_messages = recording.get("n_messages", 0)
            text = f"{out}: no message came, so there is no file"
            if n_messages:
                text = f"{out}: {n_messages} messages recorded"
            fault = recording.get("error")
            self._done(not fault, fault or text)

    def _begin(self) -> None:
        self._n += 1
        self.out = f"{self._launch.name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
        self._node = f"{LIVE_RECORDER}{self._n}"
        topics: list[str] = []
        for spec in self._launch.nodes.values():
            topics += spec.outputs
        values = {
            "out": self.out,
            "topics": topics,
            "launch": self._launch.text,
            "source": self._launch.name,
        }
        try:
            graph = single_node(self._node, "recorder", values)
            self._fleet.add(graph.nodes[self._node], topics)
        except SparseskinError as error:
            self.out = None
            raise RefusedError(f"record: {error}") from error

    def _done(self, done: bool, text: str) -> None:
        # Free for the next request before the answer is given.
        say = self._say
        self._say = None
        if say is not None:
            say(done, text)


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
        # A node that dies is to be seen at once, a counter in half a second.
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

    def _describe(self, node: str | None) -> Document:
        return graph_description(self._launch, self._fleet, self._recording.out, node)

    def _hear(self, node: NodeProcess, event: Document) -> None:
        kind = event["event"]
        self._recording.hear(node, kind)
        if kind == "answer":
            self._requests.answered(event)
            # Settings may have changed: the state is published with the next look.
            self._next_s = 0.0
