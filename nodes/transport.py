"""Settings that all ZeroMQ sockets of the nodes share."""

from __future__ import annotations

import zmq

HEARTBEAT_MS, DEAD_MS = 500, 1500
"""Over a network: how often a peer is asked for a sign of life, and when its silence is an end."""
CONNECT_MS = 800
"""When a connection that has not come about is tried again: TCP by itself waits ever longer."""
RECONNECT_MS, MAX_RECONNECT_MS = 100, 500


def make_context() -> zmq.Context[zmq.Socket[bytes]]:
    """A context whose sockets never hold up the end of a process."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    context.linger = 0
    return context


def watch_for_death(socket: zmq.Socket[bytes]) -> None:
    """Have what is bound or connected from now on notice a way that breaks without a word."""
    socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, DEAD_MS)
    socket.setsockopt(zmq.HEARTBEAT_TTL, DEAD_MS)
    socket.setsockopt(zmq.CONNECT_TIMEOUT, CONNECT_MS)
    socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
    socket.setsockopt(zmq.RECONNECT_IVL_MAX, MAX_RECONNECT_MS)
