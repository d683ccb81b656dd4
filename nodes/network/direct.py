"""The transport of direct links: one stream socket (AF_UNIX) from node to node of a host.

A message goes from the thread of its writer into the kernel and wakes its reader, where ZeroMQ
wakes a thread of its own in both processes first. It travels as a head, the number of its parts and
the size of each (32-bit, little-endian), and then the parts. Subscriptions travel the other way, as
messages of one part.

The socket is a file in a folder that no other user can enter, and both sides ask the kernel for the
user of the other one. What a link carries is checked all the same: a head that no peer of this
program sends ends the link.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import select
import socket
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path

import zmq

from sparseskin.messages.errors import MalformedError, MessageError, OversizedError
from sparseskin.messages.topics import MAX_TOPIC_BYTES
from sparseskin.messages.wire import MAX_MESSAGE_BYTES, MAX_PARTS
from sparseskin.nodes.files import is_served

from .poll import READABLE, WRITABLE, Poll
from .transport import JOINS, LEAVES, Parts, Send

MAX_WAITING = 2000
"""Largest number of messages that wait for a reader: as many as the two queues of ZeroMQ hold."""
MAX_WAITING_BYTES = 1 << 28
"""Largest number of bytes that wait for a reader."""
MAX_LINKS = 128
MAX_TOPICS = 4096
"""Links of a writer, and subscriptions of a link, beyond these are refused."""
MAX_NOTE_BYTES = 1024
SEND_BYTES = 1 << 20
"""Kernel buffer of a link that is asked for; the kernel grants as much as it allows (wmem_max)."""
BUFFER_BYTES = 1 << 18
"""First size of the buffer of a reader's link; it grows to the largest message."""
RECONNECT_NS = 100_000_000
"""Time after which a connection is tried again."""
_COUNT = struct.Struct("<I")
_HEADS = [struct.Struct(f"<{n + 1}I") for n in range(MAX_PARTS + 1)]
_CREDENTIALS = struct.Struct("3i")
_SO_PEERCRED: int | None = getattr(socket, "SO_PEERCRED", None)


class LinkEndedError(Exception):
    """The other side has closed its end of a link."""


def peer_uid(connection: socket.socket) -> int:
    """User of the process at the other end; where the kernel does not state it, this one."""
    if _SO_PEERCRED is None:
        return os.geteuid()
    data = connection.getsockopt(socket.SOL_SOCKET, _SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(data)[1])


