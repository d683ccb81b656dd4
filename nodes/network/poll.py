"""Waits for all sockets of a node at once: those of ZeroMQ, direct links and pipes."""

from __future__ import annotations

import select
from collections.abc import Callable
from typing import Any

import zmq

from .zeromq import is_readable

Handler = Callable[[int], None]
READABLE, WRITABLE = select.POLLIN, select.POLLOUT


def _ignore(events: int) -> None:
    pass


class Poll:
    """Waits until a file descriptor is ready, and then looks at no other; `zmq.Poller` looks at
    each socket of ZeroMQ twice.
    """

    def __init__(self) -> None:
        self._poll = select.poll()
        self._handlers: dict[int, Handler] = {}
        self._sockets: list[zmq.Socket[Any]] = []
        self.signalled = False
        """True if a socket of ZeroMQ may be ready since the last `wait`."""

    def add(self, fd: int, handler: Handler = _ignore, events: int = READABLE) -> None:
        """Wait for a file descriptor too; the handler is called with the events that occurred."""
        self._handlers[fd] = handler
        self._poll.register(fd, events)

    def change(self, fd: int, events: int) -> None:
        """Wait for other events of a file descriptor."""
        self._poll.modify(fd, events)

    def remove(self, fd: int) -> None:
        """Wait for a file descriptor no longer; call it before the descriptor is closed."""
        del self._handlers[fd]
        self._poll.unregister(fd)

    def add_socket(self, socket: zmq.Socket[Any]) -> None:
        """Wait for messages of a socket of ZeroMQ too."""
        if socket not in self._sockets:
            self._sockets.append(socket)
            self.add(int(socket.getsockopt(zmq.FD)), self._signal)

    def _signal(self, events: int) -> None:
        self.signalled = True

    def wait(self, timeout_ms: int) -> bool:
        """Wait until something is ready; False if the time is over first.

        The descriptor of a socket of ZeroMQ signals changes only, hence the look at what waits.
        """
        self.signalled = timeout_ms == 0 or any(map(is_readable, self._sockets))
        return self.look(0 if self.signalled else timeout_ms)

    def look(self, timeout_ms: int = 0) -> bool:
        """Call the handlers of what is ready; False if nothing is."""
        ready = self._poll.poll(timeout_ms)
        for fd, events in ready:
            handler = self._handlers.get(fd)
            if handler is not None:  # one before it may have closed this one
                handler(events)
        return bool(ready)
