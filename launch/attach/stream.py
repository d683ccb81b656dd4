"""Topics of a running graph, read by an observer: no node waits for it, and what it does not read
in time is dropped for it alone.
"""

import itertools
import math
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import NamedTuple, Self

from sparseskin.launch.run.running import RunningGraph, is_running
from sparseskin.launch.run.termination import TERMINATION
from sparseskin.messages import MessageError, SkinState, decode
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import Payload, head_of, size_of
from sparseskin.nodes.clock import SystemClock
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.network.keys import read_key_pair
from sparseskin.nodes.network.sockets import (
    QUEUE_FRAMES,
    Reader,
    make_context,
)

from .client import describe, topics_of
from .text import flowing

POLL_MS = 100
"""Longest wait for a message before the end of the graph is looked for, milliseconds."""
LOOK_S = 0.5
"""Time between two checks that the graph still runs, seconds."""
PATIENCE_S = 0.2
"""Time that messages wait to be read together, seconds."""
EXIT_NOTHING = 1
"""Exit code of a command that read no message."""
BATCH = 1024
"""Most messages that are read before they are shown: a fast topic has no end."""
DRAIN_MS = 20
"""Messages that wait at the writer arrive within it."""
READ_AHEAD = 8
"""Messages that a patient observer receives before it reads them. The others stay in the queue of
their writer, so that neither process wakes the other for each of them.
"""


class Arrival(NamedTuple):
    """One message as it came: its bytes, the time `at_ns` of reading on the graph's clock, and the
    fields that identify it. At the end of a stream `seq` is the number of messages sent. `fresh` is
    False if it may have waited for a patient observer.
    """

    topic: bytes
    payload: Payload
    at_ns: int
    run_id: str
    seq: int
    stamp_ns: int
    ends: bool
    fresh: bool = True

    @property
    def n_bytes(self) -> int:
        """Its size on the wire, topic and payload."""
        return size_of(self.topic, self.payload)


class Losses:
    """Number of messages of a topic that did not arrive after the first that did: gaps in their
    sequence numbers.
    """

    def __init__(self) -> None:
        self.n = 0
        self._run_id = ""
        self._expected = 0

    def add(self, arrival: Arrival) -> bool:
        """Count the gap before a message; False where a new run begins."""
        # A sequence that goes back is another run, even under the same id.
        is_same_run = arrival.run_id == self._run_id and arrival.seq >= self._expected
        if is_same_run:
            self.n += arrival.seq - self._expected
        self._run_id = arrival.run_id
        self._expected = arrival.seq
        if not arrival.ends:
            # The end has no number of its own.
            self._expected += 1
        return is_same_run


