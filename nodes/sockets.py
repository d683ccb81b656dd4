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

A reader on another host asks a writer for the time there in the same way: it subscribes to
"@NAME!T1", and each writer publishes "WRITER!T1:T2:T3" on the tag of that reader.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import zmq

from sparseskin.messages import MAX_MESSAGE_BYTES, Message, encode

from .gate import HANDSHAKE_MS, Gate
from .keys import KeyPair
from .transport import make_context, watch_for_death

__all__ = ["FAREWELL_MS", "Reader", "Writer", "make_context", "read_times"]

PRESENCE = b"@"
FAREWELL_MS = 500
"""How long a node that ends may take to send what its readers have not yet taken."""
MAX_NOTE_BYTES = 1024
"""Largest subscription that is taken in; a handshake with keys needs messages of 300 bytes."""
MAX_ASK_BYTES = 64
MAX_TIMES_BYTES = 160
MAX_TIME_DIGITS = 20
MAX_WRITERS = 256
MAX_READERS = 128
MAX_SUBSCRIPTIONS = 4096
"""Beyond these, readers and subscriptions are not kept in mind any more, and a line says so."""
QUEUE_FRAMES = 1000
"""High-water mark of each queue: a second at 1 kHz before anything is dropped (and counted)."""


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
    public : str
        Where readers on other hosts find it, "tcp://ADDRESS:PORT"; "" for nowhere.
    gate : Gate, optional
        Guards the socket.
    now_ns : callable, optional
        The graph's clock, for readers on other hosts that ask for the time.
    log : callable
        Takes one line of text.

    Attributes
    ----------
    present : set of str
        Names of the readers that are there.

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
        gate: Gate | None = None,
        now_ns: Callable[[], int] | None = None,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.XPUB)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self.socket.setsockopt(zmq.SNDHWM, QUEUE_FRAMES)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_NOTE_BYTES)
        if gate is not None:
            gate.guard(self.socket)
        self.socket.bind(endpoint)
        self.endpoint = self.socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()
        if public:
            watch_for_death(self.socket)
            self.socket.bind(public)
        self.present: set[str] = set()
        self._name = name
        self._now_ns = now_ns
        self._log = log
        self._n_subscriptions = 0
        self._said: set[str] = set()
        self._asks = 0
        self._answered: dict[str, int] = {}
        self._said_done: dict[str, int] = {}
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
            self._count(joins)
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

    def has_answered(self, reader: str, ask: int) -> bool:
        """Whether a reader, there or not any more, has said that it is done with all that was
        sent before an ask.
        """
        return self._said_done.get(reader, 0) >= ask

    def _count(self, joins: bool) -> None:
        self._n_subscriptions = max(0, self._n_subscriptions + (1 if joins else -1))
        if self._n_subscriptions > MAX_SUBSCRIPTIONS:
            self._say_once(f"more than {MAX_SUBSCRIPTIONS} subscriptions: some reader misbehaves")

    def _say_once(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._log(line)

    def _tell_time(self, reader: str, t1_ns: str) -> None:
        if self._now_ns is None or reader not in self.present:
            return
        if t1_ns.isdecimal() and len(t1_ns) <= MAX_TIME_DIGITS:
            note = f"{self._name}!{t1_ns}:{self._now_ns()}:{self._now_ns()}".encode()
            self.socket.send_multipart((PRESENCE + reader.encode(), note))

    def _note_presence(self, tag: str, joins: bool) -> None:
        asking, is_time, t1_ns = tag.partition("!")
        if is_time:
            if joins:
                self._tell_time(asking, t1_ns)
            return
        reader, is_answer, answer = tag.partition("#")
        if not is_answer:
            if joins and len(self.present) >= MAX_READERS:
                self._say_once(f"more than {MAX_READERS} readers: no frame waits for those beyond")
                return
            (self.present.add if joins else self.present.discard)(reader)
            if not joins:
                self._answered.pop(reader, None)
            return
        writer, _, number = answer.partition(":")
        if joins and writer == self._name and reader in self._answered and number.isdecimal():
            self._answered[reader] = max(self._answered[reader], int(number[:18]))
            self._said_done[reader] = self._answered[reader]


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
    present : bool
        Whether the writers are told of it, and so wait for it where they follow their readers;
        an onlooker is not waited for.
    keys : KeyPair, optional
        The keys of this host, for writers that ask for them.
    read_ahead : int
        How many messages of a writer wait here; those beyond wait with it.
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
    ) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, read_ahead)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self._topics = {topic.encode() for topic in topics}
        self._tag = PRESENCE + name.encode()
        self._answers: dict[bytes, bytes] = {}
        self._time_tag = b""
        if keys is not None:
            self.socket.setsockopt(zmq.CURVE_PUBLICKEY, keys.public.encode())
            self.socket.setsockopt(zmq.CURVE_SECRETKEY, keys.secret.encode())
            self.socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        for topic in sorted(self._topics):
            self.socket.subscribe(topic)
        if present:
            self.socket.subscribe(self._tag)
        for endpoint in endpoints:
            self.connect(endpoint)

    def connect(self, endpoint: str, server_key: str = "", distant: bool = False) -> None:
        """Listen to one writer more.

        Parameters
        ----------
        endpoint : str
            Where it is bound.
        server_key : str
            Its public key, where it asks for keys.
        distant : bool
            Whether it is on another host, so that the way there can break.
        """
        if server_key:
            self.socket.setsockopt(zmq.CURVE_SERVERKEY, server_key.encode())
        if distant:
            watch_for_death(self.socket)
        self.socket.connect(endpoint)

    def reconnect(self, endpoint: str, server_key: str = "", distant: bool = False) -> None:
        """Try again where ZeroMQ itself does not: after a handshake that was refused."""
        self.socket.disconnect(endpoint)
        self.connect(endpoint, server_key, distant)

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

    def ask_time(self, now_ns: int) -> None:
        """Ask all writers for the time on their clocks; the answers come like asks."""
        tag = self._tag + b"!%d" % now_ns
        self.socket.subscribe(tag)
        if self._time_tag:
            self.socket.unsubscribe(self._time_tag)
        self._time_tag = tag

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


def read_times(note: bytes) -> tuple[str, int, int, int] | None:
    """Writer, t1, t2 and t3 (ns) of an answer to `Reader.ask_time`; None where it is none."""
    writer, is_time, times = note[:MAX_TIMES_BYTES].decode(errors="replace").partition("!")
    parts = times.split(":")
    if not is_time or len(parts) != 3:
        return None
    if not all(part.isdecimal() and len(part) <= MAX_TIME_DIGITS for part in parts):
        return None
    t1_ns, t2_ns, t3_ns = map(int, parts)
    return writer, t1_ns, t2_ns, t3_ns
