"""ZeroMQ sockets as the nodes use them: one XPUB a writer, one SUB a reader.

A reader subscribes to its topics and last of all to its own presence tag, "@NAME". Since
subscriptions of one connection arrive in order, a writer that has seen the tag knows that
every topic of that reader is subscribed, and that nothing it sends from then on is lost for
want of a subscription.

The tag also carries flow control, for writers that go as fast as they are read. A writer
publishes an ask, a number, on the tag of each reader that is present. It reaches the reader
behind all messages sent before it; the reader answers, once it and all who read from it are done
with those, by subscribing to "@NAME#WRITER:NUMBER". Frames go one way all the same: an answer is
a subscription and carries nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import zmq

from sparseskin.messages import MAX_MESSAGE_BYTES, Message, encode
from sparseskin.messages.topics import MAX_TOPIC_BYTES

PRESENCE = b"@"
FAREWELL_MS = 500
"""How long a node that ends may take to send what its readers have not yet taken."""
MAX_ASK_BYTES = 64
MAX_WRITERS = 256
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
    name : str
        The node's name, for its asks.

    Attributes
    ----------
    present : set of str
        Names of the readers that are there.

    Raises
    ------
    zmq.ZMQError
        If the endpoint is in use or malformed.
    """

    def __init__(self, context: zmq.Context[Any], endpoint: str, name: str = "writer") -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self.socket.setsockopt(zmq.SNDHWM, QUEUE_FRAMES)
        self.socket.setsockopt(zmq.MAXMSGSIZE, 4 * MAX_TOPIC_BYTES)
        self.socket.bind(endpoint)
        self.endpoint = self.socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
        self.present: set[str] = set()
        self._name = name
        self._asks = 0
        self._answered: dict[str, int] = {}
        self._latched: dict[bytes, bytes] = {}

    def send(self, message: Message) -> None:
        """Publish a message to whoever subscribed to its topic."""
        topic, payload = encode(message)
        if message.latched:
            self._latched[topic] = payload
        self.socket.send_multipart((topic, payload))

    def serve_subscriptions(self) -> None:
        """Take in all waiting subscriptions: note who is there, repeat what is latched."""
        while self.socket.poll(0):
            note = self.socket.recv()
            joins, topic = note[:1] == b"\x01", note[1:]
            if topic.startswith(PRESENCE):
                self._note_presence(topic[1:].decode(errors="replace"), joins)
            elif joins and topic in self._latched:
                self.socket.send_multipart((topic, self._latched[topic]))

    def ask(self) -> int:
        """Ask all present readers to say when they are done with what was sent so far."""
        self._asks += 1
        for reader in self.present:
            self._answered.setdefault(reader, self._asks - 1)
            note = f"{self._name}:{self._asks}".encode()
            self.socket.send_multipart((PRESENCE + reader.encode(), note))
        return self._asks

    def awaits(self, ask: int) -> bool:
        """Whether some reader that was asked, and is still there, has not answered yet."""
        return any(
            self._answered[reader] < ask for reader in self.present if reader in self._answered
        )

    def _note_presence(self, tag: str, joins: bool) -> None:
        reader, is_answer, answer = tag.partition("#")
        if not is_answer:
            (self.present.add if joins else self.present.discard)(reader)
            if not joins:
                self._answered.pop(reader, None)
            return
        writer, _, number = answer.partition(":")
        if joins and writer == self._name and reader in self._answered and number.isdecimal():
            self._answered[reader] = max(self._answered[reader], int(number[:18]))


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
        self._tag = PRESENCE + name.encode()
        self._answers: dict[bytes, bytes] = {}
        for topic in sorted(self._topics):
            self.socket.subscribe(topic)
        self.socket.subscribe(self._tag)
        for endpoint in endpoints:
            self.socket.connect(endpoint)

    def receive(self) -> tuple[bytes, bytes] | None:
        """The next waiting (topic, payload), or None where none waits.

        ZeroMQ subscribes by prefix: a longer topic that begins like one of ours is left out.
        What is not a topic and one payload is handed on as a topic without a payload, for the
        decoder to refuse and count. An ask is a payload under the reader's own tag.
        """
        while True:
            try:
                parts = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return None
            if parts[0] in self._topics or parts[0] == self._tag:
                return (parts[0], parts[1] if len(parts) == 2 else b"")

    def is_ask(self, topic: bytes) -> bool:
        """Whether what came under a topic is an ask, to be answered with `answer`."""
        return topic == self._tag

    def answer(self, note: bytes) -> None:
        """Tell the writer of an ask that all that came before it is done with."""
        writer = note.partition(b":")[0]
        if len(note) > MAX_ASK_BYTES or len(self._answers) >= MAX_WRITERS:
            return  # no writer of ours
        tag = self._tag + b"#" + note
        self.socket.subscribe(tag)
        if writer in self._answers:
            self.socket.unsubscribe(self._answers[writer])
        self._answers[writer] = tag
