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

import contextlib
import struct
from collections import deque
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from sparseskin.messages import MAX_MESSAGE_BYTES, Message
from sparseskin.messages.wire import Payload, is_end, received, wire_bytes
from sparseskin.nodes.files import is_served

from .keys import KeyPair

JOINS = b"\x01"
"""Begins a subscription; the end of one begins with b"\\0"."""
PRESENCE = b"@"
"""Begins the topics by which writers and readers know each other."""
OBSERVER = "~"
"""Begins the name in the tag of a reader that is never asked."""
FAREWELL_MS = 500
"""Time for which a node that ends still sends what its readers have not yet received."""
MAX_NOTE_BYTES = 1024
"""Largest subscription; a handshake with keys needs messages of 300 bytes."""
MAX_ASK_BYTES = 64
MAX_TIMES_BYTES = 160
MAX_TIME_DIGITS = 20
"""Longest note of an ask, and of times: a name and one number, or three, of nanoseconds."""
MAX_WRITERS = 256
MAX_READERS = 128
MAX_SUBSCRIPTIONS = 4096
"""Readers and subscriptions beyond these are not counted, and one line is logged. Up to as many
subscriptions, topics without a reader are not sent.
"""
MAX_EVENTS = 1000
"""Largest number of subscriptions, or of events of connections, between two looks at messages."""
QUEUE_FRAMES = 1000
"""High-water mark of each queue: one second at 1 kHz before messages are dropped and counted."""
HANDSHAKE_MS = 2000
"""Longest handshake; ZeroMQ's default of 30 s would hide a wrong key."""
OVER_NETWORK_MS = {
    zmq.HEARTBEAT_IVL: 500,
    zmq.HEARTBEAT_TIMEOUT: 1500,
    zmq.HEARTBEAT_TTL: 1500,
    zmq.CONNECT_TIMEOUT: 800,  # TCP by itself waits ever longer
    zmq.RECONNECT_IVL: 100,
    zmq.RECONNECT_IVL_MAX: 500,
}
"""Options of sockets whose links can break silently, for all later binds and connections."""

Socket = zmq.Socket[bytes]
Context = zmq.Context[Socket]

_NOBLOCK = int(zmq.NOBLOCK)
_EVENTS = int(zmq.EVENTS)
_POLLIN = int(zmq.POLLIN)


def make_context() -> Context:
    """Return a context whose sockets never delay the end of a process."""
    context = zmq.Context()
    context.linger = 0
    return context


def events(monitor: Socket) -> Iterator[tuple[int, int, str]]:
    """Waiting events of a socket monitor, with their values and endpoints: zmq_socket_monitor(3).

    `zmq.utils.monitor` does the same and imports asyncio, which every node would wait for.
    """
    for _ in range(MAX_EVENTS):
        if not monitor.poll(0):
            return
        head, endpoint = monitor.recv_multipart()
        event, value = struct.unpack("=Hi", head)
        yield event, value, endpoint.decode(errors="replace")


def _set_options(socket: Socket, options: Mapping[Any, Any]) -> None:
    for option, value in options.items():
        socket.setsockopt(option, value)


@dataclass(frozen=True)
class Peer:
    """A writer as its readers know it: name of the node, and where it is bound.

    `host` is "" for this one, `key`, its public key, "" where it needs none.
    """

    writer: str
    endpoint: str
    host: str = ""
    key: str = ""


