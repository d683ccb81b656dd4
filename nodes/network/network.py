"""Network side of a node: its writer and reader and, in graphs of several hosts or with keys,
access control, connections to other hosts, the offsets of their clocks, and the delivery of the end
of its streams.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zmq

from sparseskin.nodes.clock import SAME_CLOCK, ClockEstimate, ClockOffset
from sparseskin.nodes.files import check_private

from .keys import KeyPair
from .sockets import Context, Peer, Reader, Socket, Writer, events, read_times

if TYPE_CHECKING:
    from .gate import Gate

END_RECEIVED_NS = 30_000_000_000
"""Time for which a node waits until readers on other hosts have the end of its streams; chosen."""
ASK_NS = 250_000_000
"""Period of the questions for the time of other hosts; chosen: clocks that differ by
50 ppm drift 13 us in it."""
FIRST_NS = 30_000_000
N_FIRST = 10
"""Period and number of the first questions: a single exchange may be a slow one."""
RETRY_NS = 2_000_000_000
"""Time after which a refused handshake is tried again."""
_REFUSED: dict[int, str] = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "it does not let this host in (the key is not on its list)",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "the handshake fails: it uses no key, or another one",
}


class Network:
    """Sockets of one node, for which `poller` waits; without other hosts and keys it adds nothing
    to them. Of several nodes in one process all share the poller, and the gate of the `first`; they
    read from each other within the process. `heard` is True for each writer on another host that is
    connected, `awaits_time` if an answer is expected whose arrival time matters.

    `config` has name, endpoint; companions (names of the other nodes of this process), public
    (endpoint for other hosts, "" for none), distant_readers (their names), distant_inputs (host of
    each topic of another host), security (own keys, allowed and known public ones; None for none).

    Raises ZMQError if an endpoint is in use or malformed, SparseskinError if other users can enter
    the folder of its socket.
    """

    def __init__(
        self,
        context: Context,
        config: Mapping[str, Any],
        now_ns: Callable[[], int],
        log: Callable[[str], None],
        poller: zmq.Poller | None = None,
        first: Network | None = None,
    ) -> None:
        if poller is None:
            poller = zmq.Poller()
        self.poller = poller
        self.heard: dict[str, bool] = {}
        self.awaits_time = False
        self._context = context
        self._name: str = config["name"]
        self._now_ns = now_ns
        self._log = log
        self._distant_inputs: dict[str, str] = config.get("distant_inputs", {})
        self._distant_readers = set(config.get("distant_readers", ()))
        self._end_ask: int | None = None
        self._end_due_ns = 0
        self._reader: Reader | None = None
        self._monitor: Socket | None = None
        self._by_endpoint: dict[str, Peer] = {}
        self._retry_ns: dict[str, int] = {}
        self._logged: set[tuple[str, str]] = set()
        self._clocks: dict[str, ClockOffset] = {}
        self._estimates: dict[str, ClockEstimate] = {}
        self._next_ask_ns = 0
        self._n_times = 0

        security = config.get("security") or {}
        self._keys: KeyPair | None = None
        if security:
            self._keys = KeyPair(**security["key_pair"])
        public = config.get("public", "")
        endpoint = config["endpoint"]
        self._companions = frozenset(config.get("companions", ()))
        # ZeroMQ asks one gate about all connections of a process: that of its first node.
        self._first = first or self
        self._gate: Gate | None = None
        if first is not None:
            self._gate = first._gate
        # Who can be reached by TCP admits its readers; the path of a socket admits one user alone.
        is_reachable = bool(public) or endpoint.startswith("tcp:")
        if self._gate is None and (security or is_reachable):
            from .gate import Gate

            allowed = security.get("allowed", {})
            names = security.get("names", {})
            self._gate = Gate(context, self._keys, allowed, names, log)
            self._first._gate = self._gate

        # Whoever can enter the folder of a socket can read the graph.
        if endpoint.startswith("ipc:///"):
            check_private(Path(endpoint.removeprefix("ipc://")).parent)
        clock = None
        if public:
            # Readers of this host share the clock: others ask for the time.
            clock = now_ns
        self.writer = Writer(
            context,
            endpoint,
            self._name,
            public=public,
            gate=self._gate,
            log=log,
            now_ns=clock,
        )
        if self._companions:
            self.writer.socket.bind(_within(self._name))
        sockets = [self.writer.socket]
        if self._gate is not None:
            sockets += self._gate.sockets
        for socket in sockets:
            self.poller.register(socket, zmq.POLLIN)

    def make_reader(self, topics: Sequence[str], observes: bool = False) -> Reader:
        """Make the reader of the node's input topics; `connect` connects it. No source waits for
        one that observes.
        """
        keys = self._keys
        self._reader = Reader(
            self._context, self._name, (), topics, keys=keys, observes=observes
        )
        self.poller.register(self._reader.socket, zmq.POLLIN)
        # Within a host, without keys, a connection neither breaks nor is refused.
        if keys is not None or self._distant_inputs:
            self._monitor = self._reader.socket.get_monitor_socket()
            self.poller.register(self._monitor, zmq.POLLIN)
        return self._reader

    def connect(self, peers: Iterable[Peer]) -> None:
        """Connect the reader to writers."""
        assert self._reader is not None
        for peer in peers:
            self._by_endpoint[peer.endpoint] = peer
            if peer.host:
                # The clock of another host has to be known before its stamps can be used.
                self.heard[peer.writer] = False
                self._clocks.setdefault(peer.host, ClockOffset())
            if peer.writer in self._companions:
                self._reader.connect(_within(peer.writer))
            else:
                is_distant = bool(peer.host)
                self._reader.connect(peer.endpoint, peer.key, is_distant)

    def serve(self) -> None:
        """Process events of the gate and of connections; connect again; ask for the time."""
        # The gate is that of all nodes of the process: the first one serves it.
        if self._gate is not None and self._first is self:
            self._gate.serve()
        if self._monitor is None or self._reader is None:
            return

        now_ns = self._now_ns()
        for event, _, endpoint in events(self._monitor):
            peer = self._by_endpoint.get(endpoint)
            if peer is None:
                continue
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._set_connected(peer, True)
            elif event == zmq.EVENT_DISCONNECTED:
                self._set_connected(peer, False)
            elif event in _REFUSED:
                self._retry_ns[endpoint] = now_ns + RETRY_NS
                self._log_refusal(peer, _REFUSED[event])

        for endpoint, due_ns in list(self._retry_ns.items()):
            if due_ns > now_ns:
                continue
            del self._retry_ns[endpoint]
            # ZeroMQ does not connect again by itself after a refused handshake.
            self._reader.socket.disconnect(endpoint)
            self.connect([self._by_endpoint[endpoint]])

        if self._clocks and now_ns >= self._next_ask_ns:
            self._ask_time(self._reader, now_ns)

    def _ask_time(self, reader: Reader, now_ns: int) -> None:
        """Ask the other hosts for the time, and estimate their clocks by the answers so far."""
        # No stamp of another host can be used before a few answers: the first questions hurry.
        period_ns = ASK_NS
        if self._n_times < N_FIRST:
            period_ns = FIRST_NS
        self._next_ask_ns = now_ns + period_ns
        reader.ask_time(now_ns)
        self.awaits_time = any(self.heard.values())
        for host, clock in self._clocks.items():
            estimate = clock.estimate(now_ns)
            if estimate is not None:
                self._estimates[host] = estimate

    def take_time(self, note: bytes) -> bool:
        """Process the answer to a question for the time; False if the note is none."""
        times = read_times(note)
        if times is None:
            return False
        writer, t1_ns, t2_ns, t3_ns = times
        for peer in self._by_endpoint.values():
            if peer.writer == writer and peer.host:
                t4_ns = self._now_ns()
                self._clocks[peer.host].add(t1_ns, t2_ns, t3_ns, t4_ns)
                self._n_times += 1
                self.awaits_time = False
        return True

    def clock_of(self, topic: str) -> ClockEstimate | None:
        """Estimate of the clock of a topic's writer; None while there is none."""
        host = self._distant_inputs.get(topic)
        if host is None:
            return SAME_CLOCK
        return self._estimates.get(host)

    def clocks(self) -> dict[str, tuple[int, int]]:
        """Offset and uncertainty (ns) of the clock of each other host."""
        clocks = {}
        for host, estimate in self._estimates.items():
            clocks[host] = (estimate.offset_ns, estimate.uncertainty_ns)
        return clocks

    def _set_connected(self, peer: Peer, connected: bool) -> None:
        if not peer.host or self.heard[peer.writer] == connected:
            return
        self.heard[peer.writer] = connected

        # A refusal after a connection is news again.
        change = "disconnected"
        if connected:
            self._logged.clear()
            change = "connected"
        self._log(f"{change}: {peer.writer} on {peer.host}")

    def _log_refusal(self, peer: Peer, reason: str) -> None:
        """Log it once, until the next connection."""
        if (peer.endpoint, reason) not in self._logged:
            self._logged.add((peer.endpoint, reason))
            writer = peer.writer
            if peer.host:
                writer += f" on {peer.host}"
            self._log(f"cannot connect to {writer} ({peer.endpoint}): {reason}")

    def end_repeated(self) -> None:
        """Ask which readers have the end of the streams, after it was published once more."""
        if self._end_ask is not None:
            self.writer.ask()

    def end_received(self) -> bool:
        """True if the readers on other hosts have the end of the streams: after the end of this
        process, a link that is broken now would never deliver it.
        """
        if not self._distant_readers:
            return True
        # The time begins with the first question.
        now_ns = self._now_ns()
        if self._end_ask is None:
            self._end_due_ns = now_ns + END_RECEIVED_NS
            self._end_ask = self.writer.ask()
        for reader in list(self._distant_readers):
            if self.writer.has_answered(reader, self._end_ask):
                self._distant_readers.discard(reader)

        if self._distant_readers and now_ns >= self._end_due_ns:
            names = ", ".join(sorted(self._distant_readers))
            limit_s = END_RECEIVED_NS // 10**9
            self._log(f"the end was not received within {limit_s} s by {names}")
            self._distant_readers.clear()
        return not self._distant_readers


def _within(name: str) -> str:
    """Endpoint of a node for the other nodes of its process."""
    return f"inproc://{name}"
