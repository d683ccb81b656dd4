"""One topic of a running graph, read by an onlooker: nobody waits for it, and what it does not
take in time is dropped for it alone.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import msgpack
import zmq

from sparseskin.messages import End
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.clock import SystemClock
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.keys import read_key_pair
from sparseskin.nodes.sockets import QUEUE_FRAMES, Reader, make_context

from .inspection import describe, topics_of
from .running import RunningGraph, is_running

POLL_MS = 100
LOOK_S = 0.5
"""How often it is looked whether the graph is still there."""
BATCH = 1024
DRAIN_MS = 20
"""What waits with the writer comes within it."""
READ_AHEAD = 8
"""Messages of one that is patient that are taken in before they are wanted. The others wait with
their writer, so that neither wakes the other for each of them.
"""


class Arrival(NamedTuple):
    """One message as it came: its bytes, and what of them names it.

    Attributes
    ----------
    at_ns : int
        When it was taken in, on the graph's clock.
    ends : bool
        Whether it says that its topic sends no more; `seq` is then the number of messages sent.
    """

    topic: bytes
    payload: bytes
    at_ns: int
    run_id: str
    seq: int
    stamp_ns: int
    ends: bool

    @property
    def n_bytes(self) -> int:
        """Its size on the wire, topic and payload."""
        return len(self.topic) + len(self.payload)


class Losses:
    """How many messages of a topic did not arrive: gaps in their numbers.

    Attributes
    ----------
    n : int
        Lost so far. What was sent before the first that arrived is not counted.
    """

    def __init__(self) -> None:
        self.n = 0
        self._run_id = ""
        self._expected = 0

    def take(self, arrival: Arrival) -> bool:
        """Count what lies between this message and the last; False where a new run begins."""
        same = arrival.run_id == self._run_id and arrival.seq >= self._expected
        if same:
            self.n += arrival.seq - self._expected
        self._run_id, self._expected = arrival.run_id, arrival.seq + (not arrival.ends)
        return same


class TopicStream:
    """The messages of one topic, as they come.

    Parameters
    ----------
    graph : RunningGraph
        The graph.
    topic : str
        One of its topics.
    patience_s : float
        How long messages may wait, so that those that come together are taken in together. Not
        longer than it takes to send `QUEUE_FRAMES` of them: those beyond are lost.

    Attributes
    ----------
    unreadable : int
        Messages that were not of the wire form; they are left out.
    interrupted : bool
        Whether SIGINT or SIGTERM came.
    """

    def __init__(self, graph: RunningGraph, topic: str, patience_s: float = 0.0) -> None:
        self._graph = graph
        self._patience_s = patience_s
        self._clock = SystemClock(graph.offset_ns)
        self._context = make_context()
        self._reader = onlooker(
            self._context, graph, topic, READ_AHEAD if patience_s else QUEUE_FRAMES
        )
        self._least_age_ns: float = math.inf
        self._has_all = False  # the first that comes tells how old one is that has not waited
        self.unreadable = 0
        self.interrupted = False

    def __enter__(self) -> TopicStream:
        self._handlers = {
            number: signal.signal(number, self._on_signal)
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._context.destroy(linger=0)

    def batches(self, duration_s: float | None) -> Iterator[list[Arrival]]:
        """What has come since the last batch, every 100 ms or sooner, later where it is patient;
        it ends after `duration_s`, with an interrupt, or with the graph.
        """
        began_s = look_at_s = time.monotonic()
        while not self.interrupted:
            now_s = time.monotonic()
            if duration_s is not None and now_s - began_s >= duration_s:
                return
            if now_s >= look_at_s:
                look_at_s = now_s + LOOK_S
                if not is_running(self._graph):
                    yield self._take()
                    return
            left_s = math.inf if duration_s is None else began_s + duration_s - now_s
            timeout_ms = max(1, round(min(POLL_MS, 1e3 * left_s)))
            if self._reader.socket.poll(timeout_ms) and self._patience_s and self._has_all:
                time.sleep(min(self._patience_s, left_s))
            yield self._take()

    def _take(self) -> list[Arrival]:
        taken: list[Arrival | None] = []
        while len(taken) < BATCH:
            if (parts := self._reader.receive()) is not None:
                taken.append(_arrival(*parts, self._clock.now_ns()))
            elif not (taken and self._patience_s and self._more_waits(taken[-1])):
                break
        if taken:
            self._has_all = len(taken) < BATCH
        found = [arrival for arrival in taken if arrival is not None]
        self.unreadable += len(taken) - len(found)
        return found

    def _more_waits(self, last: Arrival | None) -> bool:
        """Whether more waits with the writer behind the last message: not where that is about as
        new as any was when it came. Stamps of a recording are old by the same time all along.
        """
        if last is not None:
            age_ns = last.at_ns - last.stamp_ns
            self._least_age_ns = min(self._least_age_ns, age_ns)
            if age_ns <= self._least_age_ns + self._patience_s * 1e9 / 4:
                return False
        return bool(self._reader.socket.poll(DRAIN_MS))

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.interrupted = True


def onlooker(
    context: zmq.Context[Any], graph: RunningGraph, topic: str, read_ahead: int = QUEUE_FRAMES
) -> Reader:
    """A reader of one topic that its writer does not wait for.

    Parameters
    ----------
    context : zmq.Context
        From `make_context`.
    graph : RunningGraph
        The graph.
    topic : str
        One of its topics.
    read_ahead : int
        How many messages wait here; as many as wait for a node by default.

    Raises
    ------
    KeyFileError
        If the graph asks for a key that this user may not read.
    """
    keys = read_key_pair(Path(graph.key_file)) if graph.key_file else None
    name = f"onlooker_{os.getpid()}"
    reader = Reader(context, name, (), [topic], present=False, keys=keys, read_ahead=read_ahead)
    node = graph.nodes[graph.writers()[topic]]
    reader.connect(node.endpoint, node.key)
    return reader


def why_quiet(graph: RunningGraph, topic: str) -> str:
    """What is known of why nothing comes on a topic; "" where nothing is."""
    try:
        described = describe(graph)
    except SparseskinError:
        return " (the graph has ended)"
    publisher = topics_of(described)[topic].publisher
    (condition,) = (n["condition"] for n in described["nodes"] if n["name"] == publisher)
    if condition != "running":
        return f" ({publisher}: {condition})"
    schema = SCHEMAS.get(split_topic(topic)[1])
    return " (latched: sent when it changes)" if schema is not None and schema.latched else ""


def _arrival(topic: bytes, payload: bytes, at_ns: int) -> Arrival | None:
    """A message with its head read, its fields unchecked; None where it has none."""
    try:
        body: Any = msgpack.unpackb(payload, raw=False, max_map_len=64, max_ext_len=0)
        ends = body["schema"] == End.schema
        seq = body["n_messages"] if ends else body["seq"]
        head = (str(body["run_id"]), seq, body["stamp_ns"])
    except Exception:  # msgpack promises no narrower family for hostile bytes
        return None
    if type(head[1]) is not int or type(head[2]) is not int:
        return None
    return Arrival(topic, payload, at_ns, *head, ends)
