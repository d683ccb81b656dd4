"""What a node has to do with the network, in graphs of several hosts or with keys: the gate to
what it publishes, the writers that it hears, and the end of its streams that others must take.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zmq

from .clock_offset import SAME_CLOCK, ClockEstimate
from .gate import Gate
from .keys import KeyPair
from .peers import Peer, Peers
from .sockets import Reader, Writer

END_TAKEN_NS = 30_000_000_000
"""How long a node waits for its readers on other hosts to take the end of its streams."""


class Network:
    """The network as one node sees it; nothing of it costs a node of a graph on one host.

    Parameters
    ----------
    context : zmq.Context
        The node's context.
    config : mapping
        name, endpoint; public (endpoint for other hosts, "" for none), distant_readers (names of
        those there), distant_inputs (host of each topic that comes from there), security (own
        keys, allowed and known public ones; None for none).
    now_ns : callable
        The graph's clock.
    log : callable
        Takes one line of text.

    Raises
    ------
    zmq.ZMQError
        If an endpoint is in use or malformed.
    """

    def __init__(
        self,
        context: zmq.Context[Any],
        config: Mapping[str, Any],
        now_ns: Callable[[], int],
        log: Callable[[str], None],
    ) -> None:
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
        public: str = config.get("public", "")
        self._gate: Gate | None = None
        if security or public or config["endpoint"].startswith("tcp:"):
            allowed, known = (security["allowed"], security["known"]) if security else ({}, {})
            self._gate = Gate(context, self._keys, allowed, known, log)
        self._peers: Peers | None = None
        self.writer = Writer(
            context,
            config["endpoint"],
            self._name,
            public=public,
            gate=self._gate,
            now_ns=now_ns if public else None,
            log=log,
        )
        self.sockets = [self.writer.socket, *(self._gate.sockets if self._gate else ())]

    def make_reader(self, topics: Sequence[str]) -> Reader:
        """A reader of topics; `connect` tells it where their writers are."""
        reader = Reader(self._context, self._name, (), topics, keys=self._keys)
        self.sockets.append(reader.socket)
        if self._keys is not None or self._distant_inputs:
            self._peers = Peers(reader, self._log)
            self.sockets.append(self._peers.monitor)
        return reader

    def connect(self, reader: Reader, peers: Sequence[Peer]) -> None:
        """Have a reader listen to writers."""
        if self._peers is not None:
            self._peers.connect(peers)
        else:
            for peer in peers:
                reader.connect(peer.endpoint)

    def serve(self) -> None:
        """See to who knocks, and to who is heard."""
        if self._gate is not None:
            self._gate.serve(self._now_ns())
        if self._peers is not None:
            self._peers.serve(self._now_ns())

    def take_time(self, note: bytes) -> bool:
        """Take what came under the reader's tag, if it is the time of another host."""
        return self._peers is not None and self._peers.take_time(note, self._now_ns())

    @property
    def awaits_time(self) -> bool:
        """Whether what comes next is to be taken in at once."""
        return self._peers is not None and self._peers.awaits_time

    def clock_of(self, topic: str) -> ClockEstimate | None:
        """How far the clock of a topic's writer is ahead; None while that is not known."""
        host = self._distant_inputs.get(topic)
        if host is None:
            return SAME_CLOCK
        return self._peers.clock_of(host) if self._peers is not None else None

    def state(self) -> dict[str, Any]:
        """Which writers on other hosts are heard, and how their clocks are, for a heartbeat."""
        if self._peers is None:
            return {"heard": {}, "clocks": {}}
        return {"heard": self._peers.heard, "clocks": self._peers.clocks()}

    def end_said_again(self) -> None:
        """The end was published once more: ask who has it."""
        if self._end_ask is not None:
            self.writer.ask()

    def end_taken(self) -> bool:
        """Whether the readers on other hosts have the end of the streams: once this process is
        gone, a way that was broken just then brings it to nobody.
        """
        if not self._distant_readers:
            return True
        now_ns = self._now_ns()
        if self._end_ask is None:
            self._end_due_ns = now_ns + END_TAKEN_NS
            self._end_ask = self.writer.ask()
        done = {r for r in self._distant_readers if self.writer.has_answered(r, self._end_ask)}
        self._distant_readers -= done
        if self._distant_readers and now_ns >= self._end_due_ns:
            names = ", ".join(sorted(self._distant_readers))
            self._log(f"the end was not taken within {END_TAKEN_NS // 10**9} s by {names}")
            self._distant_readers.clear()
        return not self._distant_readers
