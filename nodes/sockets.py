"""ZeroMQ sockets as the nodes use them: one XPUB a writer, one SUB a reader.

A reader subscribes to its topics and last of all to its own presence tag, "@NAME". Since
subscriptions of one connection arrive in order, a writer that has seen the tag knows that
every topic of that reader is subscribed, and that nothing it sends from then on is lost for
want of a subscription.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import zmq

from sparseskin.messages import MAX_MESSAGE_BYTES, End, Message, encode
from sparseskin.messages.topics import MAX_TOPIC_BYTES

PRESENCE = b"@"
QUEUE_FRAMES = 1000
"""High-water mark of each queue: a second at 1 kHz before anything is dropped (and counted)."""


def make_context() -> zmq.Context[zmq.Socket[bytes]]:
    """A context whose sockets never hold up the end of a process."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    context.linger = 0
    return context


class Writer:
    """The publishing side of a node: an XPUB socket, and the latched messages it repeats.

    Parameters
    ----------
    context : zmq.Context
        From `make_context`.
    endpoint : str
        Where to bind: "ipc://@NAME", "tcp://127.0.0.1:*" or a stated port.

    Raises
    ------
    zmq.ZMQError
        If the endpoint is in use or malformed.
    """

    def __init__(self, context: zmq.Context[Any], endpoint: str) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self.socket.setsockopt(zmq.SNDHWM, QUEUE_FRAMES)
        self.socket.setsockopt(zmq.MAXMSGSIZE, 4 * MAX_TOPIC_BYTES)
        self.socket.bind(endpoint)
        self.endpoint = self.socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
        self.present: set[str] = set()
        self._latched: dict[bytes, bytes] = {}

    def send(self, message: Message) -> None:
        """Publish a message to whoever subscribed to its topic."""
        topic, payload = encode(message)
        if message.latched and not isinstance(message, End):
            self._latched[topic] = payload
        self.socket.send_multipart((topic, payload))

    def serve_subscriptions(self) -> None:
        """Take in all waiting subscriptions: note who is there, repeat what is latched."""
        while self.socket.poll(0):
            note = self.socket.recv()
            joins, topic = note[:1] == b"\x01", note[1:]
            if topic.startswith(PRESENCE):
                name = topic[1:].decode(errors="replace")
                (self.present.add if joins else self.present.discard)(name)
            elif joins and topic in self._latched:
                self.socket.send_multipart((topic, self._latched[topic]))


class Reader:
    """The subscribing side of a node: a SUB socket over all writers it listens to.

    Parameters
    ----------
    context : zmq.Context
        From `make_context`.
    name : str
        The node's name, for its presence tag.
    endpoints : iterable of str
        Endpoints of the writers.
    topics : iterable of str
        Topics to subscribe to.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        name: str,
        endpoints: Iterable[str],
        topics: Iterable[str],
    ) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, QUEUE_FRAMES)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self._topics = {topic.encode() for topic in topics}
        for topic in sorted(self._topics):
            self.socket.subscribe(topic)
        self.socket.subscribe(PRESENCE + name.encode())
        for endpoint in endpoints:
            self.socket.connect(endpoint)

    def receive(self) -> tuple[bytes, bytes] | None:
        """The next waiting (topic, payload), or None where none waits.

        ZeroMQ subscribes by prefix: a longer topic that begins like one of ours is left out.
        What is not a topic and one payload is handed on as a topic without a payload, for the
        decoder to refuse and count.
        """
        while True:
            try:
                parts = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return None
            if parts[0] in self._topics:
                return (parts[0], parts[1] if len(parts) == 2 else b"")