class TopicStream:
    """The messages of some topics, as they come; `unreadable` counts those that were not of the
    wire form, which are left out, `interrupted` is True once SIGINT or SIGTERM came.

    Messages may wait `patience_s` seconds to be read together; where more than `QUEUE_FRAMES` are
    sent meanwhile, those beyond are lost.
    Raises KeyFileError if the graph asks for a key that this user may not read.
    """

    def __init__(
        self,
        graph: RunningGraph,
        *topics: str,
        patience_s: float = 0.0,
    ) -> None:
        self._graph = graph
        self._patience_s = patience_s
        self._clock = SystemClock(graph.offset_ns)
        self._context = make_context()
        keys = None
        if graph.key_file:
            keys = read_key_pair(Path(graph.key_file))
        # What waits in this process is older than what waits at the writer.
        ahead = QUEUE_FRAMES
        if patience_s:
            ahead = READ_AHEAD
        self._reader = Reader(
            self._context,
            f"observer_{os.getpid()}",
            (),
            topics,
            present=False,
            keys=keys,
            read_ahead=ahead,
        )
        # One connection a publisher, however many of its topics are read.
        writers = graph.writers()
        publishers = {writers[topic] for topic in topics}
        for name in publishers:
            node = graph.nodes[name]
            self._reader.connect(node.endpoint, node.key)

        # State of reading: see `_has_waited` and `_wait_for_batch`.
        self._least_age_ns: float = math.inf
        self._drained = False
        self._look_at_s = time.monotonic()
        self.unreadable = 0
        self.interrupted = False

    @property
    def descriptor(self) -> int:
        """File that is readable when something may have come, for an event loop: zmq_getsockopt(3),
        ZMQ_FD. All messages are read before it is waited for.
        """
        return self._reader.socket.fileno()

    def wait(self, timeout_s: float) -> None:
        """Wait until a message is there, at most `timeout_s` seconds."""
        self._reader.socket.poll(math.ceil(1e3 * timeout_s))

    def graph_has_ended(self) -> bool:
        """True if the graph no longer runs: looked at every `LOOK_S` seconds."""
        now_s = time.monotonic()
        if now_s < self._look_at_s:
            return False
        self._look_at_s = now_s + LOOK_S
        return not is_running(self._graph)

    def __enter__(self) -> Self:
        TERMINATION.check()
        self._handlers = {}
        # So that a batch that is being printed is finished first.
        for number in (signal.SIGINT, signal.SIGTERM):
            self._handlers[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self.close()

    def close(self) -> None:
        """Close the connection; without `with`, signals are not caught, and this ends it."""
        self._context.destroy(linger=0)

    def batches(self, duration_s: float | None) -> Iterator[list[Arrival]]:
        """Yield the messages since the last batch, every 100 ms or sooner, later where it is
        patient, until `duration_s` is over, an interrupt comes or the graph ends.
        """
        end_s = math.inf
        if duration_s is not None:
            end_s = time.monotonic() + duration_s
        while not self.interrupted:
            remaining_s = end_s - time.monotonic()
            if remaining_s <= 0:
                return
            if self.graph_has_ended():
                # What it sent last is still on its way through the socket.
                yield self.read()
                return

            yield self.read(self._wait_for_batch(remaining_s))

    def _wait_for_batch(self, remaining_s: float) -> int | None:
        """Wait for messages, and while they wait to be read together; return the time at which the
        first one came, where that is known.
        """
        # Not 0: it would be a loop that never sleeps.
        timeout_ms = max(1, round(min(POLL_MS, 1e3 * remaining_s)))
        # Only where nothing waited before is the time of the first arrival known.
        is_idle = self._drained and not self._reader.socket.poll(0)
        if not self._reader.socket.poll(timeout_ms) or not self._patience_s:
            return None
        came_ns = None
        if is_idle:
            came_ns = self._clock.now_ns()
        time.sleep(min(self._patience_s, remaining_s))
        return came_ns

    def read(self, came_ns: int | None = None) -> list[Arrival]:
        """The messages that are there, at once, at most `BATCH`; `came_ns` is when the first came,
        where that is known.
        """
        arrivals: list[Arrival] = []
        self._drained = False
        woken = came_ns is not None
        for _ in range(BATCH):
            parts = self._reader.receive()
            while parts is None:
                if not self._may_drain(arrivals, woken):
                    self._drained = True
                    return arrivals
                parts = self._reader.receive()

            arrival = _arrival(*parts, came_ns or self._clock.now_ns())
            if arrival is None:
                self.unreadable += 1
            else:
                fresh = came_ns is not None or not self._patience_s
                arrivals.append(arrival._replace(fresh=fresh))
            came_ns = None
        return arrivals

    def _may_drain(self, arrivals: list[Arrival], woken: bool) -> bool:
        """True if messages behind those read had to wait at the writer, and have now come."""
        if not arrivals:
            return False
        is_first = woken and len(arrivals) == 1
        if not self._has_waited(arrivals[-1]) and not is_first:
            return False
        return bool(self._reader.socket.poll(DRAIN_MS))

    def _has_waited(self, arrival: Arrival) -> bool:
        """True if a message has waited at the writer, and others may wait behind it."""
        # The stamps of a recording share one offset: ages are compared with the least one.
        age_ns = arrival.at_ns - arrival.stamp_ns
        self._least_age_ns = min(self._least_age_ns, age_ns)
        patience_ns = self._patience_s * 1e9
        return patience_ns > 0 and age_ns > self._least_age_ns + patience_ns / 4

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.interrupted = True


class Display:
    """What a command shows of the messages of a topic; `patience_s` as of `TopicStream`."""

    patience_s = PATIENCE_S

    def take(self, arrival: Arrival) -> bool:
        """Take a message, or the end of the stream; True if it counts."""
        raise NotImplementedError

    def tick(self) -> None:
        """Called after each batch, ten times a second at least."""

    def finish(self) -> None:
        """Called at the end, if a message counted."""


def observe(
    graph: RunningGraph,
    topic: str,
    display: Display,
    n: int | None,
    duration_s: float | None,
) -> int:
    """Show the messages of a topic until `n` counted, `duration_s` seconds are over or its stream
    ends; return the exit code.
    """
    n_counted = 0
    ended = False
    # Of a stated number of messages, the last ones are not to wait for more.
    patience_s = 0.0
    if n is None:
        patience_s = display.patience_s
    with TopicStream(graph, topic, patience_s=patience_s) as stream:
        for arrivals in stream.batches(duration_s):
            for arrival in arrivals:
                n_counted += display.take(arrival)
                ended = arrival.ends or n_counted == n
                if ended:
                    break
            if ended:
                break
            display.tick()
    # Who asked for fewer has them all.
    if ended and n_counted != n:
        print(f"{topic}: the stream has ended", file=sys.stderr)
    if not n_counted:
        print(f"{topic}: no message came{quiet_reason(graph, topic)}", file=sys.stderr)
        return EXIT_NOTHING
    display.finish()
    return 0


def unit_of(graph: RunningGraph, topic: str) -> str:
    """Unit of the forces of the patch of a topic; "" where its skin does not come within 1 s."""
    patch, _ = split_topic(topic)
    skin = f"/{patch}/{SkinState.schema}"
    if skin not in graph.writers():
        return ""
    # It is latched: it comes at once where there is one.
    with TopicStream(graph, skin) as stream:
        for arrival in itertools.chain.from_iterable(stream.batches(1.0)):
            if arrival.ends:
                continue
            message = decode(arrival.topic, arrival.payload)
            if isinstance(message, SkinState):
                return flowing(message.unit)
    return ""


def quiet_reason(graph: RunningGraph, topic: str) -> str:
    """Why nothing comes on a topic, as " (REASON)"; "" where it is not known."""
    try:
        described = describe(graph)
    except SparseskinError:
        return " (the graph has ended)"
    described_topic = topics_of(described)[topic]
    publisher = described_topic["publisher"]
    conditions = {node["name"]: node["condition"] for node in described["nodes"]}
    if conditions[publisher] != "running":
        return f" ({publisher}: {conditions[publisher]})"
    if described_topic["latched"]:
        return " (latched: sent when it changes)"
    return ""


def _arrival(topic: bytes, payload: Payload, at_ns: int) -> Arrival | None:
    """A message with its head read, its fields unchecked; None where it has none."""
    # Fields are not decoded here: most messages are only counted.
    try:
        run_id, seq, stamp_ns, ends = head_of(payload)
    except (MessageError, KeyError):
        return None
    if type(seq) is not int or type(stamp_ns) is not int:
        return None
    return Arrival(topic, payload, at_ns, run_id, seq, stamp_ns, ends)
