"""Newest state of the monitor for pages and screen: one thread writes, many read."""

import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from sparseskin.messages import (
    Contacts,
    Labels,
    Measurements,
    Message,
    Reconstruction,
    SkinState,
    Taxels,
    Truth,
)
from sparseskin.messages.contacts import EVENTS
from sparseskin.messages.frames import known_forces
from sparseskin.nodes.monitor.metrics import FrameMetrics
from sparseskin.nodes.monitor.statistics import COLUMNS, History
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.process.control import Document

MAX_ANSWERS = 64
"""Answers to requests that are kept for pages."""
UNTRUSTED_S = 0.5
"""Time in seconds for which a frame that is not to be trusted is marked at least: as long as a
person needs to see it. Chosen."""
N_MEASURED = 16
"""Frames whose measurements are kept until they are reconstructed; of a longer queue, no page shows
any."""
STALE_S = 0.2
"""Age in seconds beyond which maps are stale."""


@dataclass(frozen=True)
class Start:
    """How far a graph is that starts: parts that are done, and all."""

    done: int
    of: int
    compiles: bool

    @property
    def text(self) -> str:
        """For a person, in a line."""
        if self.compiles:
            return f"starting: compiling once for this installation, {self.done} of {self.of}"
        return f"starting: {self.done} of {self.of} nodes"

    @classmethod
    def of_nodes(cls, nodes: Sequence[Mapping[str, Any]]) -> Self | None:
        """The start of nodes as the state of a graph lists them; None once none is starting."""
        waiting = [node for node in nodes if node["condition"] == "starting"]
        if not waiting:
            return None
        # Nodes are ready together; until then, those that compile are waited for.
        counts = [node["compiled"] for node in waiting if node["compiled"]]
        if counts:
            n_done = sum(done for done, _ in counts)
            n_all = sum(of for _, of in counts)
            return cls(n_done, n_all, compiles=True)
        n_done = len(nodes) - len(waiting)
        return cls(n_done, len(nodes), compiles=False)


@dataclass
class PatchFeed:
    """One patch: its newest maps, each with its time of arrival, and its history.

    While frames are reconstructed, `maps` are of one frame; otherwise they are the newest of
    each kind; NaN where a reading is missing. Their names are those of the schemas.
    `idle` is true while the newest frame was published as unchanged. `newest_trusted` is that of
    the newest reconstruction shown, `stamp_ns` too, `untrusted_s` the time of the last one not to
    be trusted, `reason` that of the last one. `measurements` are the newest ones, of frames that
    may still be under way. `contacts` are those of the newest frame, where they are published,
    `events` their events, a row for each frame with some: time, number of each kind. `label` is the
    newest one, where a node recognises, which came at `label_came_s`.
    """

    skin: SkinState | None = None
    maps: dict[str, Floats] = field(default_factory=dict)
    measurements: deque[Measurements] = field(
        default_factory=lambda: deque(maxlen=N_MEASURED)
    )
    contacts: Contacts | None = None
    label: Labels | None = None
    label_came_s: float = -math.inf
    events: History = field(default_factory=lambda: History(("time_s", *EVENTS)))
    stamp_ns: int = 0
    came_s: dict[str, float] = field(default_factory=dict)
    n_maps: int = 0
    history: History = field(default_factory=History)
    summary: Document = field(default_factory=dict)
    lost: int = 0
    latency_s: float = 0.0
    ended: bool = False
    newest_trusted: bool = True
    untrusted_s: float = -math.inf
    reason: str = ""
    idle: bool = False

    @property
    def stale_s(self) -> float:
        """Age in seconds beyond which maps are stale: at least 2.5 periods of the skin."""
        if self.skin is None or not self.skin.rate_hz:
            return STALE_S
        return max(STALE_S, 2.5 / self.skin.rate_hz)

    def trusted(self, now_s: float) -> bool:
        """False while a reconstruction shown, or one just before it, is not to be trusted."""
        return self.newest_trusted and now_s - self.untrusted_s > UNTRUSTED_S

    def begin(self, skin: SkinState) -> None:
        """Forget what was shown of another skin."""
        self.skin = skin
        self.maps.clear()
        self.measurements.clear()
        self.contacts = None
        self.label = None
        self.newest_trusted = True
        self.untrusted_s = -math.inf

    def note(self, reconstruction: Reconstruction, now_s: float) -> None:
        """Note which reconstruction is shown, and if it is to be trusted."""
        self.stamp_ns = reconstruction.stamp_ns
        self.newest_trusted = reconstruction.trusted[0]
        if not self.newest_trusted:
            self.untrusted_s = now_s
            self.reason = reconstruction.reason[0]


