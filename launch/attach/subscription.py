"""Messages of a topic of a running graph, for a program with a loop of its own."""

import contextlib
import math
import time
from collections import deque
from typing import Self

from sparseskin.launch.run.running import choose_graph
from sparseskin.messages import Message, MessageError, decode
from sparseskin.messages.ranges import is_real
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.network.sockets import QUEUE_FRAMES

from .client import find_topic
from .stream import DRAIN_MS, POLL_MS, Arrival, Losses, TopicStream

FULL_QUEUES = 4
"""Most queues of messages that are skipped at once for the newest one: a fast topic has no end."""
MAX_TIMEOUT_S = 1e6
"""Longest `timeout_s`, seconds; chosen: beyond any wait that is meant."""


class Subscription:
    """The messages of a topic of a running graph, an iterator: what `subscribe` returns.

    It reads as `sparseskin topic echo` does: no node waits for it. Use it in one thread, by `for`
    or by `async for`; leave it by `with` or `async with`, or call `close`. It ends with the stream
    or with the graph.

    Attributes
    ----------
    topic : str
        Name of the topic, /PATCH/SCHEMA.
    graph : str
        Label of the graph, NAME-PID.
    skipped : int
        Number of messages that were skipped because newer ones came, with `newest`; else 0.
    lost : int
        Number of messages that did not arrive, since more than 2000 waited; 0 with `newest`. Both
        numbers count from the first message on.
    unreadable : int
        Number of messages that were left out, since they were malformed.
    age_s : float
        Time from the acquisition of the last message's frame until the message was taken, seconds;
        NaN before the first one.
    """

    def __init__(
        self,
        topic: str,
        *,
        graph: str | None = None,
        newest: bool = False,
        timeout_s: float | None = None,
    ) -> None:
        # Arguments are checked before anything is connected.
        if not isinstance(topic, str):
            raise SettingsError(
                f"subscribe: topic = {topic!r} is not allowed; allowed: a text"
            )
        if timeout_s is not None and not is_real(timeout_s, 0.0, MAX_TIMEOUT_S):
            raise SettingsError(
                f"subscribe: timeout_s = {timeout_s!r} is not allowed; allowed: 0 to "
                f"{MAX_TIMEOUT_S:g} seconds, or None"
            )
        # Waits for a graph that is starting.
        running = choose_graph(graph, option="graph")

        # Public: see the docstring.
        self.topic = find_topic(running, topic)
        self.graph = running.label
        self.age_s = math.nan
        self._newest = bool(newest)
        self._timeout_s = math.inf
        if timeout_s is not None:
            self._timeout_s = float(timeout_s)
        self._stream = TopicStream(running, self.topic)
        self._losses = Losses()
        self._malformed = 0
        self._arrivals: deque[Arrival] = deque()
        self._ended = False

    def __repr__(self) -> str:
        kind = "messages"
        if self._newest:
            kind = "newest messages"
        return f"<Subscription to {kind} of {self.topic} of {self.graph}>"

    @property
    def skipped(self) -> int:
        if not self._newest:
            return 0
        return self._losses.n

    @property
    def lost(self) -> int:
        if self._newest:
            return 0
        return self._losses.n

    @property
    def unreadable(self) -> int:
        return self._malformed + self._stream.unreadable

    def close(self) -> None:
        """End the subscription; it may be called again."""
        self._ended = True
        self._arrivals.clear()
        self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Message:
        # Of each message anew.
        until_s = time.monotonic() + self._timeout_s
        message = self._take()
        while message is None:
            if self._ended:
                raise StopIteration
            self._stream.wait(self._wait_s(until_s))
            message = self._take()
        return message

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Message:
        import asyncio

        until_s = time.monotonic() + self._timeout_s
        # Other tasks run, too, where a message always waits.
        await asyncio.sleep(0)
        message = self._take()
        while message is None:
            if self._ended:
                raise StopAsyncIteration
            await self._readable(self._wait_s(until_s))
            message = self._take()
        return message

    async def _readable(self, wait_s: float) -> None:
        """Wait until something may have come, at most `wait_s` seconds."""
        import asyncio

        # The loop waits for ZeroMQ's descriptor: no thread is needed.
        loop = asyncio.get_running_loop()
        came = asyncio.Event()
        loop.add_reader(self._stream.descriptor, came.set)
        try:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(came.wait(), wait_s)
        finally:
            loop.remove_reader(self._stream.descriptor)

    def _wait_s(self, until_s: float) -> float:
        """Time to wait before the next look; raises TimeoutError if there is none."""
        left_s = until_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError(f"{self.topic}: no message within {self._timeout_s:g} s")
        return min(left_s, POLL_MS / 1e3)

    def _take(self) -> Message | None:
        """The next message that has come, or None; `_ended` is set where none will come."""
        while not self._ended:
            if not self._arrivals:
                self._receive()
            if not self._arrivals:
                return None

            arrival = self._arrivals.popleft()
            self._losses.add(arrival)
            if arrival.ends:
                self.close()
                return None

            try:
                message = decode(arrival.topic, arrival.payload)
            except MessageError:
                # A later one may be well-formed.
                self._malformed += 1
                continue

            self.age_s = (arrival.at_ns - arrival.stamp_ns) / 1e9
            return message
        return None

    def _receive(self) -> None:
        """Read what has come, and end where no more will."""
        # Looked at first: what the graph sent before its end is there then.
        has_ended = self._stream.graph_has_ended()
        arrivals = self._receive_newest() if self._newest else self._stream.read()
        self._arrivals.extend(arrivals)
        if has_ended and not arrivals:
            self.close()

    def _receive_newest(self) -> list[Arrival]:
        """Read what has come; return the newest message, and the end of the stream."""
        # ZeroMQ's CONFLATE is not used: it loses the last message of a stream that pauses, if that
        # comes while the one before is taken (libzmq 4.3.5).
        newest: list[Arrival] = []
        for _ in range(FULL_QUEUES):
            arrivals = self._stream.read()
            newest = _newest_of([*newest, *arrivals])
            # Of a full queue the others wait at the writer, and come now.
            if len(arrivals) < QUEUE_FRAMES:
                break
            self._stream.wait(DRAIN_MS / 1e3)
        return newest


