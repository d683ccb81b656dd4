"""The launcher's end of the control socket."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from .control_socket import Connection, short_path
from .fleet import Fleet

MAX_CLIENTS = 32
MAX_LINE_BYTES = 65536


class ControlServer:
    """The launcher's end of the control socket at `path`, served in the loop of the fleet.

    `take` is called with (request, reply); `describe` with the name of a node, or None, and returns
    the description of the graph.
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
        self._socket = socket.socket(socket.AF_UNIX)
        Path(path).unlink(missing_ok=True)  # left by a process that had the same number
        with short_path(path) as short:
            self._socket.bind(short)
        os.chmod(path, 0o600)
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
        """Send one object to all clients that watch."""
        for client in [client for client in self._clients if client.watches]:
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
