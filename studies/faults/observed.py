"""The graph to which faults are done, with a probe that notes which frames came, and when."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import zmq

from sparseskin.messages import MessageError, decode
from sparseskin.nodes.clock import SystemClock
from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.network.keys import read_key_pair
from sparseskin.nodes.network.sockets import Reader, make_context
from sparseskin.studies.graph_run import GraphRun, launch_text, wait_until

RATE_HZ = 100.0
FRESH_NS = 500_000_000
"""Age at which a frame that comes is one that did not wait for older ones."""
_POLL_MS = 20
_SENSED, _RECONSTRUCTED = "/skin/taxels", "/skin/reconstruction"


def graph_text(graph: Mapping[str, Any] | None = None, **changed: Mapping[str, Any]) -> str:
    """The launch file, with changed settings of the graph and of nodes by name; None: left out.

    Faults follow each other within the restart window, and each is to count as the first.
    """
    nodes: dict[str, dict[str, Any]] = {
        "sensor": {"source": "scene:path_40", "rate_hz": RATE_HZ},
        "compressor": {"rows": FIXED},
        "reconstructor": {"preset": "skin"},
        "monitor": {"page": False},
    }
    nodes = {name: {**settings, **changed.get(name, {})} for name, settings in nodes.items()}
    restarts = {"restart": "on-failure", "restart_window_s": 1}
    return launch_text(nodes, {**restarts, **(graph or {})})


class Seen(NamedTuple):
    """Stamp of a frame and time of its arrival, ns on the graph's clock."""

    stamp_ns: int
    came_ns: int


class Probe:
    """Notes each frame of the patch "skin" that is acquired or reconstructed, in a thread.

    Parameters
    ----------
    graph : GraphRun
        The graph, which is ready.

    Attributes
    ----------
    sensed, reconstructed : list of Seen
        Frames that have come so far, in order.
    """

    def __init__(self, graph: GraphRun) -> None:
        note = graph.note()
        self._clock = SystemClock(note["offset_ns"])
        self.sensed: list[Seen] = []
        self.reconstructed: list[Seen] = []
        self._seen = {_SENSED: self.sensed, _RECONSTRUCTED: self.reconstructed}
        keys = read_key_pair(Path(note["key_file"])) if note["key_file"] else None
        self._context = make_context()
        topics = list(self._seen)
        self._reader = Reader(self._context, "probe", (), topics, present=False, keys=keys)
        for node in note["nodes"].values():
            if any(topic in node["outputs"] for topic in topics):
                self._reader.connect(node["endpoint"], node["key"])
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name="probe", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        self._context.destroy(linger=0)

    def now_ns(self) -> int:
        """Time on the graph's clock."""
        return self._clock.now_ns()

    def lost(self, since_ns: int) -> tuple[int, int]:
        """Frames acquired since a time and not reconstructed, and frames acquired; from the first
        whose reconstruction came, as that subscription may begin after the other, up to the newest
        that was reconstructed, for later ones may still be on their way.
        """
        done = {seen.stamp_ns for seen in list(self.reconstructed)}
        until_ns = max(done, default=0)
        since_ns = max(since_ns, min(done, default=0) - 1)
        sensed = {seen.stamp_ns for seen in list(self.sensed)}
        sensed = {stamp_ns for stamp_ns in sensed if since_ns < stamp_ns <= until_ns}
        return len(sensed - done), len(sensed)

    def wait_for_frame(self, after_ns: int | None = None, max_age_ns: float = FRESH_NS) -> float:
        """Wait for the reconstruction of a frame acquired after a time, by default now, that is no
        older than `max_age_ns` as it comes; the seconds from that time until it came.
        """
        begin_ns = self.now_ns() if after_ns is None else after_ns
        found: list[Seen] = []

        def has_come() -> bool:
            for seen in reversed(list(self.reconstructed)):
                if seen.stamp_ns <= begin_ns:
                    break
                if seen.came_ns - seen.stamp_ns < max_age_ns:
                    found[:] = [seen]
            return bool(found)

        wait_until(has_come, "the reconstruction of a frame acquired after the fault")
        return (found[0].came_ns - begin_ns) / 1e9

    def _read(self) -> None:
        poller = zmq.Poller()
        poller.register(self._reader.socket, zmq.POLLIN)
        while not self._closing.is_set():
            poller.poll(_POLL_MS)
            while (parts := self._reader.receive()) is not None:
                try:
                    message = decode(*parts)
                except MessageError:
                    continue
                if message.topic in self._seen:
                    self._seen[message.topic].append(Seen(message.stamp_ns, self.now_ns()))


class ObservedGraph(GraphRun):
    """A graph with a probe beside it; arguments as those of `GraphRun`."""

    def __init__(self, launch: str, *arguments: str, **options: Any) -> None:
        super().__init__(launch, *arguments, **options)
        self.probe = self.stack.enter_context(Probe(self))
        self.begin()

    def begin(self) -> None:
        """Observe from now on: frames that are lost, nodes that stop."""
        self.began_ns, self._before = self.probe.now_ns(), self.nodes()

    def row(self, finding: str, *but: str, recover_s: float | None = None) -> dict[str, Any]:
        """End the graph; the row of a fault: what was lost and what stopped, except nodes named."""
        lost, n_sensed = self.probe.lost(self.began_ns)
        stopped = self.stopped(self._before, *but)
        self.end()
        return row_of(finding, self.left_behind(), recover_s, lost, n_sensed, stopped)


def row_of(
    finding: str,
    left: list[str],
    recover_s: float | None = None,
    lost: int = 0,
    of: int | None = None,
    stopped: list[str] | None = None,
) -> dict[str, Any]:
    """One line of the table of faults: `finding` is free text, `of` the frames acquired."""
    return {
        "recover_s": [] if recover_s is None else [round(recover_s, 4)],
        "lost": lost,
        "of": of,
        "stopped": stopped or [],
        "left": left,
        "told": finding,
    }
