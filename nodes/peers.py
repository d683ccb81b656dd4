"""The writers that a reader listens to over a network: which are heard, and how their clocks go."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import zmq
from zmq.utils.monitor import recv_monitor_message

from .clock_offset import ClockEstimate, ClockOffset
from .sockets import Reader, read_times

ASK_NS = 250_000_000
"""How often the writers on other hosts are asked for the time."""
FIRST_NS, N_FIRST = 30_000_000, 10
"""How often at first, and how many times: one exchange alone may have been a slow one."""
RETRY_NS = 2_000_000_000
"""How long after a refused handshake it is tried again."""
_REFUSED: dict[int, str] = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "it does not let this host in (the key is not on its list)",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "the handshake fails: it uses no key, or another one",
}


@dataclass(frozen=True)
class Peer:
    """A writer as a reader knows it.

    Attributes
    ----------
    writer : str
        Name of the node.
    endpoint : str
        Where it is bound.
    host : str
        The other host that it is on; "" for this one.
    key : str
        Its public key; "" where it asks for none.
    """

    writer: str
    endpoint: str
    host: str = ""
    key: str = ""


class Peers:
    """Follows the connections of one reader.

    Parameters
    ----------
    reader : Reader
        The reader; it must not be connected yet.
    log : callable
        Takes one line of text.

    Attributes
    ----------
    awaits_time : bool
        Whether an answer is under way whose arrival is to be noted at once.
    """

    def __init__(self, reader: Reader, log: Callable[[str], None]) -> None:
        self._reader = reader
        self._log = log
        self._by_endpoint: dict[str, Peer] = {}
        self._heard: dict[str, bool] = {}
        self._retry_ns: dict[str, int] = {}
        self._said: set[tuple[str, str]] = set()
        self._clocks: dict[str, ClockOffset] = {}
        self._estimates: dict[str, ClockEstimate] = {}
        self._next_ask_ns = 0
        self._n_times = 0
        self.awaits_time = False
        self.monitor: zmq.Socket[bytes] = reader.socket.get_monitor_socket()

    def connect(self, peers: Iterable[Peer]) -> None:
        """Listen to writers more."""
        for peer in peers:
            self._by_endpoint[peer.endpoint] = peer
            if peer.host:
                self._heard[peer.writer] = False
                self._clocks.setdefault(peer.host, ClockOffset())
            self._reader.connect(peer.endpoint, peer.key, bool(peer.host))

    def serve(self, now_ns: int) -> None:
        """Follow what happened, try refused connections again, ask for the time.

        Parameters
        ----------
        now_ns : int
            Now on the graph's clock here.
        """
        while self.monitor.poll(0):
            event = recv_monitor_message(self.monitor)
            peer = self._by_endpoint.get(event["endpoint"].decode(errors="replace"))
            if peer is not None:
                self._note(peer, int(event["event"]), now_ns)
        for endpoint in [e for e, due_ns in self._retry_ns.items() if due_ns <= now_ns]:
            del self._retry_ns[endpoint]
            peer = self._by_endpoint[endpoint]
            self._reader.reconnect(endpoint, peer.key, bool(peer.host))
        if self._clocks and now_ns >= self._next_ask_ns:
            self._next_ask_ns = now_ns + (FIRST_NS if self._n_times < N_FIRST else ASK_NS)
            self._reader.ask_time(now_ns)
            self.awaits_time = any(self._heard.values())
            for host, clock in self._clocks.items():
                estimate = clock.estimate(now_ns)
                if estimate is not None:
                    self._estimates[host] = estimate

    def take_time(self, note: bytes, now_ns: int) -> bool:
        """Take the answer to a question for the time; False for what is none."""
        times = read_times(note)
        if times is None:
            return False
        writer, t1_ns, t2_ns, t3_ns = times
        for peer in self._by_endpoint.values():
            if peer.writer == writer and peer.host:
                self._clocks[peer.host].add(t1_ns, t2_ns, t3_ns, now_ns)
                self._n_times += 1
                self.awaits_time = False
        return True

    @property
    def heard(self) -> dict[str, bool]:
        """Whether each writer on another host is connected."""
        return dict(self._heard)

    def clock_of(self, host: str) -> ClockEstimate | None:
        """How far the clock of another host is ahead; None while that is not known."""
        return self._estimates.get(host)

    def clocks(self) -> dict[str, tuple[int, int]]:
        """Offset and uncertainty (ns) of each other host whose clock is known."""
        return {h: (e.offset_ns, e.uncertainty_ns) for h, e in self._estimates.items()}

    def _note(self, peer: Peer, kind: int, now_ns: int) -> None:
        if kind == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._set_heard(peer, True)
        elif kind == zmq.EVENT_DISCONNECTED:
            self._set_heard(peer, False)
        elif kind in _REFUSED:
            self._retry_ns[peer.endpoint] = now_ns + RETRY_NS
            self._say(peer, _REFUSED[kind])

    def _set_heard(self, peer: Peer, heard: bool) -> None:
        if not peer.host or self._heard[peer.writer] == heard:
            return
        self._heard[peer.writer] = heard
        if heard:
            self._said.clear()
            self._log(f"hears {peer.writer} on {peer.host}")
        else:
            self._log(f"hears {peer.writer} on {peer.host} no more")

    def _say(self, peer: Peer, what: str) -> None:
        """Say it once, until something has changed."""
        if (peer.endpoint, what) not in self._said:
            self._said.add((peer.endpoint, what))
            where = f" on {peer.host}" if peer.host else ""
            self._log(f"cannot hear {peer.writer}{where} ({peer.endpoint}): {what}")
