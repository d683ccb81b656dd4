"""The control socket of a running graph: one JSON object a line, for programs of the same user.

It lies in the folder of the notes, which no other user may enter. A client writes requests
{id, node, command, value} and reads their answers {"answer": ...}; {"watch": true} brings
{"graph": ...} too, again and again; {"describe": NODE or null} brings {"description": ...}, once;
{"stop": true} ends the graph as Ctrl-C does, and brings {"stopping": true}.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.nodes.files import is_served
from sparseskin.nodes.process.control import Connection

from .running import GraphError

if TYPE_CHECKING:
    from .fleet import Fleet


MAX_CLIENTS = 32
MAX_LINE_BYTES = 65536


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
        take: Callable[[Mapping[str, Any], Callable[[dict[str, Any]], None]], None],
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
