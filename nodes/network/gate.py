"""Access control of a writer that can be reached over the network.

With keys, a reader receives nothing before it has proved that it holds the secret of a key on the
list. Refused peers are named in the log, with their address where it is known.
"""

import contextlib
import socket
from collections import Counter
from collections.abc import Callable, Iterator, Mapping

import zmq
from zmq.utils import z85

from sparseskin.nodes.node_host import log_some

from .keys import KeyPair
from .sockets import HANDSHAKE_MS, MAX_EVENTS, Context, Socket, events

ZAP_ENDPOINT = "inproc://zeromq.zap.01"
ZAP_DOMAIN = b"sparseskin"
MAX_CONNECTIONS = 256
"""Largest number of connections to one node; further ones are turned away."""
MAX_PENDING = 64
"""Largest number of connections that have not subscribed yet. Of more, the oldest of the address
with the most is closed, so that others are let in whatever one address opens.
"""
MAX_REFUSALS = 256
"""Largest number of pairs of address and reason whose refusals are counted, and logged, one by one.
All further ones are counted together: many addresses or keys fill neither memory nor log.
"""
UNKNOWN = "unknown address"
LOCAL = "this host"
OTHERS = ("", "")

_OTHER_SERVER_KEY = zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC
_NO_KEY = zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
_FAILED = (zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)


class Gate:
    """Guards the socket of a writer, in a context of its own; call `serve` whenever one of
    `sockets` is ready. Without `keys`, those of this host, every peer may read. `allowed` and
    `known` are names by public key: of the peers that may read, and of any, for log lines.
    """

    def __init__(
        self,
        context: Context,
        keys: KeyPair | None,
        allowed: Mapping[str, str],
        known: Mapping[str, str],
        log: Callable[[str], None],
    ) -> None:
        self._keys = keys
        self._allowed = dict(allowed)
        self._known = {**known, **allowed}
        self._log = log
        self._refused: Counter[tuple[str, str]] = Counter()
        self._open: dict[int, str] = {}
        self._pending: dict[int, str] = {}
        self._decided: Counter[str] = Counter()
        self._failure = ""

        # ZeroMQ asks this socket, of the same context, about each connection.
        self._zap = context.socket(zmq.REP)
        self._zap.bind(ZAP_ENDPOINT)
        self.sockets: list[Socket] = [self._zap]

    def guard(self, writer: Socket) -> None:
        """Guard a socket; call it before the socket is bound."""
        # Without a domain ZeroMQ asks nobody.
        writer.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN)
        writer.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        if self._keys is not None:
            writer.setsockopt(zmq.CURVE_SERVER, 1)
            writer.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret.encode())
        self.sockets.append(writer.get_monitor_socket())

    def serve(self) -> None:
        """Answer authentication requests and log refused peers."""
        for _ in range(MAX_EVENTS):
            if not self._zap.poll(0):
                break
            self._answer(self._zap.recv_multipart())
        self._serve_monitors()

    def subscribed(self, fd: int) -> None:
        """Note that a subscription came by a connection: its peer is in order."""
        if fd not in self._open or fd in self._pending:
            # Its events may still wait: they come by a socket of their own.
            self._serve_monitors()
            if fd in self._pending:
                self._decide(self._pending.pop(fd))

    def _serve_monitors(self) -> None:
        for monitor in self.sockets[1:]:
            for event, value, _ in events(monitor):
                self._note(event, value)

    def _answer(self, frames: list[bytes]) -> None:
        """Answer one authentication request (ZAP) of ZeroMQ."""
        version, request, _, address_bytes, _, mechanism, *credentials = frames
        address = address_bytes.decode(errors="replace")
        self._decided[_host(address)] += 1

        refusal = ""
        if len(self._open) - len(self._pending) >= MAX_CONNECTIONS:
            refusal = f"there are {MAX_CONNECTIONS} connections already"
        elif self._keys is not None:
            key = ""
            if mechanism == b"CURVE":
                key = z85.encode(credentials[0]).decode()
            refusal = self._refusal_of(key)

        status = b"200"
        if refusal:
            self._log_refusal(address, refusal)
            status = b"400"
        # At the end: a user and metadata, of which there are none (ZeroMQ RFC 27).
        text = refusal.encode()
        self._zap.send_multipart([version, request, status, text, b"", b""])

    def _refusal_of(self, key: str) -> str:
        """Why the peer with a public key may not read; "" if it may."""
        if key in self._allowed:
            return ""
        whose = f"its key {key} is not known here"
        if self._known.get(key):
            whose = f"its key is that of {self._known[key]}"
        return f"{whose}, and not on the list of those allowed"

    def _note(self, event: int, value: int) -> None:
        """Process one event of the socket; a failed handshake disconnects at once."""
        # A handshake that succeeds does not name its connection: a subscription does. Until then,
        # the end of a connection is logged unless an authentication of its address was decided.
        if event == zmq.EVENT_ACCEPTED:
            address = _address_of(value)
            self._open[value] = address
            self._pending[value] = address
            if len(self._pending) > MAX_PENDING:
                self._close_one()
        elif event == zmq.EVENT_ACCEPT_FAILED:
            # No descriptor is free.
            self._close_one()
        elif event in _FAILED:
            self._failure = _reason(event, value)
        elif event == zmq.EVENT_DISCONNECTED:
            reason = self._failure or "it speaks no ZeroMQ"
            self._failure = ""
            address = self._open.pop(value, UNKNOWN)
            was_pending = self._pending.pop(value, None) is not None
            if was_pending and not self._decide(address):
                self._log_refusal(address, reason)

    def _decide(self, address: str) -> bool:
        """True if an authentication of an address was decided, once for each."""
        host = _host(address)
        is_decided = self._decided[host] > 0
        self._decided[host] -= is_decided
        # Those that are zero go: many addresses must not fill the memory.
        if not self._decided[host]:
            del self._decided[host]
        return is_decided

    def _close_one(self) -> None:
        """Close the oldest pending connection of the address that has the most, if there is one."""
        if not self._pending:
            return
        # One address that floods must not shut out the others.
        hosts = [_host(address) for address in self._pending.values()]
        ((flooding, _),) = Counter(hosts).most_common(1)
        fds = list(self._pending)
        fd = fds[hosts.index(flooding)]
        address = self._pending.pop(fd)

        _shut_down(fd, address)
        self._log_refusal(address, "too many connections that read no topic")

    def _log_refusal(self, address: str, reason: str) -> None:
        """Log some of the refusals: a refused peer may try without end."""
        kind = (_host(address), reason)
        if kind not in self._refused and len(self._refused) >= MAX_REFUSALS:
            kind = OTHERS
            address = f"{address}, one of many"
        self._refused[kind] += 1
        log_some(self._log, f"turned away {address}: {reason}", self._refused[kind])


