"""What the monitor knows just now, for those who look on: one thread writes, many read."""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Message, Reconstruction, Resultant, SkinState, Taxels, Truth

from .history import History
from .metrics import Judged

MAX_ANSWERS = 64
STALE_S = 0.2
"""Data older than this is stale."""
Floats = npt.NDArray[np.float32]


@dataclass
class PatchFeed:
    """One patch: its newest maps, each with the time at which it came, and its history.

    `maps` are those of one frame, as long as frames are restored, with the `resultant` of the
    same frame where it is told; where they are not, the newest of each.
    """

    skin: SkinState | None = None
    maps: dict[str, Floats] = field(default_factory=dict)
    resultant: Resultant | None = None
    came_s: dict[str, float] = field(default_factory=dict)
    n_maps: int = 0
    history: History = field(default_factory=History)
    summary: dict[str, Any] = field(default_factory=dict)
    lost: int = 0
    latency_s: float = 0.0
    ended: bool = False

    @property
    def stale_s(self) -> float:
        """The age beyond which maps are stale."""
        rate_hz = self.skin.rate_hz if self.skin is not None else 0.0
        # A skin that is read less often than that is not stale between two frames.
        return max(STALE_S, 2.5 / rate_hz) if rate_hz else STALE_S


class Feed:
    """Newest state of all patches, of the graph, and answers to requests.

    Whoever reads holds `changed`, a condition, while it does. It is notified of answers and of
    the end; of frames only while somebody is `hungry`, due for one and without: at 1 kHz and
    with many readers each would be woken a thousand times a second for nothing.

    Parameters
    ----------
    patches : iterable of str
        Names of the patches.
    """

    def __init__(self, patches: tuple[str, ...]) -> None:
        self.changed = threading.Condition()
        self.patches = {patch: PatchFeed() for patch in patches}
        self.graph: dict[str, Any] | None = None
        self.graph_came_s = self.pulse_s = time.monotonic()
        self.answers: deque[tuple[int, dict[str, Any]]] = deque(maxlen=MAX_ANSWERS)
        self.n_answers = 0
        self.closed = False
        self.run = secrets.token_hex(4)
        self.hungry = 0

    def frame(
        self, patch: str, message: Message, judged: Judged | None, latency_ns: int | None = None
    ) -> None:
        """Take in a message of a patch, the frame that it completes, and the newest latency."""
        now_s = time.monotonic()
        feed = self.patches[patch]
        with self.changed:
            if isinstance(message, SkinState):
                feed.skin = message
                feed.maps.clear()
                feed.resultant = None
            elif latency_ns is not None:
                feed.latency_s = latency_ns / 1e9
            if judged is None:
                self._note_alone(feed, message, now_s)
                return
            feed.maps = {"taxels": judged.taxels.forces, "restored": judged.reconstruction.forces}
            if judged.truth is not None:
                feed.maps["truth"] = judged.truth.forces
            feed.resultant = judged.resultant
            feed.came_s.update(dict.fromkeys(feed.maps, now_s))
            feed.n_maps += 1
            feed.lost = judged.lost
            feed.ended = False
            feed.history.add(
                now_s,
                judged.psnr_noisy_db,
                judged.psnr_db,
                judged.latency_ms,
                judged.solve_ms,
                judged.lost,
            )
            self._feed_hungry()

    @property
    def paused(self) -> bool:
        """Whether all sources were told to wait."""
        nodes = (self.graph or {}).get("nodes", [])
        sources = [node["state"].get("paused") for node in nodes if "pause" in node["commands"]]
        return bool(sources) and all(sources)

    def pulse(self) -> None:
        """The monitor's own loop is alive."""
        self.pulse_s = time.monotonic()

    def _note_alone(self, feed: PatchFeed, message: Message, now_s: float) -> None:
        """Show what comes alone, where no whole frame has come for a while: what the taxels read
        while nothing is restored, and what is restored so late that its taxels are forgotten.
        """
        if not isinstance(message, Taxels | Truth | Reconstruction):
            return
        name = "restored" if isinstance(message, Reconstruction) else message.schema
        if now_s - feed.came_s.get("restored", -math.inf) > feed.stale_s:
            feed.maps = {**feed.maps, name: message.forces}
            feed.resultant = None
            feed.came_s[name] = now_s
            feed.n_maps += 1
            self._feed_hungry()

    def tell(
        self,
        *,
        summaries: dict[str, dict[str, Any]] | None = None,
        graph: dict[str, Any] | None = None,
        answer: dict[str, Any] | None = None,
        ended: str | None = None,
        closed: bool = False,
    ) -> None:
        """Take in what is not a frame: summaries by patch, the graph, an answer, an end."""
        with self.changed:
            for patch, summary in (summaries or {}).items():
                self.patches[patch].summary = summary
            if graph is not None:
                was_paused, now_s = self.paused, time.monotonic()
                self.graph, self.graph_came_s = graph, now_s
                if was_paused and not self.paused:
                    for feed in self.patches.values():  # no frame could have come until now
                        feed.came_s = dict.fromkeys(feed.came_s, now_s)
            if answer is not None:
                self.n_answers += 1
                self.answers.append((self.n_answers, answer))
            if ended is not None:
                self.patches[ended].ended = True
                self.patches[ended].lost = self.patches[ended].summary["frames"]["lost"]
            self.closed = self.closed or closed
            if answer is not None or closed:
                self.changed.notify_all()

    def _feed_hungry(self) -> None:
        if self.hungry:
            self.changed.notify_all()
