"""Network side of a node: its writer and reader and, in graphs of several hosts or with keys,
access control, connections to other hosts, and the delivery of the end of its streams.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zmq

from sparseskin.nodes.clock import SAME_CLOCK, ClockEstimate
from sparseskin.nodes.files import check_private

from .keys import KeyPair
from .peers import Peers
from .sockets import Peer, Reader, Writer

if TYPE_CHECKING:
    from .gate import Gate

END_RECEIVED_NS = 30_000_000_000
"""Time for which a node waits until readers on other hosts have the end of its streams."""


class Network:
    """Sockets of one node, for which `poller` waits; without other hosts and keys it adds nothing
    to them.

    `config` has name, endpoint; public (endpoint for other hosts, "" for none), distant_readers
    (their names), distant_inputs (host of each topic of another host), security (own keys, allowed
    and known public ones; None for none).

    Raises ZMQError if an endpoint is in use or malformed, SparseskinError if other users can enter
    the folder of its socket.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        config: Mapping[str, Any],
        now_ns: Callable[[], int],
        log: Callable[[str], None],
    ) -> None:
        self.poller = zmq.Poller()
        self.peers = Peers(log)
        self._context = context
        self._name: str = config["name"]
        self._now_ns = now_ns
        self._log = log
        self._distant_inputs: dict[str, str] = config.get("distant_inputs", {})
        self._distant_readers = set(config.get("distant_readers", ()))
        self._end_ask: int | None = None
        self._end_due_ns = 0
        security = config.get("security")
        self._keys = KeyPair(*security["own"]) if security else None
        public, endpoint = config.get("public", ""), config["endpoint"]
        self._gate: Gate | None = None
        if security or public or endpoint.startswith("tcp:"):
            from .gate import Gate

            allowed, known = (security["allowed"], security["known"]) if security else ({}, {})
            self._gate = Gate(context, self._keys, allowed, known, log)
        if endpoint.startswith("ipc:///"):
            check_private(Path(endpoint.removeprefix("ipc://")).parent)
        self.writer = Writer(
            context,
            endpoint,
            self._name,
            public=public,
            gate=self._gate,
            log=log,
            now_ns=now_ns if public else None,
        )
        for socket in (self.writer.socket, *(self._gate.sockets if self._gate else ())):
            self.poller.register(socket, zmq.POLLIN)

    def make_reader(self, topics: Sequence[str], observes: bool = False) -> Reader:
        """Make the reader of the node's input topics; `connect` connects it. No source waits for
        one that observes.
        """
        reader = Reader(self._context, self._name, (), topics, keys=self._keys, observes=observes)
        self.poller.register(reader.socket, zmq.POLLIN)
        if self._keys is not None or self._distant_inputs:
            self.poller.register(self.peers.watch(reader), zmq.POLLIN)
        return reader

    def connect(self, reader: Reader, peers: Sequence[Peer]) -> None:
        """Connect a reader to writers."""
        for peer in peers:
            self.peers.connect(reader, peer)

    def serve(self) -> None:
        """Process events of the gate and of connections to other hosts."""
        if self._gate is not None:
            self._gate.serve()
        if self.peers.monitor is not None:
            self.peers.serve(self._now_ns())

    def clock_of(self, topic: str) -> ClockEstimate | None:
        """Estimate of the clock of a topic's writer; None while there is none."""
        host = self._distant_inputs.get(topic)
        return SAME_CLOCK if host is None else self.peers.clock_of(host)

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
        now_ns = self._now_ns()
        if self._end_ask is None:
            self._end_due_ns = now_ns + END_RECEIVED_NS
            self._end_ask = self.writer.ask()
        done = {r for r in self._distant_readers if self.writer.has_answered(r, self._end_ask)}
        self._distant_readers -= done
        if self._distant_readers and now_ns >= self._end_due_ns:
            names = ", ".join(sorted(self._distant_readers))
            self._log(f"the end was not received within {END_RECEIVED_NS // 10**9} s by {names}")
            self._distant_readers.clear()
        return not self._distant_readers
