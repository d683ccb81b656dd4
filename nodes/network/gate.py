"""Access control of a writer that can be reached over the network.

With keys, a reader receives nothing before it has proved that it holds the secret of a key on the
list. Refused peers are named in the log, with their address where it is known.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any

import zmq
from zmq.utils import z85

from sparseskin.nodes.host import log_some

from .keys import KeyPair
from .sockets import HANDSHAKE_MS, monitor_event

ZAP_ENDPOINT = "inproc://zeromq.zap.01"
ZAP_DOMAIN = b"sparseskin"
MAX_CONNECTIONS = 256
"""Largest number of connections to one node; further ones are turned away."""
MAX_PENDING = 1024
PATIENCE_NS = 1_000_000_000
"""Time for which a line waits for the address: a short connection has none when it is asked for,
but a refused peer tries again."""
UNKNOWN = "unknown address"

_OTHER_SERVER_KEY = zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC
_NO_KEY = zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
_FAILED = (zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)


class Gate:
    """Guards the socket of a writer; call `serve` whenever one of `sockets` is ready.

    Parameters
    ----------
    context, log
        The context of the writer, one gate each; receives one line of text.
    keys : KeyPair or None
        The keys of this host; None: every peer may read.
    allowed, known : mapping of str to str
        Names by public key: of the peers that may read, and of any, for log lines.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
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
        self._failures: deque[str] = deque(maxlen=MAX_PENDING)
        self._unnamed_due_ns: dict[str, int] = {}
        self._zap = context.socket(zmq.REP)
        self._zap.bind(ZAP_ENDPOINT)
        self.sockets: list[zmq.Socket[bytes]] = [self._zap]

    def guard(self, writer: zmq.Socket[bytes]) -> None:
        """Guard a socket; call it before the socket is bound."""
        writer.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN)
        writer.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        if self._keys is not None:
            writer.setsockopt(zmq.CURVE_SERVER, 1)
            writer.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret.encode())
        self.sockets.append(writer.get_monitor_socket())

    def serve(self, now_ns: int) -> None:
        """Answer authentication requests and log refused peers; any monotonic clock serves."""
        while self._zap.poll(0):
            self._answer(self._zap.recv_multipart())
        for monitor in self.sockets[1:]:
            while monitor.poll(0):
                event, value, _ = monitor_event(monitor)
                self._note(event, value, now_ns)
        for reason in [r for r, due_ns in self._unnamed_due_ns.items() if due_ns <= now_ns]:
            del self._unnamed_due_ns[reason]
            self._log_refusal(UNKNOWN, reason)

    def _answer(self, frames: list[bytes]) -> None:
        """Answer one authentication request (ZAP) of ZeroMQ."""
        version, request, _, address, _, mechanism, *credentials = frames
        refusal = ""
        if len(self._open) - len(self._pending) >= MAX_CONNECTIONS:
            refusal = f"there are {MAX_CONNECTIONS} connections already"
        elif self._keys is not None:
            key = z85.encode(credentials[0]).decode() if mechanism == b"CURVE" else ""
            if key not in self._allowed:
                name = self._known.get(key)
                whose = f"its key is that of {name}" if name else f"its key {key} is not known here"
                refusal = f"{whose}, and not on the list of those allowed"
        if refusal:
            self._log_refusal(address.decode(errors="replace"), refusal)
        status = b"400" if refusal else b"200"
        self._zap.send_multipart([version, request, status, refusal.encode(), b"", b""])

    def _note(self, event: int, value: int, now_ns: int) -> None:
        """Process one event of the socket; a disconnection follows each failed handshake."""
        if event == zmq.EVENT_ACCEPTED and len(self._pending) < MAX_PENDING:
            self._open[value] = self._pending[value] = _address_of(value)
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED and self._pending:
            # The event does not name the connection: handshakes end in the order of connections.
            del self._pending[next(iter(self._pending))]
        elif event in _FAILED:
            self._failures.append(_reason(event, value))
        elif event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            self._failures.append("")  # the refusal was logged when it was decided
        elif event == zmq.EVENT_DISCONNECTED:
            address = self._open.pop(value, UNKNOWN)
            was_pending = self._pending.pop(value, None) is not None
            reason = ""
            if was_pending:
                reason = self._failures.popleft() if self._failures else "it speaks no ZeroMQ"
            if reason and address == UNKNOWN:
                self._unnamed_due_ns.setdefault(reason, now_ns + PATIENCE_NS)
            elif reason:
                self._unnamed_due_ns.pop(reason, None)
                self._log_refusal(address, reason)

    def _log_refusal(self, address: str, reason: str) -> None:
        """Log some of the refusals: a refused peer may try without end."""
        kind = (address.partition(":")[0], reason)
        self._refused[kind] += 1
        log_some(self._log, f"turned away {address}: {reason}", self._refused[kind])


def _address_of(fd: int) -> str:
    """Address of the peer of a connection that ZeroMQ has accepted."""
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(fd)) as connection:
        if connection.family == socket.AF_INET:
            address, port = connection.getpeername()
            return f"{address}:{port}"
        return "this host"
    return UNKNOWN


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
