"""A graph offline, in three threads: its source is ahead of the other nodes, and those that only
listen are behind.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Generic, TypeVar

from sparseskin.messages import Message
from sparseskin.messages.base import array_fields
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import Clock, ManualClock
from sparseskin.nodes.graph import NodeSpecs
from sparseskin.nodes.node import Tick
from sparseskin.nodes.node_host import NodeHost

N_TOGETHER = 64
"""Frames that are handed to another thread together. Chosen: a thread that does the same work for
many frames in a row finds its code and data in the caches of its processor."""
MOST_BYTES = 1 << 22
"""Most bytes of these frames, for memory: of larger skins there are fewer."""
N_WAITING = 2
"""Most of these groups that wait between two threads. Chosen: few enough for memory."""
SWITCH_S = 2e-5
"""Time after which a thread of Python gives way to another one that waits, seconds. Chosen: after
each loop without the lock of the interpreter, the solver waits for it that long. By default it is
5 ms, many frames."""
LOOK_S = 0.1
"""Time after which a thread that waits looks whether the others still run, seconds."""

Item = TypeVar("Item")


class Handover(Generic[Item]):
    """A queue between two threads. Neither side waits once `stopped` is set."""

    def __init__(self, stopped: threading.Event) -> None:
        self._stopped = stopped
        #: Items that are handed over together.
        self.n_together = N_TOGETHER
        #: Groups of items; an empty one is the end.
        self._groups: queue.Queue[list[Item]] = queue.Queue(N_WAITING)
        self._group: list[Item] = []

    def give(self, item: Item) -> None:
        """Append an item, when there is room; it is handed over with those that follow."""
        self._group.append(item)
        if len(self._group) >= self.n_together:
            self._hand_over()

    def end(self) -> None:
        """Hand over what is left, and the end."""
        if self._group:
            self._hand_over()
        self._hand_over()

    def items(self) -> Iterator[Item]:
        """Yield the items up to the end."""
        while not self._stopped.is_set():
            try:
                group = self._groups.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            if not group:
                return
            yield from group

    def _hand_over(self) -> None:
        group = self._group
        self._group = []
        while not self._stopped.is_set():
            try:
                self._groups.put(group, timeout=LOOK_S)
            except queue.Full:
                continue
            return


class Pipeline(Bus):
    """A bus for a graph of one source, whose frames have stamps of their own: the same messages in
    the same order, at the same times of the clock, and so the same results, bit for bit.

    The threads share one interpreter: they gain the time of the solver's loops, of compression and
    of checksums, which run without its lock. The clock follows the newest stamp. Nodes that publish
    nothing have one of their own, since they process a frame later.
    """

    def __init__(self, nodes: NodeSpecs) -> None:
        self._clock = ManualClock()
        self._clock_behind = ManualClock()
        self._listeners = set()
        for name, (cls, settings) in nodes.items():
            if not cls.outputs(settings):
                self._listeners.add(name)
        self._stopped = threading.Event()
        self._acquired: Handover[list[Message]] = Handover(self._stopped)
        self._delivered: Handover[tuple[int, list[Message]]] = Handover(self._stopped)
        self._threads: list[threading.Thread] = []
        self._error: Exception | None = None
        super().__init__(nodes, self._clock)

        # What the nodes published at their start has reached all of them.
        self._readers_behind: dict[str, list[NodeHost]] = {}
        for topic, readers in self._readers.items():
            ahead = [host for host in readers if host.outputs]
            behind = [host for host in readers if not host.outputs]
            self._readers[topic] = ahead
            self._readers_behind[topic] = behind

    def frames(self, n_frames: int | None = None) -> Iterator[list[Message]]:
        """As of `Bus`, all frames of the source; at the end every node has processed them."""
        (source,) = [host for host in self.hosts.values() if host.is_source]
        for work in (partial(self._acquire, source), self._follow):
            # A daemon: a process that is interrupted does not wait for it.
            guarded = partial(self._guard, work)
            thread = threading.Thread(target=guarded, daemon=True)
            self._threads.append(thread)
            thread.start()

        with _switching_soon():
            for messages in self._acquired.items():
                # This thread is the middle one: the solver works here.
                delivered = self._deliver(messages)
                # What listeners process later is processed at the time of now.
                now_ns = self._clock.now_ns()
                self._delivered.give((now_ns, delivered))
                _advance(self._clock, _newest_ns(delivered))
                yield delivered
            self._delivered.end()
        # What listeners write, as a recording, is complete only then.
        for thread in self._threads:
            thread.join()
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join()
        super().close()

    def _clock_of(self, name: str) -> Clock:
        if name in self._listeners:
            return self._clock_behind
        return self._clock

    def _acquire(self, source: NodeHost) -> None:
        """Let the source acquire its frames, and end its stream."""
        stamp_ns = -1
        newest_ns = 0
        index = 0
        while not source.finished and not self._stopped.is_set():
            # Stamps increase, also where a frame brings no message.
            stamp_ns = max(newest_ns, stamp_ns + 1)
            # Read whole before they are handed over: the source is used in this thread alone.
            messages = list(source.tick(Tick(stamp_ns, index)))
            newest_ns = max(newest_ns, _newest_ns(messages))
            if not index:
                self._size_groups(messages)
            index += 1
            self._acquired.give(messages)
        self._acquired.end()

    def _size_groups(self, messages: list[Message]) -> None:
        """Set how many frames like the first one are handed over together."""
        n_bytes = sum(map(_n_bytes, messages))
        n_together = min(N_TOGETHER, MOST_BYTES // max(n_bytes, 1))
        self._acquired.n_together = n_together
        self._delivered.n_together = n_together

    def _follow(self) -> None:
        """Let the listeners process what was delivered to them."""
        for now_ns, messages in self._delivered.items():
            _advance(self._clock_behind, now_ns)
            for message in messages:
                for reader in self._readers_behind.get(message.topic, ()):
                    # It publishes nothing, but is a generator.
                    for _ in reader.receive(message):
                        pass

    def _guard(self, work: Callable[[], None]) -> None:
        """Do the work of a thread; an error of it ends the others, and is raised by `frames`."""
        try:
            work()
        except Exception as error:
            # Kept, since an exception of a thread would only be printed.
            self._error = error
            self._stopped.set()


@contextmanager
def _switching_soon() -> Iterator[None]:
    """Let threads give way to each other after `SWITCH_S`."""
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(usual_s)


def _n_bytes(message: Message) -> int:
    """Bytes of the arrays of a message."""
    arrays = [getattr(message, name) for name in array_fields(type(message))]
    return sum(array.nbytes for array in arrays if array is not None)


def _newest_ns(messages: list[Message]) -> int:
    """The newest stamp of messages, 0 of none."""
    return max((message.stamp_ns for message in messages), default=0)


def _advance(clock: ManualClock, to_ns: int) -> None:
    """Let a clock move on to a time, if that is later."""
    clock.advance(max(0, to_ns - clock.now_ns()))