class Feed:
    """Newest state of all patches, of the graph, and answers to requests.

    Readers hold the condition `changed`. It is notified of answers and of the end, and of frames
    only while a reader waits for one (`n_waiting`): at 1 kHz, each of many readers would be woken
    a thousand times a second for nothing.
    """

    def __init__(
        self,
        patches: tuple[str, ...],
        poses: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        self.changed = threading.Condition()
        self.poses = poses or {}
        self.patches = {patch: PatchFeed() for patch in patches}
        self.graph: Document | None = None
        #: The start of the graph, until all its nodes run for the first time; None after it.
        self.start: Start | None = None
        self._has_started = False
        now_s = time.monotonic()
        self.graph_came_s = now_s
        self.pulse_s = now_s
        self.answers: deque[tuple[int, Document]] = deque(maxlen=MAX_ANSWERS)
        self.n_answers = 0
        self.closed = False
        self.run = secrets.token_hex(4)
        self.n_waiting = 0

    def frame(
        self,
        patch: str,
        message: Message,
        complete: FrameMetrics | None,
        latency_ns: int | None = None,
    ) -> None:
        """Add a message of a patch, the frame that it completes, and the newest latency."""
        now_s = time.monotonic()
        feed = self.patches[patch]
        with self.changed:
            # Latency of a state would be its age.
            if isinstance(message, SkinState):
                feed.begin(message)
            elif latency_ns is not None:
                feed.latency_s = latency_ns / 1e9

            if isinstance(message, Measurements):
                feed.measurements.append(message)
            if isinstance(message, Labels):
                feed.label = message
                feed.label_came_s = now_s
            elif isinstance(message, Contacts):
                self._add_contacts(feed, message, now_s)
            elif complete is None:
                self._add_unpaired(feed, message, now_s)
            else:
                self._add_frame(feed, complete, now_s)

    def _add_contacts(self, feed: PatchFeed, contacts: Contacts, now_s: float) -> None:
        feed.contacts = contacts
        if contacts.events is not None:
            # One row for the frame, with the number of each kind.
            kinds = contacts.events[:, 2]
            counts = np.bincount(kinds, minlength=len(EVENTS))
            feed.events.add(now_s, *counts.tolist())
        # Earlier ones are shown with the frame that they belong to.
        if contacts.stamp_ns == feed.stamp_ns:
            self._show(feed)

    def _add_frame(self, feed: PatchFeed, frame: FrameMetrics, now_s: float) -> None:
        messages = (frame.taxels, frame.reconstruction, frame.truth)
        feed.maps = {}
        for each in messages:
            if each is not None:
                feed.maps[each.schema] = known_forces(each)
        if frame.reconstruction is not None:
            feed.idle = frame.reconstruction.unchanged[0]
            feed.note(frame.reconstruction, now_s)
        # A map that is of no later frame keeps its age.
        feed.came_s.update(dict.fromkeys(feed.maps, now_s))
        feed.lost = frame.lost_so_far
        feed.ended = False
        # The first column is the time, the last one the losses so far.
        figures = [getattr(frame, name) for name in COLUMNS[1:-1]]
        figures.append(frame.lost_so_far)
        feed.history.add(now_s, *figures)
        self._show(feed)

    @property
    def paused(self) -> bool:
        """True if all sources are paused."""
        nodes = (self.graph or {}).get("nodes", [])
        # Only sources can be paused: the others wait for them.
        sources = [node for node in nodes if "pause" in node["commands"]]
        if not sources:
            return False
        return all(node["state"].get("paused") for node in sources)

    def pulse(self) -> None:
        """Note that the monitor's own loop is alive."""
        self.pulse_s = time.monotonic()

    def _add_unpaired(self, feed: PatchFeed, message: Message, now_s: float) -> None:
        """Show a map without the rest of its frame, if no frame was complete for a while."""
        if not isinstance(message, Taxels | Truth | Reconstruction):
            return
        # A frame that will be complete is shown whole.
        came_s = feed.came_s.get(Reconstruction.schema, -math.inf)
        if now_s - came_s > feed.stale_s:
            # A new table: pages that are being sent the old one read it on.
            feed.maps = dict(feed.maps)
            feed.maps[message.schema] = known_forces(message)
            if isinstance(message, Reconstruction):
                feed.note(message, now_s)
            feed.came_s[message.schema] = now_s
            self._show(feed)

    def update(
        self,
        *,
        summaries: dict[str, Document] | None = None,
        graph: Document | None = None,
        answer: Document | None = None,
        ended: str | None = None,
        closed: bool = False,
    ) -> None:
        """Add summaries by patch, the graph's state, an answer, the end of a patch or of all."""
        with self.changed:
            for patch, summary in (summaries or {}).items():
                self.patches[patch].summary = summary
            if graph is not None:
                self._set_graph(graph)
            if answer is not None:
                self.n_answers += 1
                self.answers.append((self.n_answers, answer))
            if ended is not None:
                feed = self.patches[ended]
                feed.ended = True
                feed.lost = feed.summary["frames"]["lost"]
            self.closed = self.closed or closed
            # A page waits for these even where it shows no frame.
            if answer is not None or closed:
                self.changed.notify_all()

    def _set_graph(self, graph: Document) -> None:
        # By the state before this one.
        was_paused = self.paused
        now_s = time.monotonic()
        self.graph = graph
        self.graph_came_s = now_s
        # A node that is started again is no start of the graph.
        self.start = None
        if not self._has_started:
            self.start = Start.of_nodes(graph["nodes"])
        self._has_started = self.start is None
        if was_paused and not self.paused:
            # No frame could have come until now.
            for feed in self.patches.values():
                feed.came_s = dict.fromkeys(feed.came_s, now_s)

    def _show(self, feed: PatchFeed) -> None:
        """Offer what is new to readers; where contacts are published, with those of its frame."""
        feed.n_maps += 1
        is_whole = feed.contacts is None or feed.contacts.stamp_ns == feed.stamp_ns
        if self.n_waiting and is_whole:
            self.changed.notify_all()
