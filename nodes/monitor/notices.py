"""What is wrong with a graph, or out of the ordinary, in words."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

from .feed import Feed, PatchFeed

BAD, NOTE = "bad", "note"
RECENT_S = 4.0
"""How long something that happened is told."""
GRAPH_S = 2.5
PULSE_S = 1.0
LATE_S = 0.5
"""A latency beyond this is none of a solver, but of a queue that grows."""
TROUBLED = ("failed", "not answering", "restarting", "starting")

Notice = tuple[str, str]
"""Tone, "bad" or "note", and text."""


class Notices:
    """Tells what is wrong just now, and for a few seconds what went wrong a moment ago.

    Parameters
    ----------
    feed : Feed
        What the monitor knows; held by the caller while notices are asked for.
    """

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._seen: dict[str, deque[tuple[float, int]]] = {}

    def all(self, now_s: float) -> list[Notice]:
        """All notices, the worst of each kind first; `now_s` by time.monotonic()."""
        feed = self._feed
        found: list[Notice] = []
        if now_s - feed.pulse_s > PULSE_S:
            found.append((BAD, f"The monitor has been busy for {ago(now_s - feed.pulse_s)}."))
        if feed.graph is not None and now_s - feed.graph_came_s > GRAPH_S:
            found.append((BAD, f"No news of the nodes for {ago(now_s - feed.graph_came_s)}."))
        for node in (feed.graph or {}).get("nodes", []):
            found += self._of_node(node, now_s)
        for name, patch in feed.patches.items():
            prefix = f"{name}: " if len(feed.patches) > 1 else ""
            found += [(tone, prefix + text) for tone, text in self._of_patch(name, patch, now_s)]
        return found

    def _of_node(self, node: dict[str, Any], now_s: float) -> Iterator[Notice]:
        name, condition = node["name"], node["condition"]
        restarted = self._risen(f"restarts {name}", node["restarts"], now_s)
        if condition in TROUBLED:
            yield BAD, f"{name}: {condition}."
        elif restarted:
            yield NOTE, f"{name} was started again."
        if self._risen(f"refused {name}", node["refused"], now_s) and node["refusal"]:
            yield BAD, f"{name} refuses messages: {node['refusal']}"
        if node["said"]:
            yield NOTE, f"{name} says: {node['said']}"
        if condition == "paused":
            yield NOTE, f"{name} is paused."
        if node["state"].get("left_out"):
            yield NOTE, f"{name}: {node['state']['left_out']}."
        if node["state"].get("swamped"):
            yield BAD, f"{name}: too many measurements do not fit each other."

    def _of_patch(self, name: str, patch: PatchFeed, now_s: float) -> Iterator[Notice]:
        if patch.ended:
            yield NOTE, "the stream has ended."
        elif not self._feed.paused and patch.came_s:
            ages = {key: now_s - came_s for key, came_s in patch.came_s.items()}
            newest = min(ages.values())
            restored = ages.get("restored", math.inf)
            if newest > patch.stale_s:
                yield BAD, f"stale: no new frame for {ago(newest)}."
            elif math.isinf(restored):
                if patch.n_maps > 1:
                    yield BAD, "frames are sensed, none is restored."
            elif restored > patch.stale_s:
                yield BAD, f"stale: frames are sensed, none restored for {ago(restored)}."
        elif not self._feed.paused:
            yield NOTE, "no frame has come yet."
        if patch.latency_s > max(LATE_S, patch.stale_s) and not patch.ended:
            yield BAD, f"frames are restored {ago(patch.latency_s)} late: it cannot keep up."
        lost = self._risen(f"lost {name}", patch.lost, now_s)
        if lost:
            yield BAD, f"{lost} frames lost just now."

    def _risen(self, name: str, count: int, now_s: float) -> int:
        """By how much a count has risen within the last seconds."""
        seen = self._seen.setdefault(name, deque())
        if not seen or count != seen[-1][1]:
            if seen and count < seen[-1][1]:
                seen.clear()  # another run of the node counts from 0
            seen.append((now_s, count))
        # The last count from before the window stays: the rise begins there.
        while len(seen) > 1 and seen[1][0] <= now_s - RECENT_S:
            seen.popleft()
        return count - seen[0][1] if seen[-1][0] > now_s - RECENT_S else 0


def ago(seconds: float) -> str:
    """A time span for a person."""
    return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
