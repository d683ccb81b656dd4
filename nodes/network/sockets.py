"""ZeroMQ sockets of the nodes: one XPUB for each writer, one SUB for each reader.

A reader subscribes to its topics and last to its own presence tag, "@NAME". Subscriptions of one
connection arrive in order, so a writer that has received the tag knows that all topics of that
reader are subscribed and that no later message is lost for want of a subscription.

The tag also serves flow control, for writers that publish as fast as they are read. A writer
publishes an ask, a number, on the tag of each present reader; it arrives after all messages sent
before it. Once the reader and all its own readers have processed those, it answers by subscribing
to "@NAME#WRITER:NUMBER". So frames travel one way only: an answer is a subscription without data.
An observer, whose tag is "@~NAME", is not asked: no writer waits for it.

A reader on another host asks a writer for its time in the same way: it subscribes to "@NAME!T1",
and each writer publishes "WRITER!T1:T2:T3" on the tag of that reader.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from sparseskin.messages import MAX_MESSAGE_BYTES, End, Message
from sparseskin.messages.wire import Payload, payload_of, wire_parts
from sparseskin.nodes.files import is_served

from .direct import DirectInlet, DirectOutlet
from .keys import KeyPair
from .transport import JOINS, PRESENCE, Inlet, Outlet, Parts, Send
from .zeromq import (
    HANDSHAKE_MS,
    MAX_SUBSCRIPTIONS,
    Guard,
    ZmqInlet,
    ZmqOutlet,
    make_context,
    watch_for_death,
)

__all__ = ["Peer", "Reader", "Writer", "make_context", "read_times"]

OBSERVER = "~"
"""Begins the name in the tag of a reader that is never asked."""
FAREWELL_MS = 500
"""Time for which a node that ends still sends what its readers have not yet received."""
MAX_NOTE_BYTES = 1024
"""Largest subscription; a handshake with keys needs messages of 300 bytes."""
MAX_ASK_BYTES = 64
MAX_TIMES_BYTES = 160
MAX_TIME_DIGITS = 20
MAX_WRITERS = 256
MAX_READERS = 128
"""Readers, and subscriptions, beyond these are not counted, and one line is logged."""
MAX_EVENTS = 1000
"""Largest number of subscriptions, or of events of connections, between two looks at messages."""
QUEUE_FRAMES = 1000
"""High-water mark of each queue: one second at 1 kHz before messages are dropped and counted."""


@dataclass(frozen=True)
class Peer:
    """A writer as its readers know it: name of the node, and where it is bound.

    `host` is "" for this one, `key`, its public key, "" where it needs none; `direct`, the path of
    its socket for direct links, "" for none.
    """

    writer: str
    endpoint: str
    host: str = ""
    key: str = ""
    direct: str = ""


class Writer:
    """Publishing side of a node: its transports, and the latched messages it repeats.

    Parameters
    ----------
    context, name
        From `make_context`; the node's name, for its asks.
    endpoint, public : str
        Where to bind: "ipc:///PATH", "tcp://127.0.0.1:*" or a stated port; and for readers on other
        hosts, "tcp://ADDRESS:PORT", or "" for none.
    gate, now_ns, log
        Guard of the socket; the graph's clock, for readers on other hosts; receives one line.
    direct : DirectOutlet, optional
        Direct links to nodes of this host, beside ZeroMQ.

    Attributes
    ----------
    present : set of str
        Names of the connected readers.

    Raises
    ------
    zmq.ZMQError
        If an endpoint is in use or malformed.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        endpoint: str,
        name: str = "writer",
        *,
        public: str = "",
        gate: Guard | None = None,
        now_ns: Callable[[], int] | None = None,
        log: Callable[[str], None] = lambda line: None,
        direct: DirectOutlet | None = None,
    ) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self.socket.setsockopt(zmq.SNDHWM, QUEUE_FRAMES)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_NOTE_BYTES)
        if gate is not None:
            gate.guard(self.socket)
        # Unlike all others, a bind to the path of a file replaces the one who listens there.
        if endpoint.startswith("ipc:///") and is_served(Path(endpoint.removeprefix("ipc://"))):
            raise zmq.ZMQError(zmq.EADDRINUSE)
        self.socket.bind(endpoint)
        self.endpoint = self.socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
        if public:
            watch_for_death(self.socket)
            self.socket.bind(public)
        # A direct link first: its reader wakes up while the other transport is served.
        zeromq = ZmqOutlet(self.socket, gate)
        self._outlets: list[Outlet] = [zeromq] if direct is None else [direct, zeromq]
        self.present: set[str] = set()
        self._observers: set[str] = set()
        self._name = name
        self._now_ns = now_ns
        self._log = log
        self._n_subscriptions = 0
        self._logged: set[str] = set()
        self._asks = 0
        self._answered: dict[str, int] = {}
        self._processed: dict[str, int] = {}
        self._latched: dict[bytes, Parts] = {}

    def send(self, message: Message) -> None:
        """Publish a message to the subscribers of its topic; where there is none, encode none."""
        topic = message.topic.encode()
        if message.latched:
            self._latched[topic] = wire_parts(message)
            self.publish(self._latched[topic])
            return
        wanted = [outlet for outlet in self._outlets if outlet.wants(topic)]
        if not wanted:  # a reader may have come since
            self.serve_subscriptions()
            wanted = [outlet for outlet in self._outlets if outlet.wants(topic)]
        if wanted:
            parts, frame = wire_parts(message), not isinstance(message, End)
            for outlet in wanted:
                outlet.send(parts, frame)

    def publish(self, parts: Parts) -> None:
        """Send parts to the subscribers of their topic as they are."""
        for outlet in self._outlets:
            if outlet.wants(parts[0]):
                outlet.send(parts)

    def serve_subscriptions(self) -> None:
        """Process waiting subscriptions: note present readers, repeat latched messages."""
        for outlet in self._outlets:
            self._serve(outlet)

    def _serve(self, outlet: Outlet) -> None:
        for _ in range(MAX_EVENTS):  # a flood must not keep a node from its work
            received = outlet.note()
            if received is None:
                return
            self._take(*received)

    def _take(self, note: bytes, reply: Send) -> None:
        joins, topic = note[:1] == JOINS, note[1:]
        self._count(joins)
        if topic.startswith(PRESENCE):
            self._note_presence(topic[1:].decode(errors="replace"), joins)
        elif joins and topic in self._latched:
            reply(self._latched[topic])

    def ask(self) -> int:
        """Ask all present readers to answer when they have processed all messages sent so far."""
        self._asks += 1
        for reader in self.present - self._observers:
            self._answered.setdefault(reader, self._asks - 1)
            note = f"{self._name}:{self._asks}".encode()
            self.publish((PRESENCE + reader.encode(), note))
        return self._asks

    def awaits(self, ask: int) -> bool:
        """True if a present reader that was asked has not answered yet."""
        return any(
            self._answered[reader] < ask for reader in self.present if reader in self._answered
        )

    def has_answered(self, reader: str, ask: int) -> bool:
        """True if a reader, present or not, has processed all messages sent before an ask."""
        return self._processed.get(reader, 0) >= ask

    def _count(self, joins: bool) -> None:
        self._n_subscriptions = max(0, self._n_subscriptions + (1 if joins else -1))
        if self._n_subscriptions > MAX_SUBSCRIPTIONS:
            self._log_once(f"more than {MAX_SUBSCRIPTIONS} subscriptions: some reader misbehaves")

    def _log_once(self, line: str) -> None:
        if line not in self._logged:
            self._logged.add(line)
            self._log(line)

    def _send_time(self, reader: str, t1_ns: str) -> None:
        if self._now_ns is None or reader.removeprefix(OBSERVER) not in self.present:
            return
        if t1_ns.isdecimal() and len(t1_ns) <= MAX_TIME_DIGITS:
            note = f"{self._name}!{t1_ns}:{self._now_ns()}:{self._now_ns()}".encode()
            self.publish((PRESENCE + reader.encode(), note))

    def _note_presence(self, tag: str, joins: bool) -> None:
        asking, is_time, t1_ns = tag.partition("!")
        if is_time:
            if joins:
                self._send_time(asking, t1_ns)
            return
        reader, is_answer, answer = tag.partition("#")
        if not is_answer:
            if joins and len(self.present) >= MAX_READERS:
                self._log_once(f"more than {MAX_READERS} readers: frames wait for these only")
                return
            observes, reader = reader.startswith(OBSERVER), reader.removeprefix(OBSERVER)
            (self.present.add if joins else self.present.discard)(reader)
            (self._observers.add if joins and observes else self._observers.discard)(reader)
            if not joins:
                self._answered.pop(reader, None)
            return
        writer, _, number = answer.partition(":")
        if joins and writer == self._name and reader in self._answered and number.isdecimal():
            self._answered[reader] = max(self._answered[reader], int(number[:18]))
            self._processed[reader] = self._answered[reader]