class Link:
    """One end of a link: sends messages, keeps what the other end does not take, reads messages.

    `max_bytes` is the size of the largest message that may come.
    """

    def __init__(self, connection: socket.socket, max_bytes: int, buffer_bytes: int) -> None:
        self.socket = connection
        self.waits = False
        """True if messages wait until the other end takes more."""
        self._max_bytes = max_bytes
        self._buffer = bytearray(max(buffer_bytes, _HEADS[-1].size))
        self._view = memoryview(self._buffer)
        self._n_read = 0
        self._rest = memoryview(b"")
        self._waiting: deque[tuple[bool, bytes]] = deque()
        self._n_waiting_bytes = 0
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)

    def send(self, buffers: Parts, n_bytes: int, frame: bool) -> None:
        """Send a head and its parts, or let them wait. Raises OSError if the link is broken."""
        n_sent = 0
        if not self.waits:
            with contextlib.suppress(BlockingIOError):
                n_sent = self.socket.sendmsg(buffers)
            if n_sent == n_bytes:
                return
        data = b"".join(buffers)
        self.waits = True
        if n_sent:
            self._rest = memoryview(data)[n_sent:]
            return
        self._waiting.append((frame, data))
        self._n_waiting_bytes += len(data)
        while len(self._waiting) > MAX_WAITING or self._n_waiting_bytes > MAX_WAITING_BYTES:
            self._drop_one()

    def _drop_one(self) -> None:
        """Drop the oldest frame; if no frame waits, the newest message."""
        last = len(self._waiting) - 1
        k = next((k for k, (frame, _) in enumerate(self._waiting) if frame), last)
        self._n_waiting_bytes -= len(self._waiting[k][1])
        del self._waiting[k]

    def flush(self) -> None:
        """Send what waits, as far as the other end takes it. Raises OSError."""
        with contextlib.suppress(BlockingIOError):
            while self._rest or self._waiting:
                if not self._rest:
                    _, data = self._waiting.popleft()
                    self._n_waiting_bytes -= len(data)
                    self._rest = memoryview(data)
                self._rest = self._rest[self.socket.send(self._rest) :]
            self.waits = False

    def read(self, found: deque[Sequence[bytes]]) -> bool:
        """Read once what has come, and append all complete messages; True if more may wait.

        Raises LinkEndedError, OSError, or MessageError for what is no message.
        """
        try:
            n = self.socket.recv_into(self._view[self._n_read :])
        except BlockingIOError:
            return False
        if not n:
            raise LinkEndedError
        self._n_read += n
        filled = self._n_read == len(self._buffer)
        begin = 0
        while begin < self._n_read and (end := self._message(begin, found)) is not None:
            begin = end
        if begin == self._n_read:
            self._n_read = 0
        elif begin:
            rest = bytes(self._view[begin : self._n_read])
            self._view[: len(rest)] = rest
            self._n_read = len(rest)
        return filled

    def _message(self, begin: int, found: deque[Sequence[bytes]]) -> int | None:
        """Append the message that begins in the buffer, and return its end; None: it has not come
        whole.
        """
        n_here = self._n_read - begin
        if n_here < _COUNT.size:
            return None
        (n_parts,) = _COUNT.unpack_from(self._buffer, begin)
        if not 1 <= n_parts <= MAX_PARTS:
            raise MalformedError(f"a message of {n_parts} parts on a link")
        head = _HEADS[n_parts]
        if n_here < head.size:
            return None
        _, *sizes = head.unpack_from(self._buffer, begin)
        total = head.size + sum(sizes)
        if total > self._max_bytes:
            raise OversizedError(f"message of {total} bytes, at most {self._max_bytes}")
        if n_here < total:
            self._make_room(begin, total)
            return None
        at: int = begin + head.size
        view, parts = self._view, []
        for size in sizes:
            parts.append(bytes(view[at : at + size]))
            at += size
        found.append(parts)
        return at

    def _make_room(self, begin: int, n_bytes: int) -> None:
        """Let the buffer hold a message that begins in it, once that is moved to its start."""
        if n_bytes > len(self._buffer):
            longer = bytearray(max(n_bytes, min(2 * len(self._buffer), self._max_bytes)))
            longer[: self._n_read] = self._view[: self._n_read]
            self._buffer, self._view = longer, memoryview(longer)


def framed(parts: Parts) -> tuple[list[object], int]:
    """Head and parts of a message as they travel, and their number of bytes."""
    sizes = [len(part) if type(part) is bytes else memoryview(part).nbytes for part in parts]
    head = _HEADS[len(sizes)].pack(len(sizes), *sizes)
    return [head, *parts], len(head) + sum(sizes)


