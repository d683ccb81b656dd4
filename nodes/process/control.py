"""Control channels of a launcher: one JSON object a line.

The stdin of a node process is a socket, at which commands for its first node arrive and events
leave; further nodes have sockets of their own. Nodes that watch their graph, and other programs of
the user, ask at the control socket of the launcher.
"""

import functools
import json
import os
import socket
import threading
import time
from collections.abc import Mapping
from typing import Any

from sparseskin.nodes.errors import SparseskinError

Document = dict[str, Any]
"""A JSON object: an event, a request or an answer; a report, or the state of a node."""
PARENT_CHECK_S = 1.0
"""Time between two looks whether the launcher still runs, seconds."""
MAX_DEPTH = 4
"""Largest depth of nested lists and maps in a request."""
COUNTED = ("received", "lost", "skipped")
"""Counters of each input in a heartbeat: messages received, lost, and received but skipped."""


def is_shallow(value: Any, depth: int = MAX_DEPTH) -> bool:
    """True if a JSON value nests lists and maps at most `depth` deep."""
    if not isinstance(value, dict | list):
        return True
    if depth == 0:
        return False
    parts: Any = value
    if isinstance(value, dict):
        parts = value.values()
    return all(is_shallow(part, depth - 1) for part in parts)


@functools.cache
def watch_parent(parent: int) -> None:
    """End this process when its parent, of that id, ends, even if the main thread is blocked."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_S)
        # The main thread notices first, and ends in order, unless it is blocked.
        time.sleep(PARENT_CHECK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="watch-parent").start()


MAX_QUEUED_BYTES = 1 << 20
"""A peer that does not read is dropped once this much is queued for it."""


class Connection:
    """One connection, one JSON object a line; no method blocks."""

    def __init__(
        self, connection: socket.socket, max_line_bytes: int = MAX_QUEUED_BYTES
    ) -> None:
        self._max_line_bytes = max_line_bytes
        self.connection = connection
        self.watches = False
        self._rest = b""
        self._unsent = b""

    @property
    def idle(self) -> bool:
        """True if nothing is queued."""
        return not self._unsent

    def lines(self) -> list[bytes] | None:
        """Complete lines that have arrived; None once the connection has ended and all are read."""
        try:
            chunk = self.connection.recv(65536, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return []
        except OSError:
            return None
        # The last part has no end yet, and is empty where a line has just ended.
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        # A line without an end would fill the memory.
        if not chunk or len(self._rest) > self._max_line_bytes:
            return None
        return lines

    def send(self, fields: Mapping[str, Any]) -> bool:
        """Send one object; False as for `flush`."""
        self._unsent += json.dumps(fields).encode() + b"\n"
        return self.flush()

    def flush(self) -> bool:
        """Send what is queued; False once too much is queued, or the connection has ended."""
        # The rest waits for the next call: a peer that is slow holds up nobody.
        try:
            while self._unsent:
                n_sent = self.connection.send(self._unsent, socket.MSG_DONTWAIT)
                self._unsent = self._unsent[n_sent:]
        except BlockingIOError:
            return len(self._unsent) < MAX_QUEUED_BYTES
        except OSError:
            return False
        return True


class Control(Connection):
    """The node's side of the channel, a descriptor: stdin for the first node of a process. Its end
    means that the launcher has ended.
    """

    def __init__(self, fd: int = 0) -> None:
        # The number of stdin stays taken: another file would be read as such.
        if fd == 0:
            fd = os.dup(fd)
        super().__init__(socket.socket(fileno=fd))
        self.closed = False
        self._lock = threading.Lock()

    def emit(self, event: str, **fields: Any) -> None:
        """Send an event, and wait until it is sent."""
        line = json.dumps({"event": event, **fields}).encode() + b"\n"
        try:
            # A node may have threads of its own.
            with self._lock:
                self.connection.sendall(line)
        except OSError:
            self.closed = True

    def commands(self) -> list[Document]:
        """Waiting commands, oldest first; sets `closed` if the launcher has ended."""
        lines = self.lines()
        self.closed = self.closed or lines is None
        return [json.loads(line) for line in lines or () if line]


class ControlClient(Connection):
    """The end of a program that asks something of a running graph.
    Raises SparseskinError if nobody listens there.
    """

    def __init__(self, path: str) -> None:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(path)
        except OSError as error:
            connection.close()
            raise SparseskinError(
                f"{path}: no graph listens there: {error.strerror}"
            ) from error
        super().__init__(connection)

    def receive(self) -> list[Document] | None:
        """The objects that have arrived; None once the graph is gone."""
        self.flush()
        lines = self.lines()
        if lines is None:
            return None
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        self.connection.close()
