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
import socket
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sparseskin.nodes.errors import SparseskinError

MAX_QUEUED_BYTES = 1 << 20
"""A peer that does not read is dropped once this much is queued for it."""


class Connection:
    """One connection, one JSON object a line; no method blocks."""

    def __init__(self, connection: socket.socket, max_line_bytes: int) -> None:
        connection.setblocking(False)
        self._max_line_bytes = max_line_bytes
        self.connection = connection
        self.watches = False
        self._rest = b""
        self._unsent = b""

    def lines(self) -> list[bytes] | None:
        """Complete lines that have arrived; None once the connection has ended and all are read."""
        try:
            chunk = self.connection.recv(65536)
        except BlockingIOError:
            return []
        except OSError:
            return None
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        return None if not chunk or len(self._rest) > self._max_line_bytes else lines

    def send(self, fields: Mapping[str, Any]) -> bool:
        """Send one object; False as for `flush`."""
        self._unsent += json.dumps(fields).encode() + b"\n"
        return self.flush()

    def flush(self) -> bool:
        """Send what is queued; False once too much is queued, or the connection has ended."""
        try:
            while self._unsent:
                self._unsent = self._unsent[self.connection.send(self._unsent) :]
        except BlockingIOError:
            return len(self._unsent) < MAX_QUEUED_BYTES
        except OSError:
            return False
        return True


class ControlClient:
    """The end of a program that asks something of a running graph.
    Raises SparseskinError if nobody listens there.
    """

    def __init__(self, path: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            with short_path(path) as short:
                self._socket.connect(short)
        except OSError as error:
            raise SparseskinError(f"{path}: no graph listens there: {error.strerror}") from error
        self._connection = Connection(self._socket, MAX_QUEUED_BYTES)
        self.fd = self._socket.fileno()

    def send(self, fields: Mapping[str, Any]) -> bool:
        """Send one request, or {"watch": true}; False once the graph is gone."""
        return self._connection.send(fields)

    def flush(self) -> None:
        """Send what is queued."""
        self._connection.flush()

    def receive(self) -> list[dict[str, Any]] | None:
        """The objects that have arrived; None once the graph is gone."""
        self._connection.flush()
        lines = self._connection.lines()
        return None if lines is None else [json.loads(line) for line in lines]

    def close(self) -> None:
        self._socket.close()


@contextlib.contextmanager
def short_path(path: str) -> Iterator[str]:
    """The path by way of its open folder, for the name of a socket has 107 characters at most."""
    folder = os.open(Path(path).parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{Path(path).name}"
    finally:
        os.close(folder)