class DirectOutlet:
    """Sending side: a socket that listens, and a link a reader.

    Parameters
    ----------
    path, poll, log
        Where to listen, in a private folder; what the node waits with; receives one line of text.

    Raises
    ------
    zmq.ZMQError
        If a process listens there, or the path cannot be used.
    """

    def __init__(self, path: str, poll: Poll, log: Callable[[str], None]) -> None:
        self._path, self._poll, self._log = path, poll, log
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            if is_served(Path(path)):
                raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
            Path(path).unlink(missing_ok=True)
            os.fchmod(self._listener.fileno(), 0o600)
            self._listener.bind(path)
            self._listener.listen(MAX_LINKS)
        except OSError as error:
            self._listener.close()
            raise zmq.ZMQError(error.errno or 0) from error
        self._listener.setblocking(False)
        self._topics: dict[Link, set[bytes]] = {}
        self._readers: dict[bytes, list[Link]] = {}
        self._notes: deque[tuple[Link, bytes]] = deque()
        self._refused: Counter[str] = Counter()
        self._deaf_until_ns = 0
        poll.add(self._listener.fileno(), lambda events: self._accept())

    def wants(self, topic: bytes) -> bool:
        return topic in self._readers

    def send(self, parts: Parts, frame: bool = False) -> None:
        readers = self._readers.get(parts[0])
        if readers:
            buffers, n_bytes = framed(parts)
            for link in readers:
                self._send(link, buffers, n_bytes, frame)

    def note(self) -> tuple[bytes, Send] | None:
        if self._deaf_until_ns and time.monotonic_ns() >= self._deaf_until_ns:
            self._listen()
        while self._notes:
            link, note = self._notes.popleft()
            if self._applies(link, note[:1] == JOINS, note[1:]):
                return note, functools.partial(self._reply, link)
        return None

    def _reply(self, link: Link, parts: Parts) -> None:
        self._send(link, *framed(parts), False)

    def _applies(self, link: Link, joins: bool, topic: bytes) -> bool:
        """Begin or end a subscription; False if it changes nothing for the writer. It begins here,
        not when it comes, so that no frame overtakes the states of which it needs to know.
        """
        readers = self._readers.get(topic, [])
        if joins == (link in readers) or (joins and link not in self._topics):
            return False
        if joins:
            self._readers[topic] = [*readers, link]
            return True
        self._readers[topic] = [other for other in readers if other is not link]
        if self._readers[topic]:
            return False
        del self._readers[topic]
        return True

    def close(self, linger_ms: int = 0) -> None:
        """Send what waits, for a bounded time, and close all links."""
        due_ns = time.monotonic_ns() + linger_ms * 1_000_000
        while True:
            late = [link for link in self._topics if link.waits]
            left_ms = (due_ns - time.monotonic_ns()) // 1_000_000
            if not late or left_ms <= 0:
                break
            waiting = select.poll()
            for link in late:
                waiting.register(link.socket, select.POLLOUT)
            waiting.poll(left_ms)
            for link in late:
                self._flush(link)
        for link in tuple(self._topics):
            self._drop(link)
        self._poll.remove(self._listener.fileno())
        self._listener.close()
        Path(self._path).unlink(missing_ok=True)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._make_free()
            return
        uid = peer_uid(connection)
        if uid != os.geteuid():
            connection.close()
            self._refuse(f"turned away user {uid}: links are for the user of the graph alone")
        elif len(self._topics) >= MAX_LINKS:
            connection.close()
            self._refuse(f"turned away a reader: there are {MAX_LINKS} links already")
        else:
            link = Link(connection, MAX_NOTE_BYTES, 4 * MAX_NOTE_BYTES)
            self._topics[link] = set()
            self._poll.add(connection.fileno(), lambda events: self._serve(link, events))

    def _make_free(self) -> None:
        """Close a link that has not subscribed, where no descriptor is free; else do not listen
        for a while: a connection that cannot be accepted would wake the node without end.
        """
        idle = next((link for link, topics in self._topics.items() if not topics), None)
        if idle is not None:
            self._drop(idle)
        else:
            self._refuse("no file descriptor is free for a link")
            self._poll.change(self._listener.fileno(), 0)
            self._deaf_until_ns = time.monotonic_ns() + RECONNECT_NS

    def _listen(self) -> None:
        self._deaf_until_ns = 0
        self._poll.change(self._listener.fileno(), READABLE)

    def _refuse(self, line: str) -> None:
        self._refused[line] += 1
        if str(self._refused[line]).strip("0") == "1":
            self._log(line)

    def _serve(self, link: Link, events: int) -> None:
        if link not in self._topics:
            return
        if events & WRITABLE:
            self._flush(link)
        if events & ~WRITABLE and link in self._topics:
            found: deque[Sequence[bytes]] = deque()
            try:
                link.read(found)
            except (LinkEndedError, OSError):
                self._drop(link)
            except MessageError as error:
                self._refuse(f"a link that carries no subscriptions is closed: {error}")
                self._drop(link)
            for parts in found:
                self._take(link, parts)

    def _take(self, link: Link, parts: Sequence[bytes]) -> None:
        topics = self._topics.get(link)
        kind, topic = parts[0][:1], parts[0][1:]
        if topics is None:
            return
        if len(parts) > 1 or kind not in (JOINS, LEAVES) or len(topics) >= MAX_TOPICS:
            self._refuse("a link that carries no subscriptions is closed: malformed or too many")
            self._drop(link)
        else:
            (topics.add if kind == JOINS else topics.discard)(topic)
            self._notes.append((link, parts[0]))

    def _send(self, link: Link, buffers: Parts, n_bytes: int, frame: bool) -> None:
        if link not in self._topics:
            return
        waited = link.waits
        try:
            link.send(buffers, n_bytes, frame)
        except OSError:
            self._drop(link)
            return
        if link.waits and not waited:
            self._poll.change(link.socket.fileno(), READABLE | WRITABLE)

    def _flush(self, link: Link) -> None:
        try:
            link.flush()
        except OSError:
            self._drop(link)
            return
        if not link.waits:
            self._poll.change(link.socket.fileno(), READABLE)

    def _drop(self, link: Link) -> None:
        self._notes.extend((link, LEAVES + topic) for topic in self._topics.pop(link))
        self._poll.remove(link.socket.fileno())
        link.socket.close()