def _newest_of(arrivals: list[Arrival]) -> list[Arrival]:
    """The last message, and the end of the stream, which replaces no message."""
    n_ends = sum(arrival.ends for arrival in arrivals)
    n_older = max(0, len(arrivals) - n_ends - 1)
    return arrivals[n_older:]


def subscribe(
    topic: str,
    *,
    graph: str | None = None,
    newest: bool = False,
    timeout_s: float | None = None,
) -> Subscription:
    """Read the messages of a topic of a graph that runs on this host.

    Parameters
    ----------
    topic : str
        Name of the topic, "/PATCH/SCHEMA", as `sparseskin topic list` prints it.
    graph : str, optional
        Name of the graph, as `sparseskin graph list` prints it; by default the only one. One that
        is starting is waited for, 30 s at most.
    newest : bool
        True: each message is the newest that has come, and older ones that were not taken are
        skipped. False: all messages in order, of which 2000 may wait.
    timeout_s : float, optional
        Longest wait for a message, seconds; 0: it is there or not. By default there is no limit.

    Returns
    -------
    Subscription
        An iterator of messages, also for `async for`. Arrays of a frame have the patches as their
        first axis: `message.forces[0]` is float32 (n_rows, n_cols), in the unit of the skin.

    Raises
    ------
    SparseskinError
        If no graph runs, several do and none is named, the graph has no such topic, its key may not
        be read, or an argument is not allowed.
    TimeoutError
        By `next` and by the loops, after `timeout_s` without a message; `next` can be called again.

    Examples
    --------
    With a graph started by ``sparseskin launch drag_wrench_40 --set reconstructor.contacts=true``::

        with sparseskin.subscribe("/skin/contacts", newest=True) as contacts:
            for message in contacts:
                print(message.total, message.trusted[0], contacts.age_s, contacts.skipped)
    """
    return Subscription(
        topic,
        graph=graph,
        newest=newest,
        timeout_s=timeout_s,
    )
