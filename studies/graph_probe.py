"""A reader beside a graph that runs: which frames came, and when."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zmq

from sparseskin.messages import Message, MessageError, decode
from sparseskin.nodes.clock import SystemClock
from sparseskin.nodes.keys import read_key_pair
from sparseskin.nodes.sockets import Reader, make_context

from .graph_run import GraphRun, wait_until

POLL_MS = 20
FRESH_NS = 500_000_000


@dataclass(frozen=True)
class Seen:
    """One message that came: its publisher's run and number, its frame, its arrival."""

    run_id: str
    seq: int
    stamp_ns: int
    came_ns: int


class Probe:
    """Notes each message of some topics as it comes, in a thread of its own.

    Parameters
    ----------
    graph : GraphRun
        The graph, which is ready.
    schemas : iterable of str
        Topics of its one patch: "taxels", "reconstruction".

    Attributes
    ----------
    clock : SystemClock
        The graph's clock.
    """

    def __init__(self, graph: GraphRun, schemas: Iterable[str] = ("reconstruction",)) -> None:
        note = graph.note()
        self.clock = SystemClock(note["offset_ns"])
        topics = [f"/skin/{schema}" for schema in schemas]
        writers = [
            (node["endpoint"], node["key"])
            for node in note["nodes"].values()
            if any(topic in node["outputs"] for topic in topics)
        ]
        keys = read_key_pair(Path(note["key_file"])) if note["key_file"] else None
        self._context = make_context()
        self._reader = Reader(self._context, "probe", (), topics, present=False, keys=keys)
        for endpoint, key in writers:
            self._reader.connect(endpoint, key)
        self._seen: dict[str, list[Seen]] = {schema: [] for schema in schemas}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name="probe", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _type: type[BaseException] | None,
        _error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        self._closing.set()
        self._thread.join()
        self._context.destroy(linger=0)

    def seen(self, schema: str = "reconstruction") -> list[Seen]:
        """All that came so far, in order."""
        return list(self._seen[schema])

    def stamps(self, schema: str) -> set[int]:
        """The frames that came so far."""
        return {seen.stamp_ns for seen in self.seen(schema)}

    def lost(self, since_ns: int) -> tuple[int, int]:
        """Frames sensed since a time and not restored, and frames sensed; up to the newest that
        was restored: those that come after it may be under way still.
        """
        restored = self.stamps("reconstruction")
        until_ns = max(restored, default=0)
        sensed = {stamp for stamp in self.stamps("taxels") if since_ns < stamp <= until_ns}
        return len(sensed - restored), len(sensed)

    def wait_for_frame(self, after_ns: int, schema: str = "reconstruction") -> int:
        """Wait for a frame that was acquired after a time, and return when it came."""
        found: list[Seen] = []

        def has_come() -> bool:
            newest = self._seen[schema][-1:]
            found[:] = [seen for seen in newest if seen.stamp_ns > after_ns]
            return bool(found)

        wait_until(has_come, f"a {schema} of a frame acquired after the fault")
        first = found[0]
        for seen in reversed(self.seen(schema)):  # the newest may have come a little later
            if seen.stamp_ns <= after_ns:
                break
            first = seen
        return first.came_ns

    def wait_for_fresh(self, after_ns: int, schema: str = "reconstruction") -> int:
        """As `wait_for_frame`, but for a frame that comes within `FRESH_NS` of its acquisition, so
        that no older ones are waiting any more.
        """
        found: list[Seen] = []

        def has_come() -> bool:
            newest = self._seen[schema][-1:]
            found[:] = [s for s in newest if s.stamp_ns > max(after_ns, s.came_ns - FRESH_NS)]
            return bool(found)

        what = f"a {schema} that is less than {FRESH_NS / 1e6:g} ms old"
        wait_until(has_come, what)
        return found[0].came_ns

    def _read(self) -> None:
        poller = zmq.Poller()
        poller.register(self._reader.socket, zmq.POLLIN)
        while not self._closing.is_set():
            poller.poll(POLL_MS)
            while (parts := self._reader.receive()) is not None:
                message = _decoded(*parts)
                if message is not None and message.schema in self._seen:
                    seen = Seen(message.run_id, message.seq, message.stamp_ns, self.clock.now_ns())
                    self._seen[message.schema].append(seen)


def _decoded(topic: bytes, payload: bytes) -> Message | Any:
    try:
        return decode(topic, payload)
    except MessageError:
        return None
