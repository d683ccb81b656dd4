"""Writers on other hosts: their connections to a reader, and the offsets of their clocks."""

from collections.abc import Callable

import zmq

from sparseskin.nodes.clock import ClockEstimate, ClockOffset

from .sockets import MAX_EVENTS, Peer, Reader, events, read_times

ASK_NS = 250_000_000
"""Period of the questions for the time of other hosts."""
FIRST_NS, N_FIRST = 30_000_000, 10
"""Period and number of the first questions: a single exchange may be a slow one."""
RETRY_NS = 2_000_000_000
"""Time after which a refused handshake is tried again."""
_REFUSED: dict[int, str] = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "it does not let this host in (the key is not on its list)",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "the handshake fails: it uses no key, or another one",
}


class Peers:
    """Follows the connections of one reader to its writers, where one of them is on another host
    or has keys: `watch` is called before the first `connect`, else nothing is followed.

    `awaits_time` is True if an answer is expected whose arrival time matters; `heard` is True for
    each writer on another host that is connected.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._by_endpoint: dict[str, Peer] = {}
        self._retry_ns: dict[str, int] = {}
        self._logged: set[tuple[str, str]] = set()
        self._clocks: dict[str, ClockOffset] = {}
        self._estimates: dict[str, ClockEstimate] = {}
        self._next_ask_ns = 0
        self._n_times = 0
        self._reader: Reader | None = None
        self.monitor: zmq.Socket[bytes] | None = None
        self.awaits_time = False
        self.heard: dict[str, bool] = {}

    def watch(self, reader: Reader) -> zmq.Socket[bytes]:
        """Follow a reader that is not connected yet; return the socket of its events."""
        self._reader, self.monitor = reader, reader.socket.get_monitor_socket()
        return self.monitor

    def connect(self, reader: Reader, peer: Peer) -> None:
        """Connect a reader to one more writer."""
        self._by_endpoint[peer.endpoint] = peer
        if peer.host:
            self.heard[peer.writer] = False
            self._clocks.setdefault(peer.host, ClockOffset())
        reader.connect(peer.endpoint, peer.key, bool(peer.host))

    def serve(self, now_ns: int) -> None:
        """Process events, retry refused connections, ask for the time; now on the graph's clock."""
        assert self._reader is not None
        assert self.monitor is not None
        for event, _, endpoint in events(self.monitor, MAX_EVENTS):
            if (peer := self._by_endpoint.get(endpoint)) is not None:
                self._note(peer, event, now_ns)
        for endpoint in [e for e, due_ns in self._retry_ns.items() if due_ns <= now_ns]:
            del self._retry_ns[endpoint]
            # ZeroMQ does not connect again by itself after a refused handshake.
            self._reader.socket.disconnect(endpoint)
            self.connect(self._reader, self._by_endpoint[endpoint])
        if self._clocks and now_ns >= self._next_ask_ns:
            self._next_ask_ns = now_ns + (FIRST_NS if self._n_times < N_FIRST else ASK_NS)
            self._reader.ask_time(now_ns)
            self.awaits_time = any(self.heard.values())
            for host, clock in self._clocks.items():
                estimate = clock.estimate(now_ns)
                if estimate is not None:
                    self._estimates[host] = estimate

    def take_time(self, note: bytes, now_ns: int) -> bool:
        """Process the answer to a question for the time; False if the note is none."""
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

    def clock_of(self, host: str) -> ClockEstimate | None:
        """Estimate of the clock of another host; None while there is none."""
        return self._estimates.get(host)

    def clocks(self) -> dict[str, tuple[int, int]]:
        """Offset and uncertainty (ns) of the clock of each other host."""
        return {h: (e.offset_ns, e.uncertainty_ns) for h, e in self._estimates.items()}

    def _note(self, peer: Peer, kind: int, now_ns: int) -> None:
        if kind == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._set_connected(peer, True)
        elif kind == zmq.EVENT_DISCONNECTED:
            self._set_connected(peer, False)
        elif kind in _REFUSED:
            self._retry_ns[peer.endpoint] = now_ns + RETRY_NS
            self._log_refusal(peer, _REFUSED[kind])

    def _set_connected(self, peer: Peer, connected: bool) -> None:
        if not peer.host or self.heard[peer.writer] == connected:
            return
        self.heard[peer.writer] = connected
        if connected:
            self._logged.clear()
        self._log(f"{'' if connected else 'dis'}connected: {peer.writer} on {peer.host}")

    def _log_refusal(self, peer: Peer, reason: str) -> None:
        """Log it once, until the next connection."""
        if (peer.endpoint, reason) not in self._logged:
            self._logged.add((peer.endpoint, reason))
            where = f" on {peer.host}" if peer.host else ""
            self._log(f"cannot connect to {peer.writer}{where} ({peer.endpoint}): {reason}")
