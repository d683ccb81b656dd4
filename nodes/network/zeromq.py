"""The transport ZeroMQ: sockets of publishers and subscribers."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Sequence
from typing import Protocol

import zmq

from .transport import JOINS, PRESENCE, Parts, Send

MAX_SUBSCRIPTIONS = 4096
"""Number of subscriptions up to which topics without a reader are not sent."""

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


def is_readable(socket: zmq.Socket[bytes]) -> bool:
    """True if a message waits; a tenth of the time of `poll(0)`, or of a receive that fails."""
    return bool(int(socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN)


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


class ZmqOutlet:
    """A socket that publishes, XPUB, and its access control, if any.

    A topic is wanted from its first subscription on: that of a reader which never had it can be
    ended by any other one.
    """

    def __init__(self, socket: zmq.Socket[bytes], gate: Guard | None) -> None:
        self.socket = socket
        self._gate = gate
        self._prefixes: set[bytes] = set()
        self._wanted: dict[bytes, bool] = {}

    def wants(self, topic: bytes) -> bool:
        wanted = self._wanted.get(topic)
        if wanted is None:
            # ZeroMQ subscribes by prefix.
            wanted = topic.startswith((PRESENCE, *self._prefixes))
            wanted = wanted or len(self._prefixes) >= MAX_SUBSCRIPTIONS
            self._wanted[topic] = wanted
        return wanted

    def send(self, parts: Parts, frame: bool = False) -> None:
        self.socket.send_multipart(parts)

    def note(self) -> tuple[bytes, Send] | None:
        if not is_readable(self.socket):
            return None
        received = self.socket.recv(copy=False)
        if self._gate is not None:
            with contextlib.suppress(zmq.ZMQError):  # by no connection, in a process
                self._gate.subscribed(received.get(zmq.SRCFD))
        note = received.bytes
        if note[:1] == JOINS and len(self._prefixes) < MAX_SUBSCRIPTIONS:
            prefix = note[1:]
            if not prefix.startswith(PRESENCE) and prefix not in self._prefixes:
                self._prefixes.add(prefix)
                self._wanted.clear()
        return note, self.send


class ZmqInlet:
    """A socket that subscribes, SUB."""

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self.socket = socket

    def subscribe(self, topic: bytes) -> None:
        self.socket.subscribe(topic)

    def unsubscribe(self, topic: bytes) -> None:
        self.socket.unsubscribe(topic)

    def receive(self) -> Sequence[bytes] | None:
        if not is_readable(self.socket):
            return None
        try:
            return self.socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None