class Reader:
    """Subscribing side of a node: its transports, connected to all its writers.

    Parameters
    ----------
    context, name
        From `make_context`; the node's name, for its presence tag.
    endpoints, topics
        Endpoints of the writers; topics to subscribe to.
    present : bool
        True if writers know this one by its name, and wait for it as they start.
    observes : bool
        True if no writer that follows its readers waits for this one.
    keys, read_ahead
        Keys of this host, for writers that need them; number of messages of a writer that wait
        here, further ones wait at the writer.
    direct : DirectInlet, optional
        For direct links to writers of this host.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        name: str,
        endpoints: Iterable[str],
        topics: Iterable[str],
        present: bool = True,
        keys: KeyPair | None = None,
        read_ahead: int = QUEUE_FRAMES,
        observes: bool = False,
        direct: DirectInlet | None = None,
    ) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, read_ahead)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self._topics = {topic.encode() for topic in topics}
        self._tag = PRESENCE + (OBSERVER if observes else "").encode() + name.encode()
        self._answers: dict[bytes, bytes] = {}
        self._time_tag = b""
        if keys is not None:
            self.socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public.encode())
            self.socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret.encode())
            self.socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        self._zeromq, self._direct = ZmqInlet(self.socket), direct
        self._inlets: list[Inlet] = [self._zeromq] if direct is None else [direct, self._zeromq]
        self._connected: list[Inlet] = []
        for topic in sorted(self._topics):
            self._subscribe(topic)
        if present:
            self._subscribe(self._tag)
        for endpoint in endpoints:
            self.connect(endpoint)

    def connect_direct(self, path: str) -> None:
        """Connect to one more writer by a direct link, in place of ZeroMQ."""
        assert self._direct is not None
        self._add(self._direct)
        self._direct.connect(path)

    def connect(self, endpoint: str, server_key: str = "", distant: bool = False) -> None:
        """Connect to one more writer, with its public key if it needs keys.

        The link to a distant one, on another host, can break.
        """
        if server_key:
            self.socket.setsockopt(zmq.CURVE_SERVERKEY, server_key.encode())
        if distant:
            watch_for_death(self.socket)
        self._add(self._zeromq)
        self.socket.connect(endpoint)

    def close(self) -> None:
        """Close all connections."""
        self.socket.close()
        if self._direct is not None:
            self._direct.close()

    def reconnect(self, endpoint: str, server_key: str = "", distant: bool = False) -> None:
        """Connect again after a refused handshake, which ZeroMQ does not do by itself."""
        self.socket.disconnect(endpoint)
        self.connect(endpoint, server_key, distant)

    def receive(self) -> tuple[bytes, Payload] | None:
        """Next waiting (topic, payload), or None.

        ZeroMQ subscribes by prefix: a longer topic that begins like one of ours is dropped. A
        message without a payload, or of too many parts, is returned as one with an empty payload,
        for the decoder to refuse and count. An ask is a payload under the reader's own tag.
        """
        for inlet in self._connected:
            while (parts := inlet.receive()) is not None:
                if parts[0] in self._topics or parts[0] == self._tag:
                    return parts[0], payload_of(parts)
        return None

    def _add(self, inlet: Inlet) -> None:
        if inlet not in self._connected:
            self._connected.append(inlet)

    def _subscribe(self, topic: bytes) -> None:
        for inlet in self._inlets:
            inlet.subscribe(topic)

    def _unsubscribe(self, topic: bytes) -> None:
        for inlet in self._inlets:
            inlet.unsubscribe(topic)

    def is_ask(self, topic: bytes) -> bool:
        """True if a topic is that of asks, to be answered by `answer`."""
        return topic == self._tag

    def ask_time(self, now_ns: int) -> None:
        """Ask all writers for the time on their clocks; the answers arrive like asks."""
        tag = self._tag + b"!%d" % now_ns
        self._zeromq.subscribe(tag)  # of this host the clock is the same
        if self._time_tag:
            self._zeromq.unsubscribe(self._time_tag)
        self._time_tag = tag

    def answer(self, note: bytes) -> None:
        """Answer the writer of an ask that all messages before it are processed."""
        writer = note.partition(b":")[0]
        if len(note) > MAX_ASK_BYTES or len(self._answers) >= MAX_WRITERS:
            return  # not one of the writers
        tag = self._tag + b"#" + note
        self._subscribe(tag)
        if writer in self._answers:
            self._unsubscribe(self._answers[writer])
        self._answers[writer] = tag


def read_times(note: bytes) -> tuple[str, int, int, int] | None:
    """Writer, t1, t2 and t3 (ns) in an answer to `Reader.ask_time`; None for anything else."""
    writer, is_time, times = note[:MAX_TIMES_BYTES].decode(errors="replace").partition("!")
    parts = times.split(":")
    if not is_time or len(parts) != 3:
        return None
    if not all(part.isdecimal() and len(part) <= MAX_TIME_DIGITS for part in parts):
        return None
    t1_ns, t2_ns, t3_ns = map(int, parts)
    return writer, t1_ns, t2_ns, t3_ns