class Writer:
    """Publishing side of a node: an XPUB socket, and the latched messages it repeats.

    A topic is sent from its first subscription on: that of a reader which never had it can be ended
    by any other one. `present` are the names of the connected readers.

    It binds to `endpoint`, "ipc:///PATH", "tcp://127.0.0.1:*" or a stated port, and for readers on
    other hosts to `public`, "tcp://ADDRESS:PORT", or "" for none; `now_ns` is the graph's clock for
    these; a `gate.Gate` admits readers. Raises ZMQError if an endpoint is in use or malformed.
    """

    def __init__(
        self,
        context: Context,
        endpoint: str,
        name: str = "writer",
        *,
        public: str = "",
        gate: Any = None,
        now_ns: Callable[[], int] | None = None,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.socket: Socket = context.socket(zmq.XPUB)
        # Each subscription arrives, not the first of a topic alone: late readers get its state.
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self.socket.setsockopt(zmq.SNDHWM, QUEUE_FRAMES)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_NOTE_BYTES)

        self._gate = gate
        if gate is not None:
            gate.guard(self.socket)
        # Unlike all others, a bind to the path of a file replaces the one who listens there.
        path = endpoint.removeprefix("ipc://")
        if endpoint.startswith("ipc:///") and is_served(Path(path)):
            raise zmq.ZMQError(zmq.EADDRINUSE)
        self.socket.bind(endpoint)
        # Where it was bound: the port may have been left to the system.
        last_endpoint: bytes = self.socket.last_endpoint  # type: ignore[assignment]
        self.endpoint = last_endpoint.decode()
        if public:
            _set_options(self.socket, OVER_NETWORK_MS)
            self.socket.bind(public)

        self._name = name
        self._now_ns = now_ns
        self._log = log
        self._logged: set[str] = set()
        self._latched: dict[bytes, bytes] = {}

        # Subscriptions; and by topic, as it is asked for, whether one selects it.
        self._prefixes: set[bytes] = set()
        self._is_wanted: dict[str, bool] = {}
        self._n_subscriptions = 0

        # Readers; number of the last ask that each one, and each one so far, has answered.
        self.present: set[str] = set()
        self._observers: set[str] = set()
        self._asks = 0
        self._answered: dict[str, int] = {}
        self._processed: dict[str, int] = {}

    def send(self, message: Message) -> None:
        """Publish a message to the subscribers of its topic; where there is none, encode none."""
        topic = message.topic
        if message.latched:
            buffer = wire_bytes(message)
            self._latched[topic.encode()] = buffer
            self.socket.send(buffer)
            return
        # A reader may have come since the last look.
        if not self._wants(topic):
            self.serve_subscriptions()
        if self._wants(topic):
            self.socket.send(wire_bytes(message))

    def note(self, reader: str, text: str) -> None:
        """Send a note to a reader, under its presence tag."""
        # As in any message, a 0 stands between topic and payload.
        tag = PRESENCE + reader.encode()
        self.socket.send(tag + b"\0" + text.encode())

    def serve_subscriptions(self) -> None:
        """Process waiting subscriptions: note present readers, repeat latched messages."""
        # A flood of subscriptions must not keep a node from its work.
        for _ in range(MAX_EVENTS):
            # A third of the time of a receive that fails.
            if not self.socket.getsockopt(_EVENTS) & _POLLIN:  # type: ignore[operator]
                return
            frame = self.socket.recv(copy=False)
            if self._gate is not None:
                # That of a node of the same process comes by no connection.
                with contextlib.suppress(zmq.ZMQError):
                    self._gate.subscribed(frame.get(zmq.SRCFD))

            joins = frame.bytes[:1] == JOINS
            topic = frame.bytes[1:]
            self._count_subscription(joins)
            if topic.startswith(PRESENCE):
                tag = topic[1:].decode(errors="replace")
                self._note_presence(tag, joins)
            elif joins:
                self._add_prefix(topic)
                # A reader that comes late gets the state that holds.
                if topic in self._latched:
                    self.socket.send(self._latched[topic])

    def _add_prefix(self, prefix: bytes) -> None:
        # None is taken out again: a reader that never had a topic can end it for the others.
        if prefix not in self._prefixes and len(self._prefixes) < MAX_SUBSCRIPTIONS:
            self._prefixes.add(prefix)
            self._is_wanted.clear()

    def _count_subscription(self, joins: bool) -> None:
        if joins:
            self._n_subscriptions += 1
        else:
            self._n_subscriptions = max(0, self._n_subscriptions - 1)
        if self._n_subscriptions > MAX_SUBSCRIPTIONS:
            self._log_once(
                f"more than {MAX_SUBSCRIPTIONS} subscriptions: some reader misbehaves"
            )

    def _wants(self, topic: str) -> bool:
        """True if a reader may have subscribed to a topic; ZeroMQ subscribes by prefix."""
        is_wanted = self._is_wanted.get(topic)
        if is_wanted is None:
            prefixes = tuple(self._prefixes)
            is_wanted = topic.encode().startswith(prefixes)
            # Further prefixes were not kept: one of them may select it.
            if len(prefixes) >= MAX_SUBSCRIPTIONS:
                is_wanted = True
            self._is_wanted[topic] = is_wanted
        return is_wanted

    def ask(self) -> int:
        """Ask all present readers to answer when they have processed all messages sent so far."""
        self._asks += 1
        for reader in self.present - self._observers:
            # One that is new has nothing to answer of the asks before.
            self._answered.setdefault(reader, self._asks - 1)
            self.note(reader, f"{self._name}:{self._asks}")
        return self._asks

    def awaits(self, ask: int) -> bool:
        """True if a present reader that was asked has not answered yet."""
        asked = self.present & self._answered.keys()
        # A reader that has left is not waited for.
        return any(self._answered[reader] < ask for reader in asked)

    def has_answered(self, reader: str, ask: int) -> bool:
        """True if a reader, present or not, has processed all messages sent before an ask."""
        return self._processed.get(reader, 0) >= ask

    def _log_once(self, line: str) -> None:
        if line not in self._logged:
            self._logged.add(line)
            self._log(line)

    def _note_presence(self, tag: str, joins: bool) -> None:
        """Process a tag: of a reader that comes or goes, an answer, or a question for the time."""
        asking, is_time, t1_ns = tag.partition("!")
        reader, is_answer, answer = tag.partition("#")
        if is_time:
            if joins:
                self._answer_time(asking, t1_ns)
        elif is_answer:
            if joins:
                self._note_answer(reader, answer)
        elif joins and len(self.present) >= MAX_READERS:
            self._log_once(
                f"more than {MAX_READERS} readers: frames wait for these only"
            )
        else:
            self._note_reader(reader, joins)

    def _answer_time(self, asking: str, t1_ns: str) -> None:
        """Send the time to a reader that asks for it, unless it is none, or its time is not one."""
        is_number = t1_ns.isdecimal() and len(t1_ns) <= MAX_TIME_DIGITS
        is_reader = asking.removeprefix(OBSERVER) in self.present
        if is_number and is_reader and self._now_ns is not None:
            now_ns = self._now_ns()
            self.note(asking, f"{self._name}!{t1_ns}:{now_ns}:{now_ns}")

    def _note_answer(self, reader: str, answer: str) -> None:
        """Note that a reader has processed all messages before an ask of this writer."""
        # Answers come to all writers of the reader; a text of any length may claim to be one.
        writer, _, number = answer.partition(":")
        is_for_us = writer == self._name and reader in self._answered
        if is_for_us and number.isdecimal():
            # Of at most 18 digits: no ask has more.
            answered = int(number[:18])
            self._answered[reader] = max(self._answered[reader], answered)
            self._processed[reader] = self._answered[reader]

    def _note_reader(self, tag: str, joins: bool) -> None:
        """Note a reader, or an observer, that comes or goes."""
        reader = tag.removeprefix(OBSERVER)
        self._observers.discard(reader)
        if joins:
            self.present.add(reader)
            if tag.startswith(OBSERVER):
                self._observers.add(reader)
        else:
            self.present.discard(reader)
            self._answered.pop(reader, None)