def _host(address: str) -> str:
    return address.partition(":")[0] or LOCAL


def _address_of(fd: int) -> str:
    """Address of the peer of a connection that ZeroMQ has accepted."""
    with contextlib.suppress(OSError), _connection(fd) as connection:
        if connection.family == socket.AF_INET:
            address, port = connection.getpeername()
            return f"{address}:{port}"
        return LOCAL
    return UNKNOWN


def _shut_down(fd: int, address: str) -> None:
    """End a connection, if it is still that of the address; ZeroMQ then closes it."""
    # ZeroMQ may have closed it meanwhile, and its descriptor may be of another connection.
    if _address_of(fd) == address != UNKNOWN:
        with contextlib.suppress(OSError), _connection(fd) as connection:
            connection.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def _connection(fd: int) -> Iterator[socket.socket]:
    """A connection of ZeroMQ, which alone closes it; no descriptor more is needed."""
    connection = socket.socket(fileno=fd)
    try:
        yield connection
    finally:
        connection.detach()


def _reason(event: int, value: int) -> str:
    if event == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL:
        return (
            "it uses no key and broke off the handshake, "
            f"or sent nothing for {HANDSHAKE_MS / 1000:g} s"
        )
    if value == _NO_KEY:
        return "it uses no key, or another security than this node"
    if value == _OTHER_SERVER_KEY:
        return "it has a wrong key for this host"
    return f"its handshake is broken (ZMTP error {value:#x})"
