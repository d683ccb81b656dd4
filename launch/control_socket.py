"""The control socket of a running graph: one JSON object a line, for programs of the same user.

It lies in the folder of the notes, which nobody else may enter. A client writes requests
{id, node, command, value} and reads their answers {"answer": ...}; {"watch": true} brings
{"graph": ...} too, again and again; {"describe": NODE or null} brings {"description": ...}, once.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.nodes.errors import SparseskinError

if TYPE_CHECKING:  # a client, such as the completion of a shell, is to load fast
    from .fleet import Fleet

MAX_CLIENTS = 32
MAX_LINE_BYTES = 65536
MAX_QUEUED_BYTES = 1 << 20
"""A client that does not read is left when this much waits for it."""


class _Client:
    """One connection; `read` and `write` never block."""

    def __init__(self, connection: socket.socket, max_line_bytes: int) -> None:
        connection.setblocking(False)
        self._max_line_bytes = max_line_bytes
        self.connection = connection
        self.watches = False
        self._rest = b""
        self._unsent = b""

    def lines(self) -> list[bytes] | None:
        """Complete lines that wait; None once the connection has ended and all are read."""
        try:
            chunk = self.connection.recv(65536)
        except BlockingIOError:
            return []
        except OSError:
            return None
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        return None if not chunk or len(self._rest) > self._max_line_bytes else lines

    def send(self, fields: Mapping[str, Any]) -> bool:
        """Send one object; False where the client does not take it."""
        self._unsent += json.dumps(fields).encode() + b"\n"
        return self.flush()

    def flush(self) -> bool:
        """Send what there was no room for; False where too much waits, or all is over."""
        try:
            while self._unsent:
                self._unsent = self._unsent[self.connection.send(self._unsent) :]
        except BlockingIOError:
            return len(self._unsent) < MAX_QUEUED_BYTES
        except OSError:
            return False
        return True


class ControlServer:
    """The launcher's end.

    Parameters
    ----------
    path : str
        Where the socket is to lie.
    fleet : Fleet
        Whose loop waits for requests.
    take : callable
        Takes (request, reply).
    describe : callable
        Takes the name of a node, or None; gives the description of the graph.
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
        self._clients: list[_Client] = []
        self._socket = socket.socket(socket.AF_UNIX)
        with _short_path(path) as short:
            self._socket.bind(short)
        os.chmod(path, 0o600)
        self._socket.listen(MAX_CLIENTS)
        self._socket.setblocking(False)
        fleet.watch(self._socket, self._accept)

    @property
    def watched(self) -> bool:
        """Whether anybody wants to know the state of the graph."""
        return any(client.watches for client in self._clients)

    def flush(self) -> None:
        """Send what clients had no room for; leave those that take nothing any more."""
        for client in [client for client in self._clients if not client.flush()]:
            self._drop(client)

    def tell(self, fields: dict[str, Any]) -> None:
        """Send one object to all who watch."""
        for client in [client for client in self._clients if client.watches]:
            self._send(client, fields)

    def close(self) -> None:
        for client in list(self._clients):
            self._drop(client)
        self._socket.close()
        Path(self._path).unlink(missing_ok=True)

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            connection, _ = self._socket.accept()
            if len(self._clients) >= MAX_CLIENTS:
                connection.close()
                return
            client = _Client(connection, MAX_LINE_BYTES)
            self._clients.append(client)
            self._fleet.watch(connection, partial(self._serve, client))

    def _serve(self, client: _Client) -> None:
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
            else:
                self._take(request, lambda answer: self._send(client, {"answer": answer}))

    def _send(self, client: _Client, fields: Mapping[str, Any]) -> None:
        if client in self._clients and not client.send(fields):
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            self._fleet.unwatch(client.connection)
            client.connection.close()


class ControlClient:
    """The other end: a program that asks something of a running graph.

    Raises
    ------
    SparseskinError
        If nobody listens there.
    """

    def __init__(self, path: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            with _short_path(path) as short:
                self._socket.connect(short)
        except OSError as error:
            raise SparseskinError(f"{path}: no graph listens there: {error.strerror}") from error
        self._client = _Client(self._socket, MAX_QUEUED_BYTES)
        self.fd = self._socket.fileno()

    def send(self, fields: Mapping[str, Any]) -> bool:
        """Send one request, or {"watch": true}; False once the graph is gone."""
        return self._client.send(fields)

    def flush(self) -> None:
        """Send what the graph had no room for."""
        self._client.flush()

    def receive(self) -> list[dict[str, Any]] | None:
        """What waits, without waiting for more; None once the graph is gone."""
        self._client.flush()
        lines = self._client.lines()
        return None if lines is None else [json.loads(line) for line in lines]

    def close(self) -> None:
        self._socket.close()


@contextlib.contextmanager
def _short_path(path: str) -> Any:
    """The path by way of its open folder: a socket's name ends at 107 characters."""
    folder = os.open(Path(path).parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{Path(path).name}"
    finally:
        os.close(folder)