class Reader:
    """Subscribing side of a node: a SUB socket connected to the endpoints of all its writers.

    Writers know it by its name, and wait for it as they start, if it is `present`; none that
    follows its readers waits for one that `observes`. `keys` are those of this host, for writers
    that need them. Beyond `read_ahead` messages of a writer, further ones wait at the writer.
    """

    def __init__(
        self,
        context: Context,
        name: str,
        endpoints: Iterable[str],
        topics: Iterable[str],
        present: bool = True,
        keys: KeyPair | None = None,
        read_ahead: int = QUEUE_FRAMES,
        observes: bool = False,
    ) -> None:
        self.socket: Socket = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self.socket.setsockopt(zmq.RCVHWM, read_ahead)
        if keys is not None:
            self.socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public.encode())
            self.socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret.encode())
            self.socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)

        self._topics = {topic.encode() for topic in topics}
        self._tag = PRESENCE + name.encode()
        if observes:
            self._tag = PRESENCE + OBSERVER.encode() + name.encode()
        self._queue: deque[tuple[bytes, Payload]] = deque()
        self._answers: dict[bytes, bytes] = {}
        self._time_tag = b""

        # The tag comes last: a writer that has it has all topics.
        for topic in sorted(self._topics):
            self.socket.subscribe(topic)
        if present:
            self.socket.subscribe(self._tag)
        for endpoint in endpoints:
            self.connect(endpoint)

    def connect(
        self, endpoint: str, server_key: str = "", distant: bool = False
    ) -> None:
        """Connect to one more writer, with its public key if it needs keys.

        The link to a distant one, on another host, can break.
        """
        if server_key:
            self.socket.setsockopt(zmq.CURVE_SERVERKEY, server_key.encode())
        if distant:
            _set_options(self.socket, OVER_NETWORK_MS)
        self.socket.connect(endpoint)

    def receive(self) -> tuple[bytes, Payload] | None:
        """Next waiting (topic, payload), or None.

        ZeroMQ subscribes by prefix: a longer topic that begins like one of ours is dropped. A topic
        alone is returned with an empty payload, for the decoder to refuse and count; each part of a
        message of several counts as a message. An ask is a payload under the reader's own tag.
        """
        while True:
            # To ask first whether one waits would cost as much as to receive it.
            try:
                topic, payload = received(self.socket.recv(_NOBLOCK))
            except zmq.Again:
                return None
            if topic in self._topics:
                return topic, payload
            if topic == self._tag:
                return topic, bytes(payload)

    @property
    def has_waiting(self) -> bool:
        """True if a message waits."""
        if self._queue:
            return True
        return bool(self.socket.getsockopt(_EVENTS) & _POLLIN)  # type: ignore[operator]

    def take(
        self, depth: int, streams: Container[bytes]
    ) -> tuple[bytes, Payload, bool] | None:
        """Next waiting topic and payload, and True if `depth` newer ones of its stream, one of
        `streams`, overtake it (0: none does); or None.

        No message before an ask is overtaken, since its writer waits until all are processed. The
        end of a stream overtakes none of its messages.
        """
        if depth:
            self._fill_queue()
        if self._queue:
            message: tuple[bytes, Payload] | None = self._queue.popleft()
        else:
            message = self.receive()
        if message is None:
            return None
        topic, payload = message
        is_overtaken = False
        if depth > 0 and topic in streams:
            is_overtaken = self._has_newer(topic, depth)
        return topic, payload, is_overtaken

    def _fill_queue(self) -> None:
        # A bound, as of the queues of ZeroMQ: a writer may be faster than this loop.
        while len(self._queue) < QUEUE_FRAMES:
            message = self.receive()
            if message is None:
                return
            self._queue.append(message)

    def _has_newer(self, topic: bytes, depth: int) -> bool:
        """True if as many messages of a topic wait before the next ask."""
        n_newer = 0
        for waiting, payload in self._queue:
            if waiting == self._tag:
                return False
            if waiting == topic and not is_end(payload):
                n_newer += 1
            if n_newer == depth:
                return True
        return False

    def is_ask(self, topic: bytes) -> bool:
        """True if a topic is that of asks, to be answered by `answer`."""
        return topic == self._tag

    def ask_time(self, now_ns: int) -> None:
        """Ask all writers for the time on their clocks; the answers arrive like asks."""
        # The new question comes first, so that a reader has one at all times.
        tag = self._tag + b"!%d" % now_ns
        self.socket.subscribe(tag)
        if self._time_tag:
            self.socket.unsubscribe(self._time_tag)
        self._time_tag = tag

    def answer(self, note: bytes) -> None:
        """Answer the writer of an ask that all messages before it are processed."""
        writer = note.partition(b":")[0]
        # No ask of a writer is as long, and no reader has as many writers.
        if len(note) > MAX_ASK_BYTES or len(self._answers) >= MAX_WRITERS:
            return
        tag = self._tag + b"#" + note
        self.socket.subscribe(tag)
        if writer in self._answers:
            self.socket.unsubscribe(self._answers[writer])
        self._answers[writer] = tag


def read_times(note: bytes) -> tuple[str, int, int, int] | None:
    """Writer, t1, t2 and t3 (ns) in an answer to `Reader.ask_time`; None for anything else."""
    text = note[:MAX_TIMES_BYTES].decode(errors="replace")
    writer, _, times = text.partition("!")
    parts = times.split(":")
    if len(parts) != 3:
        return None
    for part in parts:
        # int() takes time that grows with the square of the digits.
        if not part.isdecimal() or len(part) > MAX_TIME_DIGITS:
            return None
    t1_ns, t2_ns, t3_ns = map(int, parts)
    return writer, t1_ns, t2_ns, t3_ns
