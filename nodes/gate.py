"""Who may read a node that others reach over the network, and who was turned away.

With keys, every reader has to prove that it holds the secret of a key on the list, and sees
nothing before it has. Whoever fails is named in the log, with its address where that is known.
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
from zmq.utils.monitor import recv_monitor_message

from .keys import KeyPair

ZAP_ENDPOINT = "inproc://zeromq.zap.01"
ZAP_DOMAIN = b"sparseskin"
MAX_CONNECTIONS = 256
"""Most connections to one node at a time; one more is turned away, with a line that says so."""
MAX_PENDING = 1024
HANDSHAKE_MS = 2000
"""How long a handshake may take; ZeroMQ's own 30 s would hide a wrong key."""

PATIENCE_NS = 1_000_000_000
"""How long a line waits for the address: a connection that is over at once has none any more, but
who is turned away tries again.
"""
UNKNOWN = "unknown address"

_OTHER_SERVER_KEY = zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC
_NO_KEY = zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
_FAILED = (zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)


class Gate:
    """Guards the socket of a writer; `serve` is called whenever one of `sockets` is ready.

    Parameters
    ----------
    context : zmq.Context
        The context of the writer; it can have one gate.
    keys : KeyPair or None
        The keys of this host; None: whoever reaches the socket may read.
    allowed : mapping of str to str
        Public key and name of each peer that may read.
    known : mapping of str to str
        Public keys that have a name, whether allowed or not: to name those turned away.
    log : callable
        Takes one line of text.
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
        self._said: Counter[tuple[str, str]] = Counter()
        self._open: dict[int, str] = {}
        self._pending: dict[int, str] = {}
        self._failures: deque[str] = deque(maxlen=MAX_PENDING)
        self._unnamed_due_ns: dict[str, int] = {}
        self._zap = context.socket(zmq.REP)
        self._zap.bind(ZAP_ENDPOINT)
        self.sockets: list[zmq.Socket[bytes]] = [self._zap]

    def guard(self, writer: zmq.Socket[bytes]) -> None:
        """Have a socket guarded; before it is bound."""
        writer.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN)
        writer.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_MS)
        if self._keys is not None:
            writer.setsockopt(zmq.CURVE_SERVER, 1)
            writer.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret.encode())
        self.sockets.append(writer.get_monitor_socket())

    def serve(self, now_ns: int) -> None:
        """Answer those who knock, and say who was turned away.

        Parameters
        ----------
        now_ns : int
            Now, on any clock that never goes back.
        """
        while self._zap.poll(0):
            self._answer(self._zap.recv_multipart())
        for monitor in self.sockets[1:]:
            while monitor.poll(0):
                event = recv_monitor_message(monitor)
                self._note(int(event["event"]), int(event["value"]), now_ns)
        for reason in [r for r, due_ns in self._unnamed_due_ns.items() if due_ns <= now_ns]:
            del self._unnamed_due_ns[reason]
            self._say(UNKNOWN, reason)

    def _answer(self, frames: list[bytes]) -> None:
        """Answer one request of ZeroMQ's: who is it, may it in?"""
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
            self._say(address.decode(errors="replace"), refusal)
        status = b"400" if refusal else b"200"
        self._zap.send_multipart([version, request, status, refusal.encode(), b"", b""])

    def _note(self, event: int, value: int, now_ns: int) -> None:
        """Follow one event of the socket; a failed handshake is followed by its disconnection."""
        if event == zmq.EVENT_ACCEPTED and len(self._pending) < MAX_PENDING:
            self._open[value] = self._pending[value] = _address_of(value)
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED and self._pending:
            # The event does not say whose: connections shake hands in the order they came in.
            del self._pending[next(iter(self._pending))]
        elif event in _FAILED:
            self._failures.append(_reason(event, value))
        elif event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            self._failures.append("")  # the refusal itself was said when it was decided
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
                self._say(address, reason)

    def _say(self, address: str, reason: str) -> None:
        """Say it the 1st, 10th, 100th ... time: who is turned away may try without end."""
        host = address.partition(":")[0]
        self._said[host, reason] += 1
        times = self._said[host, reason]
        if times == 10 ** (len(str(times)) - 1):
            self._log(
                f"turned away {address}: {reason}" + (f" ({times} times)" if times > 1 else "")
            )


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
        return "it uses no key and broke off the handshake, or said nothing for 2 s"
    if value == _NO_KEY:
        return "it uses no key, or another security than this node"
    if value == _OTHER_SERVER_KEY:
        return "it has a wrong key for this host"
    return f"its handshake is broken (ZMTP error {value:#x})"
