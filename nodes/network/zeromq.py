"""What all sockets of ZeroMQ share here: context, state, events, detection of broken links."""

from __future__ import annotations

import struct
from typing import Protocol

import zmq

HANDSHAKE_MS = 2000
"""Longest handshake; ZeroMQ's default of 30 s would hide a wrong key."""
HEARTBEAT_MS, DEAD_MS = 500, 1500
"""Over a network: period of heartbeats, and silence after which a peer counts as disconnected."""
CONNECT_MS = 800
"""Time after which a pending connection is tried again; TCP by itself waits ever longer."""
RECONNECT_MS, MAX_RECONNECT_MS = 100, 500


class Guard(Protocol):
    """Access control of a writer's socket, e.g. a `gate.Gate`."""

    def guard(self, writer: zmq.Socket[bytes]) -> None:
        """Admit allowed readers only; called before the socket is bound."""

    def subscribed(self, fd: int) -> None:
        """Note that a subscription came by a connection, given by its file descriptor."""


def make_context() -> zmq.Context[zmq.Socket[bytes]]:
    """Return a context whose sockets never delay the end of a process."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    context.linger = 0
    return context


_EVENTS, _POLLIN = int(zmq.EVENTS), int(zmq.POLLIN)


def is_readable(socket: zmq.Socket[bytes]) -> bool:
    """True if a message waits; a third of the time of a receive that fails."""
    return bool(socket.getsockopt(_EVENTS) & _POLLIN)  # type: ignore[operator]


def monitor_event(monitor: zmq.Socket[bytes]) -> tuple[int, int, str]:
    """The next event of a socket monitor, its value, and the endpoint: zmq_socket_monitor(3).

    `zmq.utils.monitor` does the same and imports asyncio, which every node would wait for.
    """
    head, endpoint = monitor.recv_multipart()
    event, value = struct.unpack("=Hi", head)
    return event, value, endpoint.decode(errors="replace")


def watch_for_death(socket: zmq.Socket[bytes]) -> None:
    """Let a socket detect links that break silently, for all later binds and connections."""
    for option, value_ms in (
        (zmq.HEARTBEAT_IVL, HEARTBEAT_MS),
        (zmq.HEARTBEAT_TIMEOUT, DEAD_MS),
        (zmq.HEARTBEAT_TTL, DEAD_MS),
        (zmq.CONNECT_TIMEOUT, CONNECT_MS),
        (zmq.RECONNECT_IVL, RECONNECT_MS),
        (zmq.RECONNECT_IVL_MAX, MAX_RECONNECT_MS),
    ):
        socket.setsockopt(option, value_ms)