class DirectInlet:
    """Receiving side: a link a writer, connected again when it breaks.

    Parameters
    ----------
    poll, log
        What the node waits with; receives one line of text.
    refused : callable
        Called with the MessageError for what is no message; by default it is logged.
    """

    def __init__(
        self,
        poll: Poll,
        log: Callable[[str], None],
        refused: Callable[[MessageError], None] | None = None,
    ) -> None:
        self._poll, self._log = poll, log
        self._refused = refused or (lambda error: log(f"{error.reason}: {error}"))
        self._topics: dict[bytes, None] = {}
        self._links: dict[str, Link | None] = {}
        self._due_ns: dict[str, int] = {}
        self._ready: deque[str] = deque()
        self._messages: deque[Sequence[bytes]] = deque()
        self._logged: set[str] = set()

    def connect(self, path: str) -> None:
        """Connect to one more writer, now or as soon as it listens."""
        self._links[path] = None
        self._try(path)

    @property
    def is_broken(self) -> bool:
        """True if a link is to be connected again."""
        return bool(self._due_ns)

    def serve(self) -> None:
        """Connect again where that is due."""
        now_ns = time.monotonic_ns()
        for path in [path for path, due_ns in self._due_ns.items() if due_ns <= now_ns]:
            self._try(path)

    def subscribe(self, topic: bytes) -> None:
        self._topics[topic] = None
        self._note(JOINS + topic)

    def unsubscribe(self, topic: bytes) -> None:
        self._topics.pop(topic, None)
        self._note(LEAVES + topic)

    def receive(self) -> Sequence[bytes] | None:
        while not self._messages:
            if not self._ready:
                self._poll.look()
            if not self._ready:
                return None
            self._read(self._ready.popleft())
        return self._messages.popleft()

    def close(self) -> None:
        """Close all links."""
        self._due_ns.clear()
        for path in self._links:
            self._drop(path)

    def _try(self, path: str) -> None:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.setblocking(False)
        try:
            connection.connect(path)
            uid = peer_uid(connection)
        except OSError:  # it does not listen yet, or no longer
            uid = -1
        if uid != os.geteuid():
            connection.close()
            self._due_ns[path] = time.monotonic_ns() + RECONNECT_NS
            if uid >= 0 and path not in self._logged:
                self._logged.add(path)
                self._log(f"cannot connect to {path}: user {uid} listens there")
            return
        self._due_ns.pop(path, None)
        most = MAX_MESSAGE_BYTES + MAX_TOPIC_BYTES + _HEADS[-1].size
        link = self._links[path] = Link(connection, most, BUFFER_BYTES)
        self._poll.add(connection.fileno(), lambda events: self._mark(path, events))
        for topic in self._topics:
            self._send(path, link, JOINS + topic)

    def _mark(self, path: str, events: int) -> None:
        link = self._links[path]
        if link is None:
            return
        if events & WRITABLE:
            try:
                link.flush()
            except OSError:
                link.waits = False
            if not link.waits:
                self._poll.change(link.socket.fileno(), READABLE)
        if events & ~WRITABLE and path not in self._ready:
            self._ready.append(path)

    def _read(self, path: str) -> None:
        link = self._links[path]
        if link is None:
            return
        try:
            if link.read(self._messages):
                self._ready.append(path)
        except (LinkEndedError, OSError):
            self._lose(path)
        except MessageError as error:
            self._refused(error)
            self._lose(path)

    def _note(self, note: bytes) -> None:
        for path, link in self._links.items():
            if link is not None:
                self._send(path, link, note)

    def _send(self, path: str, link: Link, note: bytes) -> None:
        waited = link.waits
        with contextlib.suppress(OSError):  # it is closed; what it holds is still to be read
            link.send(*framed((note,)), frame=False)
        if link.waits and not waited:
            self._poll.change(link.socket.fileno(), READABLE | WRITABLE)

    def _lose(self, path: str) -> None:
        self._drop(path)
        self._due_ns[path] = time.monotonic_ns() + RECONNECT_NS

    def _drop(self, path: str) -> None:
        link = self._links[path]
        if link is not None:
            self._links[path] = None
            self._poll.remove(link.socket.fileno())
            link.socket.close()
